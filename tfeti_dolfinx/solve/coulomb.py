"""Coulomb's law: Newton's method on it, and problems with given bounds of friction."""

from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.common.arrays import TINY, Array, sums
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.common.parallel import any_rank, largest, norm_over, steering, summed
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.solvability import sliding_motion
from tfeti_dolfinx.feti.stopping import Accuracy, ErrorTarget, MakeRule
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.friction_newton import PARAMETERS as ON_LAW
from tfeti_dolfinx.qp.friction_newton import Law, LawPoint, LawProgram, newton_on_law
from tfeti_dolfinx.qp.newton import growth, multipliers_at, seen_norm
from tfeti_dolfinx.qp.problem import ConvergedReason, KnownProduct, Monitor, Point, QPResult, Steps
from tfeti_dolfinx.solve.solver import solve_dual


@dataclass(frozen=True)
class CoulombParameters:
    """Parameters of a solve with Coulomb's law."""

    tries: int = 4  # how often that may end and its bounds not be at rest; once where it has failed
    finer: float = 0.03  # of its first residual: its target at most, where no look has told one
    nearer: float = 0.2  # the same where a look has
    # its target at most, over the tolerance that a look leaves to a solve. Looks leave half of
    # what an answer needs (StoppingTolerances.aim), bar where a bound or a leap limits them
    looser: float = 2.0
    first: float = 1e-2  # relative tolerance of the first problem with given bounds
    # of the last change of bounds: that of the next one. Forces are less exact than displacements
    share: float = 0.01
    # of rtol times its first residual: no residual that earlier solves let expect is less
    expected: float = 0.01
    near: float = 10.0  # of what is wanted: a change from which on the next one may be small enough
    # times rtol: change of bounds at rest, where options ask for no less
    beside_rtol: float = 100.0
    # of the change of bounds at rest: rtol, where a target of the error in energy takes its place,
    # since forces have to be known to that change
    with_target: float = 0.1
    # problems in a row whose change is not half of the least one before, and bounds do not come to
    # rest
    patience: int = 12
    shortest: float = 0.125  # of a step towards the forces found: bounds never take less of it
    # problems in a row whose forces are less than half of their bounds: these fall to 0
    falls: int = 2
    # of the load of a body, over the number of its points: other bounds, one after the other. Their
    # friction may bear what slides, but not all of the load, or points hang; at last it may
    shares: tuple[float, ...] = (4.0, 2.0, 1000.0)
    # of all multipliers: forces of normals that rounding makes of none. As bounds they would be
    # discs that bend so much that nothing else is seen beside them
    no_force: float = 1e-13
    # of the largest forces of normals on a body: those of a lighter one count as so large
    light: float = 1e-6
    reach: float = 10.0  # ρ of the natural map at points that are made to slip
    rounding: float = 2e-16  # of ‖F‖‖λ‖, or of ‖d‖: no residual is less
    seen: float = 1e3  # times that: a residual that is expected is not less
    # of what bends, of gaps and of what is prescribed: a slip without end. It is below 10 where
    # friction holds, below 1e3 where it holds 1e-6 more than the load, 1e4 and more where it fails
    slips: float = 1e4


PARAMETERS = CoulombParameters()


@dataclass(frozen=True)
class FixedPointStatus:
    """Convergence of the bounds of friction."""

    iterations: int = 0  # problems with given bounds that were solved; 0 without Coulomb's law
    change: float = 0.0  # last change of the bounds, over their size
    tolerance: float = 0.0  # what that had to come down to
    body: int = -1  # that on which they changed most at last; -1 without Coulomb's law
    newton_steps: int = 0  # steps of Newton's method on Coulomb's law, beside the problems
    slides: str = ""  # what friction does not hold, in words
    looks: int = 0  # assessments of all problems


