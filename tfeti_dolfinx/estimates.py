"""The errors that a solve knows: what the solver has left, and what the mesh leaves."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from tfeti_dolfinx.arrays import TINY
from tfeti_dolfinx.dual.duality_gap import EnergyBound, energy_bound
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.system import System


@dataclass(frozen=True)
class Estimates:
    """Errors of a solution in the energy norm ‖u‖_K = √(uᵀKu); the same on all ranks.

    Attributes:
        energy: ‖u‖_K, a root of an energy.
        algebraic: Bound of ‖u − u*‖_K, u* the exact solution of the discrete problem: its rows,
            and the last bounds of friction. Infinite where no forces balance the load.
        factorizations: Subdomain matrices factored for it.
        lifting_multiplications: Multiplications by S, the Schur complements.
        recoveries: Displacements recovered, each for one more solve in every subdomain.
        closing_steps: Steps that made a displacement admissible, each a multiplication by B and
            by Bᵀ.
        seconds: Wall seconds of this rank.
    """

    energy: float
    algebraic: float
    factorizations: int
    lifting_multiplications: int
    recoveries: int
    closing_steps: int
    seconds: float

    @property
    def relative_algebraic(self) -> float:
        """The bound over ‖u‖_K."""
        return self.algebraic / max(self.energy, TINY)


def estimate(system: System, solution: Solution) -> Estimates:
    """Estimate the errors of a solution. Collective.

    Args:
        system: What the solution was found with.
        solution: The last solution.

    Raises:
        InputError: The rows are no longer those of the solution.
        FactorError: The stiffness inside of a subdomain could not be factored.
    """
    if solution.gluing.constraints is not system.gluing.constraints:
        raise InputError(
            "estimate: the rows are no longer those of the solution; expected a call after solve()"
        )
    counters, comm = system.dual.subdomains.counters, system.dual.coarse.comm
    start, factored = perf_counter(), counters.factorizations
    energy, bound = bound_of(system, solution)
    return Estimates(
        energy=energy,
        algebraic=bound.error,
        factorizations=comm.allreduce(counters.factorizations - factored),
        lifting_multiplications=1,
        recoveries=int(bound.moved > 0.0),
        closing_steps=bound.steps,
        seconds=perf_counter() - start,
    )


def bound_of(system: System, solution: Solution) -> tuple[float, EnergyBound]:
    """‖u‖_K, and the bound of the algebraic error. Collective."""
    dual = system.dual
    lam = dual.d.duplicate()
    lam.array[:] = solution.lam
    bound = energy_bound(dual, lam, solution.u)
    lam.destroy()
    comm = dual.coarse.comm
    square = agreed(comm, comm.allreduce(sum(dual.subdomains.energies(solution.u))))
    return float(np.sqrt(max(square, 0.0))), bound
