"""All solvers of the dual problem in one table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from petsc4py import PETSc

from tfeti_dolfinx.qp.homogenised import Homogenised, restored
from tfeti_dolfinx.qp.krylov import solve_by_pcpg
from tfeti_dolfinx.qp.newton import feasible_start, first_point, newton
from tfeti_dolfinx.qp.parameters import NewtonParameters, SmalseParameters
from tfeti_dolfinx.qp.problem import QP, Monitor, QPResult, Start, StoppingRule
from tfeti_dolfinx.qp.smalse import smalse


class Parameters(Protocol):
    """Parameters of all solvers, of which each takes its own."""

    @property
    def max_it(self) -> int:
        """Most inner steps, and most outer ones."""
        ...

    @property
    def newton(self) -> NewtonParameters:
        """Parameters of block Newton."""
        ...

    @property
    def smalse(self) -> SmalseParameters:
        """Parameters of SMALSE-M."""
        ...


@dataclass(frozen=True)
class Solver:
    """QP solver, with its requirements.

    Attributes:
        solve: Solves a program, from its homogenised form.
        keeps_bounds: Whether it keeps inequalities.
        keeps_discs: Whether it keeps discs and ellipses.
        pc_type: Preconditioner that ``auto`` stands for.
        relative_to_norm: Whether its steps are relative to ‖PFP‖.
        cold: Where it starts, which is its λ̄; None: λ̄₀ = Gᵀ(GGᵀ)⁻¹e.
        warm: From a start to its λ̄; None: λ̄ is as without one.
    """

    solve: Callable[[QP, Homogenised, StoppingRule, Parameters, Start | None, Monitor], QPResult]
    keeps_bounds: bool
    keeps_discs: bool
    pc_type: str
    relative_to_norm: bool
    cold: Callable[[QP], PETSc.Vec] | None = None
    warm: Callable[[QP, Start], PETSc.Vec] | None = None


def _pcpg(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    parameters: Parameters,
    start: Start | None,
    monitor: Monitor,
) -> QPResult:
    return solve_by_pcpg(qp, homogenised, rule, max_it=parameters.max_it, monitor=monitor)


def _smalse(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    parameters: Parameters,
    start: Start | None,
    monitor: Monitor,
) -> QPResult:
    own, max_it = parameters.smalse, parameters.max_it
    return smalse(qp, homogenised, rule, own, max_it=max_it, start=start, monitor=monitor)


def _newton(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    parameters: Parameters,
    start: Start | None,
    monitor: Monitor,
) -> QPResult:
    own, max_it = parameters.newton, parameters.max_it
    return newton(qp, homogenised, rule, own, max_it=max_it, start=start, monitor=monitor)


def _restored(qp: QP, start: Start) -> PETSc.Vec:
    return restored(qp.coarse, start.lam)


SOLVERS = {
    "pcpg": Solver(
        _pcpg,
        keeps_bounds=False,
        keeps_discs=False,
        pc_type="dirichlet",
        relative_to_norm=False,
        warm=_restored,
    ),
    "smalse": Solver(
        _smalse,
        keeps_bounds=True,
        keeps_discs=True,
        pc_type="none",
        relative_to_norm=True,
    ),
    "newton": Solver(
        _newton,
        keeps_bounds=True,
        keeps_discs=True,
        pc_type="dirichlet",
        relative_to_norm=False,
        cold=first_point,
        warm=feasible_start,
    ),
}
# what auto stands for, without and with inequalities
AUTO = {False: "pcpg", True: "newton"}