def solve_with_friction(
    dual: Dual,
    options: Options,
    start: tuple[Array, Array] | None = None,
    monitor: Monitor | None = None,
    goal: ErrorTarget | None = None,
    make_rule: MakeRule = Accuracy,
) -> tuple[QPResult, Accuracy, FixedPointStatus]:
    """Solve the dual problem with bounds of friction that fit the forces of normals. Collective.

    Problems with given bounds, of which the last one has to give the forces again that its bounds
    are of. The next bounds are those of Newton's method on the law or, where that is off or fails,
    the last forces: a fixed point iteration. Arguments and result are those of ``solve_dual``, with
    the steps and looks of all problems, and how the bounds have come to rest.
    """
    if not any_rank(dual.coarse.comm, dual.constraints.pressed.size > 0):
        dual.bound_friction(None)  # there may have been coefficients
        solved = solve_dual(dual, options, start, monitor, goal, make_rule)
        slides = _slides(dual, *solved, None)
        return *solved, FixedPointStatus(slides=slides, looks=solved[1].looks)
    least = options.number if goal is None else PARAMETERS.with_target * options.friction_rtol
    tolerance = min(options.friction_rtol, PARAMETERS.beside_rtol * least)
    bounds = FrictionBounds(dual, start)
    newton = NewtonOnLaw(dual, options, least)
    rtol, change, aim, near = PARAMETERS.first, np.inf, np.inf, False
    steps, looks, iterations = Steps(), 0, 0
    # Step 0: the first bounds: of Newton's method on the law, else those of the start
    law = newton.solve(start, bounds)
    motion = None if law else bounds.set_feasible()
    while True:
        # Step 1: the problem with these bounds; those of the law are worth all digits
        if law is None:
            rtol = least if near else max(least, min(rtol, PARAMETERS.share * change))
        asked = least if law else rtol
        exact = goal if asked <= least else None
        # how exact the first of the law has to be a look tells
        max_it = 0 if law and aim == np.inf else options.max_it
        limited = replace(options, rtol=asked, max_it=max_it)
        result, rule = solve_dual(dual, limited, law or start, monitor, exact, make_rule)
        iterations, looks, steps = iterations + 1, looks + rule.looks, steps.plus(result.steps)
        reached = PARAMETERS.looser * rule.tolerance
        # Step 2: without an answer other bounds, or more steps of Newton's method
        if result.reason <= 0:
            if law:
                looked = aim == np.inf and result.reason == ConvergedReason.DIVERGED_ITS
                law = newton.go_on(law, bounds, reached, looked)
            elif not bounds.try_others(result):
                break
            aim = reached
            if not law and (motion := bounds.set_feasible()) is not None:
                break
            continue
        # Step 3: its forces of normals, beside those that the bounds are of
        change = bounds.take_forces(result.lam)
        near = change <= PARAMETERS.near * tolerance
        aim = reached * min(1.0, least / asked)  # residuals and errors fall together
        # Step 4: where they are at rest, what they leave of the law
        if change <= tolerance and asked <= least:
            if goal is not None or bounds.fit_law(result, rule):
                break
            if newton.tries == 0 and (bounds.idle > 1 or iterations >= options.friction_max_it):
                result.reason = ConvergedReason.CONVERGED_FRICTION_RTOL
                break
        # Step 5: the next bounds: of Newton's method on the law, or those forces
        # where nothing was to do the change tells nothing of the error of bounds: finer, first
        moved = law is not None or result.steps.inner > 0
        rtol *= 1.0 if moved else PARAMETERS.share
        start = law or (result.lam, result.mu)
        bounds.advance()
        law = newton.solve(start, bounds, aim) if moved else None
        found = bounds.now
        motion = None if law else bounds.set_feasible()
        start = start if bounds.now is found else None  # with other bounds anew
        restless = bounds.idle > PARAMETERS.patience or iterations >= options.friction_max_it
        if motion is not None or restless:
            result.reason = ConvergedReason.DIVERGED_FRICTION
            break
    newton.learn(result, rule)
    result.steps = steps
    slides = _slides(dual, result, rule, motion)
    at_rest = change, tolerance, bounds.body
    return result, rule, FixedPointStatus(iterations, *at_rest, newton.steps, slides, looks)


def _slides(dual: Dual, result: QPResult, rule: Accuracy, motion: Array | None) -> str:
    """Say that a motion of bodies, else that of u, has no end; "" if it has one. Collective.

    Then the result is no answer, and has the rows that slip most. Where friction fails a body may
    yet wedge in rounding, or in straight facets, far away.
    """
    state, coarse = rule.recovered, dual.coarse
    known = motion is not None or result.reason == ConvergedReason.DIVERGED_CONTRADICTION
    if not known and dual.contact_rows[1] and coarse.dimension:
        slip, bends = (np.abs(x) / coarse.row_size for x in (state.gap, state.residual))
        rubs = coarse.rubbing[state.active[coarse.rubbing]]  # what is let go may go anywhere
        if largest(coarse.comm, slip[rubs]) > PARAMETERS.slips * largest(coarse.comm, bends):
            motion = coarse.bodies.part_of(state.u)
    if motion is None:
        return ""
    slips = np.zeros(len(dual.d))
    slips[coarse.rubbing] = np.abs(coarse.J @ motion)[coarse.rubbing]
    result.reason = ConvergedReason.DIVERGED_FRICTION
    result.excluding = np.flatnonzero(slips > 0.5 * largest(coarse.comm, slips))
    return coarse.bodies.sentence(coarse.bodies.amounts(motion))


