"""The stopping rule: the displacement of each body is right."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tfeti_dolfinx.common.arrays import TINY, Array, sums
from tfeti_dolfinx.common.parallel import maxima, steering, summed
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.duality_gap import energy_bound, within
from tfeti_dolfinx.feti.recovery import (
    Recovered,
    min_norm_correction,
    placed,
    recover,
    without_loose,
)
from tfeti_dolfinx.qp.coarse import LIGHT
from tfeti_dolfinx.qp.problem import ROUNDING, ConvergedReason, QPResult, StoppingRule
from tfeti_dolfinx.qp.sets import Face

# from the displacement on this rank to the other error, a root of an energy; collective
ErrorTarget = Callable[[Array], float]


@dataclass(frozen=True)
class StoppingTolerances:
    """Tolerances of an answer that is right, beside rtol."""

    # rounding of displacements, of the largest of all bodies, or of the slip that friction counts
    # from
    noise: float = 2.5e-13
    load_noise: float = 1e-14  # the same of what the load does to subdomains alone, and of gaps
    # of rtol: error of u in energy over all bodies, so that forces are right where bodies move much
    # and deform little
    energy: float = 10.0
    # of the other error, or of a 1e-5th of ‖u‖_K where that is more: the bound of the algebraic
    # error
    target: float = 0.1
    # motions of loose bodies that rows resist by less than this share they do not see, nor by less
    # than that of rtol: overlaps that this leaves are small beside the motion
    unseen: float = 3e-7
    share_unseen: float = 0.1
    aim: float = 0.5  # of the tolerance: residuals are aimed a little below what was asked for
    # a tolerance never falls by more at once, since the size of the displacement may have been
    # learnt from a poor iterate
    leap: float = 1e-6


# --- Measures of an iterate in physical units -------------------------------------------------


@dataclass(frozen=True)
class Measures:
    """An iterate in physical terms; the same on all ranks. Arrays have the shape ``(bodies,)``."""

    size: Array  # largest displacement of a node of each body, as a length
    elastic: Array  # the same but for a rigid motion
    energies: Array  # uᵀKu of each body
    correction: Array  # largest displacement v of each body that closes jumps and overlaps
    correction_energies: Array  # vᵀ diag(K) v, its diagonal as in D the mean at each node
    change: Array  # largest change of each body since the iterate before, loose motions apart, or 0
    alone: Array  # largest displacement K⁺f of the trace of each body
    stiffness: Array  # trace of K on the trace unknowns of each body
    pushed: Array  # size of what contact and prescribed values do to each body, squared; 0: nothing
    # deepest overlap, distance of a row that carries a force, or slip that friction does not allow
    penetration: float
    balance: float  # force left on a kernel mode, where it is largest beside the forces there
    forces: float  # size of these forces
    gap: float  # largest gap of a contact row, or overlap
    # largest slip that friction counts from, or displacement from which loose motions are found
    begin: float
    # what rounding leaves of the residuals of rows that the face holds, however far others are open
    rounding: float
    error: float  # norm of the correction in energy, over all bodies
    energy: float  # ‖u‖_K
    longest: float  # the longest of what rows miss, and of what closes that
    effect: float  # ‖F‖‖λ‖: no displacement that forces make is larger


def measure(
    dual: Dual, state: Recovered, face: Face, norm: float, before: Array | None = None
) -> Measures:
    """Measure how well the displacement of an iterate fulfils the rows. Collective.

    1. Rows miss w: of Bu − c all of equalities and of rows that press both ways, of others where
       they overlap, or as far as a force on them says that they are not open, min(c − Bu, ‖F‖λ),
       of tangential ones what of the slip their force does not allow: inside its disc all, on the
       circle, where τ = P(τ + q/‖F‖) for a slip q that it opposes, ‖F‖ times the difference.
    2. v, the least displacement in D that closes that, makes u + v admissible; so ‖v‖_K bounds the
       error of u in energy, as far as λ balances the load.
    3. Sizes and energies of u, of its elastic part and of v, body by body.
    4. What Gλ − e leaves of the balance of forces.

    ``norm`` is ‖F‖, or an estimate; ``before`` the displacement of an earlier iterate.
    """
    # 1. what rows miss
    constraints, sets, comm = dual.constraints, dual.constraints.sets, dual.coarse.comm
    c, normals, tangents = constraints.c, sets.normals, sets.tangents
    w = -state.gap
    overlap, closed = w[normals], state.active[normals]
    # an open row whose force is not gone yet: of distance and force, as a length, the smaller
    nearer = norm * within(dual.feasible, state.lam, normals, np.minimum(overlap, 0.0) / norm)
    w[normals] = np.where(closed | (overlap > 0.0), overlap, nearer)
    lengths = np.abs((w[normals], c[normals])) / constraints.scale
    penetration, gap = np.max(lengths, axis=1, initial=0.0)
    begin = float(np.max(np.abs(dual.begin), initial=0.0)) if state.loose.count else 0.0
    if tangents.size:
        w[tangents] = norm * within(dual.feasible, state.lam, tangents, w[tangents] / norm)
        slips = np.linalg.norm((w[tangents], c[tangents]), axis=2)
        slips /= constraints.contact.tangent_scale
        penetration, begin = max(penetration, slips[0].max()), max(begin, slips[1].max())
    penetration, gap, begin = map(float, maxima(comm, np.array([penetration, gap, begin])))
    d = dual.d
    held_d, held_F = (x[face.holding] for x in (d, state.residual + d))
    squares = summed(comm, np.array([x @ x for x in (state.lam, held_d, held_F)]))
    multipliers, *sizes = np.sqrt(squares)
    # 2. its correction
    closed = np.concatenate((closed | (w[normals] != 0.0), constraints.limits.ravel() > 0.0))
    v = min_norm_correction(constraints, w, closed)
    # 3. bodies
    u, subdomains = state.u, dual.subdomains
    trace, diagonal = subdomains.trace_parts, subdomains.diagonal
    closing = sums(diagonal * v**2, trace)
    if len(sets.springs):
        ends = sums(dual.coarse.sigma * w[sets.springs] ** 2, subdomains.spring_parts)
        closing = [a + b for a, b in zip(closing, ends, strict=True)]
    pushing = np.array(c)
    pushing[sets.contact] = state.lam[sets.contact]
    pushing = constraints.forces(pushing) ** 2
    energies, correction_energies, stiffness, pushed = subdomains.of_bodies(
        [subdomains.energies(u), closing, sums(diagonal, trace), sums(pushing, trace)]
    )
    displacements = (
        u,
        dual.coarse.bodies.elastic(u),
        subdomains.extended(v),
        np.zeros_like(u) if before is None else without_loose(dual.coarse, state, u - before),
        subdomains.extended(subdomains.pinv_load[subdomains.trace]),
    )
    size, elastic, correction, change, alone = subdomains.body_sizes(displacements)
    # 4. the entry of Gλ − e that is largest beside the forces on its mode; rounding of the largest
    # forces is nobody's to mend
    balance = forces = 0.0
    if (coarse := dual.coarse).dimension:
        on_modes = coarse.terms(state.lam)
        most = on_modes.max()
        on_modes = np.maximum(on_modes, LIGHT * most)
        apart = np.abs(coarse.G(state.lam) - coarse.e)
        if subdomains.num_springs:  # whose forces are those of u only as far as their rows hold
            forces_missed = np.zeros(len(w))
            forces_missed[sets.springs] = coarse.sigma * w[sets.springs]
            apart = np.maximum(apart, np.abs(coarse.G(forces_missed)))
        apart -= StoppingTolerances.noise * most
        worst = int(np.argmax(np.maximum(apart, 0.0) / np.maximum(on_modes, TINY)))
        balance, forces = float(max(apart[worst], 0.0)), float(on_modes[worst])
    return Measures(
        size=size,
        elastic=elastic,
        energies=energies,
        correction=correction,
        correction_energies=correction_energies,
        change=change,
        alone=alone,
        stiffness=stiffness,
        pushed=pushed,
        penetration=penetration,
        balance=balance,
        forces=forces,
        gap=gap,
        begin=begin,
        rounding=ROUNDING * float(sum(sizes)),
        error=float(np.sqrt(correction_energies.sum())),
        energy=float(np.sqrt(max(energies.sum(), 0.0))),
        longest=max(float(correction.max(initial=0.0)), penetration),
        effect=norm * float(multipliers),
    )


# --- The stopping rule ------------------------------------------------------------------------


class Criterion(NamedTuple):
    """An error and what it may be: numbers that are the same on all ranks, or one for each body."""

    error: Array | float
    allowed: Array | float
    rounding: float = 0.0  # allowed on top where residuals are small, or forces move nothing
    size: Array | float = 1.0  # that both are relative to in reports

    def ratio(self, rounds: bool = True) -> float:
        """Return the error over what it may be, with rounding or without."""
        most = self.allowed + self.rounding if rounds else self.allowed
        return float(np.asarray(self.error / np.maximum(most, TINY)).max(initial=0.0))

    def relative(self) -> tuple[float, float]:
        """Return the error and what it may be over the size, of the worst body."""
        size = np.maximum(self.size, TINY)
        error, most = map(np.asarray, (self.error / size, (self.allowed + self.rounding) / size))
        return float(error.max(initial=0.0)), float(most.max(initial=0.0))


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of an answer, in physical units."""

    displacement: Array  # error of u for each body, a length, shape (bodies,)
    # jumps at tears, distances from Dirichlet values, overlaps, and distances where a force acts
    jump: float
    overlap: float  # of nodes without a row: what is more than rounding may bear forces
    balance: float  # force left on a kernel mode
    rounding: float  # error of u in energy that rounding leaves of bodies that do not deform


