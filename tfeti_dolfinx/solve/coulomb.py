"""Coulomb's law: Newton's method on it, problems with given bounds around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import TINY, Array, sums
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, norm_over, summed
from tfeti_dolfinx.errors import ConvergenceError
from tfeti_dolfinx.feti.dual import Dual, contact_set
from tfeti_dolfinx.feti.stopping import Accuracy, ErrorTarget
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.coarse import NoOblique, Oblique
from tfeti_dolfinx.qp.friction_newton import (
    UNSEEN,
    Law,
    LawPoint,
    follow_friction,
    newton_on_law,
    residual_of,
)
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Monitor, QPResult, Steps
from tfeti_dolfinx.qp.projection import project_or_least
from tfeti_dolfinx.qp.sets import Face, FeasibleSet
from tfeti_dolfinx.solve.dilation import Anderson, DeSaxceIteration, cone_set
from tfeti_dolfinx.solve.solver import learn, solve_dual

# --- Friction bounds and their iteration ------------------------------------------------------

# of all multipliers, or of those that make what drives the problem: forces of normals that rounding
# makes of none; as bounds they would be discs whose boundaries bend so much that nothing else is
# seen beside them, and where only slips of earlier steps drive they might shrink for ever
NO_FORCE = 1e-13
# of the largest forces of normals on a body: those on a lighter one count as so large at least
LIGHT = 1e-6
# factors on the forces of normals of the nearest balanced point: it is found to some digits only
LARGER = (1.0, 1.001, 1.1, 2.0)
# problems in a row whose change is not half of the least before: bounds come no nearer to rest
PATIENCE = 6
# problems in a row whose forces are less than half of their bounds: these fall to 0
FALLS = 2
# change of slips at which De Saxcé's fixed point is looked at first; and a factor each time
# after it
COARSE, FINER = 1e-4, 0.01
# the largest share of the change of bounds that is taken to be left of it in the next problem
SLOWEST = 0.9
# of a step of bounds that ends where they cannot hold the load: those that can are a convex set
NEARER = (0.5, 0.25, 0.1)


class FrictionBoundIteration:
    """Iteration for the λ_N that friction limits are taken from. All methods are collective.

    Without a start what touches sticks at first: that has a solution wherever any bounds have one.

    Args:
        dual: The dual problem.
        options: Options.
        start: Multipliers to start from.

    Attributes:
        restless: The body on which bounds changed most at last; -1 before.
    """

    def __init__(self, dual: Dual, options: Options, start: tuple[Array, Array] | None) -> None:
        self._dual, self._constraints, self._options = dual, dual.constraints, options
        self._dilated: DeSaxceIteration | None = None
        self._lost, self._share, self._falls = False, COARSE, 0
        self._best, self._idle = np.inf, 0
        self._comm = dual.coarse.comm
        at = dual.constraints.pressed
        self._rows = dual.constraints.pressed_by[at]
        # differences of bounds are measured as forces
        self._mu = np.linalg.norm(dual.constraints.coefficients[at], axis=1)
        self._weight = self._mu * dual.constraints.tangent_scale[at]
        self._now, self._found, self._none = self._first(start), np.zeros(len(at)), 0.0
        self._before = self._now
        self.restless, self._change = -1, np.inf
        self._solved: list[tuple[Array, Array, Array]] = []
        self._held: Array = np.full(len(at), np.inf)
        self._anderson = Anderson(self._products)

    def _first(self, start: tuple[Array, Array] | None) -> Array:
        known = self._constraints.pressures[self._constraints.pressed]
        if start is None:
            return np.full(len(self._rows), np.inf)
        if any_rank(self._comm, not np.all(np.isfinite(known))):
            return np.maximum(start[0][self._rows], 0.0)
        return known

    def set_feasible(self, start: tuple[Array, Array] | None) -> tuple[Array, Array] | None:
        """Set the limits: the present ones, or if these cannot hold the load others that can.

        First those of a point that balances it; for the second time, or where the bounds come no
        nearer to rest, those of De Saxcé's fixed point, from then on.

        Returns:
            Where to start.

        Raises:
            ConvergenceError: None was found.
        """
        if self._dilated is None:
            self._constraints.set_pressures(self._now)
            late = self._idle >= PATIENCE
            if not late and (self._sticks or self._dual.holds or self._holds_nearer()):
                self._held = self._now
                return start
            lam, missing = self._balanced(start)
            if not self._lost and not late:
                self._lost = True
                self._set_larger(lam[self._rows], missing)
                return start
            self._dilated = DeSaxceIteration(self._dual, lam, self._options)
        self._now = self._dilated.settle(self._share)
        self._share *= FINER
        self._constraints.set_pressures(self._now)
        return self._dilated.lam, self._dilated.mu

    def _balanced(self, start: tuple[Array, Array] | None) -> tuple[Array, float]:
        """Return forces near the last ones, within the law, that balance the load; the defect."""
        lam = self._dual.d.duplicate()
        lam.set(0.0)
        if start is not None:
            lam.array[:] = start[0]
        found = project_or_least(self._dual.coarse, cone_set(self._constraints), lam)
        values = np.array(found.lam.array_r)
        found.lam.destroy()
        lam.destroy()
        self._anderson = Anderson(self._products)
        return values, found.missing

    def _set_larger(self, pressures: Array, missing: float) -> None:
        """Set the limits of pressures of balanced forces, or larger ones that hold the load."""
        for factor in LARGER:
            self._now = factor * pressures
            self._constraints.set_pressures(self._now)
            if self._dual.holds:
                self._held = self._now
                return
        raise ConvergenceError(
            "Coulomb's friction: no bounds were found that can hold the load (forces within its "
            f"law miss {missing:.1e} of it); expected a load farther from what friction holds"
        )

    def _holds_nearer(self) -> bool:
        """Retreat towards the last bounds that held the load; return whether those found do."""
        if any_rank(self._comm, not np.all(np.isfinite(self._held))):
            return False
        for share in NEARER:
            between = self._held + share * (self._now - self._held)
            self._constraints.set_pressures(between)
            if self._dual.holds:
                self._now = between
                return True
        return False

    def change(self, lam: PETSc.Vec, u: Array) -> float:
        """Store a solve's normal forces; return their relative distance from the bounds.

        Body by body: beside forces elsewhere those on a light one would not be seen.

        Args:
            lam: The multipliers.
            u: Their displacement, this rank's part.
        """
        values = lam.array_r
        driving = norm_over(self._comm, self._dual.driving) / (self._dual.seen or np.inf)
        self._none = NO_FORCE * max(norm_over(self._comm, values), driving)
        self._found = self._forces(values[self._rows])
        again = bool(self._solved) and self._now is self._solved[-1][0]
        self._solved = [*self._solved[: -1 if again else None][-1:], (self._now, self._found, u)]
        if self._sticks:
            return float("inf")
        miss, size = (self._on_bodies(x) for x in (self._found - self._now, self._found))
        least = self._on_bodies(np.full(len(self._rows), self._none)).max(initial=TINY)
        size = np.maximum(size, max(least, LIGHT * size.max(initial=0.0)))
        miss = np.where(miss > least, miss, 0.0)  # less is rounding
        change, body = bcast_from_root(self._comm, _largest(miss / size))
        self.restless, self._change = int(body), change
        self._idle += 1
        if change <= 0.5 * self._best:
            self._best, self._idle = change, 0
        return change

    def end(self, result: QPResult, rule: Accuracy, may_go_on: bool) -> bool:
        """Return whether converged bounds end the iteration; set the reason if u is not right.

        Args:
            result: The last solution.
            rule: Its accuracy, which tells what bounds leave of the law from now on.
            may_go_on: Whether something may come nearer to the law.
        """
        if self._fit(result, rule):
            return True
        if not may_go_on and not self._rest(rule):
            result.reason = ConvergedReason.CONVERGED_FRICTION_RTOL
        return not may_go_on

    def _fit(self, result: QPResult, rule: Accuracy) -> bool:
        """Return whether u is right to rtol with the limits that the new forces give, too.

        The rule has looked at the answer with the limits that it was found with; from now on it
        tells the larger errors. Of an answer that is a sum of two only the change is known.
        """
        if not rule.is_of(self._dual):
            return self._change <= rule.rtol
        self._constraints.set_pressures(self._found)
        given, self._dual.feasible = self._dual.feasible, contact_set(self._constraints)
        residual = max(result.projected_gradient, result.norm * result.equality)
        fits = rule.look_again(result.lam, result.gradient, result.face, residual)
        self._constraints.set_pressures(self._now)
        self._dual.feasible = given
        return fits

    def _rest(self, rule: Accuracy) -> bool:
        """Return whether u is right to rtol, extrapolated from the last two problems.

        Between them the bounds ψ and u have changed; so far as the forces are from the bounds yet,
        u is from its limit by as much, and by what is left of a geometric series.
        """
        if len(self._solved) < 2 or not rule.is_of(self._dual):
            return False
        (first, of_first, v), (now, found, u) = self._solved
        way, left, before = (
            norm_over(self._comm, self._weight * x)
            for x in (now - first, found - now, of_first - first)
        )
        if not bcast_from_root(self._comm, 0.0 < way < np.inf):
            return False
        rate = min(left / max(before, TINY), SLOWEST)
        subdomains = self._dual.subdomains
        moved = subdomains.body_maxima([subdomains.sizes(u - v)])[0]
        return rule.take(moved * bcast_from_root(self._comm, left / way / (1.0 - rate)))

    def _on_bodies(self, pressures: Array) -> Array:
        """Return norms of the nodal forces μ times those of normals make on each body."""
        B, subdomains = self._constraints.B, self._dual.subdomains
        forces, trace = B.createVecLeft(), B.createVecRight()
        forces.set(0.0)
        forces.array[self._rows] = self._mu * pressures
        B.multTranspose(forces, trace)
        squares = subdomains.body_sums([sums(trace.array_r**2, subdomains.trace_parts)])[0]
        forces.destroy()
        trace.destroy()
        return np.asarray(np.sqrt(squares))

    def advance(self) -> None:
        """Take the next bounds; not where De Saxcé's fixed point gives them.

        Forces that fall to less than half again and again, as where slips of earlier steps alone
        drive, make a geometric series: of its bounds the limit 0 is tried.
        """
        if self._dilated is not None:
            return
        if self._sticks:
            self._now = self._found
            return
        self._falls = self._falls + 1 if self._change > 1.0 else 0
        if self._falls == FALLS:
            self._now = np.zeros_like(self._found)
            self._anderson = Anderson(self._products)
        else:
            self._now = self._forces(self._anderson.next(self._now, self._found))

    def take(self, lam: Array) -> None:
        """Try the bounds of multipliers for which the law holds."""
        self._before, self._now = self._now, self._forces(lam[self._rows])
        self._constraints.set_pressures(self._now)

    def take_back(self) -> None:
        """Restore the bounds from before the try."""
        self._now = self._before

    @property
    def are_known(self) -> bool:
        """True if there are bounds to start from, none of which is De Saxcé's."""
        return self._dilated is None and not self._sticks

    def goes_on(self, reason: ConvergedReason) -> bool:
        """Choose what to try next after a failed solve; return whether there is something.

        What sticks may contradict itself, as beside a wall that pushes; then all slips. Bounds with
        hardly any forces between them leave faces that are nearly singular: then De Saxcé's fixed
        point, whose cones have far more.
        """
        if self._sticks and reason == ConvergedReason.DIVERGED_CONTRADICTION:
            self._now = np.zeros_like(self._found)
            return True
        lost = reason in (ConvergedReason.DIVERGED_ROUNDING, ConvergedReason.DIVERGED_STALLED)
        if not lost or self._dilated is not None or self._idle >= PATIENCE:
            return False
        self._idle = PATIENCE
        return True

    def _forces(self, values: Array) -> Array:
        """Return the normal forces, those that are rounding set to 0."""
        return np.where(values > self._none, values, 0.0)

    @property
    def astray(self) -> bool:
        """True if slips of De Saxcé's fixed point diverge or do not converge."""
        return self._dilated is not None and self._dilated.astray

    @property
    def slides(self) -> bool:
        """True if slips grow without converging on a body that nothing else holds."""
        free = self._dual.coarse.unheld.free
        return (
            self._dilated is not None and self._dilated.slides and bool(free[self.restless].any())
        )

    @property
    def _sticks(self) -> bool:
        """True if no bound is set yet, so that all points stick."""
        return any_rank(self._comm, bool(np.any(np.isinf(self._now))))

    def _products(self, A: Array, B: Array) -> Array:
        weighted = (self._weight[:, None] ** 2) * B
        return bcast_from_root(self._comm, summed(self._comm, A.T @ weighted))


