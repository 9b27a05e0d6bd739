"""Solves on faces by PCPG, one after the other: the inner part of block Newton."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tfeti_dolfinx.parallel import agreed, any_rank
from tfeti_dolfinx.qp.coarse import HELD, Coarse
from tfeti_dolfinx.qp.dependent import DependentRows
from tfeti_dolfinx.qp.directions import Directions
from tfeti_dolfinx.qp.eased import Eased
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.monitors import Monitor
from tfeti_dolfinx.qp.nearest import nearest_within
from tfeti_dolfinx.qp.newton_curved import (
    Bent,
    bent_at,
    has_left,
    imbalance_on,
    is_curved,
    restored_on,
)
from tfeti_dolfinx.qp.parameters import NewtonParameters
from tfeti_dolfinx.qp.pcpg import pcpg
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, FaceOperator, Point, Steps
from tfeti_dolfinx.qp.stopping import StoppingRule, TargetRule
from tfeti_dolfinx.qp.trial import Trial

# rows leave a face in so many rounds at most: each round drops one row at least, but most at once
MOST_ROUNDS = 60
# rounds that wake rows again, to hold a body: after so many the same ones leave and wake by turns
MOST_WOKEN = 4
# of the rule's tolerance, for the last solve on a face: ‖g^P‖ is measured otherwise than ‖P_f g‖
FINAL = 0.9
# a solve on a face that stays is looked at whenever it has come down by this: PCPG goes on where it
# has stopped, and rows that want to carry are found before the wrong face is solved to the end
STAGE = 0.1
# of the residual of PCPG: where ‖g^P‖ is at most that, the face hardly bends on the way; the next
# solve is to be so much better that the end is superlinear
FOLLOWED = 2.0
# times λ: what restores Gλ = e by forces so much larger does it with rows that hold nothing
WILD = 1e6


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
        dependent: What to do where rows of the face depend on each other.
        settled: Whether λ is where PCPG has stopped on the face entered.
        curved: Whether that face is curved.
        left: The residual there.
        cautious: Whether rows leave a flat face as they block the way, not all that are out at its
            end: then q falls for certain, but fewer leave for as many solves.
        rounded: So many solves in a row ended at rounding, or with no row at the end of a flat way.
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
        self._directions.norm = qp.seen
        self.dependent = DependentRows(qp, self._directions)
        self._face: Face | None = None
        self._eased: Eased
        self.settled, self.curved, self._accepted, self.left = False, False, False, np.inf
        self._on_face, self.rounded, self._woken, self.cautious = qp, 0, 0, False
        self._bent: Bent | None = None
        self._preconditioner: FaceOperator | None = None
        self._prepared, self._stayed, self._stage, self._size = False, False, STAGE, 0.0

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

    def stays_on(self, face: Face) -> bool:
        """Whether each row does on a face what it does on the one entered. Collective."""
        return self._face is not None and not any_rank(
            self._comm, not np.array_equal(face.status, self._face.status)
        )

    def enter(self, face: Face) -> bool:
        """Make the projectors of a face, unless it is the last one; anew where it is curved.

        Returns:
            Whether each row does what it did on the last one.
        """
        same = self.stays_on(face)
        if same and not self.curved:
            return True
        self._leave()
        self._steps.faces += not same
        self.curved = is_curved(self._qp, face)
        self._face, self._eased = face, Eased(face, self.norm)
        coarse = self._qp.coarse.on_face(self._eased.face)
        self._on_face = replace(self._qp, coarse=coarse, preconditioner=None)
        self.forget()
        return same

    def _ready(self) -> None:
        """Make the preconditioner of the face entered, and what its curvature adds to F."""
        if self._prepared:
            return
        if self._qp.preconditioner_on is not None:
            self._preconditioner = self._qp.preconditioner_on(self._eased.face)
        self.dependent.preconditioner = self._preconditioner
        self.dependent.face = self._eased.face
        self._bent = Bent(self._qp.F, self._eased.face) if self.curved else None
        on = replace(self._on_face, F=self._bent or self._qp.F, preconditioner=self._preconditioner)
        past = None if self.curved or on.recycled is None else on.recycled.on(self._eased.face)
        self._on_face = replace(on, recycled=past)
        self._prepared = True

    def settle(self) -> None:
        """The last solve's end was accepted; if its face stays, PCPG goes on from there.

        Not where it is curved: the end was brought back to it.
        """
        self.settled, self._accepted = not self.curved, True

    def forget(self) -> None:
        """The next direction is a first one: the point is not where PCPG stopped."""
        self._directions.fresh, self.settled, self._accepted = True, False, False

    def solve(self, start: Point, face: Face, optimality: float) -> Trial:
        """Solve on a face; drop what leaves Ω, restore Gλ = e, solve again.

        Args:
            start: A feasible point, in the face.
            face: The face.
            optimality: ‖g^P‖ there.
        """
        z, first, out, accepted = start.copy(), None, True, self._accepted
        self._size, self._woken = start.lam.norm(), 0
        stays, rounds = self.enter(face) and accepted, 0
        for _ in range(MOST_ROUNDS):
            self._ready()
            assert self._face is not None
            target = self._target(z, optimality, stays)
            bound = self.dependent.slack(z, target)
            if self.dependent.contradicts:
                break
            if bound is not None:
                first = first or bound
                self._drop(z)
                continue
            before = z.copy()
            broken = self._pcpg(z, target) == ConvergedReason.DIVERGED_INDEFINITE_MAT
            stays, rounds = False, rounds + 1
            self.dependent.shorten(before, z)
            if first is None:
                first, face = z.copy(), self._face
            out = has_left(self._qp, self._face, z.lam.array_r)
            ends = self._steps.cg >= self._max_it or self._woken >= MOST_WOKEN
            ends = ends or not (out or (broken and self.dependent.slide(z)))
            if not ends:
                self.rounded = self.rounded if out else 0
                out = not self._let_go(before, z)
            before.destroy()
            if ends:
                break
        assert self._face is not None
        back = not out and (not self.curved or self._eased.back(self._qp, self.coarse, z))
        return Trial(first or z.copy(), z, back, face, rounds)

    def _let_go(self, before: Point, z: Point) -> bool:
        """What has left Ω leaves the face, or what did so first; whether z stays in Ω then."""
        blocked = self.cautious and not self.curved
        if blocked:
            self.dependent.stop(before, z)
        z.lam.array[:] = self._qp.feasible.project(z.lam.array_r)
        self._drop(z, blocked)
        return blocked and not self.curved

    def _drop(self, z: Point, restored: bool = False) -> None:
        """Enter the face of z, and bring z back to Gλ = e in it; multiplies by F once.

        Not on a flat face where z has kept it.
        """
        previous, feasible = self._face, self._qp.feasible
        assert previous is not None
        on = np.array(z.lam.array_r)
        self.enter(feasible.face(on, z.g.array_r))
        if restored and not self.curved:
            self.forget()
            return
        of = (self._qp, self.coarse, self._eased.face)
        near = restored_on(*of, z.lam)
        wild = agreed(self._comm, near.norm() > WILD * max(z.lam.norm(), self._size))
        if wild or imbalance_on(*of, near) > HELD:
            # it no longer holds a body: what is nearest names rows that do, near by if it can
            near.destroy()
            self._woken += 1
            near = nearest_within(self._qp.coarse, feasible, previous, z.lam)
            on = 0.5 * (z.lam.array_r + near.array_r)
            self.enter(feasible.face(on, z.g.array_r))
        near.copy(z.lam)
        near.destroy()
        z.refresh(self._qp)
        if self.curved and self._face is not None:
            self._face = bent_at(self._qp, self.coarse, self._face, on, z.g)
            self._eased.bend(self._face)
        self.forget()

    def _target(self, z: Point, optimality: float, stays: bool) -> float:
        """What PCPG aims at: a part of what there is to do; more where the face stays."""
        z.g.copy(self._directions.r)
        self.coarse.project(self._directions.r)
        start, final = float(self._directions.r.norm()), FINAL * self._rule.aim
        followed = self._stayed and self.curved and optimality <= FOLLOWED * self.left
        self._stage = STAGE if not stays else self._stage**2 if followed else self._stage
        self._stayed = stays
        share = self._stage if stays else self._parameters.reduction
        return max(final, share * min(start, optimality))

    def _pcpg(self, z: Point, target: float) -> ConvergedReason:
        """PCPG on the face entered; what a curvature adds is taken from the gradient again."""
        before = np.array(z.lam.array_r)
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
        ended = reason != ConvergedReason.CONVERGED_RTOL and self._steps.cg < self._max_it
        self.rounded = self.rounded + 1 if ended else 0
        if self._bent is not None:
            z.g.array[:] -= self._bent.bend(z.lam.array_r - before)
        return reason

    def _leave(self) -> None:
        """Free what belongs to the face."""
        if self._face is not None:
            self._on_face.coarse.destroy()
        if self._preconditioner is not None:
            self._preconditioner.destroy()
        self._preconditioner = self.dependent.preconditioner = None
        self._face, self._prepared = None, False

    def destroy(self) -> None:
        """Free what it holds. Collective."""
        self._leave()
        self._directions.destroy()
