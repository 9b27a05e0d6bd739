"""The forces of normals that Coulomb's law takes its bounds from, and the next ones to try."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import TINY, Array, sums
from tfeti_dolfinx.dilation import DilatedGaps, cone_set
from tfeti_dolfinx.dual.accuracy import Accuracy
from tfeti_dolfinx.dual.dual import Dual, contact_set
from tfeti_dolfinx.errors import ConvergenceError
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import agreed, any_rank, norm_over, summed
from tfeti_dolfinx.qp.acceleration import Anderson
from tfeti_dolfinx.qp.nearest import nearest_or_least
from tfeti_dolfinx.qp.problem import ConvergedReason, QPResult

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
# change of slips at which De Saxcé's fixed point is looked at first; and a factor each time
# after it
COARSE, FINER = 1e-4, 0.01
# the largest share of the change of bounds that is taken to be left of it in the next problem
SLOWEST = 0.9
# of a step of bounds that ends where they cannot hold the load: those that can are a convex set
NEARER = (0.5, 0.25, 0.1)


class Pressures:
    """λ_N of the rows under Coulomb's law, that the limits belong to. All methods are collective.

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
        self._dilated: DilatedGaps | None = None
        self._lost, self._share = False, COARSE
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
            self._dilated = DilatedGaps(self._dual, lam, self._options)
        self._now = self._dilated.settle(self._share)
        self._share *= FINER
        self._constraints.set_pressures(self._now)
        return self._dilated.lam, self._dilated.mu

    def _balanced(self, start: tuple[Array, Array] | None) -> tuple[Array, float]:
        """Forces within the law that balance the load, near the last ones; what they miss of it."""
        lam = self._dual.d.duplicate()
        lam.set(0.0)
        if start is not None:
            lam.array[:] = start[0]
        found = nearest_or_least(self._dual.coarse, cone_set(self._constraints), lam)
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
        """Whether bounds between the last ones, which held the load, and the present ones do."""
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
        """Take what a solve has found; how far that is from the bounds, over its size.

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
        change, body = agreed(self._comm, _largest(miss / size))
        self.restless, self._change = int(body), change
        self._idle += 1
        if change <= 0.5 * self._best:
            self._best, self._idle = change, 0
        return change

    def end(self, result: QPResult, rule: Accuracy, may_go_on: bool) -> bool:
        """Whether bounds at rest end the iteration; if u is not right to rtol, the reason says so.

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
        """Whether u is right to rtol with the limits of the forces that were found, too.

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
        """Whether u is right to rtol as far as the last two problems tell; else ``_fit`` has told.

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
        if not agreed(self._comm, 0.0 < way < np.inf):
            return False
        rate = min(left / max(before, TINY), SLOWEST)
        subdomains = self._dual.subdomains
        moved = subdomains.body_maxima([subdomains.sizes(u - v)])[0]
        return rule.take(moved * agreed(self._comm, left / way / (1.0 - rate)))

    def _on_bodies(self, pressures: Array) -> Array:
        """Norms of the nodal forces μ times those of normals make on each body."""
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
        """Take the next bounds; not where De Saxcé's fixed point gives them."""
        if self._dilated is not None:
            return
        sticks = self._sticks
        self._now = (
            self._found if sticks else self._forces(self._anderson.next(self._now, self._found))
        )

    def take(self, lam: Array) -> None:
        """Take the bounds of multipliers for which the law holds, for a try."""
        self._before, self._now = self._now, self._forces(lam[self._rows])
        self._constraints.set_pressures(self._now)

    def take_back(self) -> None:
        """Take those again that were there before."""
        self._now = self._before

    @property
    def are_known(self) -> bool:
        """Whether there are bounds to start from, none of which is De Saxcé's."""
        return self._dilated is None and not self._sticks

    def goes_on(self, reason: ConvergedReason) -> bool:
        """Whether there is something else to try where a problem has no solution, or none is found.

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
        """Forces of normals, without what is none but for rounding."""
        return np.where(values > self._none, values, 0.0)

    @property
    def astray(self) -> bool:
        """Whether slips of De Saxcé's fixed point grow without end, or do not come to rest."""
        return self._dilated is not None and self._dilated.astray

    @property
    def slides(self) -> bool:
        """Whether slips have grown, and not come to rest, on a body that nothing else holds."""
        free = self._dual.coarse.unheld.free
        return (
            self._dilated is not None and self._dilated.slides and bool(free[self.restless].any())
        )

    @property
    def _sticks(self) -> bool:
        """Whether no bound is set yet."""
        return any_rank(self._comm, bool(np.any(np.isinf(self._now))))

    def _products(self, A: Array, B: Array) -> Array:
        weighted = (self._weight[:, None] ** 2) * B
        return agreed(self._comm, summed(self._comm, A.T @ weighted))


def _largest(values: Array) -> tuple[float, int]:
    """The largest of some values that are not negative, and which one it is."""
    at = int(np.argmax(values)) if len(values) else -1
    return float(values[at]) if at >= 0 else 0.0, at
