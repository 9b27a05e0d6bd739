"""Sparse Cholesky factors by CHOLMOD, through PETSc."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array


class NotPositiveDefiniteError(ArithmeticError):
    """A matrix that should have a Cholesky factor has none."""


class CholeskyFactor:
    """A = L Lᵀ of a symmetric positive definite matrix on one rank.

    Args:
        A: scipy sparse matrix, both triangles, shape ``(n, n)``.

    Raises:
        NotPositiveDefiniteError: A is not positive definite.
    """

    def __init__(self, A: Any) -> None:
        A = A.tocsr()
        A.sort_indices()
        index = PETSc.IntType
        matrix = PETSc.Mat().createAIJWithArrays(
            A.shape,
            (A.indptr.astype(index), A.indices.astype(index), A.data),
            comm=PETSc.COMM_SELF,
        )
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        pc = PETSc.PC().create(PETSc.COMM_SELF)
        pc.setType(PETSc.PC.Type.CHOLESKY)
        pc.setFactorSolverType(PETSc.Mat.SolverType.CHOLMOD)
        pc.setOperators(matrix)
        self._b, self._x = matrix.createVecs()
        try:
            pc.setUp()
            self._factor = pc.getFactorMatrix()
            regular = bool(np.all(np.isfinite(self.solve(np.ones(A.shape[0])))))
        except PETSc.Error:
            regular = False
        finally:
            pc.destroy()
            matrix.destroy()
        if not regular:
            raise NotPositiveDefiniteError("CHOLMOD found no Cholesky factor")

    def solve(self, b: Array) -> Array:
        """A⁻¹ b, shape ``(n,)``."""
        self._b.array[:] = b
        self._factor.solve(self._b, self._x)
        return np.array(self._x.array_r)

    def destroy(self) -> None:
        """Free the factor."""
        for item in (self._b, self._x, self._factor):
            item.destroy()
