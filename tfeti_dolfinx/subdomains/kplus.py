"""Generalised inverses of a subdomain's stiffness."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.data import Counters
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.inverse import FactoredInverse, GeneralisedInverse, lent
from tfeti_dolfinx.subdomains.pseudoinverse import SchurPseudoinverse, TrailingPseudoinverse

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
    """Whether two CSR matrices store the same entries."""
    return np.array_equal(K.indptr, other.indptr) and np.array_equal(K.indices, other.indices)


def _projector(K: Any, R: Array, fixing_dofs: Array) -> Array:
    """ρ Nᵀ(NNᵀ)⁻¹N on the fixing unknowns; what moves in no motion may be far stiffer."""
    Q, _ = np.linalg.qr(R[fixing_dofs])
    moves = np.abs(R).max(axis=1) > STILL * np.abs(R).max()
    return np.asarray(K.diagonal()[moves].max() * (Q @ Q.T))


def _places(K: Any, dofs: Array) -> Array:
    """Where the entries of each pair of dofs are stored, −1 where they are not."""
    number = csr_array((np.arange(1, K.nnz + 1), K.indices, K.indptr), shape=K.shape)
    return np.asarray(number[dofs][:, dofs].toarray()) - 1


def _regular(K: Any, R: Array, fixing_dofs: Array) -> AbstractContextManager[None]:
    """The values of K_ρ in the place of those of K, for a while."""
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
class Making:
    """How inverses are made.

    Attributes:
        counters: Counts factorisations.
        kplus: Makes the generalised inverse.
        prefix: Prefix of the factors' PETSc options.
    """

    counters: Counters = field(default_factory=Counters)
    kplus: MakeInverse = Regularised
    prefix: str = "tfeti_sub_"
