"""A law of friction as solvers see it: sets of tangential multipliers that grow with normals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.qp.faces import Face, Status
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet

# what sticks for once is moved so far to the centre of its disc
INSIDE = 0.5


@dataclass(frozen=True)
class Law:
    """λ ∈ Ω(λ_N), on this rank's rows: the set of a point's λ_T is λ_N times one of its own.

    Attributes:
        at: Makes Ω of the λ_N of all points, shape ``(p,)``.
        normals: Row of λ_N of each point, shape ``(p,)``.
        tangents: Rows of its λ_T, shape ``(p, k)``.
        share: Of all coefficients of friction: Ω(share λ_N) is the set.
    """

    at: Callable[[Array], FeasibleSet]
    normals: Array
    tangents: Array
    share: float = 1.0

    def with_share(self, share: float) -> Law:
        """Return the law with this share of all coefficients; 0 is contact without friction."""
        return replace(self, share=share)

    def nearest(self, y: Array) -> tuple[FeasibleSet, Array]:
        """Ω(y_N⁺), and the nearest point to y in it."""
        feasible = self.at(self.share * np.maximum(y[self.normals], 0.0))
        return feasible, feasible.project(y)

    def slips(self, face: Face) -> Array:
        """Which points slip, flags of shape ``(p,)``."""
        return np.asarray(np.any(face.status[self.tangents] == Status.SLIP, axis=1))

    def following(self, p: Array, face: Face) -> csr_array:
        """C: where points slip λ_T follows λ_N, λ_T = Cλ with the direction of p. Shape ``(m, m)``.

        Args:
            p: A point of Ω(p_N).
            face: Its face.
        """
        at = np.flatnonzero(self.slips(face))
        rows, columns = self.tangents[at], self.normals[at]
        values = p[rows] / p[columns][:, None]
        index = rows.ravel(), np.repeat(columns, rows.shape[1])
        return csr_array((values.ravel(), index), shape=(len(p), len(p)))

    def stuck(self, p: Array, at: Array) -> Array:
        """p with the λ_T of points flagged inside of their sets."""
        inside = np.array(p)
        inside[self.tangents[at]] *= INSIDE
        return inside


@dataclass(frozen=True)
class OnFace:
    """What a step knows of a face: its directions, what follows them, where it is entered.

    Attributes:
        face: The face, hard directions held.
        C: What λ_T follows.
        p: A point of the face.
    """

    face: Face
    C: csr_array
    p: Array

    def followed(self, u: Array) -> Array:
        """(I + C)u, shapes ``(m,)`` or ``(m, q)``."""
        return np.asarray(u + self.C @ u)

    def entered(self, lam: Array) -> Array:
        """λ with what is open or slips where p has it; what follows does so."""
        held = np.isin(self.face.status, (Status.OPEN, Status.SLIP))
        follows = np.diff(self.C.indptr) > 0
        return np.where(follows, self.C @ lam, np.where(held, self.p, lam))

    def bend(self, u: Array) -> Array:
        """Z diag(κ) Zᵀu, shapes ``(m,)`` or ``(m, q)``."""
        Z = self.face.Z
        return np.asarray(Z @ (self.face.curvature * (Z.T @ u).T).T)
