"""Generalised inverses by a Schur complement, and the table of all that an option names."""

from __future__ import annotations

from bisect import bisect_left
from typing import Any

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.subdomains.factor import (
    CholeskyFactor,
    NotPositiveDefiniteError,
    as_petsc_matrix,
)
from tfeti_dolfinx.subdomains.kplus import MakeInverse, regularised


class SchurPseudoinverse(CholeskyFactor):
    """K⁺ = [K_rr⁻¹, 0; 0, 0] + E S⁺ Eᵀ, E = [−K_rr⁻¹K_rs; I], S = K_ss − K_sr K_rr⁻¹ K_rs.

    s are the unknowns of the fixing nodes, r the others; K_rr has a Cholesky factor, since no
    motion of the kernel is 0 on s, and S⁺ is the pseudo-inverse of a small matrix whose kernel,
    that of K on s, is known. E S⁺ Eᵀ is kept as H Hᵀ. Of the rank of K, so K⁺ K K⁺ = K⁺
    (Brzobohatý, Dostál, Kozubek, Kovář, Markopoulos, IJNME 88, 2011).

    Args:
        K: Stiffness, scipy CSR, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        fixing_dofs: s.
        prefix: Prefix of the factor's PETSc options.

    Attributes:
        unknowns: s.

    Raises:
        NotPositiveDefiniteError: K_rr has no Cholesky factor, or S is not semidefinite.
    """

    def __init__(self, K: Any, R: Array, fixing_dofs: Array, prefix: str = "tfeti_sub_") -> None:
        s = self.unknowns = fixing_dofs
        # diag(K_rr, diag K_ss)
        apart = K.tocoo()
        in_s = np.isin(np.arange(K.shape[0]), s)
        row, column = apart.coords
        values = np.where((in_s[row] | in_s[column]) & (row != column), 0.0, apart.data)
        self._H = np.zeros((K.shape[0], 0))
        super().__init__(csr_array((values, (row, column)), shape=K.shape), prefix)
        # H with H Hᵀ = E S⁺ Eᵀ
        K_s = K[:, s].toarray()
        K_rs = np.array(K_s)
        K_rs[s] = 0.0
        E = -super().solve(K_rs)
        S = K_s[s] + K_rs.T @ E
        E[s] += np.eye(len(s))
        V = np.linalg.qr(R[s], mode="complete")[0][:, R.shape[1] :]
        energies, vectors = np.linalg.eigh(V.T @ S @ V)
        if np.any(energies <= 0.0):
            self.destroy()
            raise NotPositiveDefiniteError("the Schur complement on the fixing nodes is indefinite")
        self._H = np.asarray(E @ V @ (vectors / np.sqrt(energies)))

    def solve(self, b: Array) -> Array:
        """K⁺ b, shapes ``(n,)`` or ``(n, q)``."""
        b_r = np.array(b)
        b_r[self.unknowns] = 0.0
        return np.asarray(super().solve(b_r) + self._H @ (self._H.T @ b))

    @property
    def entries(self) -> float:
        """Entries of the factor, and half of H, of which a solve reads all once."""
        return super().entries + self._H.size / 2.0


def trailing_pseudoinverse(
    K: Any, R: Array, fixing_dofs: Array, prefix: str = "tfeti_sub_", no_pivot: float = 1e-4
) -> SchurPseudoinverse:
    """Make the pseudo-inverse with s what elimination leaves at its first zero pivot.

    The singular block at the end of a nested dissection, whose pseudo-inverse is found apart,
    as in LU with a singular value decomposition of the last block (Farhat, Géradin, IJNME 41,
    1998). s is found by the kernel instead of by the pivots: the last unknowns, as few as hold
    it: no motion is less than ``no_pivot`` of its mean size on them, which would leave a pivot of
    1e-8 before them. The given fixing unknowns are not looked at.
    """
    last: Array = np.empty(0, dtype=np.int64)
    if R.shape[1]:
        matrix = as_petsc_matrix(K)
        rows, columns = matrix.getOrdering(PETSc.Mat.OrderingType.ND)
        last = np.array(rows.indices[::-1], dtype=np.int64)
        for item in (rows, columns, matrix):
            item.destroy()
        counts = range(R.shape[1], len(last) + 1)
        found = bisect_left(counts, no_pivot, key=lambda q: _least(R[last[:q]]) / _least(R))
        last = np.sort(last[: counts[found]])
    return SchurPseudoinverse(K, R, last, prefix)


# the generalised inverses that an option names
KPLUS_TYPES: dict[str, MakeInverse] = {
    "regularized": regularised,
    "schur": SchurPseudoinverse,
    "lu_svd": trailing_pseudoinverse,
}


def _least(R: Array) -> float:
    """Return the least mean motion of some unknowns, over all unit motions of the kernel."""
    return float(np.linalg.svd(R, compute_uv=False)[-1] / np.sqrt(len(R)))
