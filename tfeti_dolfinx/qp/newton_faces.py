"""Solves on faces of the feasible set by PCPG: the inner part of block Newton."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root
from tfeti_dolfinx.qp.coarse import HELD, Coarse, imbalance
from tfeti_dolfinx.qp.homogenised import restored
from tfeti_dolfinx.qp.krylov import Directions, pcpg
from tfeti_dolfinx.qp.parameters import NewtonParameters
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    FaceOperator,
    Monitor,
    Operator,
    Point,
    Steps,
    StoppingRule,
    TargetRule,
)
from tfeti_dolfinx.qp.projection import WithinFace, project_onto_feasible, project_within_face
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status, without_slip

# --- Result of solves on faces ----------------------------------------------------------------


@dataclass(frozen=True)
class Trial:
    """Result of the solves on faces of one Newton step.

    Attributes:
        first: Where the first one ended, maybe outside of Ω.
        last: Where the last one ended.
        feasible: Whether that is in Ω.
        face: The face of the first one.
        rounds: How many there were.
    """

    first: Point
    last: Point
    feasible: bool
    face: Face
    rounds: int

    def feasible_part(self, feasible: FeasibleSet, at: Point) -> float:
        """Largest t up to 1 with λ + t(first − λ) ∈ Ω, but for rows that slip. Collective."""
        down = without_slip(self.face, at.lam.array_r - self.first.lam.array_r)
        own = feasible.max_step(at.lam.array_r, down)
        return min(1.0, float(at.lam.getComm().tompi4py().allreduce(own, op=MPI.MIN)))

    def destroy(self) -> None:
        """Destroy the points. Collective."""
        self.first.destroy()
        self.last.destroy()


# --- Curved faces -----------------------------------------------------------------------------

# of Gλ = e: what is left after a first try to restore it, as where rows hardly hold, is worth a
# second one
EXACT = 1e-13
# points looked at on the way back to circles: it is short, or there is no such way
BACK = 30
# of a way along a face that is curved, with all that leaves Ω brought back, which lets go many
# nodes at once
PARTS = (0.5, 0.125)


class CurvedHessian:
    """Hessian F + Z diag(κ) Zᵀ of q along a curved face, to second order.

    Args:
        F: The operator.
        face: The face.
    """

    def __init__(self, F: Operator, face: Face) -> None:
        self._F, self._face = F, face

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (F + Z diag(κ) Zᵀ)x. Collective."""
        self._F.mult(x, y)
        y.array[:] += self.bend(x.array_r)

    def bend(self, x: Array) -> Array:
        """Z diag(κ) Zᵀx."""
        return np.asarray(self._face.Z @ (self._face.curvature * (self._face.Z.T @ x)))


def is_curved(qp: QP, face: Face) -> bool:
    """Return whether a row of some rank slips along a boundary. Collective."""
    return any_rank(qp.d.getComm().tompi4py(), face.curved)


def has_friction_rows(qp: QP, face: Face) -> bool:
    """Return whether a row of some rank sticks or slips. Collective."""
    rubbing = np.isin(face.status, (Status.STICK, Status.SLIP))
    return any_rank(qp.d.getComm().tompi4py(), bool(np.any(rubbing)))


def has_left(qp: QP, face: Face, x: Array) -> bool:
    """Return whether rows that do not slip are outside of Ω. Collective."""
    left = without_slip(face, qp.feasible.project(x) - x)
    return any_rank(qp.d.getComm().tompi4py(), bool(np.any(left != 0.0)))


def restored_on(qp: QP, coarse: Coarse, face: Face, lam: PETSc.Vec) -> PETSc.Vec:
    """λ + ZG_fᵀ(G_fG_fᵀ)⁺(e − Gλ); twice where its factor leaves much. Collective.

    Args:
        qp: The program.
        coarse: Projectors of the face.
        face: The face.
        lam: A point of the face.
    """
    near = _restored_once(qp, coarse, face, lam)
    if imbalance_on(qp, coarse, face, near) > EXACT:
        once, near = near, _restored_once(qp, coarse, face, near)
        once.destroy()
    return near


def _restored_once(qp: QP, coarse: Coarse, face: Face, lam: PETSc.Vec) -> PETSc.Vec:
    if not _is_beside(face, lam):
        return restored(coarse, lam)
    near = lam.duplicate()
    coarse.combine(coarse.solve(qp.coarse.residual(lam)), near)
    near.axpy(1.0, lam)
    return near


def imbalance_on(qp: QP, coarse: Coarse, face: Face, lam: PETSc.Vec) -> float:
    """Return the largest entry of Gλ − e over the size of its terms, at most 1. Collective."""
    return imbalance(qp.coarse if _is_beside(face, lam) else coarse, lam)


