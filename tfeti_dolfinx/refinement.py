"""More digits where rounding has ended a solve: what its answer lacks is solved for and added."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.accuracy import Accuracy
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.dual.recovery import at_rest
from tfeti_dolfinx.dual.remainder import Remainder
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.homogenised import homogenise, image, scale_near
from tfeti_dolfinx.qp.monitors import Monitor
from tfeti_dolfinx.qp.problem import ConvergedReason, QPResult, Start
from tfeti_dolfinx.qp.solvers import Solver, Task

# of the worst error: what a round has to bring, or there is no other; and of the displacement: an
# answer that is as wrong as that has no digits to add some to
DIGIT, NO_DIGITS = 0.1, 0.1


@dataclass(frozen=True)
class Told:
    """A solver, and what it is told.

    Attributes:
        solver: The solver.
        options: Options.
        monitor: Called after each step.
    """

    solver: Solver
    options: Options
    monitor: Monitor


def with_more_digits(
    dual: Dual, told: Told, result: QPResult, rule: Accuracy
) -> tuple[QPResult, Accuracy]:
    """Where rounding has ended a solve, solve for what is left, as long as that brings a digit.

    Iterative refinement (Wilkinson): each round begins at the sum of those before, and the residual
    of that is made from K itself. Where this does not suffice, once more from the same answer, and
    K is not asked about motions of subdomains, of which it makes forces that are its rounding: the
    residual is made from the displacement less these. Collective; does nothing where a solve has
    ended otherwise.

    Args:
        dual: The dual problem.
        told: The solver, which can start somewhere, and what it is told.
        result: What it returned; becomes the function's own.
        rule: Its accuracy.

    Returns:
        The multipliers and their displacement, whose sum has more digits than K⁺(f − Bᵀλ).
    """
    comm, first = dual.coarse.comm, (result, rule)
    enough = agreed(comm, rule.ratio() * rule.rtol <= NO_DIGITS)
    if result.reason != ConvergedReason.DIVERGED_ROUNDING or not enough:
        return first
    found = _in_rounds(dual, told, first, rule.u)
    if found[0].reason <= 0 and dual.coarse.dimension:
        plain = found
        result.steps, rule.looks = plain[0].steps, plain[1].looks
        other = _in_rounds(dual, told, first, at_rest(dual.subdomains, rule.u))
        found = other if agreed(comm, other[1].ratio() < plain[1].ratio()) else plain
        found[0].steps, found[1].looks = other[0].steps, other[1].looks
        for answer, _ in (plain, other):
            if answer is not found[0] and answer is not result:
                answer.destroy()
    if found[0] is not result:
        result.destroy()
    return found


def _in_rounds(
    dual: Dual, told: Told, first: tuple[QPResult, Accuracy], v: Array
) -> tuple[QPResult, Accuracy]:
    """Rounds from a first answer, which stays; v is its displacement, or that less its motions."""
    result, rule = first
    comm = dual.coarse.comm
    while result.reason == ConvergedReason.DIVERGED_ROUNDING:
        before = agreed(comm, rule.ratio())
        more, again, v = _of_remainder(dual, told, result, rule, v)
        after = agreed(comm, again.ratio())
        if after >= before:
            more.destroy()
            break
        if result is not first[0]:
            result.destroy()
        result, rule = more, again
        if after > DIGIT * before:
            break
    return result, rule


def _of_remainder(
    dual: Dual, told: Told, result: QPResult, rule: Accuracy, v: Array
) -> tuple[QPResult, Accuracy, Array]:
    """The sum of a result and the solution of what it lacks, its accuracy, and its new v."""
    options, norm = told.options, rule.norm
    left = Remainder(dual, np.array(result.lam.array_r), rule.u, v)
    qp = left.qp()
    start = Start(left.start(result.face), np.zeros(qp.coarse.dimension))
    at = image(qp.F, start.lam.copy())
    homogenised = homogenise(qp, at, scale_near(qp, at))
    scale = (homogenised.scale.reference, homogenised.scale.rounding)
    again = Accuracy(left, options.number, options.atol, scale, norm)
    task = Task(qp, homogenised, again, options, start, told.monitor)
    more = told.solver.solve(task)
    if more.reason <= 0:
        last_look(more, again)
    again.looks += rule.looks
    v = again.u if v is rule.u else left.at_rest(more.lam)
    more.lam.axpy(1.0, result.lam)
    more.mu, more.reference, more.norm = result.mu, result.reference, result.norm
    more.steps = result.steps.plus(more.steps)
    for item in (at, homogenised, start.lam, left):
        item.destroy()
    return more, again, v


def last_look(result: QPResult, rule: Accuracy) -> None:
    """Measure where a solver has stopped before its tolerance: it may be good enough."""
    residual = max(result.projected_gradient, result.norm * result.equality)
    rule.accept_rounding()
    reason = rule.examine(result.lam, result.gradient, result.face, residual)
    if reason > 0:
        result.reason = reason
