"""Faces: in which directions a point of a feasible set may move to both sides."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.arrays import Array


class Status(IntEnum):
    """What a row does at a point of a feasible set.

    FREE: no set constrains it. OPEN: it is on its bound, and what it multiplies may open.
    TOUCHING: it is off its bound, in contact. STICK: inside its disc. SLIP: on its circle, and
    pushed against it.
    """

    FREE = 0
    OPEN = 1
    TOUCHING = 2
    STICK = 3
    SLIP = 4


@dataclass(frozen=True)
class Face:
    """The face of a feasible set on which a point lies, on this rank's rows.

    Attributes:
        Z: Free directions as orthonormal columns, scipy CSR, shape ``(m, k)``; each of them
            lives on this rank.
        curvature: What the set's boundary adds to the Hessian along each direction: where the
            gradient pushes against it, moving along the set by Zt changes gᵀx by
            gᵀZt + ½ Σ κ_j t_j². 0 where it is flat or not pushed against. Shape ``(k,)``.
        status: Status of each row, shape ``(m,)``.
    """

    Z: csr_array
    curvature: Array
    status: Array

    @property
    def carrying(self) -> Array:
        """Rows that carry a force: all but the open ones; flags, shape ``(m,)``."""
        return np.asarray(self.status != Status.OPEN)

    @property
    def holding(self) -> Array:
        """Rows that hold what they multiply, Bu = c: neither open nor slipping; flags."""
        return self.carrying & (self.status != Status.SLIP)

    @property
    def constrained(self) -> Array:
        """Rows that some set constrains; flags, shape ``(m,)``."""
        return np.asarray(self.status != Status.FREE)

    @property
    def held(self) -> Array:
        """Rows that no direction moves; flags."""
        return np.asarray(np.diff(self.Z.indptr) == 0)

    @property
    def curved(self) -> bool:
        """Whether some row of this rank slips along a boundary."""
        return bool(np.any(np.diff(self.Z.indptr)[self.status == Status.SLIP]))

    def damped(self) -> Face:
        """Z diag(1 + κ)^{-1/2}: ZZᵀ is the derivative of P_Ω at x, P_Ω(x) − x its gradient."""
        if not np.any(self.curvature):
            return self
        share = diags_array(1.0 / np.sqrt(1.0 + self.curvature))
        return Face(csr_array(self.Z @ share), self.curvature, self.status)

    def with_directions(self, kept: Array) -> Face:
        """The face with some of its directions only, the others held."""
        return Face(csr_array(self.Z[:, kept]), self.curvature[kept], self.status)

    def restricted(self, x: Array) -> Array:
        """Z Zᵀ x: the part of vectors, shapes ``(m,)`` or ``(m, q)``, that lies in the face."""
        if self._of_coordinates:
            return np.where(np.diff(self.Z.indptr) > 0, x.T, 0.0).T
        return np.asarray(self.Z @ (self.Z.T @ x))

    @cached_property
    def _of_coordinates(self) -> bool:
        """Whether the directions are coordinates: unit columns with one entry each."""
        return bool(self.Z.nnz == self.Z.shape[1] and np.all(np.abs(self.Z.data) == 1.0))


def without_slip(face: Face, x: Array) -> Array:
    """x, 0 where rows slip: these follow their boundary, no bound stops them."""
    return np.where(face.status == Status.SLIP, 0.0, x)


def face_of(free: Array, status: Array) -> Face:
    """A flat face whose directions are coordinates.

    Args:
        free: Flags of the rows that may move, shape ``(m,)``.
        status: Status of each row.
    """
    rows = np.flatnonzero(free)
    k, m = len(rows), len(free)
    Z = csr_array((np.ones(k), (rows, np.arange(k))), shape=(m, k))
    return Face(Z, np.zeros(k), status)