def _largest(values: Array) -> tuple[float, int]:
    """Return the largest of some values that are not negative, and which one it is."""
    at = int(np.argmax(values)) if len(values) else -1
    return float(values[at]) if at >= 0 else 0.0, at


# --- Newton's method on Coulomb's law ---------------------------------------------------------

# how often it may end and its bounds not be at rest; the factor on its target each time, and at
# least on its residual; of ‖F‖‖λ‖: what rounding leaves of that
TRIES, FINER_LAW, ROUNDING = 4, 0.03, 2e-16
# of the first residual: what points on the path of growing friction are solved to
LOOSE = 1e-3


class NewtonOnCoulomb:
    """Newton's method on the law of a scene, tried until it fails. All methods are collective.

    Args:
        dual: The dual problem.
        options: Options.
        qp_type: The solver of problems with given bounds.

    Attributes:
        steps: Steps so far.
    """

    def __init__(self, dual: Dual, options: Options, qp_type: str) -> None:
        kind = options.friction_type
        self._dual, self._rtol, self.steps = dual, options.number, 0
        self._tries = TRIES if kind == "newton" or (kind == "auto" and qp_type == "newton") else 0
        self._share, self._options = 1.0, options
        self._recycled = dual.recycled
        # the same load again: the last bounds are right
        self._rests = dual.last.is_of(dual.d, dual.coarse.e)

    @property
    def may_try(self) -> bool:
        """True if Newton's method is wanted, has not failed, and may end nearer to the law."""
        return self._tries > 0

    def give_up(self) -> None:
        """Give up Newton's method, and drop the directions of the failed try."""
        self._tries, self._dual.recycled = 0, self._recycled

    def solve(
        self, start: tuple[Array, Array] | None, aim: float = np.inf
    ) -> tuple[Array, Array] | None:
        """λ on this rank's rows and the multipliers of Gλ = e for which the law holds.

        A step multiplies by F once, and once for each direction of its solve; so does the start,
        where it is not the last solution.

        Args:
            start: Where to start; None: nothing is tried, nor where no solve has seen F yet.
            aim: What residual an answer must have to be right, as far as a look has told.

        Returns:
            None where it is not tried, or fails.
        """
        if start is None or self._tries == 0 or self._dual.seen == 0.0:
            return None
        if self._rests:
            self._rests = False
            return None
        cite("newton on friction")
        learn(self._dual, self._options)  # steps differ by few rows, if by any
        qp, law, norm = self._dual.qp(), self._law(), self._dual.seen
        constraints = self._dual.constraints
        known = constraints.pressures[constraints.pressed]
        residual, first = self._first(qp, law, start)
        target = min(self._target(qp), FINER_LAW * residual, aim)
        if target <= ROUNDING * norm * norm_over(self._dual.coarse.comm, start[0]):
            end, steps = None, 0
        else:
            given = qp, law, self._oblique, first, target, norm
            end, steps = newton_on_law(*given)
            if end is None and not self._dual.coarse.unheld.free.any():
                end, more = follow_friction(*given, loose=LOOSE * residual)
                steps += more
        constraints.set_pressures(known)
        self.steps, self._share = self.steps + steps, FINER_LAW * self._share
        self._tries -= 1
        if end is None:
            self.give_up()
            return None
        self._pass_on(qp, end, UNSEEN * target / norm)
        return end.lam, end.mu

    def _first(self, qp: QP, law: Law, start: tuple[Array, Array]) -> tuple[float, LawPoint]:
        """The start with its μ, or with that of least squares: the one with the lesser residual."""
        (lam, mu), work = start, qp.d.duplicate()
        work.array[:] = lam
        at = self._dual.last.image(qp.F, work)
        at.Fx.axpy(-1.0, qp.d)
        found = []
        for alpha in (mu, qp.coarse.coordinates(at.Fx)):
            qp.coarse.combine(alpha, work)
            point = LawPoint(np.array(lam), at.Fx.array_r - work.array_r, alpha)
            found.append((residual_of(qp, law, point, self._dual.seen), point))
        at.destroy()
        return min(found, key=lambda one: one[0])

    def _pass_on(self, qp: QP, end: LawPoint, within: float) -> None:
        """Store Fλ of the end, to stand for points near it in the problem with its bounds."""
        work = qp.d.duplicate()
        qp.coarse.combine(end.mu, work)
        self._dual.last.pass_on(end.lam, end.s + work.array_r + qp.d.array_r, within)
        work.destroy()

    def _target(self, qp: QP) -> float:
        """Return the target rtol ‖Pd‖, smaller at each try."""
        Pd = qp.d.copy()
        qp.coarse.project(Pd)
        size = bcast_from_root(self._dual.coarse.comm, float(Pd.norm()))
        Pd.destroy()
        return self._share * self._rtol * size

    def _oblique(self, face: Face, C: csr_array) -> Oblique:
        coarse = self._dual.coarse
        return coarse.oblique(face, C) if coarse.dimension else NoOblique(face)

    def _law(self) -> Law:
        constraints = self._dual.constraints
        at = constraints.pressed

        def bounded(pressures: Array) -> FeasibleSet:
            constraints.set_pressures(pressures)
            return contact_set(constraints)

        return Law(bounded, constraints.pressed_by[at], constraints.sets.tangents[at])


