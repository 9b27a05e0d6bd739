"""Whether what is added to a stiffness holds motions firmly."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.kernel import orthonormal

# of the largest diagonal entry of K: an energy of a motion of length 1 that is rounding, and one
# from which on the motion is held as firmly as others bend
NOTHING, FIRM = 1e-26, 0.02


def holds_firmly(modes: Array, added: Array, diagonal: Array) -> bool:
    """Whether rigid motions are left free, or held about as firmly as a subdomain deforms.

    What holds them softly, as a short end or a soft part do, makes a nearly singular matrix of one
    whose kernel is known.

    Args:
        modes: Rigid motions as columns, shape ``(n, k)``.
        added: What the diagonal of K is to get, shape ``(n,)``.
        diagonal: That of K, shape ``(n,)``.
    """
    R, most = orthonormal(modes), diagonal.max(initial=0.0)
    # singular values: an eigenvalue of Rᵀ diag(added) R would have an error of 1e-16 of the largest
    energies = np.linalg.svd(np.sqrt(added)[:, None] * R, compute_uv=False) ** 2
    return not np.any((energies > NOTHING * most) & (energies < FIRM * most))