class FrictionBounds:
    """The λ_N that friction limits are taken from. All methods are collective.

    Without a start what touches sticks at first: that has a solution wherever any bounds have one.
    So does what touches a body that nothing but friction may hold, and that has borne no force.

    Attributes:
        now: The present ones, of each of ``constraints.pressed``; ∞: the point sticks.
        found: The forces of normals of the last problem.
        body: The body on which they changed most at last; -1 before.
        idle: Problems in a row whose change is not half of the least one before.
    """

    def __init__(self, dual: Dual, start: tuple[Array, Array] | None) -> None:
        self._dual, self._comm = dual, dual.coarse.comm
        constraints, coarse = dual.constraints, dual.coarse
        self._constraints, at = constraints, constraints.pressed
        self._rows = constraints.pressed_by[at]
        self._mu = np.linalg.norm(constraints.coefficients[at], axis=1)
        self.now: Array = np.full(len(self._rows), np.inf)
        if start is not None:
            known = dual.pressures[at]
            lost = any_rank(self._comm, not np.all(np.isfinite(known)))
            self.now = np.maximum(start[0][self._rows], 0.0) if lost else known
            # points stick on bodies that friction may hold, and whose forces tell nothing of it;
            # where slips count from elsewhere, a body was let go, and would be drawn back there
            tangents = constraints.sets.tangents
            loose = np.any(coarse.unheld.free, axis=1) & (self._on_bodies(self.now) == 0.0)
            loose &= not any_rank(self._comm, constraints.c[tangents])
            on_loose = np.zeros(constraints.num_rows, dtype=bool)
            on_loose[coarse.J.row[loose[coarse.J.body]]] = True
            unknown = np.any(on_loose[tangents[at]], axis=1) & (self._mu > 0.0)
            self.now = np.where(unknown, np.inf, self.now)
        # what ``set_feasible`` and ``try_others`` have not tried yet
        self._others = [*([] if start is None else [np.inf]), *PARAMETERS.shares]
        self._turns = 2
        self.found = self.now
        self._last: tuple[Array, Array] | None = None  # bounds and forces before these
        self._none, self._best, self._falls = 0.0, np.inf, 0
        self.idle, self.body = 0, -1

    @property
    def some_stick(self) -> bool:
        """True if some bounds are not set yet, so that their points stick. Collective."""
        return any_rank(self._comm, np.isinf(self.now))

    def set_feasible(self) -> Array | None:
        """Set the present bounds, else others, each once; return a motion that they let go.

        Others are those of points that all stick. These may hang where they do not touch, which
        tells no forces of normals: then those of points that share the load of a body.
        """
        dual, first = self._dual, None
        while True:
            dual.bound_friction(self.now)
            if self.some_stick:
                return None
            motion = sliding_motion(dual.coarse, dual.constraints, dual.pulling)
            first = motion if first is None else first
            if motion is None or not self._others:
                return None if motion is None else first
            self.now = self._shared_load(self._others.pop(0))

    def _shared_load(self, share: float) -> Array:
        """λ_N of points that bear a share of the load of a body over their number; ∞: all stick."""
        if np.isinf(share):
            return np.full(len(self._rows), np.inf)
        coarse, weights = self._dual.coarse, np.zeros(self._constraints.num_rows)
        loads = coarse.bodies.loads * np.sqrt(coarse.bodies.nodes)
        presses = np.isin(coarse.J.row, self._rows)
        counts = np.bincount(coarse.J.body[presses], minlength=coarse.bodies.count)
        loads = loads * share / np.maximum(summed(self._comm, counts.astype(float)), 1.0)
        np.maximum.at(weights, coarse.J.row, loads[coarse.J.body])
        return np.asarray((weights / coarse.row_size)[self._rows])

    def try_others(self, result: QPResult) -> bool:
        """Take other bounds after a problem without an answer; return whether there are any.

        Where sticking contradicts itself, as beside a wall that pushes, or bounds of forces that
        are gone leave a body that is let go to rounding, all slip. Where that is lost, too, as in a
        gap that is hardly a wedge, bounds are those of the forces found then. Each is tried once.
        """
        reason, slips = result.reason, not any_rank(self._comm, self.now > 0.0)
        lost = reason in (ConvergedReason.DIVERGED_STALLED, ConvergedReason.DIVERGED_ROUNDING)
        contradicts = self.some_stick and reason == ConvergedReason.DIVERGED_CONTRADICTION
        found = self.forces_of(result.lam)
        if (lost or contradicts) and self._turns == 2 and not slips:
            self.now, self._turns = np.zeros(len(self._rows)), 1
        elif lost and self._turns and any_rank(self._comm, found > 0.0):
            self.now, self._turns = found, 0
        else:
            return False
        return True

    def take_forces(self, values: Array) -> float:
        """Store a solve's normal forces; return their relative distance from the bounds.

        Body by body, as nodal forces of friction: beside forces elsewhere those on a light one
        would not be seen.
        """
        driving = norm_over(self._comm, self._dual.driving) / (self._dual.norm or np.inf)
        most = max(norm_over(self._comm, values), driving)
        moves_none = float(np.min(self._dual.negligible)) / (self._dual.norm or np.inf)
        self._none = max(PARAMETERS.no_force * most, moves_none)
        self.found = self.forces_of(values)
        if self.some_stick:
            return float("inf")
        nothing = np.full(len(self._rows), self._none)
        miss, size, least = map(self._on_bodies, (self.found - self.now, self.found, nothing))
        lightest = PARAMETERS.light * size.max(initial=0.0)
        size = np.maximum(size, max(least.max(initial=TINY), lightest))
        self.body = int(np.argmax(miss / size))
        miss = np.where(miss > least, miss, 0.0)  # less is rounding
        change = float(miss[self.body] / size[self.body])
        self.idle += 1
        self._falls = self._falls + 1 if change > 1.0 else 0
        if change <= 0.5 * self._best:
            self._best, self.idle = change, 0
        return change

    def fit_law(self, result: QPResult, rule: Accuracy) -> bool:
        """Return whether u is right to rtol with the limits that the new forces give, too.

        From then on the rule tells the larger errors.
        """
        self._dual.bound_friction(self.found)
        fits = rule.look_again(result.face)
        self._dual.bound_friction(self.now)
        return fits

    def advance(self) -> None:
        """Go towards the forces that were found, all of the way unless that has led away."""
        now, found = self.now, self.found
        # forces that fall to less than half again and again, as where slips of earlier steps alone
        # drive, make a geometric series: of its bounds the limit 0 is tried
        if self._falls == PARAMETERS.falls and not self.some_stick:
            self.now = np.zeros_like(found)
        else:
            share = 1.0 if self.some_stick else self._relaxation()
            self.now = found if share == 1.0 else now + share * (found - now)
        self._last = now, found

    def _relaxation(self) -> float:
        """Return the share of the next step: Aitken's (Irons, Tuck, IJNME 1, 1969), 1 at most."""
        if self._last is None or any_rank(self._comm, np.isinf(self._last[0])):  # all stuck
            return 1.0
        (first, of_first), now, found = self._last, self.now, self.found
        step, turn = now - first, (found - now) - (of_first - first)
        along, size = summed(self._comm, np.array([-(step @ turn), turn @ turn]))
        share = along / size if along > 0.0 else 1.0  # else they run away, to other ones
        return float(steering(self._comm, np.clip(share, PARAMETERS.shortest, 1.0))[0])

    def forces_of(self, lam: Array, none: float = 0.0) -> Array:
        """Return the normal forces, those that are rounding or at most ``none`` set to 0."""
        return np.where(lam[self._rows] > max(self._none, none), lam[self._rows], 0.0)

    def _on_bodies(self, pressures: Array) -> Array:
        """Return norms of the nodal forces μ times those of normals make on each body."""
        subdomains, forces = self._dual.subdomains, np.zeros(self._constraints.num_rows)
        forces[self._rows] = self._mu * pressures
        squares = sums(self._constraints.forces(forces) ** 2, subdomains.trace_parts)
        squares = subdomains.of_bodies([squares])[0]
        return steering(self._comm, *np.sqrt(squares))


