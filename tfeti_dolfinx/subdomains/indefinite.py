"""Why a stiffness is not positive semidefinite: by rounding, or by its form."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import diags_array

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import regular_matrix

# Of the diagonal: what this makes positive definite was indefinite by rounding only, which in
# assembly and factor comes to 1e-14 or so.
ROUNDING = 1e-12


def why_indefinite(K: Any, R: Array, fixing_dofs: Array, x: Array, prefix: str) -> str:
    """What is wrong with a stiffness whose K_ρ has no Cholesky factor.

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
        CholeskyFactor(shifted, prefix).destroy()
    except NotPositiveDefiniteError:
        return "the stiffness is not positive semidefinite; expected a linear elastic form"
    extents = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    flat = extents[0] / max(extents[-1], TINY)
    return (
        "the stiffness is indefinite by rounding: its softest deformations are lost beside its "
        f"stiffest (its length is {flat:.0e} of its thickness, its diagonal spans a factor of "
        f"{diagonal.max() / diagonal.min():.0e}); expected subdomains and cells that are less "
        "flat, or moduli that differ less"
    )
