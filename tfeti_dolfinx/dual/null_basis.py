"""Free motions of bodies in kernel coordinates: an orthonormal basis of null(Gᵀ)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.dual.kernel_basis import independent


@dataclass(frozen=True)
class NullBasis:
    """A null space of unit vectors and a few others.

    Attributes:
        alone: Coordinates of the unit vectors.
        joint: Orthonormal, zero at those coordinates, as columns, shape ``(r, c)``.
    """

    alone: Array
    joint: Array

    def removed(self, x: Array) -> Array:
        """x less its part in the space."""
        x = x - self.joint @ (self.joint.T @ x)
        x[self.alone] = 0.0
        return np.asarray(x)

    def pins(self, scale: Array) -> Array:
        """As many coordinates as vectors, on which these are independent.

        Args:
            scale: Coordinates are to be counted in these units.
        """
        joint = self.joint / scale[:, None]
        size = np.maximum(np.linalg.norm(joint, axis=0), TINY)
        return np.concatenate((self.alone, independent(joint / size)))


def null_basis(alone: Array, joint: Array) -> NullBasis:
    """Basis of unit vectors and others.

    Args:
        alone: Coordinates of the unit vectors.
        joint: Other vectors as columns, independent of them.
    """
    joint = joint.copy()
    joint[alone] = 0.0
    return NullBasis(alone, np.linalg.qr(joint)[0])
