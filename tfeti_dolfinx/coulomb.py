"""Coulomb's law: a fixed point iteration on the bounds of friction, each a problem of Tresca's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.dual.accuracy import Accuracy
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.dual.goals import Goal
from tfeti_dolfinx.errors import ConvergenceError
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import agreed, any_rank, summed
from tfeti_dolfinx.qp.acceleration import Anderson
from tfeti_dolfinx.qp.cones import Cones
from tfeti_dolfinx.qp.discs import Ellipses
from tfeti_dolfinx.qp.feasible_sets import Bounds, FeasibleSet, Product
from tfeti_dolfinx.qp.monitors import Monitor
from tfeti_dolfinx.qp.nearest import nearest_or_least
from tfeti_dolfinx.qp.problem import ConvergedReason, QPResult, Steps
from tfeti_dolfinx.solver import solve_dual
from tfeti_dolfinx.subdomains.subdomains import sums

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
# of all multipliers: forces of normals that rounding makes of none; as bounds they would be discs
# whose boundaries bend so much that nothing else is seen beside them
NO_FORCE = 1e-13
# of the largest forces of normals on a body: those on a lighter one count as so large at least
LIGHT = 1e-6
# factors on the forces of normals of the nearest balanced point: it is found to some digits only
LARGER = (1.0, 1.001, 1.1, 2.0)
# of a step of bounds that ends where they cannot hold the load: those that can are a convex set
NEARER = (0.5, 0.25, 0.1)


@dataclass(frozen=True)
class Settling:
    """How the bounds of friction have come to rest.

    Attributes:
        iterations: Problems with given bounds that were solved; 0 without Coulomb's law.
        change: Last change of the bounds, over their size.
        tolerance: What that had to come down to.
        last: Multiplications by F of the last problem.
    """

    iterations: int = 0
    change: float = 0.0
    tolerance: float = 0.0
    last: int = 0


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
    bounds, steps, looks = _Pressures(dual, start), Steps(), 0
    least = options.number
    tolerance = min(options.friction_rtol, BESIDE_RTOL * least)
    change, rtol, iterations = np.inf, FIRST, 0
    while True:
        bounds.set_feasible(start)
        near = change <= NEAR * tolerance
        rtol = least if near else max(least, min(rtol, SHARE * change))
        before = dual.F.count["solver"]
        asked, exact = replace(options, rtol=rtol), goal if rtol <= least else None
        result, rule = solve_dual(dual, asked, qp_type, start, monitor, exact)
        iterations, looks = iterations + 1, looks + rule.looks
        steps = steps.plus(result.steps)
        if bounds.slips_first(result.reason):
            result.destroy()
            continue
        if result.reason <= 0:
            break
        change = bounds.change(result.lam)
        if change <= tolerance and rtol <= least:
            break
        if iterations >= options.friction_max_it:
            result.reason = ConvergedReason.DIVERGED_FRICTION
            break
        if change > tolerance:
            bounds.advance()
        if result.steps.inner == 0:
            rtol *= SHARE
        start = (np.array(result.lam.array_r), result.mu)
        result.destroy()
    result.steps, rule.looks = steps, looks
    last = dual.F.count["solver"] - before
    return result, rule, Settling(iterations, float(change), tolerance, last)


class _Pressures:
    """λ_N of the rows under Coulomb's law, that the limits belong to. All methods are collective.

    Without a start what touches sticks at first: that has a solution wherever any bounds have one.

    Args:
        dual: The dual problem.
        start: Multipliers to start from.
    """

    def __init__(self, dual: Dual, start: tuple[Array, Array] | None) -> None:
        self._dual, self._constraints = dual, dual.constraints
        self._comm = dual.coarse.comm
        at = dual.constraints.pressed
        self._rows = dual.constraints.pressed_by[at]
        # differences of bounds are measured as forces
        self._mu = np.linalg.norm(dual.constraints.coefficients[at], axis=1)
        self._weight = self._mu * dual.constraints.tangent_scale[at]
        self._now, self._found, self._none = self._first(start), np.zeros(len(at)), 0.0
        self._anderson, self._held = Anderson(self._products), np.full(len(at), np.inf)

    def _first(self, start: tuple[Array, Array] | None) -> Array:
        known = self._constraints.pressures[self._constraints.pressed]
        if start is None:
            return np.full(len(self._rows), np.inf)
        if any_rank(self._comm, not np.all(np.isfinite(known))):
            return np.maximum(start[0][self._rows], 0.0)
        return known

    def set_feasible(self, start: tuple[Array, Array] | None) -> None:
        """Set the limits, first those of a point that balances the load if these cannot.

        Raises:
            ConvergenceError: None was found.
        """
        self._constraints.set_pressures(self._now)
        if self._sticks or self._dual.holds or self._holds_nearer():
            self._held = self._now
            return
        lam = self._dual.d.duplicate()
        lam.set(0.0)
        if start is not None:
            lam.array[:] = start[0]
        found = nearest_or_least(self._dual.coarse, _cone_set(self._constraints), lam)
        pressures = np.array(found.lam.array_r[self._rows])
        found.lam.destroy()
        lam.destroy()
        self._anderson = Anderson(self._products)
        for factor in LARGER:
            self._now = factor * pressures
            self._constraints.set_pressures(self._now)
            if self._dual.holds:
                self._held = self._now
                return
        raise ConvergenceError(
            "Coulomb's friction: no bounds were found that can hold the load (forces within its "
            f"law miss {found.missing:.1e} of it); expected a load farther from what friction holds"
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

    def change(self, lam: PETSc.Vec) -> float:
        """Take what a solve has found; how far that is from the bounds, over its size.

        Body by body: beside forces elsewhere those on a light one would not be seen.
        """
        values = lam.array_r
        self._none = NO_FORCE * float(np.sqrt(summed(self._comm, np.array([values @ values]))[0]))
        self._found = self._forces(values[self._rows])
        if self._sticks:
            return float("inf")
        miss, size = (self._on_bodies(x) for x in (self._found - self._now, self._found))
        least = self._on_bodies(np.full(len(self._rows), self._none)).max(initial=TINY)
        size = np.maximum(size, max(least, LIGHT * size.max(initial=0.0)))
        return agreed(self._comm, float(np.max(miss / size, initial=0.0)))

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
        """Take the next bounds."""
        sticks = self._sticks
        self._now = (
            self._found if sticks else self._forces(self._anderson.next(self._now, self._found))
        )

    def slips_first(self, reason: ConvergedReason) -> bool:
        """Whether what sticks contradicts itself, as beside a wall that pushes; then all slips."""
        if not self._sticks or reason != ConvergedReason.DIVERGED_CONTRADICTION:
            return False
        self._now = np.zeros_like(self._found)
        return True

    def _forces(self, values: Array) -> Array:
        """Forces of normals, without what is none but for rounding."""
        return np.where(values > self._none, values, 0.0)

    @property
    def _sticks(self) -> bool:
        """Whether no bound is set yet."""
        return any_rank(self._comm, bool(np.any(np.isinf(self._now))))

    def _products(self, A: Array, B: Array) -> Array:
        weighted = (self._weight[:, None] ** 2) * B
        return agreed(self._comm, summed(self._comm, A.T @ weighted))


def _cone_set(constraints: Constraints) -> Product:
    """λ_N ≥ 0, given bounds, and Coulomb's law for normal and tangents together."""
    sets, pressed = constraints.sets, constraints.pressed
    above = constraints.pressed_by[pressed]
    given = np.setdiff1d(np.arange(len(sets.tangents)), pressed)
    rows = np.column_stack((above, sets.tangents[pressed]))
    # the nearest point asks for no more than projections and faces
    cone = cast(FeasibleSet, Cones(constraints.coefficients[pressed]))
    return Product(
        [
            (np.setdiff1d(sets.normals, above), Bounds()),
            (sets.tangents[given].ravel(), Ellipses(constraints.limits[given])),
            (rows.ravel(), cone),
        ]
    )
