"""What solves on faces hand to the iterate of block Newton."""

from __future__ import annotations

from dataclasses import dataclass

from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.problem import Point


@dataclass(frozen=True)
class Trial:
    """What solves on faces have come to.

    Attributes:
        first: Where the first one ended, maybe outside of Ω.
        last: Where the last one ended.
        feasible: Whether that is in Ω.
        face: The face of the first one.
        rounds: How many there were.
    """

    first: Point
    last: Point
    feasible: bool
    face: Face
    rounds: int

    def destroy(self) -> None:
        """Destroy the points. Collective."""
        self.first.destroy()
        self.last.destroy()