class NewtonOnLaw:
    """Newton's method on the law of a scene, tried until it fails. All methods are collective."""

    def __init__(self, dual: Dual, options: Options, rtol: float) -> None:
        self._dual, self._rtol = dual, rtol
        self.tries = PARAMETERS.tries if options.friction_type == "newton" else 0
        self.steps, self._first = 0, 0.0
        self._recycled = dual.recycled
        self._before: Array = np.zeros(0)  # bounds before those of the last answer
        pairs = zip(dual.solved, (dual.d, dual.coarse.e), strict=True)
        other = not all(np.array_equal(kept, now) for kept, now in pairs)
        self._rests = not any_rank(dual.coarse.comm, other)

    def learn(self, result: QPResult, rule: Accuracy) -> None:
        """Keep for the next solve what residual is little enough, over that of the start."""
        if self._first > 0.0 and result.reason > 0:
            enough = result.projected_gradient / max(rule.ratio(), PARAMETERS.finer)
            left = PARAMETERS.looser * enough / self._first
            self._dual.law_target = self._rtol, float(steering(self._dual.coarse.comm, left)[0])

    def go_on(
        self, law: tuple[Array, Array], bounds: FrictionBounds, aim: float, looked: bool
    ) -> tuple[Array, Array] | None:
        """Go on from the first answer, which has only been looked at, or go back.

        Where Newton's method fails, the problem with its bounds goes on. To go back bounds become
        those before the answer, and Newton's method is tried no more.
        """
        before = self._before
        again = (self.solve(law, bounds, aim) or law) if looked else None
        if again is None:
            self.tries, self._dual.recycled, bounds.now = 0, self._recycled, before
        self._before = before
        return again

    def solve(
        self, start: tuple[Array, Array] | None, bounds: FrictionBounds, aim: float = np.inf
    ) -> tuple[Array, Array] | None:
        """Find λ, on this rank's rows, and multipliers of Gλ = e for which the law holds.

        ``bounds`` become those of λ; ``aim`` is what residual an answer must have to be right, as
        far as a look has told. None where it fails, or is not tried, as without a start.
        """
        dual = self._dual
        if start is None or self.tries == 0 or bounds.some_stick:
            return None
        rows, at = dual.constraints, dual.constraints.pressed
        if not any_rank(dual.coarse.comm, start[0][rows.pressed_by[at]] > 0.0):
            return None  # of a body that is let go there is nothing to find
        if self._rests:  # the same load again: the last bounds are right
            self._rests = False
            return None
        cite("newton on friction")
        dual.learn()  # steps differ by few rows, if by any
        qp, normals, tangents = dual.qp(), rows.pressed_by[at], rows.sets.tangents[at]
        law = Law(lambda N: dual.make_feasible(rows.with_pressures(N)), normals, tangents)
        # Step 1: the start or its multiple, with its μ or that of least squares: the least residual
        Fx = dual.last.image(qp.F, qp.coarse.comm, start[0])
        dual.norm = dual.norm or seen_norm(qp, Point(start[0], Fx - qp.d))
        if (norm := dual.norm) == 0.0:
            return None
        # what is made to slip along a row without entries
        drawn = np.any(~rows.contact.moves[at] & (rows.c[tangents] != 0.0), axis=1)
        reach = np.ones(rows.num_rows)
        reach[tangents[drawn]] = PARAMETERS.reach
        program = LawProgram(qp, law, dual.coarse.oblique, norm, reach)
        points = []
        for c in dict.fromkeys((1.0, growth(qp.coarse, start[0]))):
            z = Point(c * start[0], c * Fx - qp.d)
            known = start[1] if len(start[1]) == qp.coarse.dimension else multipliers_at(qp, z)
            for mu in (known, qp.coarse.coordinates(z.g)):
                points.append(LawPoint(z.lam, z.g - qp.coarse.combined(mu), mu))
        residuals = [program.natural_map(point)[2] for point in points]
        residual = min(residuals)
        first = points[residuals.index(residual)]
        # Step 2: the target; the first also by what the last solve to rtol has left of its own
        if aim < np.inf:
            target = min(aim, PARAMETERS.nearer * residual)
        else:
            size = norm_over(qp.coarse.comm, qp.coarse.project(qp.d))
            target = min(self._rtol * size, PARAMETERS.finer * residual)
        terms = max(norm * norm_over(dual.coarse.comm, start[0]), norm_over(dual.coarse.comm, qp.d))
        if self._first == 0.0:
            self._first, (rtol, left) = residual, dual.law_target
            expected = max(left, PARAMETERS.expected * rtol) * residual
            if rtol == self._rtol and expected > PARAMETERS.seen * PARAMETERS.rounding * terms:
                target = min(target, expected)
        # Step 3: Newton's method
        end, steps = None, 0
        if target > PARAMETERS.rounding * terms:
            end, steps = newton_on_law(program, first, target)
        self.steps += steps
        self.tries -= 1
        if end is None:
            self.tries, dual.recycled = min(self.tries, 1), self._recycled
            return None
        # F of the end stands for that of the nearest point of its set, where the problem begins
        Fx = end.s + qp.coarse.combined(end.mu) + qp.d
        dual.last = KnownProduct(end.lam, Fx, within=ON_LAW.unseen * target / norm)
        # the bounds of multipliers for which the law holds; what cannot be seen bounds none
        self._before, bounds.now = bounds.now, bounds.forces_of(end.lam, dual.last.within)
        dual.bound_friction(bounds.now)
        return end.lam, end.mu
