"""The solver that the options choose."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.errors import ConvergenceError, InputError, NoSolutionError
from tfeti_dolfinx.feti.dual import Dual, contact_set
from tfeti_dolfinx.feti.stopping import Accuracy, ErrorTarget, MakeRule
from tfeti_dolfinx.options import AUTO, SOLVERS, Options, Solver
from tfeti_dolfinx.qp.coarse import imbalance
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    KnownProduct,
    Monitor,
    QPResult,
    Start,
    homogenise,
    no_monitor,
    printing,
)
from tfeti_dolfinx.qp.projection import UNBALANCED

EXPLANATIONS = {
    ConvergedReason.DIVERGED_ROUNDING: "; rounding does not let it come lower: expected a "
    "larger rtol, or a model with smaller ratios of stiffness or size",
    ConvergedReason.DIVERGED_STALLED: "; the forces come no nearer to balancing the load",
    ConvergedReason.DIVERGED_FRICTION: "; the bounds of Coulomb's friction do not come to rest, "
    "least of all on the body {restless!r}: "
    "expected a smaller coefficient, smaller load steps, a larger friction_max_it, or a load that "
    "does not need bodies wedged between others",
    ConvergedReason.DIVERGED_CONTRADICTION: "; contact constraints that depend on each other "
    "contradict each other{contacts}: expected gaps that some displacement keeps",
}
# in the place of that of DIVERGED_FRICTION
SLIDES = (
    "; {slides} without end{contacts}, where contact does not press as much as friction needs to "
    "balance the load: expected a smaller load, or a body that is held, or pressed by another load "
    "or by gaps that overlap"
)


def resolved(options: Options, rows: Sequence[int], prefix: str) -> Options:
    """Return options with the solver, preconditioner and friction that ``auto`` stands for.

    ``rows`` are the numbers of normal and of tangential rows of contacts, on all ranks. Raise an
    InputError where the scene has inequalities or friction, but a solver that does not keep them is
    asked for; or a preconditioner with a solver that takes none.
    """
    qp_type, (num_inequalities, num_tangents) = options.qp_type, rows
    if qp_type == "auto":
        qp_type = AUTO[num_inequalities + num_tangents > 0]
    if num_inequalities + num_tangents > 0 and not SOLVERS[qp_type].keeps_sets:
        able = ["auto", *(name for name, solver in SOLVERS.items() if solver.keeps_sets)]
        tangential = f"friction, {num_tangents} tangential constraints,"
        rows_of = tangential if num_tangents else f"{num_inequalities} contact constraints,"
        raise InputError(
            f"-{prefix}qp_type {qp_type}: the model has {rows_of} which {qp_type.upper()} "
            f"cannot keep; expected {' or '.join(able)}"
        )
    own = SOLVERS[qp_type].pc_type
    if own == "none" and options.pc_type not in ("auto", "none"):
        raise InputError(
            f"-{prefix}pc_type {options.pc_type}: {qp_type.upper()} takes no preconditioner; "
            "expected auto or none"
        )
    if "late_schur" in options.without and own == "auto":
        own = "dirichlet"
    pc_type = own if options.pc_type == "auto" else options.pc_type
    friction = options.friction_type
    if friction == "auto":
        friction = "newton" if qp_type == "newton" else "fixed_point"
    keeps, cautious = (name not in options.without for name in ("kept_directions", "cautious"))
    pcpg = replace(options.pcpg, keeps=keeps)
    return replace(
        options,
        qp_type=qp_type,
        pc_type=pc_type,
        friction_type=friction,
        pcpg=pcpg,
        newton=replace(options.newton, pcpg=pcpg, cautious=cautious),
    )


def solve_dual(
    dual: Dual,
    options: Options,
    start: tuple[Array, Array] | None = None,
    monitor: Monitor | None = None,
    goal: ErrorTarget | None = None,
    make_rule: MakeRule = Accuracy,
) -> tuple[QPResult, Accuracy]:
    """Solve the dual problem, and look at the answer. Collective.

    From the solution of an earlier solve PCPG multiplies by F once, SMALSE-M at most twice: PCPG
    not even that where there is no kernel and it starts where the last solve has ended. Block
    Newton multiplies once, and not even that where it starts at the end of the last solve.

    ``start`` are λ on this rank's rows, and the multipliers of Gλ = e, to start from; ``monitor``
    is called after each step, by default as options say; bounds of the algebraic error in energy
    come down to ``goal``, too. Return multipliers, and the rule, which has their displacement and
    its measured accuracy.
    """
    cite("tfeti", qp_type := options.qp_type)
    solver = SOLVERS[qp_type]
    qp = dual.qp(options.norm_steps if solver.relative_to_norm else 0)
    begin = _begin(dual, qp, solver, start)
    # of a set of one's own solvability knows which rows pull, not how much they bear
    given = dual.make_feasible is not contact_set and solver.cold is not None
    if given and imbalance(qp.coarse, begin.at.lam) > UNBALANCED:
        raise NoSolutionError(
            "extensions: feasible_set has no forces that balance the load; expected a set that "
            "bears it, or a Dirichlet condition or a spring besides"
        )
    if monitor is None and options.monitor:
        monitor = printing(qp.coarse.comm, qp.feasible, lambda: dual.F.count)
    scale = begin.reference, begin.rounding
    rule = make_rule(dual, options.number, options.atol, scale, goal)
    own, most = getattr(options, qp_type), options.max_it
    result = solver.solve(qp, begin, rule, own, max_it=most, monitor=monitor or no_monitor)
    rounding = result.reason == ConvergedReason.DIVERGED_ROUNDING
    if rounding and (late := dual.late) is not None and late.metric is None and late.lumped_for:
        late.lumped_for = 0  # K_bb of thin parts spans more digits than S: begin again
        return solve_dual(dual, options, start, monitor, goal, make_rule)
    broken = rounding or result.reason == ConvergedReason.DIVERGED_INDEFINITE_MAT
    if broken and dual.rough is not None:
        dual.rough = None  # what single precision does not tell: begin again with F itself
        return solve_dual(dual, options, start, monitor, goal, make_rule)
    dual.norm = max(dual.norm, result.norm)  # the next start may see far less
    if dual.coarse.dimension == 0 or qp_type == "newton":
        # what steps leave out of the gradient does not grow from solve to solve, where a look was
        # at the end
        end = rule.recovered if rule.looks else None
        if end is None or any_rank(qp.coarse.comm, not np.array_equal(end.lam, result.lam)):
            Fx = result.gradient + qp.coarse.combined(result.mu) + qp.d
        else:
            Fx = end.residual + qp.d
        dual.last, dual.solved = KnownProduct(result.lam, Fx), (qp.d, np.array(qp.coarse.e))
    if result.reason <= 0 and (options.max_it > 0 or rule.looks == 0):  # else a look was all
        rule.examine_stopped(result)
    return result, rule


def _begin(dual: Dual, qp: QP, solver: Solver, earlier: tuple[Array, Array] | None) -> Start:
    """Return where a solver begins: as it does with earlier multipliers, if they are not 0."""
    comm, lam, mu = qp.coarse.comm, None, None
    if earlier is not None and any_rank(comm, earlier[0]):
        lam, mu = earlier
        mu = mu if len(mu) == qp.coarse.dimension else None
    if lam is None or solver.warm is None:
        cold = None if solver.cold is None else solver.cold(qp)
        return replace(homogenise(qp, cold), lam=lam, mu=mu)
    at = solver.warm(qp, lam)
    Fx = dual.last.image(qp.F, comm, at)
    # Begin at 0 where it is admissible and q is no less at a start, as after unloading: of what
    # the start has and the solution has not, conjugate gradients would leave its rounding.
    zero = np.zeros(len(qp.d))
    may = not np.any(qp.coarse.e) and not np.any(qp.feasible.project(zero))
    energy, work = qp.dot((at, Fx), (at, qp.d))
    if not any_rank(comm, not may) and 0.5 * energy >= work:
        at, Fx, mu = zero, zero, None if mu is None else np.zeros(len(mu))
    return replace(homogenise(qp, at, Fx, warm=True), lam=lam, mu=mu)


def conclude(
    result: QPResult,
    rule: Accuracy,
    options: Options,
    comm: MPI.Intracomm,
    excluding: Sequence[str] = (),
    restless: str = "",
    slides: str = "",
    said: Sequence[str] = (),
) -> None:
    """Say why the solver stopped, and raise where it should have gone on.

    ``excluding`` are names of the contacts whose rows exclude each other, or slip; ``restless`` is
    the body on which bounds of friction change most, ``slides`` says what friction does not hold;
    what is ``said`` of the answer, by warnings and notes, an error says, too.
    Raise a ConvergenceError where it stopped before its tolerance, unless options turn that off.
    """
    if result.reason > 0 and not options.converged_reason:
        return
    explanation = SLIDES if slides else EXPLANATIONS.get(result.reason, "")
    of = " on contact" if slides else ", those of"
    contacts = f"{of} {' and '.join(excluding)}" if excluding else ""
    explanation = explanation.format(contacts=contacts, restless=restless, slides=slides)
    text = (
        f"{result.reason.name} after {result.steps.outer} outer and {result.steps.inner} inner "
        f"iterations: the worst of its errors is {rule.ratio():.3g} times what rtol "
        f"{options.rtol} allows{explanation}"
    )
    if options.converged_reason and comm.rank == 0:
        print(f"TFETI solve {text}", flush=True)
    if result.reason <= 0 and options.error_if_not_converged:
        raise ConvergenceError("; ".join([f"the dual solver stopped: {text}", *said]))