def _is_beside(face: Face, lam: PETSc.Vec) -> bool:
    """Return whether λ has a part outside the face's directions, as where rows slip."""
    fixed = lam.array_r - face.restricted(lam.array_r)
    return any_rank(lam.getComm().tompi4py(), bool(np.any(fixed)))


def face_with_curvature(qp: QP, coarse: Coarse, face: Face, on: Array, g: PETSc.Vec) -> Face:
    """Return a face with the curvature κ of another gradient. Collective.

    Args:
        qp: The program.
        coarse: Projectors of the face.
        face: The face.
        on: A point that has this face, shape ``(m,)``.
        g: Fλ − d.
    """
    s = gradient_on(qp, coarse, g)
    curvature = qp.feasible.face(on, s.array_r).curvature
    s.destroy()
    return Face(face.Z, curvature, face.status)


def gradient_on(qp: QP, coarse: Coarse, g: PETSc.Vec) -> PETSc.Vec:
    """Fλ − d − Gᵀμ with the μ of a face, the caller's own. Collective."""
    s = g.duplicate()
    qp.coarse.combine(coarse.coordinates(g), s)
    s.aypx(-1.0, g)
    return s


def slipping_work(lam: PETSc.Vec, s: PETSc.Vec, face: Face) -> float:
    """Return Σ|s_iλ_i| over slipping rows; its rounding may hide changes of q.

    Collective.
    """
    own = np.abs(lam.array_r * s.array_r)
    slip = float(np.sum(own - without_slip(face, own)))
    return float(lam.getComm().tompi4py().allreduce(slip))


def slipping_start(
    qp: QP, at: Point, face: Face, back: PETSc.Vec, pressed: Face
) -> tuple[Point, Face]:
    """Copy a point and its face, or ``back`` and its own if more points slip there. Collective.

    Near its circle a point that sticks, and whose gradient points outwards, would leave by far, in
    a direction of no use. So would, with friction, one that touches with less force than it is open
    by: at a start from elsewhere these are few, with forces that restoring Gλ = e has left.
    Multiplies by F once where it begins at ``back``.
    """
    start = at.copy()
    early = (face.status == Status.STICK) & (pressed.status == Status.SLIP)
    if has_friction_rows(qp, face):
        early |= (face.status == Status.TOUCHING) & (pressed.status == Status.OPEN)
    if not any_rank(qp.d.getComm().tompi4py(), bool(np.any(early))):
        return start, face
    moved_to(qp, start, back.copy())
    return start, pressed


def part_of_way(at: Point, end: Point, share: float) -> Point:
    """Return a new point at this share of the way from ``at`` to ``end``. Collective."""
    part = at.copy()
    for kept, last in ((part.lam, end.lam), (part.g, end.g)):
        kept.scale(1.0 - share)
        kept.axpy(share, last)
    return part


def projected_part(qp: QP, at: Point, end: Point, share: float) -> Point:
    """Project a point of the segment from ``at`` to ``end`` onto Ω. Collective; one F."""
    part = part_of_way(at, end, share)
    found = project_onto_feasible(qp.coarse, qp.feasible, part.lam)
    moved_to(qp, part, found.lam)
    return part


def moved_to(qp: QP, z: Point, lam: PETSc.Vec) -> None:
    """Move z to λ, which is destroyed, and update its gradient; multiplies by F once."""
    way, image = lam.copy(), z.g.duplicate()
    way.axpy(-1.0, z.lam)
    qp.F.mult(way, image)
    lam.copy(z.lam)
    z.g.axpy(1.0, image)
    for vec in (way, image, lam):
        vec.destroy()


def brought_back(qp: QP, face: Face, z: Point, near: PETSc.Vec | None = None) -> bool:
    """Retract z to Gz = e with slipping rows on their boundary. Collective.

    Multiplies by F once.

    Args:
        qp: The program.
        face: The face.
        z: The point.
        near: What it is brought near to, itself by default.

    Returns:
        Whether there is such a point near by.
    """
    within = WithinFace(qp.feasible, face, slipping=True)
    found = project_onto_feasible(
        qp.coarse, within, z.lam if near is None else near, max_trials=BACK
    )
    held = imbalance(qp.coarse, found.lam) <= HELD
    moved_to(qp, z, found.lam)
    return held


