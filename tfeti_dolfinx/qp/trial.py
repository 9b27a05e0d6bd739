"""What solves on faces hand to the iterate of block Newton."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

from tfeti_dolfinx.qp.faces import Face, without_slip
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
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

    def feasible_part(self, feasible: FeasibleSet, at: Point) -> float:
        """Largest t up to 1 with λ + t(first − λ) ∈ Ω, but for rows that slip. Collective."""
        down = without_slip(self.face, at.lam.array_r - self.first.lam.array_r)
        own = feasible.max_step(at.lam.array_r, down)
        return min(1.0, float(at.lam.getComm().tompi4py().allreduce(own, op=MPI.MIN)))

    def destroy(self) -> None:
        """Destroy the points. Collective."""
        self.first.destroy()
        self.last.destroy()
