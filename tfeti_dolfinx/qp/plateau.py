"""Whether conjugate gradients still get anywhere."""

from __future__ import annotations

from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.problem import QP, Point

# so many steps in which neither ‖r‖ comes down to a half nor q by what stands out from its rounding
# have met rounding: at that pace 10 000 steps would bring 6 digits at best; twice as many as there
# are rows, and a few, have it too
PLATEAU, FEW, ROUNDING = 500, 20, 1e-15


class Plateau:
    """Whether residuals and q still come down.

    Args:
        norm: ‖r‖ at the start.
        rows: Number of rows.
    """

    def __init__(self, norm: float, rows: int) -> None:
        self._most = min(PLATEAU, 2 * rows + FEW)
        self._best, self._steps, self._gain, self._restarted = norm, 0, 0.0, False

    def step(self, norm: float, gain: float) -> None:
        """A step has lowered q by so much, and ends with that ‖r‖."""
        self._steps, self._gain = self._steps + 1, self._gain + gain
        if norm <= 0.5 * self._best:
            self._best, self._steps, self._gain, self._restarted = norm, 0, 0.0, False

    def ended(self, qp: QP, point: Point) -> bool:
        """Whether there was none for long. Collective where there were many steps."""
        if self._steps < self._most:
            return False
        sizes = abs(point.lam.dot(point.g)) + abs(point.lam.dot(qp.d))
        comm = point.lam.getComm().tompi4py()
        ended = agreed(comm, self._gain <= ROUNDING * sizes)
        self._steps, self._gain = 0, 0.0
        return ended

    def once_more(self) -> bool:
        """Whether this is the first time since ‖r‖ came down."""
        first, self._restarted = not self._restarted, True
        return first
