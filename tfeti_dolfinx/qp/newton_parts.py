"""What block Newton is made of: its iterate, and the solves on faces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.parallel import agreed, any_rank
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.homogenised import Homogenised, restored
from tfeti_dolfinx.qp.monitors import Monitor
from tfeti_dolfinx.qp.nearest import WithinFace, nearest
from tfeti_dolfinx.qp.parameters import NewtonParameters
from tfeti_dolfinx.qp.pcpg import Directions, pcpg
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    FaceOperator,
    Point,
    QPResult,
    Steps,
)
from tfeti_dolfinx.qp.stopping import StoppingRule, TargetRule

# of what the gradient step promises at least, (ᾱ/2)‖g^P‖²: a step must lower q by that share
ENOUGH = 0.1
# Gλ = e on a smaller face holds as well as its factor can tell
HELD = 1e-9
# rows leave a face in so many rounds at most: each round drops one row at least, but most at once
MOST_ROUNDS = 60
# of the rule's tolerance, for the last solve on a face: ‖g^P‖ is measured otherwise than ‖P_f g‖
FINAL = 0.9
# a solve on a face that stays is looked at whenever it has come down by this: PCPG goes on where it
# has stopped, and rows that want to carry are found before the wrong face is solved to the end
STAGE = 0.1
# of Gλ = e: what is left after a first try to restore it is worth a second one
EXACT = 1e-13
# of ‖F‖: curvature of the way that a solve has gone; less is nearly none, and the way far
LOOSE = 1e-8
# of the way to the first bound, where nothing else ends it: more rows than one are to leave
BEYOND = 10.0
# so many steps in a row that neither lower q by what stands out from its rounding, nor halve ‖g^P‖
PATIENCE, ROUNDING = 10, 1e-15


class Iterate:
    """A feasible point, with what it lacks to be optimal.

    Args:
        qp: The program.
        homogenised: Holds the start.

    Attributes:
        point: λ and Fλ − d.
        s: Multipliers of Ω: Fλ − d − Gᵀμ; 0 where λ is free, if it is optimal.
        mu: Multipliers μ of Gλ = e.
        back: The nearest feasible point to λ − ᾱ(Fλ − d).
        residual: ‖g^P‖, g^P = (λ − back)/ᾱ.
        norm: Estimate of ‖F‖; ᾱ is its inverse.
    """

    def __init__(self, qp: QP, homogenised: Homogenised) -> None:
        self._qp, self._homogenised = qp, homogenised
        self._comm = qp.d.getComm().tompi4py()
        self.point = Point(homogenised.lam_bar.copy(), homogenised.gradient.copy())
        self.s, self._work = qp.d.duplicate(), qp.d.duplicate()
        self.back: PETSc.Vec | None = None
        self.mu = np.zeros(qp.coarse.dimension)
        self.residual, self.norm = float("inf"), _rayleigh(qp, self.point)
        self._best, self._idle = float("inf"), 0

    def face(self) -> Face:
        """The face of λ."""
        return self._qp.feasible.face(self.point.lam.array_r, self.s.array_r)

    def multipliers_on(self, faces: FaceSolver) -> None:
        """μ and s that belong to the face entered, while nothing is known of ‖F‖."""
        self.mu = faces.coarse.coordinates(self.point.g)
        self._set_multipliers()

    def look(self, norm: float) -> None:
        """Optimality: how far a gradient step, brought back to the feasible set, moves.

        Args:
            norm: Estimate of ‖F‖.
        """
        self.norm = norm or 1.0
        target = self.point.lam.copy()
        target.axpy(-1.0 / self.norm, self.point.g)
        found = nearest(self._qp.coarse, self._qp.feasible, target, self.mu / self.norm)
        self.mu = found.alpha * self.norm
        self._set_multipliers()
        if self.back is not None:
            self.back.destroy()
        self.back = found.lam
        self.point.lam.copy(target)
        target.axpy(-1.0, self.back)
        self.residual = self.norm * target.norm()
        target.destroy()
        self._idle += 1
        if self.residual <= 0.5 * self._best:
            self._best, self._idle = self.residual, 0

    def _set_multipliers(self) -> None:
        self._qp.coarse.combine(self.mu, self.s)
        self.s.aypx(-1.0, self.point.g)

    def wanted_face(self, gamma: float, faces: FaceSolver) -> Face:
        """What carries force, and what wants to, if that is most of what is wrong.

        The rest is what PCPG has left on the face, if it has stopped at λ.
        """
        lam, s, feasible = self.point.lam.array_r, self.s.array_r, self._qp.feasible
        phi, beta = feasible.split(lam, s)
        free, chopped = self._comm.allreduce(np.array([phi @ phi, beta @ beta]), op=MPI.SUM)
        if faces.settled:
            free = faces.left**2
        if agreed(self._comm, chopped > gamma**2 * free):
            moved = feasible.project(lam - beta / self.norm)
            return feasible.face(0.5 * (lam + moved), s)
        return self.face()

    def accept(self, trial: Trial, faces: FaceSolver) -> bool:
        """Go where q falls enough: trial, the feasible part of its first step, or downhill.

        Returns:
            Whether q could be lowered.
        """
        known = np.isfinite(self.residual)
        enough = ENOUGH * 0.5 / self.norm * self.residual**2 if known else 0.0
        gain = self.gain(trial.last)
        if trial.feasible and agreed(self._comm, gain >= enough):
            self._take(trial.last, gain)
            faces.settle()
            return True
        faces.forget()
        length = self._feasible_part(trial.first)
        shorter = self.point.copy()
        for kept, end in ((shorter.lam, trial.first.lam), (shorter.g, trial.first.g)):
            kept.aypx(1.0 - length, self._scaled(length, end))
        shorter.lam.array[:] = self._qp.feasible.project(shorter.lam.array_r)
        gain = self.gain(shorter)
        taken = agreed(self._comm, length > 0.0 and gain >= enough)
        if taken:
            self._take(shorter, gain)
        shorter.destroy()
        return taken or self._descend(known, faces)

    @property
    def stalled(self) -> bool:
        """Whether q and ‖g^P‖ have not come down any more for long."""
        return agreed(self._comm, self._idle >= PATIENCE)

    def _take(self, to: Point, gain: float) -> None:
        """Go there; a gain that stands out from the rounding of q is worth more steps."""
        sizes = abs(self.point.lam.dot(self.point.g)) + abs(self.point.lam.dot(self._qp.d))
        if gain > ROUNDING * sizes:
            self._idle = 0
        self.point.take(to)

    def gain(self, to: Point) -> float:
        """q(λ) − q(to), by differences, and without what Gλ = e makes constant. Collective."""
        apart, gradient = to.lam.copy(), to.g.copy()
        apart.axpy(-1.0, self.point.lam)
        gradient.axpy(-1.0, self.point.g)
        gradient.axpy(2.0, self.s)
        value = -0.5 * float(apart.dot(gradient))
        apart.destroy()
        gradient.destroy()
        return value

    def _descend(self, known: bool, faces: FaceSolver) -> bool:
        """The projected gradient step, or the part of it where q is least."""
        if not known:
            self.look(max(faces.norm, self.norm))
        assert self.back is not None
        p, Fp = self.back.copy(), self._work
        p.axpy(-1.0, self.point.lam)
        self._qp.F.mult(p, Fp)
        slope, curvature, size = -self.s.dot(p), p.dot(Fp), p.dot(p)
        faces.saw(curvature, size)
        length = min(1.0, slope / curvature) if curvature > 0.0 else 1.0
        moved = agreed(self._comm, size > 0.0 and slope > 0.0)
        if moved:
            if length * slope > ROUNDING * abs(self.point.lam.dot(self.point.g)):
                self._idle = 0
            self.point.move(length, p, Fp)
            self.point.lam.array[:] = self._qp.feasible.project(self.point.lam.array_r)
        p.destroy()
        return moved

    def _feasible_part(self, end: Point) -> float:
        """Largest t up to 1 with λ + t(end − λ) ∈ Ω. Collective."""
        down = self.point.lam.array_r - end.lam.array_r
        own = self._qp.feasible.max_step(self.point.lam.array_r, down)
        return min(1.0, float(self._comm.allreduce(own, op=MPI.MIN)))

    def _scaled(self, share: float, x: PETSc.Vec) -> PETSc.Vec:
        x.copy(self._work)
        self._work.scale(share)
        return self._work

    def result(self, reason: ConvergedReason, steps: Steps) -> QPResult:
        """The answer; takes λ and s over."""
        moved = self.point.lam.copy()
        moved.axpy(-1.0, self._homogenised.lam_bar)
        equality = self._qp.coarse.norm_Q(moved)
        moved.destroy()
        return QPResult(
            lam=self.point.lam.copy(),
            mu=self.mu,
            gradient=self.s.copy(),
            face=self.face(),
            reason=reason,
            projected_gradient=self.residual,
            equality=equality,
            reference=self._homogenised.scale.reference,
            norm=self.norm,
            steps=steps,
        )

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        self.point.destroy()
        for vec in (self.s, self._work, self.back):
            if vec is not None:
                vec.destroy()


@dataclass(frozen=True)
class Trial:
    """What solves on faces have come to.

    Attributes:
        first: Where the first one ended, maybe outside of Ω.
        last: Where the last one ended.
        feasible: Whether that is in Ω.
    """

    first: Point
    last: Point
    feasible: bool

    def destroy(self) -> None:
        """Destroy the points. Collective."""
        self.first.destroy()
        self.last.destroy()


class FaceSolver:
    """Solves on faces by PCPG; keeps factor and directions while the face stays.

    Args:
        qp: The program on all rows.
        rule: Its tolerance is what the last solve aims at.
        parameters: What other solves reduce.
        steps: Counts.
        max_it: Most conjugate gradient steps.
        monitor: Called after each.

    Attributes:
        settled: Whether λ is where PCPG has stopped on the face entered.
        left: The residual there.
    """

    def __init__(
        self,
        qp: QP,
        rule: StoppingRule,
        parameters: NewtonParameters,
        steps: Steps,
        max_it: int,
        monitor: Monitor,
    ) -> None:
        self._qp, self._rule, self._parameters = qp, rule, parameters
        self._steps, self._max_it, self._monitor = steps, max_it, monitor
        self._comm = qp.d.getComm().tompi4py()
        self._directions = Directions(qp.d)
        self._face: Face | None = None
        self.settled, self.left = False, float("inf")
        self._on_face = qp
        self._preconditioner: FaceOperator | None = None

    @property
    def norm(self) -> float:
        """Largest Rayleigh quotient of F seen; at most ‖F‖."""
        return self._directions.norm

    def saw(self, curvature: float, size: float) -> None:
        """Another Rayleigh quotient."""
        self._directions.seen(curvature, size)

    @property
    def coarse(self) -> Coarse:
        """Projectors of the face entered."""
        return self._on_face.coarse

    def enter(self, face: Face) -> bool:
        """Make the projectors and the preconditioner of a face, unless it is the last one.

        Returns:
            Whether it is the last one.
        """
        if self._face is not None and not any_rank(
            self._comm, not np.array_equal(face.status, self._face.status)
        ):
            return True
        self._leave()
        self._steps.faces += 1
        coarse = self._qp.coarse.on_face(face)
        if self._qp.preconditioner_on is not None:
            self._preconditioner = self._qp.preconditioner_on(face)
        self._on_face = replace(self._qp, coarse=coarse, preconditioner=self._preconditioner)
        self._face = face
        self.forget()
        return False

    def settle(self) -> None:
        """The last solve's end was accepted; if its face stays, PCPG goes on from there."""
        self.settled = True

    def forget(self) -> None:
        """The next direction is a first one: the point is not where PCPG has stopped."""
        self._directions.fresh, self.settled = True, False

    def solve(self, start: Point, face: Face, optimality: float) -> Trial:
        """Solve on a face; drop what leaves Ω, restore Gλ = e, solve again.

        Args:
            start: A feasible point, in the face.
            face: The face.
            optimality: ‖g^P‖ there.
        """
        z, first, feasible = start.copy(), None, self._qp.feasible
        stays = self.enter(face) and self.settled
        for _ in range(MOST_ROUNDS):
            before = z.copy()
            broken = self._pcpg(z, optimality, stays) == ConvergedReason.DIVERGED_INDEFINITE_MAT
            stays = False
            self._shorten(before, z)
            before.destroy()
            if first is None:
                first = z.copy()
            inside = feasible.project(z.lam.array_r)
            out = any_rank(self._comm, not np.array_equal(inside, z.lam.array_r))
            if self._steps.cg >= self._max_it or not (out or (broken and self._slide(z))):
                break
            z.lam.array[:] = feasible.project(z.lam.array_r)
            self._drop(z)
        assert first is not None
        return Trial(first, z, not out)

    def _shorten(self, before: Point, z: Point) -> None:
        """Where a solve has gone far because nothing held it, go to the first bound only.

        Rows depend on each other there, or nearly so; numbers of that size would drown the others.
        """
        p, Fp = z.lam.copy(), z.g.copy()
        p.axpy(-1.0, before.lam)
        Fp.axpy(-1.0, before.g)
        own = self._qp.feasible.max_step(before.lam.array_r, -p.array_r)
        length = float(self._comm.allreduce(own, op=MPI.MIN))
        if agreed(self._comm, length < 1.0 and p.dot(Fp) <= LOOSE * self.norm * p.dot(p)):
            z.take(before)
            z.move(max(length, 0.0) * BEYOND, p, Fp)
        p.destroy()
        Fp.destroy()

    def _slide(self, z: Point) -> bool:
        """Along a residual that meets no curvature, where rows depend on each other, to a bound.

        Returns:
            Whether there is one.
        """
        r, Fr = self._directions.r, self._directions.Fp
        self._qp.F.mult(r, Fr)
        if self._directions.seen(r.dot(Fr), r.dot(r)):
            return False
        own = self._qp.feasible.max_step(z.lam.array_r, -r.array_r)
        length = float(self._comm.allreduce(own, op=MPI.MIN))
        if np.isfinite(length):
            z.move(length * BEYOND, r, Fr)
        return bool(np.isfinite(length))

    def _drop(self, z: Point) -> None:
        """Enter the face of z, and bring z back to Gλ = e in it; multiplies by F once."""
        previous, feasible = self._face, self._qp.feasible
        assert previous is not None
        face = feasible.face(z.lam.array_r, z.g.array_r)
        self.enter(face)
        near = self._restored(z.lam)
        if self.coarse.imbalance(near) > HELD:
            # it no longer holds a body: what is nearest names rows that do, near by if it can
            near.destroy()
            within = WithinFace(feasible, previous, z.lam.array_r)
            found = nearest(self._qp.coarse, within, z.lam)
            if self._qp.coarse.imbalance(found.lam) > HELD:
                found.lam.destroy()
                found = nearest(self._qp.coarse, feasible, z.lam)
            near = found.lam
            middle = 0.5 * (z.lam.array_r + near.array_r)
            self.enter(feasible.face(middle, z.g.array_r))
        near.copy(z.lam)
        near.destroy()
        z.refresh(self._qp)
        self.forget()

    def _restored(self, lam: PETSc.Vec) -> PETSc.Vec:
        """The nearest point of Gλ = e on the face entered, if it has one."""
        near = restored(self.coarse, lam)
        if self.coarse.imbalance(near) > EXACT:  # what its factor leaves where rows hardly hold
            once, near = near, restored(self.coarse, near)
            once.destroy()
        return near

    def _pcpg(self, z: Point, optimality: float, stays: bool) -> ConvergedReason:
        """PCPG to a part of what there is to do; to the end where the face stays."""
        z.g.copy(self._directions.r)
        self.coarse.project(self._directions.r)
        start, final = float(self._directions.r.norm()), FINAL * self._rule.tolerance
        share = STAGE if stays else self._parameters.reduction
        target = max(final, share * min(start, optimality))
        reason = pcpg(
            self._on_face,
            z,
            TargetRule(target),
            self._steps,
            self._max_it,
            self._monitor,
            self._directions,
        )
        self.left = float(self._directions.r.norm())
        return reason

    def _leave(self) -> None:
        """Free what belongs to the face."""
        if self._face is not None:
            self._on_face.coarse.destroy()
        if self._preconditioner is not None:
            self._preconditioner.destroy()
            self._preconditioner = None
        self._face = None

    def destroy(self) -> None:
        """Free what it holds. Collective."""
        self._leave()
        self._directions.destroy()


def _rayleigh(qp: QP, point: Point) -> float:
    """λᵀFλ/λᵀλ, 0 where λ = 0."""
    size = point.lam.dot(point.lam)
    return float(point.lam.dot(point.g) + point.lam.dot(qp.d)) / size if size > 0.0 else 0.0
