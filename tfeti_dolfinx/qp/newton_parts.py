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
FINAL = float(__import__("os").environ.get("FINAL", 0.9))
# a solve on a face that stays is looked at from time to time: PCPG goes on where it stopped
STAGE = float(__import__("os").environ.get("STAGE", 0.1))


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
        if trial.feasible and agreed(self._comm, self.gain(trial.last) >= enough):
            self.point.take(trial.last)
            faces.settle()
            return True
        faces.forget()
        length = self._feasible_part(trial.first)
        shorter = self.point.copy()
        for kept, end in ((shorter.lam, trial.first.lam), (shorter.g, trial.first.g)):
            kept.aypx(1.0 - length, self._scaled(length, end))
        shorter.lam.array[:] = self._qp.feasible.project(shorter.lam.array_r)
        taken = agreed(self._comm, length > 0.0 and self.gain(shorter) >= enough)
        if taken:
            self.point.take(shorter)
        shorter.destroy()
        return taken or self._descend(known, faces)

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
            self._pcpg(z, optimality, stays)
            stays = False
            if first is None:
                first = z.copy()
            inside = feasible.project(z.lam.array_r)
            out = any_rank(self._comm, not np.array_equal(inside, z.lam.array_r))
            if not out or self._steps.cg >= self._max_it:
                break
            z.lam.array[:] = inside
            self._drop(z)
        assert first is not None
        return Trial(first, z, not out)

    def _drop(self, z: Point) -> None:
        """Enter the face of z, and bring z back to Gλ = e in it; multiplies by F once."""
        previous, feasible = self._face, self._qp.feasible
        assert previous is not None
        face = feasible.face(z.lam.array_r, z.g.array_r)
        self.enter(face)
        near = restored(self.coarse, z.lam)
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

    def _pcpg(self, z: Point, optimality: float, stays: bool) -> None:
        """PCPG to a part of what there is to do; to the end where the face stays."""
        z.g.copy(self._directions.r)
        self.coarse.project(self._directions.r)
        start, final = float(self._directions.r.norm()), FINAL * self._rule.tolerance
        share = STAGE if stays else self._parameters.reduction
        target = max(final, share * min(start, optimality))
        pcpg(
            self._on_face,
            z,
            TargetRule(target),
            self._steps,
            self._max_it,
            self._monitor,
            self._directions,
        )
        self.left = float(self._directions.r.norm())

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