# --- Solve with Coulomb's law -----------------------------------------------------------------
# Problems with given bounds of friction; the next bounds are those of Newton's method on the law
# or, where that is off or fails, of a fixed point iteration.

# Inner tolerance: rtol of the first step, and share of the last change of the bounds. Forces are
# less exact than displacements: with a tenth of the change the acceleration meets noise. The
# tolerance never grows, and stays if a problem was solved without a CG step, as the change of the
# bounds is then no measure of their error.
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
class FixedPointStatus:
    """Convergence of the bounds of friction.

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
        """Return the name of the body whose bounds changed most, and whether it slides."""
        return names[self.body], self.slides


def solve_with_friction(
    dual: Dual,
    options: Options,
    qp_type: str,
    start: tuple[Array, Array] | None = None,
    monitor: Monitor | None = None,
    goal: ErrorTarget | None = None,
) -> tuple[QPResult, Accuracy, FixedPointStatus]:
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
        return *solve_dual(dual, options, qp_type, start, monitor, goal), FixedPointStatus()
    if goal is not None:
        options = replace(options, rtol=SHARE_OF_BOUNDS * options.friction_rtol)
    bounds, steps, looks = FrictionBoundIteration(dual, options, start), Steps(), 0
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
        aim = rule.tolerance if asked <= least else np.inf  # of a coarser look nothing follows
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
    return result, rule, FixedPointStatus(iterations, *how)
