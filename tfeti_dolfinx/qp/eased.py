"""Faces without the directions along which they bend so hard that F has no say there."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.newton_curved import brought_back, brought_into, gradient_on
from tfeti_dolfinx.qp.problem import QP, Point

# times ‖F‖: a curvature that leaves F no say in where a force on a small circle points, as where
# what slips goes far beside what deforms; conjugate gradients and P would see nothing but it
HARD = 1e3


class Eased:
    """A face of which conjugate gradients see what does not bend hard; the rest is turned apart.

    Args:
        whole: The face.
        norm: ‖F‖, or an estimate; 0 where nothing is known.

    Attributes:
        whole: The face.
        face: The same, but directions with κ ≫ ‖F‖ are held.
    """

    def __init__(self, whole: Face, norm: float) -> None:
        hard = whole.curvature > HARD * norm if norm > 0.0 else np.zeros(len(whole.curvature), bool)
        self._hard, self._kept = np.flatnonzero(hard), np.flatnonzero(~hard)
        self.bend(whole)

    def bend(self, whole: Face) -> None:
        """Take the face with other curvatures; what is held stays."""
        self.whole = whole
        self.face = whole.with_directions(self._kept) if self._hard.size else whole

    def back(self, qp: QP, coarse: Coarse, z: Point) -> bool:
        """Bring z back to the circles, turned by −κ⁻¹Zᵀs where these bend hard. Collective.

        Into the discs where circles do not bear it. Multiplies by F once, or twice.

        Args:
            qp: The program.
            coarse: Projectors of ``face``.
            z: The point.

        Returns:
            Whether there is such a point near by.
        """
        s, near = gradient_on(qp, coarse, z.g), z.lam.copy()
        Z, kappa = self.whole.Z[:, self._hard], self.whole.curvature[self._hard]
        slope = Z.T @ s.array_r
        near.array[:] -= Z @ np.divide(slope, kappa, out=np.zeros_like(slope), where=kappa > 0.0)
        held = brought_back(qp, self.whole, z, near) or brought_into(qp, self.whole, z)
        s.destroy()
        near.destroy()
        return held
