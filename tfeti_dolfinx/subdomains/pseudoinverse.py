"""Generalised inverses by the Schur complement on a few unknowns, and two choices of these."""

from __future__ import annotations

from bisect import bisect_left
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.factor import (
    REAL,
    CholeskyFactor,
    FactorSize,
    NotPositiveDefiniteError,
    as_petsc_matrix,
)
from tfeti_dolfinx.subdomains.inverse import FactoredInverse, lent

# Of the mean size of a motion: one that is less on the last unknowns leaves a pivot of 1e-8 before
# them, which counts as none.
NO_PIVOT = 1e-4


class SchurPseudoinverse(FactoredInverse):
    """K⁺ = [K_rr⁻¹, 0; 0, 0] + E S⁺ Eᵀ, E = [−K_rr⁻¹K_rs; I], S = K_ss − K_sr K_rr⁻¹ K_rs.

    s are the unknowns of the fixing nodes, r the others; K_rr has a Cholesky factor, since no
    motion of the kernel is 0 on s, and S⁺ is the pseudo-inverse of a small matrix whose kernel,
    that of K on s, is known. E S⁺ Eᵀ is kept as H Hᵀ. Of the rank of K, so K⁺ K K⁺ = K⁺
    (Brzobohatý, Dostál, Kozubek, Kovář, Markopoulos, IJNME 88, 2011).
    K_rr is not stored: K lends its own entries for as long as the factor is made.

    Args:
        K: Stiffness, CSR with sorted indices, shape ``(n, n)``. Its arrays are held.
        R: Kernel, shape ``(n, r)``; it may be another one, or none, after ``refactor``.
        fixing_dofs: Unknowns of the fixing nodes.
        prefix: Prefix of the factor's PETSc options.

    Attributes:
        unknowns: s.

    Raises:
        NotPositiveDefiniteError: K_rr has no Cholesky factor, or S is not semidefinite.
        FactorError: It could not be made for another reason.
    """

    def __init__(self, K: Any, R: Array, fixing_dofs: Array, prefix: str = "tfeti_sub_") -> None:
        self._K, self._fixing_dofs = K, fixing_dofs
        self.unknowns = self._chosen(R)
        with _apart(K, self.unknowns):
            self._factor = CholeskyFactor(K, prefix, keep=True)
        self._complete(R)

    def solve(self, b: Array) -> Array:
        """K⁺ b, shapes ``(n,)`` or ``(n, q)``."""
        b_r = np.array(b)
        b_r[self.unknowns] = 0.0
        return self._factor.solve(b_r) + self._H @ (self._H.T @ b)

    @property
    def size(self) -> FactorSize:
        """What the factor stores, and H, of which a sweep reads half."""
        factor = self._factor.size
        return FactorSize(factor.entries + self._H.size, factor.memory + REAL * self._H.size)

    def refactor(self, R: Array) -> None:
        """Follow new values of K in the same pattern; R is their kernel.

        Raises:
            NotPositiveDefiniteError: K_rr has no Cholesky factor, or S is not semidefinite.
            FactorError: It could not be made for another reason.
        """
        self.unknowns = self._chosen(R)
        with _apart(self._K, self.unknowns):
            self._factor.refactor()
        self._complete(R)

    def _chosen(self, R: Array) -> Array:
        """s for the present K."""
        return self._fixing_dofs

    def _complete(self, R: Array) -> None:
        """H with H Hᵀ = E S⁺ Eᵀ."""
        K_s = self._K[:, self.unknowns].toarray()
        K_rs = np.array(K_s)
        K_rs[self.unknowns] = 0.0
        E = -self._factor.solve(K_rs)
        S = K_s[self.unknowns] + K_rs.T @ E
        E[self.unknowns] += np.eye(len(self.unknowns))
        try:
            self._H = np.asarray(E @ _root_of_pseudoinverse(S, R[self.unknowns]))
        except NotPositiveDefiniteError:
            self.destroy()
            raise


class TrailingPseudoinverse(SchurPseudoinverse):
    """The same where s is what an elimination leaves when it meets its first zero pivot.

    The singular block at the end of a nested dissection, whose pseudo-inverse is found apart,
    as in LU with a singular value decomposition of the last block (Farhat, Géradin, IJNME 41,
    1998); the given fixing nodes are not looked at. s is found by the kernel instead of by the
    pivots: it has full rank on the unknowns that are left as long as these are not singular.
    """

    def _chosen(self, R: Array) -> Array:
        """The last unknowns, as few as hold the kernel."""
        if R.shape[1] == 0:
            return np.empty(0, dtype=np.int64)
        matrix = as_petsc_matrix(self._K)
        rows, columns = matrix.getOrdering(PETSc.Mat.OrderingType.ND)
        last = np.array(rows.indices[::-1], dtype=np.int64)
        for item in (rows, columns, matrix):
            item.destroy()
        counts = range(R.shape[1], len(last) + 1)
        found = bisect_left(counts, NO_PIVOT * _least(R), key=lambda q: _least(R[last[:q]]))
        return np.sort(last[: counts[found]])


def _least(R: Array) -> float:
    """Of all motions of the kernel, the least that moves some unknowns, in the mean."""
    return float(np.linalg.svd(R, compute_uv=False)[-1] / np.sqrt(len(R)))


def _root_of_pseudoinverse(S: Array, R: Array) -> Array:
    """T with T Tᵀ = S⁺, S semidefinite of kernel R; shape ``(s, s − r)``.

    Raises:
        NotPositiveDefiniteError: S has an eigenvalue that is not positive beside its kernel.
    """
    V = np.linalg.qr(R, mode="complete")[0][:, R.shape[1] :]
    values, vectors = np.linalg.eigh(V.T @ S @ V)
    if np.any(values <= 0.0):
        raise NotPositiveDefiniteError("the Schur complement on the fixing nodes is indefinite")
    return np.asarray(V @ (vectors / np.sqrt(values)))


def _apart(K: Any, s: Array) -> AbstractContextManager[None]:
    """diag(K_rr, diag K_ss) in the place of K, for a while."""
    in_s = np.zeros(K.shape[0], dtype=bool)
    in_s[s] = True
    row_of = np.repeat(np.arange(len(in_s), dtype=K.indices.dtype), np.diff(K.indptr))
    coupled = (in_s[row_of] | in_s[K.indices]) & (row_of != K.indices)
    return lent(K.data, np.flatnonzero(coupled), 0.0)
