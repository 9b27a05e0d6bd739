"""The errors that a solve knows: what the solver has left, and what the mesh leaves."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import nan
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
        discretisation: Estimate of ‖u* − ū‖_K, ū the exact solution of the continuous problem;
            None if the problem was given no stress. ``Solution.discretisation_error`` has its
            parts.
        factorizations: Subdomain matrices factored for it.
        lifting_multiplications: Multiplications by S, the Schur complements.
        recoveries: Displacements recovered, each for one more solve in every subdomain.
        closing_steps: Steps that made a displacement admissible, each a multiplication by B and
            by Bᵀ.
        seconds: Wall seconds of this rank.
    """

    energy: float
    algebraic: float
    discretisation: float | None
    factorizations: int
    lifting_multiplications: int
    recoveries: int
    closing_steps: int
    seconds: float

    @property
    def relative_algebraic(self) -> float:
        """The bound over ‖u‖_K."""
        return self.algebraic / max(self.energy, TINY)

    @property
    def relative_discretisation(self) -> float:
        """The estimate over ‖u‖_K; nan if the problem was given no stress."""
        return (nan if self.discretisation is None else self.discretisation) / max(
            self.energy, TINY
        )

    def numbers(self) -> dict[str, float]:
        """What is known, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


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
    discretisation = _discretisation(solution) if solution.has_stress else None
    return Estimates(
        energy=energy,
        algebraic=bound.error,
        discretisation=discretisation,
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


def _discretisation(solution: Solution) -> float:
    """The root of the sum of squares. Collective."""
    comm = solution.dofs.comm
    own = float(np.sum(solution.discretisation_error.x.array**2))
    return float(np.sqrt(agreed(comm, comm.allreduce(own))))
