"""Gλ = e where some multipliers follow others, as a Newton step on a law of friction sees it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.qp.faces import Face


class Oblique(Protocol):
    """Projectors of a face Z on whose vectors u others depend: λ = (I + C)u.

    With G_f = GZ and H = G(I + C)ZG_fᵀ: P = Z(I − G_fᵀH⁺G(I + C)Z)Zᵀ. Vectors are this rank's
    parts, in the layout of all rows.
    """

    def coordinates(self, x: Array) -> Array:
        """H⁺G(I + C)ZZᵀx, replicated, shape ``(r,)``. Collective."""
        ...

    def project(self, x: Array) -> Array:
        """P x, shapes ``(m,)`` or ``(m, q)``. Collective."""
        ...

    def restoring(self, y: Array) -> Array:
        """u = ZG_fᵀH⁺y, for which G(I + C)u = y if any u does that. Not collective."""
        ...


class NoOblique:
    """Without Gλ = e: only masks.

    Args:
        face: The face.
    """

    def __init__(self, face: Face) -> None:
        self._face = face

    def coordinates(self, x: Array) -> Array:
        """None."""
        return np.zeros(0)

    def project(self, x: Array) -> Array:
        """ZZᵀx."""
        return self._face.restricted(x)

    def restoring(self, y: Array) -> Array:
        """0."""
        return np.zeros(self._face.Z.shape[0])