class Accuracy(StoppingRule):
    """Stops a solver when the displacement of each body is right to rtol, in the maximum norm.

    A body's error is estimated as what closes its jumps, plus what that does in energy, turned into
    a displacement by the ratio of the two that the solution itself and its last change have shown.
    Stiffness, units and gaps that stay open do not enter. Residuals only decide when to look: the
    first look is taken early, to learn how far things move. Creation is not collective; ``examine``
    is, and costs one solve in each subdomain. ``atol`` is a length that errors may have whatever
    moves, ``scale`` b₀, the norm of the residual at the start, and what rounding leaves of it;
    ``goal`` an error beside which the algebraic one has to be small, too, or None.

    A rule of one's own overrides ``criteria``.

    Attributes:
        dual: The dual problem.
        norm: ‖F‖, or an estimate, at the last look; 1 where none is known.
        limits: Tolerances beside rtol; those of a class.
        tolerance: Norm of the residuals from which on one looks (again).
        recovered: What the last look has recovered.
        u: This rank's part of its displacement, shape ``(n,)``.
        looks: How many looks there were.
        measures: What the last look has seen, and ``allowed`` the tolerances of that.
        checks: All that the last look has compared, by name.
        estimates: With a goal the errors at the last look, and what they have cost at all looks, as
            in ``Estimates`` of ``accuracy.py``.
    """

    limits = StoppingTolerances()
    measures: Measures
    allowed: Tolerances
    checks: dict[str, Criterion]
    recovered: Recovered
    u: Array

    def __init_subclass__(cls) -> None:
        if "ratio" in vars(cls):
            raise InputError(f"{cls.__name__} overrides ratio; expected criteria, which it is of")

    def __init__(
        self,
        dual: Dual,
        rtol: float,
        atol: float,
        scale: tuple[float, float],
        goal: ErrorTarget | None = None,
    ) -> None:
        self.dual, self.rtol, self._atol, self._goal = dual, rtol, atol, goal
        reference, self._rounding = scale
        # looks for a goal are costly
        super().__init__(max(rtol**0.5 * reference, atol, self._rounding), waits=goal is not None)
        # where nothing drives any force, rows that only just touch have forces that are rounding
        drives = reference > self._rounding
        self._small = 0.01 * max(rtol * reference, self._rounding) if drives else self._rounding
        self.looks, self._stopped, self.norm = 0, False, 1.0
        self._before: Measures | None = None
        self.estimates: dict[str, float] = {}

    def criteria(self) -> dict[str, Criterion]:
        """Return what has to be right, by name, from ``measures``, ``allowed`` and ``rtol``.

        A look adds the balance of forces and, with a goal, the algebraic error.
        """
        now, allowed, rounding = self.measures, self.allowed, self.allowed.rounding
        sizes = allowed.displacement / max(self.rtol, self.limits.noise)
        energy, energy_size = self.limits.energy * self.rtol * now.energy, max(now.energy, rounding)
        return {
            "displacement_error": Criterion(self.errors(), allowed.displacement, size=sizes),
            "penetration": Criterion(now.penetration, allowed.jump),
            # forces of a body that falls far may be known better than the rounding of its fall
            "energy_error": Criterion(now.error, energy, rounding, energy_size),
        }

    def examine(
        self, lam: Array, gradient: Array, face: Face, residual: float, norm: float
    ) -> ConvergedReason:
        """Assess an iterate, and return why to stop, or ITERATING. Collective."""
        dual, self.norm = self.dual, norm or 1.0
        # 1. its displacement, beside that of the look before
        state = recover(dual.constraints, dual.coarse, lam, gradient, face, residual / self.norm)
        self._before, u = (self.measures, self.u) if self.looks else (None, None)
        self.looks, self.waits = self.looks + 1, False
        self._assess(state, measure(dual, state, face, self.norm, u))
        reason = self._verdict(residual)
        # 2. in an answer bodies that nothing holds are placed: a rough iterate has forces too small
        # to hold them
        if state.loose.count and (reason > 0 or self._stopped):
            unseen = min(self.limits.share_unseen * self.rtol, self.limits.unseen)
            state = placed(dual.coarse, state, dual.begin, unseen)
            now = measure(dual, state, face, self.norm)
            self._assess(state, replace(now, change=self.measures.change))
            reason = self._verdict(residual)
        return reason

    def _verdict(self, residual: float) -> ConvergedReason:
        """Return why to stop, or ITERATING, by what the last look has seen. Collective."""
        given, now, bounded = self.limits, self.measures, self.checks.get("algebraic_error")
        # 1. errors over their tolerances, with rounding and, where forces move anything, without
        ratio, longest, strict, bound = steering(
            self.dual.coarse.comm,
            self.ratio(),
            now.longest,
            self.ratio(rounds=now.effect <= self._rounding),
            bounded.ratio() if bounded else 0.0,
        )
        if ratio <= 1.0 and (strict <= 1.0 or residual <= self._small):
            return ConvergedReason.CONVERGED_RTOL
        if longest <= self._atol:
            return ConvergedReason.CONVERGED_ATOL
        # 2. residuals at which the next look is worth its price
        aim = 1.0 if bound >= ratio else given.aim  # a bound follows residuals
        least = 1e-4 * min(self._rounding, now.rounding)  # no residual comes down to that
        tolerance = residual * max(aim / (ratio if ratio > 1.0 else strict), given.leap)
        if ratio <= 1.0:
            tolerance = max(tolerance, self._small)
        if tolerance <= least:  # rounding has the last word
            return ConvergedReason.DIVERGED_ROUNDING
        self.tolerance = float(tolerance)
        return ConvergedReason.ITERATING

    def _assess(self, state: Recovered, now: Measures) -> None:
        """Compare the errors of a displacement with their tolerances. Collective with a goal."""
        self.recovered, self.measures, self.u = state, now, state.u
        self.gradient = state.residual
        self.allowed = self._tolerances()
        self.checks = self.criteria() | {"balance": Criterion(now.balance, self.allowed.balance)}
        if self._goal is not None:
            bound, moved = energy_bound(self.dual, state.lam, state.u, self.norm)
            goal, rounding, known = self._goal(state.u), self.allowed.rounding, self.estimates
            allowed = max(self.limits.target * max(goal, 1e-5 * now.energy), rounding)
            self.checks["algebraic_error"] = Criterion(bound, allowed, size=now.energy)
            self.estimates = {
                "energy": now.energy,
                "algebraic": bound,
                "discretisation": goal,
                "rounding": rounding,
                "lifting_multiplications": known.get("lifting_multiplications", 0) + 1,
                "recoveries": known.get("recoveries", 0) + (moved > 0.0),
            }

    def look_again(self, face: Face) -> bool:
        """Measure the iterate of the last look with another set of multipliers. Collective.

        Bounds of friction that a solve was given are not those of its forces. What the last look
        has seen stays the least of the errors. Return whether it is right to the tolerance with
        that set, too.
        """
        first, self._before = self.checks, None
        self._assess(self.recovered, measure(self.dual, self.recovered, face, self.norm))
        for name, now in self.checks.items():
            error = np.maximum(now.error, first.get(name, now).error)
            self.checks[name] = now._replace(error=error)
        ratio, longest = steering(self.dual.coarse.comm, self.ratio(), self.measures.longest)
        return bool(ratio <= 1.0 or longest <= self._atol)

    def examine_stopped(self, result: QPResult) -> None:
        """Assess where a solver has stopped early: errors that rounding explains are accepted."""
        self._small, self._stopped = float("inf"), True
        residual = max(result.projected_gradient, result.norm * result.equality)
        reason = self.examine(result.lam, result.gradient, result.face, residual, result.norm)
        result.reason = reason if reason > 0 else result.reason

    def errors(self) -> Array:
        """Estimated errors of u at the last look, a length for each body, shape ``(bodies,)``."""
        now, before = self.measures, self._before
        energy = np.sqrt(np.maximum(now.energies, 0.0))
        # where all is rounding, energy does not say how far anything moves
        noise = self.limits.noise * now.size.max(initial=0.0) + self._at_rest()
        noise = np.maximum(noise, self.dual.negligible)
        known = (energy > 0.0) & (now.size > noise)
        shown = np.divide(now.elastic, energy, out=np.zeros_like(energy), where=known)
        estimate = shown * np.sqrt(now.correction_energies)
        if before is not None and before.error > 0.0:
            estimate = np.maximum(estimate, now.change * (now.error / before.error))
        return estimate + now.correction

    def _tolerances(self) -> Tolerances:
        """Return the tolerances that the measures are compared with."""
        now, given = self.measures, self.limits
        at_rest = self._at_rest()
        most = now.size.max(initial=0.0)
        # a body that is stiff beside another has the error of the other's forces on top
        share = np.where(now.size < 1e-3 * most, 0.1, 1.0)
        most = max(most, now.begin)
        all_rest = at_rest.min() if len(at_rest) else 0.0  # then forces are rounding, too
        noise = given.noise * most + given.load_noise * now.alone + all_rest
        noise = np.maximum(noise, self.dual.negligible)
        displacement = self.rtol * share * now.size + noise
        largest = float(displacement.max(initial=0.0))
        # a body that nothing acts on, as one that was unloaded, rests: all of its u is error
        rests = (now.alone == 0.0) & (now.pushed == 0.0)
        displacement = np.maximum.reduce((displacement, at_rest, self.rtol * most * rests))
        # rounding of bodies that do not deform at all: its energy, and forces that make it
        rigid = float(np.sqrt(now.stiffness @ (noise + 3.0 * given.noise * most) ** 2))
        balance = max(self.rtol, given.noise) * now.forces + rigid / np.sqrt(self.norm)
        return Tolerances(
            displacement=displacement,
            jump=2.0 * largest,
            overlap=2.0 * float(np.maximum(noise, at_rest).max(initial=0.0)),
            balance=balance + all_rest * now.stiffness.max(initial=0.0),
            rounding=rigid,
        )

    def ratio(self, rounds: bool = True) -> float:
        """Return the largest ratio of errors at the last look; u is right if it is at most 1."""
        return float(np.max([check.ratio(rounds) for check in self.checks.values()]))

    def _at_rest(self) -> Array:
        """The size of displacements that are rounding of 0, of bodies without a load, else 0."""
        now = self.measures
        small = self.limits.load_noise * now.gap
        return np.where((now.alone == 0.0) & (now.size <= small), small, 0.0)


# from the dual problem, rtol, atol, b₀ with what rounding leaves of it, and a goal, to a rule
MakeRule = Callable[[Dual, float, float, tuple[float, float], ErrorTarget | None], Accuracy]
