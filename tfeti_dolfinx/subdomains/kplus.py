"""Generalised inverses of a subdomain's stiffness."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from scipy.sparse import coo_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.factor import CholeskyFactor


class GeneralisedInverse(Protocol):
    """K⁺ with K K⁺ K = K."""

    def solve(self, b: Array) -> Array:
        """K⁺ b, shape ``(n,)``."""
        ...

    def destroy(self) -> None:
        """Free the factor."""
        ...


def regularised(
    K: Any, R: Array, fixing_dofs: Array, prefix: str = "tfeti_sub_"
) -> GeneralisedInverse:
    """K_ρ⁻¹ with K_ρ = K + ρ Nᵀ(NNᵀ)⁻¹N, N the kernel on a few fixing unknowns, ρ = max diag K.

    An exact generalised inverse, because N R is regular
    (Brzobohatý, Dostál, Kozubek, Kovář, Markopoulos, IJNME 88, 2011, section 4).

    Args:
        K: Stiffness, shape ``(n, n)``.
        R: Kernel, shape ``(n, r)``; without columns K itself is inverted.
        fixing_dofs: Unknowns of the fixing nodes.
        prefix: Prefix of the factor's PETSc options.

    Raises:
        NotPositiveDefiniteError: K_ρ has no Cholesky factor.
        FactorError: It could not be made for another reason.
    """
    return CholeskyFactor(regular_matrix(K, R, fixing_dofs), prefix)


def regular_matrix(K: Any, R: Array, fixing_dofs: Array) -> Any:
    """K_ρ, scipy CSR; K itself where R has no columns."""
    if R.shape[1] == 0:
        return K
    Q, _ = np.linalg.qr(R[fixing_dofs])
    rho = K.diagonal().max()
    row, column = np.meshgrid(fixing_dofs, fixing_dofs, indexing="ij")
    projector = coo_array((rho * (Q @ Q.T).ravel(), (row.ravel(), column.ravel())), shape=K.shape)
    return (K + projector).tocsr()


KPLUS_TYPES = {"regularized": regularised}
