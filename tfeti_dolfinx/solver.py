"""The solver that the options choose, run on a dual problem."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.citations import cite
from tfeti_dolfinx.dual.accuracy import Accuracy
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.dual.particular import feasible_particular
from tfeti_dolfinx.errors import ConvergenceError, InputError
from tfeti_dolfinx.options import Options, check_preconditioner
from tfeti_dolfinx.qp.homogenised import Homogenised, homogenise
from tfeti_dolfinx.qp.monitors import Monitor, PrintMonitor, no_monitor
from tfeti_dolfinx.qp.norm import estimate_norm
from tfeti_dolfinx.qp.pcpg import pcpg
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, QPResult, Start
from tfeti_dolfinx.qp.smalse import smalse

EXPLANATIONS = {
    ConvergedReason.DIVERGED_ROUNDING: "; rounding does not let it come lower: expected a "
    "larger rtol, or a scene with smaller ratios of stiffness or size",
    ConvergedReason.DIVERGED_STALLED: "; the forces come no nearer to balancing the load",
}


def resolve_types(options: Options, num_inequalities: int, prefix: str) -> tuple[str, str]:
    """The solver and the preconditioner that ``auto`` stands for.

    Raises:
        InputError: The scene has inequalities, but pcpg or a preconditioner is asked for.
    """
    qp_type = options.qp_type
    if qp_type == "auto":
        qp_type = "smalse" if num_inequalities else "pcpg"
    if qp_type == "pcpg" and num_inequalities:
        raise InputError(
            f"-{prefix}qp_type pcpg: the scene has {num_inequalities} contact rows, which PCPG "
            "cannot keep; expected auto or smalse"
        )
    if qp_type == "smalse":
        check_preconditioner(options, prefix)
    pc_type = options.pc_type
    if pc_type == "auto":
        pc_type = "dirichlet" if qp_type == "pcpg" else "none"
    return qp_type, pc_type


def solve_dual(
    dual: Dual, options: Options, qp_type: str, start: tuple[Array, Array] | None = None
) -> tuple[QPResult, Accuracy]:
    """Solve the dual problem, and look at the answer. Collective.

    Args:
        dual: The dual problem.
        options: Options.
        qp_type: pcpg or smalse.
        start: λ on this rank's rows, and the multipliers of Gλ = e, to start from.

    Returns:
        Multipliers, and their displacement with its measured accuracy.
    """
    cite("tfeti", qp_type)
    qp = dual.qp()
    homogenised = _homogenise(dual, qp, options)
    monitor, norm = _monitor(dual, homogenised, options), 1.0
    if qp_type == "smalse":
        with dual.F.charged_to("power method"):
            norm = estimate_norm(qp.F, qp.coarse, qp.d, options.norm_steps)
    reference, rounding = homogenised.reference, homogenised.rounding
    rule = Accuracy(dual, options.rtol, options.atol, reference, rounding, norm)
    if qp_type == "pcpg":
        result = pcpg(qp, homogenised, rule, max_it=options.max_it, monitor=monitor)
    else:
        result = smalse(
            qp,
            homogenised,
            norm,
            rule,
            options.smalse(),
            max_it=options.max_it,
            start=_start(start, qp.d),
            monitor=monitor,
        )
    homogenised.destroy()
    if result.reason <= 0:
        _last_look(result, rule)
    return result, rule


def _last_look(result: QPResult, rule: Accuracy) -> None:
    """Measure where a solver has stopped before its tolerance: it may be good enough."""
    residual = max(result.projected_gradient, result.norm * result.equality)
    reason = rule.examine(result.lam, result.gradient, residual)
    if reason > 0:
        result.reason = reason


def _start(values: tuple[Array, Array] | None, like: PETSc.Vec) -> Start | None:
    if values is None:
        return None
    lam = like.duplicate()
    lam.array[:] = values[0]
    return Start(lam, values[1])


def _homogenise(dual: Dual, qp: QP, options: Options) -> Homogenised:
    if options.homogenization == "natural" or not dual.num_inequalities:
        return homogenise(qp)
    lam_bar = qp.d.duplicate()
    lam_bar.array[:] = feasible_particular(dual.coarse, dual.constraints.inequalities)
    homogenised = homogenise(qp, lam_bar)
    lam_bar.destroy()
    return homogenised


def _monitor(dual: Dual, homogenised: Homogenised, options: Options) -> Monitor:
    if not options.monitor:
        return no_monitor
    comm, feasible = dual.coarse.comm, homogenised.feasible
    return PrintMonitor(
        touching=lambda x: comm.allreduce(feasible.num_off(x)),
        multiplications=lambda: dual.F.count["solver"],
    )


def conclude(result: QPResult, rule: Accuracy, options: Options, comm: MPI.Intracomm) -> None:
    """Say why the solver stopped, and raise where it should have gone on.

    Raises:
        ConvergenceError: It stopped before its tolerance, unless options turn that off.
    """
    text = (
        f"{result.reason.name} after {result.steps.outer} outer and {result.steps.inner} inner "
        f"iterations: the worst of its errors is {rule.ratio():.3g} times what rtol "
        f"{options.rtol:g} allows{EXPLANATIONS.get(result.reason, '')}"
    )
    if options.converged_reason and comm.rank == 0:
        print(f"TFETI solve {text}", flush=True)
    if result.reason <= 0 and options.error_if_not_converged:
        raise ConvergenceError(f"the dual solver stopped: {text}")
