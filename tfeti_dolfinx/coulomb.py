"""Coulomb's law: problems with given bounds of friction, the next ones from Newton's method.

Or, where that is not wanted or fails, from a fixed point iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.accuracy import Accuracy
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.dual.goals import Goal
from tfeti_dolfinx.newton_coulomb import NewtonOnCoulomb
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.pressures import Pressures
from tfeti_dolfinx.qp.monitors import Monitor
from tfeti_dolfinx.qp.problem import ConvergedReason, QPResult, Steps
from tfeti_dolfinx.solver import solve_dual

# Inner tolerance: rtol of the first step, and share of the last change of the bounds. Forces are
# less exact than displacements: with a tenth the acceleration meets noise. It never grows again,
# and a problem that was solved without a CG step tells nothing of its bounds: the same share then.
FIRST, SHARE = 1e-2, 0.01
# of the change of the bounds at which they are at rest: rtol where a goal takes its place, since
# forces have to be known to that change
SHARE_OF_BOUNDS = 0.1
# Change of the bounds beside rtol, where that is smaller than what options ask for: the law holds
# to the change, and each step makes it smaller by a factor of this order
BESIDE_RTOL = 100.0
# of what is wanted: a change from which on the next one may be small enough
NEAR = 10.0


@dataclass(frozen=True)
class Settling:
    """How the bounds of friction have come to rest.

    Attributes:
        iterations: Problems with given bounds that were solved; 0 without Coulomb's law.
        change: Last change of the bounds, over their size.
        tolerance: What that had to come down to.
        last: Multiplications by F of the last problem.
        body: The body on which they changed most at last; -1 without Coulomb's law.
        newton_steps: Steps of Newton's method on Coulomb's law, beside the problems.
        slides: Whether slips have grown without end, as where contact does not press a body that
            friction would have to hold.
    """

    iterations: int = 0
    change: float = 0.0
    tolerance: float = 0.0
    last: int = 0
    body: int = -1
    newton_steps: int = 0
    slides: bool = False

    def restless(self, names: Sequence[str]) -> tuple[str, bool]:
        """The name of the body of all names, and whether it slides."""
        return names[self.body], self.slides


def solve_with_friction(
    dual: Dual,
    options: Options,
    qp_type: str,
    start: tuple[Array, Array] | None = None,
    monitor: Monitor | None = None,
    goal: Goal | None = None,
) -> tuple[QPResult, Accuracy, Settling]:
    """Solve the dual problem with bounds of friction that fit the forces of normals. Collective.

    Args:
        dual: The dual problem.
        options: Options.
        qp_type: A solver of ``SOLVERS``.
        start: λ on this rank's rows, and the multipliers of Gλ = e, to start from.
        monitor: Called after each step; default as options say.
        goal: What bounds the algebraic error in energy has to come down to, too.

    Returns:
        Multipliers, their displacement with its accuracy (of the last step; steps and looks are
        those of all), and how the bounds have come to rest.
    """
    if not any_rank(dual.coarse.comm, dual.constraints.pressed.size > 0):
        return *solve_dual(dual, options, qp_type, start, monitor, goal), Settling()
    if goal is not None:
        options = replace(options, rtol=SHARE_OF_BOUNDS * options.friction_rtol)
    bounds, steps, looks = Pressures(dual, options, start), Steps(), 0
    least = options.number
    tolerance = min(options.friction_rtol, BESIDE_RTOL * least)
    change, rtol, iterations, aim = np.inf, FIRST, 0, np.inf
    on_law = NewtonOnCoulomb(dual, options, qp_type)
    while True:
        start = bounds.set_feasible(start)
        near = change <= NEAR * tolerance
        # where Newton's method has brought them so near, problems would follow their rounding
        tries = bounds.are_known and (on_law.steps > 0 or not near)
        solved = on_law.solve(start, aim) if tries else None
        if solved is not None:
            bounds.take(solved[0])
        else:
            rtol = least if near else max(least, min(rtol, SHARE * change))
        before = dual.F.count["solver"]
        asked = least if solved is not None else rtol
        exact = goal if asked <= least else None
        given = replace(options, rtol=asked), qp_type, solved or start
        result, rule = solve_dual(dual, *given, monitor, exact)
        iterations, looks = iterations + 1, looks + rule.looks
        aim = rule.tolerance * least / asked
        steps = steps.plus(result.steps)
        if result.reason <= 0 and solved is not None:
            on_law.give_up()
            bounds.take_back()
            result.destroy()
            continue
        if bounds.goes_on(result.reason):
            result.destroy()
            continue
        if result.reason <= 0:
            break
        change = bounds.change(result.lam, rule.u)
        at_rest = change <= tolerance and asked <= least
        if at_rest and (goal is not None or bounds.end(result, rule, on_law.may_try)):
            break
        if bounds.astray or iterations >= options.friction_max_it:
            result.reason = ConvergedReason.DIVERGED_FRICTION
            break
        if change > tolerance:
            bounds.advance()
        if result.steps.inner == 0 and solved is None:
            rtol *= SHARE
        start = solved or (np.array(result.lam.array_r), result.mu)
        result.destroy()
    result.steps, rule.looks = steps, looks
    last = dual.F.count["solver"] - before
    how = (float(change), tolerance, last, bounds.restless, on_law.steps, bounds.slides)
    return result, rule, Settling(iterations, *how)