def brought_into(qp: QP, face: Face, z: Point) -> bool:
    """Project z onto Gz = e with open rows at 0. Collective.

    Where circles are small beside what Gz lacks, no points of them may balance it; of the discs
    some do. Multiplies by F once.

    Args:
        qp: The program.
        face: The face.
        z: The point.

    Returns:
        Whether there is such a point.
    """
    found = project_onto_feasible(qp.coarse, WithinFace(qp.feasible, face), z.lam)
    held = imbalance(qp.coarse, found.lam) <= HELD
    moved_to(qp, z, found.lam)
    return held


# --- Faces without directions of very high curvature ------------------------------------------

# times ‖F‖: a curvature that leaves F no say in where a force on a small circle points, as where
# what slips goes far beside what deforms; conjugate gradients and P would see nothing but it
HARD = 1e3


class FlattenedFace:
    """Face without its directions of high curvature κ, which are treated apart from PCPG.

    Args:
        whole: The face.
        norm: ‖F‖, or an estimate; 0 where nothing is known.

    Attributes:
        whole: The face.
        face: The same, but directions with κ ≫ ‖F‖ are held.
    """

    def __init__(self, whole: Face, norm: float) -> None:
        hard = whole.curvature > HARD * norm if norm > 0.0 else np.zeros(len(whole.curvature), bool)
        self._hard, self._kept = np.flatnonzero(hard), np.flatnonzero(~hard)
        self.bend(whole)

    def bend(self, whole: Face) -> None:
        """Replace the face by one with other curvatures; held directions stay held."""
        self.whole = whole
        self.face = whole.with_directions(self._kept) if self._hard.size else whole

    def back(self, qp: QP, coarse: Coarse, z: Point) -> bool:
        """Retract z to the circles; directions of high curvature move by −κ⁻¹Zᵀs. Collective.

        Into the discs where circles do not bear it. Multiplies by F once, or twice.

        Args:
            qp: The program.
            coarse: Projectors of ``face``.
            z: The point.

        Returns:
            Whether there is such a point near by.
        """
        s, near = gradient_on(qp, coarse, z.g), z.lam.copy()
        Z, kappa = self.whole.Z[:, self._hard], self.whole.curvature[self._hard]
        slope = Z.T @ s.array_r
        near.array[:] -= Z @ np.divide(slope, kappa, out=np.zeros_like(slope), where=kappa > 0.0)
        held = brought_back(qp, self.whole, z, near) or brought_into(qp, self.whole, z)
        s.destroy()
        near.destroy()
        return held


# --- Dependent rows of a face -----------------------------------------------------------------

# of ‖F‖: curvature of the way that a solve has gone; less is nearly none, and the way far
LOOSE = 1e-8
# of the way to the first bound, where nothing else ends it: more rows than one are to leave
BEYOND = 10.0
# of a way, beyond its first bound: what blocks it is out then, and what has just come into the
# face, at its bound as yet, is off it if it goes inwards, and stays in the face
ONWARDS = 1e-12
# projections to find forces in Ω on such a way: between two rows each halves what is missing
ALTERNATIONS = 10
# of d: rows that want gaps so far apart exclude each other, less may be rounding
APART = 1e-8
# projections at most until nothing but what F does not see is left; what one keeps of it at least
PURE, REMAINS = 4, 0.9
# of ‖F‖ and of a way: what F and G may make of it by rounding, where it is to prove that rows
# exclude each other; so far all sets of forces that have an end have ended
PROOF, FAR = 1e-10, 1e30
# of the largest force of a way that nothing ends: rows with less have no part in it
TAKES_PART = 1e-3


