"""Estimates of the algebraic and the discretisation error of a solve."""

from dataclasses import dataclass
from math import nan
from time import perf_counter
from typing import Any

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import count_over, steering, summed
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.feti.duality_gap import energy_bound
from tfeti_dolfinx.feti.stopping import ErrorTarget
from tfeti_dolfinx.forms.fields import Stress, StressRecovery, checked_stress
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.system import System


@dataclass(frozen=True)
class Estimates:
    """Errors of a solution in the energy norm ‖u‖_K = √(uᵀKu); the same on all ranks.

    Attributes:
        energy: ‖u‖_K, a root of an energy.
        algebraic: Bound of ‖u − u*‖_K, u* the exact solution of the discrete problem: its
            constraints, and the last bounds of friction. Infinite where no forces balance the load.
        discretisation: Estimate of ‖u* − ū‖_K, ū the exact solution of the continuous problem;
            None if the problem was given no stress. ``Solution.discretisation_error`` has its
            parts.
        rounding: What rounding leaves of ‖u‖_K where bodies move and do not deform.
        factorizations: Subdomain matrices factored for it.
        lifting_multiplications: Applications of S, the Schur complements.
        recoveries: Displacements recovered, each for one more solve in every subdomain.
        seconds: Wall seconds of this rank.
    """

    energy: float
    algebraic: float
    discretisation: float | None
    rounding: float
    factorizations: int
    lifting_multiplications: int
    recoveries: int
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


def estimate(system: System[Any], solution: Solution, rounding: float) -> Estimates:
    """Estimate the errors of the last solution, ‖u‖_K of which may be rounding. Collective."""
    if solution.gluing.constraints is not system.gluing.constraints:
        raise InputError(
            "estimate: the constraints are not those of the solution; expected a call after solve()"
        )
    dual, u = system.dual, system.subdomains.with_rigid(solution.u)
    comm, factory, start = dual.coarse.comm, system.factory, perf_counter()
    factored = factory.factorizations
    bound, moved = energy_bound(dual, solution.lam, u, dual.norm)
    squares = [float(sum(dual.subdomains.energies(u))), 0.0]
    if solution.has_stress:
        squares[1] = float(np.sum(solution.discretisation_error.x.array**2))
    sizes = np.sqrt(np.maximum(summed(comm, np.array(squares)), 0.0))
    energy, discretisation = steering(comm, *sizes)
    return Estimates(
        energy=float(energy),
        algebraic=bound,
        discretisation=float(discretisation) if solution.has_stress else None,
        rounding=rounding,
        factorizations=count_over(comm, factory.factorizations - factored),
        lifting_multiplications=1,
        recoveries=int(moved > 0.0),
        seconds=perf_counter() - start,
    )


def goal_of(stress: Stress, dofs: TornDofs, thickness: Any) -> ErrorTarget:
    """From displacements in primal order to their discretisation error. Collective."""
    u = fem.Function(dofs.V)
    recovery = StressRecovery(u, checked_stress(stress, u), dofs, thickness)

    def error(values: Array) -> float:  # of all bodies, a root of an energy
        u.x.array[:] = dofs.to_dolfinx(values[: dofs.num_nodes * dofs.bs])
        total = summed(dofs.comm, np.array([recovery.squares().sum()]))
        return float(steering(dofs.comm, *np.sqrt(total))[0])

    return error
