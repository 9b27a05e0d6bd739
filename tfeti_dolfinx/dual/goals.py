"""How small the algebraic error has to be beside another one, in energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.duality_gap import EnergyBound, LiftedScene, energy_bound
from tfeti_dolfinx.dual.measures import Measures, Scene

# of the other error; of ‖u‖_K where that is more, as where there is no other error
TENTH, FINEST = 0.1, 1e-6

# from the displacement on this rank to the other error, a root of an energy; collective
Goal = Callable[[Array], float]


class LookedAt(Scene, LiftedScene, Protocol):
    """What a look, and a bound, need to know of the dual problem."""


@dataclass(frozen=True)
class Reached:
    """How far an iterate is from a goal; the same on all ranks.

    Attributes:
        bound: Bound of its algebraic error.
        goal: The other error.
        energy: ‖u‖_K.
    """

    bound: EnergyBound
    goal: float
    energy: float

    @classmethod
    def of(
        cls, scene: LiftedScene, lam: PETSc.Vec, now: Measures, goal: Goal, norm: float
    ) -> Reached:
        """What it is at a look, ‖F‖ given. Collective."""
        energy = float(np.sqrt(max(now.bodies.energy.sum(), 0.0)))
        return cls(energy_bound(scene, lam, now.u, norm), goal(now.u), energy)

    @property
    def allowed(self) -> float:
        """What the bound may be."""
        return max(TENTH * self.goal, FINEST * self.energy)