class DependentRows:
    """Treatment of faces on which F is singular, or nearly so.

    Args:
        qp: The program on all rows.
        directions: Those of PCPG on the face.

    Attributes:
        preconditioner: That of the face, which knows how rows depend on each other, or None.
        face: The face; its rows that slip follow their boundary, no bound ends their ways.
        contradicts: Whether q falls along a way that F and Gᵀ do not see, and that nothing ends.
        excluding: The local rows that exclude each other: those of that way.
    """

    def __init__(self, qp: QP, directions: Directions) -> None:
        self._qp, self._directions = qp, directions
        self._comm = qp.d.getComm().tompi4py()
        self.preconditioner: FaceOperator | None = None
        self.face: Face | None = None
        self.contradicts = False
        self.excluding: Array = np.empty(0, dtype=np.int64)

    def part(self, x: Array) -> PETSc.Vec | None:
        """Return the part of x in the common null space of F and G, or None. Collective.

        What the projector only makes small, more of it takes away.
        """
        part = self._unseen(x)
        for _ in range(PURE if part is not None else 0):
            assert part is not None
            again = self._unseen(part.array_r)
            assert again is not None
            kept = bcast_from_root(self._comm, again.norm() >= REMAINS * part.norm() > 0.0)
            part.destroy()
            part = again
            if kept:
                return part
        if part is not None:
            part.destroy()
        return None

    def _unseen(self, x: Array) -> PETSc.Vec | None:
        """Return x projected once."""
        part = self.preconditioner.dependent(x) if self.preconditioner is not None else None
        if part is None:
            return None
        found = self._qp.d.duplicate()
        found.array[:] = part
        return found

    def slack(self, z: Point, target: float) -> Point | None:
        """Step along a null direction of F to a bound, where dependent rows want different gaps.

        Between them forces may move that F does not see, and q falls all the way to a bound.

        Args:
            z: The point; moved into Ω, to a smaller face, if there is such a way.
            target: What PCPG aims at; it would not get below what the way leads along.

        Returns:
            The point at the first bound, or None where z stays; then ``contradicts`` says whether
            there is a way without a bound.
        """
        way = self.part(-z.g.array_r)
        if way is None:
            return None
        length = self._to_a_bound(z, way.array_r)
        self._endless(length, way.norm(), way)
        if not (np.isfinite(length) and bcast_from_root(self._comm, way.norm() > target)):
            way.destroy()
            return None
        bound, start = z.copy(), np.array(z.lam.array_r)
        bound.lam.axpy(length, way)
        z.lam.axpy(BEYOND * length, way)
        for _ in range(ALTERNATIONS):
            inside = self._qp.feasible.project(z.lam.array_r) - start
            unseen = self._unseen(inside)
            assert unseen is not None
            z.lam.array[:] = start + unseen.array_r
            unseen.destroy()
        z.lam.array[:] = self._qp.feasible.project(z.lam.array_r)
        way.destroy()
        return bound

    def shorten(self, before: Point, z: Point) -> None:
        """Shorten a long step of hardly any curvature to the first bound.

        Rows depend on each other there, or nearly so; numbers of that size would drown the others.
        """
        p, Fp = z.lam.copy(), z.g.copy()
        p.axpy(-1.0, before.lam)
        Fp.axpy(-1.0, before.g)
        length = self._to_a_bound(before, p.array_r)
        loose = p.dot(Fp) <= LOOSE * self._directions.norm * p.dot(p)
        if bcast_from_root(self._comm, length < 1.0 and loose):
            z.take(before)
            z.move(max(length, 0.0) * BEYOND + ONWARDS, p, Fp)
        p.destroy()
        Fp.destroy()

    def stop(self, before: Point, z: Point) -> None:
        """Move z back to where the segment from ``before`` leaves Ω; q is lower there, too.

        What blocks it is at its bound there; F λ − d is known, and Gλ = e kept.
        """
        p, Fp = z.lam.copy(), z.g.copy()
        p.axpy(-1.0, before.lam)
        Fp.axpy(-1.0, before.g)
        length = self._to_a_bound(before, p.array_r)
        z.take(before)
        z.move(min(max(length, 0.0) + ONWARDS, 1.0), p, Fp)
        p.destroy()
        Fp.destroy()

    def slide(self, z: Point) -> bool:
        """Step to a bound along a direction of no curvature, as of dependent rows.

        Returns:
            Whether there is one.
        """
        own = self._directions
        for way in (own.p, own.r):
            self._qp.F.mult(way, own.Fp)
            if way.norm() == 0.0 or own.seen(way.dot(own.Fp), way.dot(way)):
                continue
            length = self._to_a_bound(z, way.array_r)
            self._endless(length, own.r.dot(way) / way.norm(), way)
            if np.isfinite(length):
                z.move(length * BEYOND, way, own.Fp)
            return bool(np.isfinite(length))
        return False

    def _endless(self, length: float, slope: float, way: PETSc.Vec) -> None:
        """Check whether a descent direction proves that q is unbounded below. Collective.

        Then it does in Ω's cone of recession, and neither F nor G sees it: rows that slip, and
        rounding of an F that is hardly definite, make ways that are none. Multiplies by F once.
        """
        if not bcast_from_root(
            self._comm, slope > APART * self._qp.d.norm() and not np.isfinite(length)
        ):
            return
        p, work = self._recession(way), way.duplicate()
        size = p.norm()
        self._qp.F.mult(p, work)
        unseen = work.norm() <= PROOF * self._directions.norm * size
        p.copy(work)
        self._qp.coarse.project(work)
        work.axpy(-1.0, p)
        unseen = unseen and work.norm() <= PROOF * size
        falls = p.dot(self._qp.d) > APART * self._qp.d.norm() * size
        self.contradicts = bool(bcast_from_root(self._comm, size > 0.0 and unseen and falls))
        if self.contradicts:
            largest = p.norm(PETSc.NormType.INFINITY)
            self.excluding = np.flatnonzero(np.abs(p.array_r) > TAKES_PART * largest)
        p.destroy()
        work.destroy()

    def _recession(self, way: PETSc.Vec) -> PETSc.Vec:
        """Project a direction onto the recession cone of Ω: P_Ω(t·way)/t for a large t."""
        p, far = way.copy(), FAR / way.norm(PETSc.NormType.INFINITY)
        p.array[:] = self._qp.feasible.project(far * way.array_r) / far
        return p

    def _to_a_bound(self, z: Point, way: Array) -> float:
        """Return largest t with λ + t·way ∈ Ω, maybe infinite; rounding ends no way. Collective."""
        held = way if self.face is None else without_slip(self.face, way)
        largest = self._comm.allreduce(float(np.max(np.abs(way), initial=0.0)), op=MPI.MAX)
        held = np.where(np.abs(held) > PROOF * largest, held, 0.0)
        own = self._qp.feasible.max_step(z.lam.array_r, -held)
        return float(self._comm.allreduce(own, op=MPI.MIN))


