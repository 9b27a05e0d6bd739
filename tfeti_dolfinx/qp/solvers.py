"""All solvers of the dual problem in one table."""

from collections.abc import Callable
from dataclasses import dataclass

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.qp.krylov import solve_by_pcpg
from tfeti_dolfinx.qp.newton import feasible_start, first_point, newton
from tfeti_dolfinx.qp.problem import QP, QPResult
from tfeti_dolfinx.qp.smalse import smalse


@dataclass(frozen=True)
class Solver:
    """QP solver, with its requirements."""

    # solves a program from a start, with a stopping rule and parameters, those of options with its
    # name; by name `max_it` and `monitor`, as `newton` does
    solve: Callable[..., QPResult]
    keeps_sets: bool  # whether it keeps inequalities and friction
    pc_type: str  # preconditioner that `auto` stands for
    relative_to_norm: bool  # whether its steps are relative to ‖PFP‖
    # where it starts, which is its λ̄; None: λ̄₀ = Gᵀ(GGᵀ)⁻¹e
    cold: Callable[[QP], Array] | None = None
    # from an earlier λ to λ̄; None: λ̄ is as without one
    warm: Callable[[QP, Array], Array] | None = None


SOLVERS = {
    "pcpg": Solver(
        solve_by_pcpg,
        keeps_sets=False,
        pc_type="auto",
        relative_to_norm=False,
        # the nearest solution of Gλ̄ = e: λ + Gᵀ(GGᵀ)⁻¹(e − Gλ)
        warm=lambda qp, lam: qp.coarse.project(lam) + qp.coarse.particular(),
    ),
    "smalse": Solver(smalse, keeps_sets=True, pc_type="none", relative_to_norm=True),
    "newton": Solver(
        newton,
        keeps_sets=True,
        pc_type="auto",
        relative_to_norm=False,
        cold=first_point,
        warm=feasible_start,
    ),
}
# what auto stands for, without and with inequalities
AUTO = {False: "pcpg", True: "newton"}
