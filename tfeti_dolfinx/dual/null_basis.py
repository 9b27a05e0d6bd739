"""Free motions of bodies in kernel coordinates: an orthonormal basis of null(Gᵀ)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.dual.kernel_basis import independent
from tfeti_dolfinx.dual.sparse_columns import orthonormal_columns, parts_of_columns


@dataclass(frozen=True)
class NullBasis:
    """A null space of unit vectors and a few others.

    Attributes:
        alone: Coordinates of the unit vectors.
        joint: Orthonormal, zero at those coordinates, as columns, scipy CSR, shape ``(r, c)``.
    """

    alone: Array
    joint: csr_array

    def removed(self, x: Array) -> Array:
        """x less its part in the space."""
        x = x - self.joint @ (self.joint.T @ x) if self.joint.shape[1] else np.array(x)
        x[self.alone] = 0.0
        return np.asarray(x)

    def pins(self, scale: Array) -> Array:
        """As many coordinates as vectors, on which these are independent.

        Args:
            scale: Coordinates are to be counted in these units.
        """
        pins = [self.alone]
        for _, rows, dense in parts_of_columns(self.joint):
            joint = dense / scale[rows, None]
            size = np.maximum(np.linalg.norm(joint, axis=0), TINY)
            pins.append(rows[independent(joint / size)])
        return np.concatenate(pins)

    def extended(self, count: int) -> NullBasis:
        """The same space, 0 on so many more coordinates."""
        rows = self.joint.shape[0] + count
        table = (self.joint.data, self.joint.indices, np.pad(self.joint.indptr, (0, count), "edge"))
        return NullBasis(self.alone, csr_array(table, shape=(rows, self.joint.shape[1])))


def null_basis(alone: Array, joint: csr_array) -> NullBasis:
    """Basis of unit vectors and others.

    Args:
        alone: Coordinates of the unit vectors.
        joint: Other vectors as columns, independent of them.
    """
    others = np.ones(joint.shape[0])
    others[alone] = 0.0
    kept = csr_array(diags_array(others) @ joint)
    kept.eliminate_zeros()
    return NullBasis(alone, orthonormal_columns(kept))