# --- Solves on faces by PCPG ------------------------------------------------------------------

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
        self._eased: FlattenedFace
        self.settled, self.curved, self._accepted, self.left = False, False, False, np.inf
        self._on_face, self.rounded, self._woken, self.cautious = qp, 0, 0, False
        self._bent: CurvedHessian | None = None
        self._preconditioner: FaceOperator | None = None
        self._prepared, self._stayed, self._stage, self._size = False, False, STAGE, 0.0

    @property
    def norm(self) -> float:
        """Largest Rayleigh quotient of F seen; at most ‖F‖."""
        return self._directions.norm

    def saw(self, curvature: float, size: float) -> None:
        """Update the norm estimate by another Rayleigh quotient."""
        self._directions.seen(curvature, size)

    @property
    def coarse(self) -> Coarse:
        """Projectors of the face entered."""
        return self._on_face.coarse

    def stays_on(self, face: Face) -> bool:
        """Return whether each row has the status that it has on the face entered. Collective."""
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
        self._face, self._eased = face, FlattenedFace(face, self.norm)
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
        self._bent = CurvedHessian(self._qp.F, self._eased.face) if self.curved else None
        on = replace(self._on_face, F=self._bent or self._qp.F, preconditioner=self._preconditioner)
        past = None if self.curved or on.recycled is None else on.recycled.on(self._eased.face)
        self._on_face = replace(on, recycled=past)
        self._prepared = True

    def settle(self) -> None:
        """Note that the last solve was accepted; PCPG continues its directions if the face stays.

        Not on a curved face, since the point was then retracted to it.
        """
        self.settled, self._accepted = not self.curved, True

    def forget(self) -> None:
        """Restart PCPG at the next solve, since the point is not where it stopped."""
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
        """Project z onto Ω and drop the rows that left it; return whether z stays in Ω."""
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
        wild = bcast_from_root(self._comm, near.norm() > WILD * max(z.lam.norm(), self._size))
        if wild or imbalance_on(*of, near) > HELD:
            # it no longer holds a body: what is nearest names rows that do, near by if it can
            near.destroy()
            self._woken += 1
            near = project_within_face(self._qp.coarse, feasible, previous, z.lam)
            on = 0.5 * (z.lam.array_r + near.array_r)
            self.enter(feasible.face(on, z.g.array_r))
        near.copy(z.lam)
        near.destroy()
        z.refresh(self._qp)
        if self.curved and self._face is not None:
            self._face = face_with_curvature(self._qp, self.coarse, self._face, on, z.g)
            self._eased.bend(self._face)
        self.forget()

    def _target(self, z: Point, optimality: float, stays: bool) -> float:
        """Return PCPG's target: a share of the residual, a smaller one where the face stays."""
        z.g.copy(self._directions.r)
        self.coarse.project(self._directions.r)
        start, final = float(self._directions.r.norm()), FINAL * self._rule.aim
        followed = self._stayed and self.curved and optimality <= FOLLOWED * self.left
        self._stage = STAGE if not stays else self._stage**2 if followed else self._stage
        self._stayed = stays
        share = self._stage if stays else self._parameters.reduction
        return max(final, share * min(start, optimality))

    def _pcpg(self, z: Point, target: float) -> ConvergedReason:
        """Run PCPG on the face entered; then remove curvature terms from the gradient."""
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
        """Free projectors and preconditioner of the face."""
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
