"""Generalised inverses K⁺ of a subdomain."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.subdomains.block import Counters
from tfeti_dolfinx.subdomains.factor import (
    REAL,
    CholeskyFactor,
    FactoredInverse,
    FactorSize,
    GeneralisedInverse,
    NotPositiveDefiniteError,
    as_petsc_matrix,
    lent,
)

# --- Generalised inverses by a Schur complement -----------------------------------------------

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
        """Storage of the factor and of H, of which a sweep reads half."""
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
    """Schur pseudoinverse whose s are the unknowns left by elimination at its first zero pivot.

    The singular block at the end of a nested dissection, whose pseudo-inverse is found apart,
    as in LU with a singular value decomposition of the last block (Farhat, Géradin, IJNME 41,
    1998); the given fixing nodes are not looked at. s is found by the kernel instead of by the
    pivots: it has full rank on the unknowns that are left as long as these are not singular.
    """

    def _chosen(self, R: Array) -> Array:
        """Return the last unknowns, as few as hold the kernel."""
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
    """Return the least mean motion of some unknowns, over all unit motions of the kernel."""
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


# --- Choice of generalised inverse ------------------------------------------------------------

# of the largest entry of a kernel: rounding
STILL = 1e-8


class Regularised(FactoredInverse):
    """K_ρ⁻¹ with K_ρ = K + ρ Nᵀ(NNᵀ)⁻¹N, N the kernel on a few fixing unknowns, ρ = max diag K.

    An exact generalised inverse, because N R is regular
    (Brzobohatý, Dostál, Kozubek, Kovář, Markopoulos, IJNME 88, 2011, section 4). K_ρ is never
    stored: K lends its own entries for as long as the factor is made.

    Args:
        K: Stiffness, CSR with sorted indices and an entry, maybe 0, for each pair of fixing
            unknowns (see ``with_entries``), shape ``(n, n)``. Its arrays are held.
        R: Kernel, shape ``(n, r)``; without columns K itself is inverted.
        fixing_dofs: Unknowns of the fixing nodes.
        prefix: Prefix of the factor's PETSc options.

    Raises:
        NotPositiveDefiniteError: K_ρ has no Cholesky factor.
        FactorError: It could not be made for another reason.
    """

    def __init__(self, K: Any, R: Array, fixing_dofs: Array, prefix: str = "tfeti_sub_") -> None:
        self._K, self._fixing_dofs = K, fixing_dofs
        with _regular(K, R, fixing_dofs):
            self._factor = CholeskyFactor(K, prefix, keep=True)

    def refactor(self, R: Array) -> None:
        """Follow new values of K in the same pattern; R is their kernel.

        Raises:
            NotPositiveDefiniteError: K_ρ has no Cholesky factor.
            FactorError: It could not be made for another reason.
        """
        with _regular(self._K, R, self._fixing_dofs):
            self._factor.refactor()


def regularised(K: Any, R: Array, fixing_dofs: Array, prefix: str = "tfeti_sub_") -> CholeskyFactor:
    """K_ρ⁻¹ (see ``Regularised``) of a K that is not needed any more.

    Raises:
        NotPositiveDefiniteError: K_ρ has no Cholesky factor.
        FactorError: It could not be made for another reason.
    """
    return CholeskyFactor(regular_matrix(K, R, fixing_dofs), prefix)


def regular_matrix(K: Any, R: Array, fixing_dofs: Array) -> Any:
    """K_ρ, scipy CSR; K itself where R has no columns."""
    if R.shape[1] == 0:
        return K
    added = _projector(K, R, fixing_dofs).ravel()
    row, column = np.meshgrid(fixing_dofs, fixing_dofs, indexing="ij")
    return (K + coo_array((added, (row.ravel(), column.ravel())), shape=K.shape)).tocsr()


def with_entries(K: Any, dofs: Array) -> Any:
    """The same matrix in CSR with sorted indices and an entry, maybe 0, for each pair of dofs."""
    K.sort_indices()
    if np.all(_places(K, dofs) >= 0):
        return K
    entries = K.tocoo()
    row, column = (index.ravel() for index in np.meshgrid(dofs, dofs, indexing="ij"))
    rows, columns = (
        np.concatenate((old, new.astype(old.dtype)))
        for old, new in zip(entries.coords, (row, column), strict=True)
    )
    values = np.concatenate((entries.data, np.zeros(len(row))))
    return csr_array(coo_array((values, (rows, columns)), shape=K.shape))


def same_pattern(K: Any, other: Any) -> bool:
    """Return whether two CSR matrices store the same entries."""
    return np.array_equal(K.indptr, other.indptr) and np.array_equal(K.indices, other.indices)


def _projector(K: Any, R: Array, fixing_dofs: Array) -> Array:
    """ρ Nᵀ(NNᵀ)⁻¹N on the fixing unknowns; what moves in no motion may be far stiffer."""
    Q, _ = np.linalg.qr(R[fixing_dofs])
    moves = np.abs(R).max(axis=1) > STILL * np.abs(R).max()
    return np.asarray(K.diagonal()[moves].max() * (Q @ Q.T))


def _places(K: Any, dofs: Array) -> Array:
    """Return where the entries of each pair of dofs are stored, −1 where they are not."""
    number = csr_array((np.arange(1, K.nnz + 1), K.indices, K.indptr), shape=K.shape)
    return np.asarray(number[dofs][:, dofs].toarray()) - 1


def _regular(K: Any, R: Array, fixing_dofs: Array) -> AbstractContextManager[None]:
    """Return the values of K_ρ in the place of those of K, for a while."""
    places = _places(K, fixing_dofs)
    added = _projector(K, R, fixing_dofs) if R.shape[1] else 0.0
    return lent(K.data, places, K.data[places] + added)


# from K, its kernel, the unknowns of fixing nodes and a prefix of options to K⁺
MakeInverse = Callable[[Any, Array, Array, str], GeneralisedInverse]
KPLUS_TYPES: dict[str, MakeInverse] = {
    "regularized": Regularised,
    "schur": SchurPseudoinverse,
    "lu_svd": TrailingPseudoinverse,
}


@dataclass(frozen=True)
class InverseFactory:
    """Factory of generalised inverses.

    Attributes:
        counters: Counts factorisations.
        kplus: Makes the generalised inverse.
        prefix: Prefix of the factors' PETSc options.
    """

    counters: Counters = field(default_factory=Counters)
    kplus: MakeInverse = Regularised
    prefix: str = "tfeti_sub_"


# --- Causes of indefinite stiffnesses ---------------------------------------------------------

# Of the diagonal: what this makes positive definite was indefinite by rounding only, which in
# assembly and factor comes to 1e-14 or so.
ROUNDING = 1e-12
# Of the energy that springs between its nodes get from a motion: an elastic form gives it more
# than this, however flat the subdomain or small its shear modulus; rounding leaves 1e-12 or less.
NO_ENERGY = 1e-10
# so many motions without energy are counted at most
COUNTED = 20


def why_indefinite(K: Any, R: Array, fixing_dofs: Array, x: Array, prefix: str) -> str:
    """Say what is wrong with a stiffness whose K_ρ has no Cholesky factor, or a useless one.

    Args:
        K: Stiffness, its diagonal positive, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        fixing_dofs: Unknowns of the fixing nodes.
        x: Points of the nodes.
        prefix: Prefix of the factor's PETSc options.

    Raises:
        FactorError: It could not be found out, say for want of memory.
    """
    diagonal = K.diagonal()
    shifted = regular_matrix(K, R, fixing_dofs) + diags_array(ROUNDING * diagonal)
    try:
        factor = CholeskyFactor(shifted, prefix)
    except NotPositiveDefiniteError:
        return "the stiffness is not positive semidefinite; expected a linear elastic form"
    free = _motions_without_energy(K, R, x, factor.solve)
    factor.destroy()
    if free:
        count = f"{'at least ' if free == COUNTED else ''}{free} motion{'s' * (free > 1)}"
        return (
            f"the form gives no energy to {count} beside the {R.shape[1]} of a rigid body that it "
            "leaves free; expected a linear elastic form of the whole strain, with quadrature "
            "that is fine enough (one point leaves hourglasses to quadrilaterals and hexahedra)"
        )
    extents = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    flat = extents[0] / max(extents[-1], TINY)
    return (
        "the stiffness is indefinite by rounding: its softest deformations are lost beside its "
        f"stiffest (its length is {flat:.0e} of its thickness, its diagonal spans a factor of "
        f"{diagonal.max() / diagonal.min():.0e}); expected subdomains and cells that are less "
        "flat, or moduli that differ less"
    )


def check_rank(K: Any, R: Array, x: Array, solve: Callable[[Array], Array]) -> None:
    """Raise if K⁺ blows up a motion that is not rigid and that K gives no energy.

    Pivots that should be 0 are positive where rounding makes them so. It takes one solve.

    Args:
        K: Stiffness, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        x: Points of the nodes.
        solve: K⁺ b, shapes ``(n,)``.

    Raises:
        NotPositiveDefiniteError: It does.
    """
    u = _beside(R, solve(_beside(R, _drawn(K.shape[0], 1)[:, 0])))
    energy, rounding = float(u @ (K @ u)), ROUNDING * float(u @ (K.diagonal() * u))
    if energy > rounding:
        return
    stretches = _springs(K, x) @ u
    if abs(energy) <= NO_ENERGY * (float(stretches @ stretches) + rounding):
        raise NotPositiveDefiniteError("a pivot is zero but for rounding")


def _motions_without_energy(K: Any, R: Array, x: Array, solve: Callable[[Array], Array]) -> int:
    """Count motions beside the kernel that springs resist and K does not, up to ``COUNTED``.

    Args:
        K: Stiffness, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``.
        x: Points of the nodes.
        solve: Inverse of a K_ρ that is regular, shapes ``(n, q)``.
    """
    U = _drawn(K.shape[0], min(COUNTED, K.shape[0] - R.shape[1]))
    for _ in range(2):  # subspace iteration: what it looks for stands out by 1e8 or more
        U = np.linalg.qr(_beside(R, solve(U)))[0]
    energies, turn = np.linalg.eigh(U.T @ (K @ U))
    U = U @ turn
    # what springs hardly resist, in flat cells or where nodes hang together by a point, is lost
    resisted = np.sum((_springs(K, x) @ U) ** 2, axis=0)
    resisted += ROUNDING * np.sum(U * (K.diagonal()[:, None] * U), axis=0)
    return int(np.sum(np.abs(energies) <= NO_ENERGY * resisted))


def _drawn(n: int, count: int) -> Array:
    return np.random.default_rng(0).standard_normal((n, count))


def _beside(R: Array, u: Array) -> Array:
    """Return the part that is orthogonal to the kernel."""
    return u - R @ (R.T @ u)


def _springs(K: Any, x: Array) -> csr_array:
    """Return the stretches of springs between all pairs of nodes that share a cell.

    Springs resist what an elastic body resists, and about as much: a rod of volume V, length h and
    modulus E has the stiffness EV/h². Entries of K are as large as that for the shortest way
    across a cell. Of a scalar field springs resist differences.

    Returns:
        Times the root of the stiffness, shape ``(pairs, n)``.
    """
    bs, entries = K.shape[0] // len(x), K.tocoo()
    row, column = (index // bs for index in entries.coords)
    upper = row < column
    numbers = row[upper].astype(np.int64) * len(x) + column[upper]
    pairs, which = np.unique(numbers, return_inverse=True)
    size = np.bincount(which, np.abs(entries.data[upper]), minlength=len(pairs))
    i, j = np.divmod(pairs, len(x))
    along = x[j] - x[i]
    length = np.maximum(np.linalg.norm(along, axis=1), TINY)
    shortest = np.full(len(x), np.inf)
    for end in (i, j):
        np.minimum.at(shortest, end, length)
    direction = along / length[:, None] if bs > 1 else np.ones((len(pairs), 1))
    root = np.sqrt(size) * np.minimum(shortest[i], shortest[j]) / length
    values = (root[:, None] * direction).ravel()
    rows = np.tile(np.repeat(np.arange(len(pairs)), bs), 2)
    columns = (node[:, None] * bs + np.arange(bs) for node in (j, i))
    at = (rows, np.concatenate([numbers.ravel() for numbers in columns]))
    return csr_array(coo_array((np.append(values, -values), at), shape=(len(pairs), K.shape[0])))
