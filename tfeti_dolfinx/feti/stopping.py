"""The stopping rule: the displacement of each body is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import TINY, Array, sums
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.duality_gap import EnergyBound, LiftedScene, energy_bound
from tfeti_dolfinx.feti.recovery import constraint_residual, min_norm_correction
from tfeti_dolfinx.qp.problem import ConvergedReason
from tfeti_dolfinx.qp.sets import Face, FeasibleSet
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- Measures of an iterate in physical units -------------------------------------------------

# of the largest forces on a kernel mode: those on a light one beside it count as so large at least,
# since the rounding of the largest reaches them; and that rounding, which is nobody's to mend
LIGHT, ROUNDING = 1e-4, 1e-13


class Scene(Protocol):
    """Parts of the dual problem that measuring an iterate needs."""

    constraints: Constraints
    subdomains: Subdomains
    coarse: CoarseSpace
    pressing: Array
    feasible: FeasibleSet

    def recover(self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, error: float) -> Array:
        """Return this rank's part of u, given the solver's face and error. Collective."""
        ...


@dataclass(frozen=True)
class BodyMeasures:
    """Measures of each body at an iterate, arrays of shape ``(bodies,)``; on all ranks.

    Attributes:
        size: Largest displacement of a node, as a length.
        elastic: The same but for a rigid motion.
        energy: uᵀKu.
        correction: Largest displacement v that closes jumps and overlaps.
        correction_energy: vᵀ diag(K) v, its diagonal as in D the mean at each node.
        change: Largest change since the iterate before, or 0.
        alone: Largest displacement K⁺f of the trace.
        stiffness: Trace of K on the trace unknowns.
    """

    size: Array
    elastic: Array
    energy: Array
    correction: Array
    correction_energy: Array
    change: Array
    alone: Array
    stiffness: Array


@dataclass(frozen=True)
class Measures:
    """An iterate in physical terms; the same on all ranks but for the displacements.

    Attributes:
        u: This rank's part of the displacement, shape ``(n,)``.
        bodies: What is known of each body.
        penetration: Deepest overlap, distance of a row that carries a force, or slip that friction
            does not allow.
        balance: Force left on a kernel mode, where it is largest beside the forces there.
        forces: Size of these forces.
        residual: Norm of what rows miss.
        gap: Largest gap of a contact row, or overlap.
        begin: Largest slip that friction counts from.
    """

    u: Array
    bodies: BodyMeasures
    penetration: float
    balance: float
    forces: float
    residual: float
    gap: float
    begin: float

    @property
    def error(self) -> float:
        """Norm of the correction in energy, over all bodies."""
        return float(np.sqrt(self.bodies.correction_energy.sum()))


def measure(
    scene: Scene,
    lam: PETSc.Vec,
    gradient: PETSc.Vec,
    face: Face,
    norm: float,
    error: float,
    before: Array | None = None,
) -> Measures:
    """Recover the displacement of an iterate and see how well it fulfils the rows. Collective.

    Rows miss w = Bu − c: rows of equalities and those that press both ways, others where they
    overlap, or as far as a force on them says that they are not open, min(c − Bu, ‖F‖λ), tangential
    ones what of the slip their force does not allow. v, the least displacement
    in D that closes that, makes u + v admissible; so ‖v‖_K bounds the error of u in energy, as far
    as λ balances the load.

    Args:
        scene: The dual problem.
        lam: The multipliers λ.
        gradient: Fλ − d up to the range of Gᵀ.
        face: The face of λ.
        norm: ‖F‖, or an estimate.
        error: How large multipliers may be by the solver's error alone.
        before: The displacement of an earlier iterate.
    """
    u = scene.recover(lam, gradient, face, error)
    w, (penetration, gap, begin) = _missed(scene, u, lam, norm)
    constraints = scene.constraints
    residual, normals = w.norm(), constraints.sets.normals
    closed = scene.pressing[normals] | (w.array_r[normals] != 0.0)
    closed = np.concatenate((closed, constraints.limits.ravel() > 0.0))
    bodies = _bodies(scene, u, min_norm_correction(constraints, w, closed), before)
    balance, forces = _balance(scene.coarse, lam)
    w.destroy()
    return Measures(u, bodies, penetration, balance, forces, residual, gap, begin)


def _missed(scene: Scene, u: Array, lam: PETSc.Vec, norm: float) -> tuple[PETSc.Vec, Array]:
    """w, and as lengths the largest of its contact rows, of their gaps and slips at first."""
    constraints = scene.constraints
    w = constraint_residual(constraints, u[scene.subdomains.trace])
    normals = constraints.sets.normals
    rows = w.array_r[normals]
    # an open row whose force is not gone yet: of distance and force, as a length, the smaller
    still = _missed_by(scene, lam.array_r, normals, np.minimum(rows, 0.0), norm)
    rows = np.where(scene.pressing[normals] | (rows > 0.0), rows, still)
    w.array[normals] = rows
    lengths = np.abs((rows, constraints.c.array_r[normals])) / constraints.scale
    largest = np.append(np.max(lengths, axis=1, initial=0.0), 0.0)
    tangents = constraints.sets.tangents
    if tangents.size:
        slip = w.array_r[tangents]
        w.array[tangents] = _missed_by(scene, lam.array_r, tangents, slip, norm)
        rows = np.stack((w.array_r[tangents], constraints.c.array_r[tangents]))
        length = np.linalg.norm(rows, axis=2) / constraints.tangent_scale
        largest[[0, 2]] = np.maximum(largest[[0, 2]], length.max(axis=1))
    w.getComm().tompi4py().Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    return w, largest


def _missed_by(scene: Scene, lam: Array, rows: Array, values: Array, norm: float) -> Array:
    """Return the part of gaps or slips that is not normal to the feasible set at the forces.

    A force of a normal allows no gap, but 0 does. A force inside its disc allows no slip, one on
    the circle only a slip that it opposes: then τ is P(τ + q/‖F‖), and ‖F‖ times the difference is
    the slip that is missed. Where it is less than q, no force within the disc makes more of a slip
    than that.

    Args:
        scene: The dual problem.
        lam: The multipliers.
        rows: Local rows, any shape.
        values: Their gaps, negative, or slips, scaled, of the same shape.
        norm: ‖F‖, or an estimate.
    """
    moved = np.array(lam)
    moved[rows] += values / norm
    return np.asarray(norm * (scene.feasible.project(moved) - lam)[rows])


def _bodies(scene: Scene, u: Array, v: Array, before: Array | None) -> BodyMeasures:
    """Measure displacements, energies and corrections of each body. Collective."""
    subdomains, motions = scene.subdomains, scene.coarse.bodies
    rigid = subdomains.modes_motion(motions.amounts(motions.part_of(u)))
    change = u - before if before is not None else np.zeros_like(u)
    trace, diagonal = subdomains.trace_parts, subdomains.diagonal
    energy, correction_energy, stiffness = subdomains.body_sums(
        [subdomains.energies(u), sums(diagonal * v**2, trace), sums(diagonal, trace)]
    )
    size, elastic, correction, changed, alone = subdomains.body_maxima(
        [
            subdomains.sizes(u),
            subdomains.sizes(u - rigid),
            subdomains.sizes(subdomains.extended(v)),
            subdomains.sizes(change),
            subdomains.sizes(subdomains.extended(subdomains.pinv_load[subdomains.trace])),
        ]
    )
    return BodyMeasures(
        size=size,
        elastic=elastic,
        energy=energy,
        correction=correction,
        correction_energy=correction_energy,
        change=changed,
        alone=alone,
        stiffness=stiffness,
    )


def _balance(coarse: CoarseSpace, lam: PETSc.Vec) -> tuple[float, float]:
    """Entry of Gλ − e that is largest beside the forces on its mode, and those. Collective."""
    if coarse.dimension == 0:
        return 0.0, 0.0
    forces = coarse.terms(lam)
    most = forces.max()
    forces = np.maximum(forces, LIGHT * most)
    left = np.maximum(np.abs(coarse.G(lam.array_r) - coarse.e) - ROUNDING * most, 0.0)
    worst = int(np.argmax(left / np.maximum(forces, TINY)))
    return float(left[worst]), float(forces[worst])


# --- Target of the algebraic error ------------------------------------------------------------

# of the other error; of ‖u‖_K where that is more, as where there is no other error
TENTH, FINEST = 0.1, 1e-6

# from the displacement on this rank to the other error, a root of an energy; collective
ErrorTarget = Callable[[Array], float]


class LookedAt(Scene, LiftedScene, Protocol):
    """Parts of the dual problem that an assessment and an error bound need."""


@dataclass(frozen=True)
class TargetStatus:
    """Algebraic error of an iterate beside its target; the same on all ranks.

    Attributes:
        bound: Bound of its algebraic error.
        goal: The other error.
        energy: ‖u‖_K.
    """

    bound: EnergyBound
    goal: float
    energy: float

    @classmethod
    def of(
        cls, scene: LiftedScene, lam: PETSc.Vec, now: Measures, goal: ErrorTarget, norm: float
    ) -> TargetStatus:
        """Bound the error of an iterate, given ‖F‖, and evaluate the target. Collective."""
        energy = float(np.sqrt(max(now.bodies.energy.sum(), 0.0)))
        return cls(energy_bound(scene, lam, now.u, norm), goal(now.u), energy)

    @property
    def allowed(self) -> float:
        """Largest bound of the algebraic error that meets the target."""
        return max(TENTH * self.goal, FINEST * self.energy)


# --- The stopping rule ------------------------------------------------------------------------

# Differences that are rounding, in a body that hardly moves as well: of the largest displacement
# of all bodies, or slip that friction counts from; of what its load does to its subdomains alone,
# if that is held where it acts.
NOISE, LOAD_NOISE = 2.5e-13, 1e-14
# a body that moves by less than this share of another is stiff beside it, and has the error of the
# other's forces on top of its own: its own must be as much smaller
STIFF, STRICTER = 1e-3, 0.1
# of rtol: error of u in energy over all bodies, so that forces are right where bodies move much
# and deform little; what rounding leaves of bodies that do not deform at all, as a displacement
FORCES, RIGID = 10.0, 1e-12
# of the largest gap of a contact row: without load all displacements may be that small and are
# what rounding leaves of 0 (seen: 3e-15)
AT_REST = 1e-14
# of rtol b₀, and of what rounding leaves of a residual where numbers of all sizes meet: a residual
# that is good enough where rounding may explain an error in energy
SMALL, LITTLE = 1e-2, 0.01
# the first look is taken at this power of rtol, to learn how far things move
FIRST_LOOK = 0.5
# a new tolerance aims a little below what was asked for, less where a bound of the error in energy
# asks for it, which follows residuals; it never falls by more than LEAP at once, since the size of
# the displacement may have been learnt from a poor iterate
AIM, AIM_AT_BOUND, LEAP = 0.5, 1.0, 1e-6
# the true residual has stalled if the digits it fell by are less than this share of those that the
# updated one fell by; the gradient is then computed anew, and the second time the solve ends
STALL = 0.5
# of what rounding leaves of a residual: nothing comes down to that
OUT_OF_REACH = 1e-4


@dataclass(frozen=True)
class Tolerances:
    """Tolerances of an answer, in physical units.

    Attributes:
        displacement: Error of u for each body, a length, shape ``(bodies,)``.
        jump: Jumps at tears, and distances from Dirichlet values.
        penetration: Overlaps, and distances where a force acts.
        balance: Force left on a kernel mode.
        energy: Norm of the correction in energy, over all bodies.
    """

    displacement: Array
    jump: float
    penetration: float
    balance: float
    energy: float


class Accuracy:
    """Stops a solver when the displacement of each body is right to rtol, in the maximum norm.

    A body's error is estimated as what closes its jumps, plus what that does in energy, turned
    into a displacement by the ratio of the two that the solution itself and its last change have
    shown. Stiffness, units and gaps that stay open do not enter. Residuals only decide when to
    look: the first look is taken early, to learn how far things move. Creation is not
    collective; ``examine`` is, and costs one solve in each subdomain.

    Args:
        scene: The dual problem.
        rtol: Relative tolerance of displacements and forces.
        atol: A length that errors may have whatever moves.
        scale: b₀, the norm of the residual at the start, and what rounding leaves of it.
        norm: ‖F‖, or an estimate; residuals over it are errors of multipliers.

    Attributes:
        rtol: Relative tolerance.
        tolerance: Norm of the residuals from which on one looks (again).
        drifted: Whether the solver's gradient has to be made anew.
        norm: ‖F‖, or an estimate.
        measures: What the last look has seen.
        looks: How many looks there were.
        goal: An error beside which the algebraic one has to be small, too, or None.
        reached: What looks have seen of that.
    """

    def __init__(
        self,
        scene: LookedAt,
        rtol: float,
        atol: float,
        scale: tuple[float, float],
        norm: float = 1.0,
    ) -> None:
        self._scene, self.rtol, self._atol = scene, rtol, atol
        reference, rounding = scale
        self._rounding, self.norm = rounding, norm or 1.0
        self._before: Measures | None = None
        self._least: Array = np.zeros(1)
        self._own: Measures | None = None
        self.tolerance = max(rtol**FIRST_LOOK * reference, atol, rounding)
        self._small = max(SMALL * rtol * reference, LITTLE * rounding)
        self.drifted, self.looks, self._stalls, self._claimed = False, 0, 0, 1.0
        self.measures: Measures | None = None
        self.goal: ErrorTarget | None = None
        self.reached: list[TargetStatus] = []

    @property
    def aim(self) -> float:
        """The tolerance; 0 before the first assessment against a target, which is costly."""
        return 0.0 if self.goal is not None and self.looks == 0 else self.tolerance

    def look(self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, residual: float) -> Measures:
        """Measure an iterate. Collective."""
        before, error = self.measures, residual / self.norm
        self.measures = measure(
            self._scene, lam, gradient, face, self.norm, error, before.u if before else None
        )
        self.looks += 1
        self._before = before
        if self.goal is not None:
            reached = TargetStatus.of(self._scene, lam, self.measures, self.goal, self.norm)
            self.reached.append(reached)
        return self.measures

    def examine(
        self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, residual: float
    ) -> ConvergedReason:
        """Assess an iterate, and return why to stop, or ITERATING. Collective."""
        now = self.look(lam, gradient, face, residual)
        comm = self._scene.coarse.comm
        values = (
            self.ratio(),
            self.ratio(changes=False),
            self._longest(now),
            self._energy_ratio(now),
        )
        ratio, own, longest, in_energy = bcast_from_root(comm, values)
        if ratio <= 1.0 and (in_energy <= 1.0 or residual <= self._small):
            return ConvergedReason.CONVERGED_RTOL
        if longest <= self._atol:
            return ConvergedReason.CONVERGED_ATOL
        aim = AIM_AT_BOUND if bcast_from_root(comm, self._over_goal() >= ratio) else AIM
        tolerance = residual * max(aim / (ratio if ratio > 1.0 else in_energy), LEAP)
        if ratio <= 1.0:
            tolerance = max(tolerance, self._small)
        elif tolerance < OUT_OF_REACH * self._rounding:
            # the change since a poor iterate says little: another look before one gives up
            tolerance = residual * max(AIM / max(own, 1.0), LEAP)
        self._stalls = (
            self._stalls + 1 if bcast_from_root(comm, self._stalled(now, residual)) else 0
        )
        if self._stalls > 1 or bcast_from_root(comm, tolerance <= OUT_OF_REACH * self._rounding):
            return ConvergedReason.DIVERGED_ROUNDING
        self.drifted = self._stalls > 0
        self.tolerance, self._claimed = tolerance, residual
        return ConvergedReason.ITERATING

    def look_again(self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, residual: float) -> bool:
        """Measure the iterate of the last look with another set of multipliers. Collective.

        Bounds of friction that a solve was given are not those of its forces. What the last look
        has seen stays the least of the errors.

        Returns:
            Whether it is right to the tolerance with that set, too.
        """
        self._least, self._own = self.errors(), self.measures
        self.look(lam, gradient, face, residual)
        self._before = None
        return self._is_right()

    def take(self, errors: Array) -> bool:
        """Take known errors of bodies in the place of those of ``look_again``. Collective.

        Args:
            errors: Lengths, shape ``(bodies,)``.

        Returns:
            Whether they are within the tolerance.
        """
        self.measures, self._least = self._own, self._least + errors
        return self._is_right()

    def _is_right(self) -> bool:
        now = self._looked()
        ratio, longest = bcast_from_root(
            self._scene.coarse.comm, (self.ratio(), self._longest(now))
        )
        return bool(ratio <= 1.0 or longest <= self._atol)

    def accept_rounding(self) -> None:
        """Accept errors that rounding may explain, as no solver reduces them any further."""
        self._small = float("inf")

    def _energy_ratio(self, now: Measures) -> float:
        """Return error in energy over its tolerance without what that allows for rounding.

        A body that falls far deforms by less than rounding of its fall, but forces may be known.
        """
        energy = np.sqrt(max(now.bodies.energy.sum(), 0.0))
        return now.error / max(FORCES * self.rtol * float(energy), TINY)

    def _stalled(self, now: Measures, residual: float) -> bool:
        """Return whether the true residual lags behind the one that the solver updates."""
        if self._before is None or self._before.residual == 0.0:
            return False
        claimed = residual / self._claimed
        return now.residual / self._before.residual > claimed**STALL

    @property
    def balance(self) -> float:
        """Largest force left on a kernel mode at the last look."""
        return self._looked().balance

    @property
    def u(self) -> Array:
        """This rank's part of the displacement at the last look, shape ``(n,)``."""
        return self._looked().u

    def errors(self, changes: bool = True) -> Array:
        """Estimated errors of u at the last look, a length for each body, shape ``(bodies,)``.

        Args:
            changes: Whether what has changed since the look before it counts.
        """
        now, before = self._looked(), self._before if changes else None
        bodies, energy = now.bodies, np.sqrt(np.maximum(now.bodies.energy, 0.0))
        own = np.sqrt(bodies.correction_energy)
        # where all is rounding, energy does not say how far anything moves
        moves = bodies.size > NOISE * bodies.size.max(initial=0.0)
        known = (energy > 0.0) & moves & (self._at_rest(now) == 0.0)
        shown = np.divide(bodies.elastic, energy, out=np.zeros_like(energy), where=known)
        estimate = shown * own
        if before is not None and before.error > 0.0:
            estimate = np.maximum(estimate, bodies.change * (now.error / before.error))
        return np.maximum(estimate + bodies.correction, self._least)

    def tolerances(self) -> Tolerances:
        """Return the tolerances that the last assessment is compared with."""
        now = self._looked()
        size, most = now.bodies.size, now.bodies.size.max(initial=0.0)
        share = np.where(size < STIFF * most, STRICTER, 1.0)
        most = max(most, now.begin)
        alone = LOAD_NOISE * now.bodies.alone
        at_rest = self._at_rest(now)
        displacement = self.rtol * share * size + NOISE * most + alone + at_rest
        largest = float(displacement.max(initial=0.0))
        energy = FORCES * self.rtol * np.sqrt(max(now.bodies.energy.sum(), 0.0))
        rigid = np.sqrt(now.bodies.stiffness @ (RIGID * most + alone + at_rest) ** 2)
        balance = max(self.rtol, NOISE) * now.forces
        # forces that do not balance have an energy of ‖F‖ times their square
        balance += at_rest * now.bodies.stiffness.max(initial=0.0) + rigid / np.sqrt(self.norm)
        energy += rigid
        return Tolerances(displacement, 2.0 * largest, 2.0 * largest, balance, float(energy))

    def _at_rest(self, now: Measures) -> float:
        """The size of displacements that are rounding of 0 where nothing is loaded, else 0."""
        small = AT_REST * now.gap
        loaded = bool(now.bodies.alone.any())
        return 0.0 if loaded or now.bodies.size.max(initial=0.0) > small else small

    def ratio(self, changes: bool = True) -> float:
        """Return the largest ratio of errors (``errors``) to their tolerances; right if ≤ 1."""
        now, allowed = self._looked(), self.tolerances()
        pairs = [
            *zip(self.errors(changes), allowed.displacement, strict=True),
            (now.penetration, allowed.penetration),
            (now.balance, allowed.balance),
            (now.error, allowed.energy),
        ]
        own = max(float(error) / max(float(limit), TINY) for error, limit in pairs)
        return max(own, self._over_goal())

    def _over_goal(self) -> float:
        """Return the bound at the last look over what the goal allows; 0 without a goal."""
        if not self.reached:
            return 0.0
        return self.reached[-1].bound.error / max(self.reached[-1].allowed, TINY)

    def relative_error(self) -> float:
        """Return the largest estimated error of a body over its largest displacement."""
        noise = self.tolerances().displacement / max(self.rtol, NOISE)
        errors = self.errors()
        return float(np.max(errors / np.maximum(noise, TINY), initial=0.0))

    def energy_error(self) -> tuple[float, float]:
        """Return estimated error of u in energy over ‖u‖_K at the last look, and what it may be.

        Where ‖u‖_K is rounding of a rigid motion, over what rounding may leave of it.
        """
        now, allowed = self._looked(), self.tolerances().energy
        size = max(float(np.sqrt(max(now.bodies.energy.sum(), 0.0))), allowed, TINY)
        return now.error / size, allowed / size

    def _longest(self, now: Measures) -> float:
        return max(float(now.bodies.correction.max(initial=0.0)), now.penetration)

    def _looked(self) -> Measures:
        if self.measures is None:
            raise RuntimeError("nothing has been measured yet")
        return self.measures
