"""Rows of a face that depend on each other: ways along which F sees nothing."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.directions import Directions
from tfeti_dolfinx.qp.faces import Face, without_slip
from tfeti_dolfinx.qp.problem import QP, FaceOperator, Point

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
    """What to do on a face where F is singular, or nearly so.

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
        """The part of x that F and Gᵀ do not see; None where there is none. Collective.

        What the projector only makes small, more of it takes away.
        """
        part = self._unseen(x)
        for _ in range(PURE if part is not None else 0):
            assert part is not None
            again = self._unseen(part.array_r)
            assert again is not None
            kept = agreed(self._comm, again.norm() >= REMAINS * part.norm() > 0.0)
            part.destroy()
            part = again
            if kept:
                return part
        if part is not None:
            part.destroy()
        return None

    def _unseen(self, x: Array) -> PETSc.Vec | None:
        """x projected once."""
        part = self.preconditioner.dependent(x) if self.preconditioner is not None else None
        if part is None:
            return None
        found = self._qp.d.duplicate()
        found.array[:] = part
        return found

    def slack(self, z: Point, target: float) -> Point | None:
        """Where rows that depend on each other want different gaps, let those go that lose.

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
        if not (np.isfinite(length) and agreed(self._comm, way.norm() > target)):
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
        """Where a solve has gone far because nothing held it, go to the first bound only.

        Rows depend on each other there, or nearly so; numbers of that size would drown the others.
        """
        p, Fp = z.lam.copy(), z.g.copy()
        p.axpy(-1.0, before.lam)
        Fp.axpy(-1.0, before.g)
        length = self._to_a_bound(before, p.array_r)
        loose = p.dot(Fp) <= LOOSE * self._directions.norm * p.dot(p)
        if agreed(self._comm, length < 1.0 and loose):
            z.take(before)
            z.move(max(length, 0.0) * BEYOND + ONWARDS, p, Fp)
        p.destroy()
        Fp.destroy()

    def stop(self, before: Point, z: Point) -> None:
        """Take z back to where the way from ``before`` first leaves Ω; q is lower there, too.

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
        """To a bound along a direction or residual without curvature, as of dependent rows.

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
        """Whether a way down that costs nothing proves that q falls forever. Collective.

        Then it does in Ω's cone of recession, and neither F nor G sees it: rows that slip, and
        rounding of an F that is hardly definite, make ways that are none. Multiplies by F once.
        """
        if not agreed(self._comm, slope > APART * self._qp.d.norm() and not np.isfinite(length)):
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
        self.contradicts = bool(agreed(self._comm, size > 0.0 and unseen and falls))
        if self.contradicts:
            largest = p.norm(PETSc.NormType.INFINITY)
            self.excluding = np.flatnonzero(np.abs(p.array_r) > TAKES_PART * largest)
        p.destroy()
        work.destroy()

    def _recession(self, way: PETSc.Vec) -> PETSc.Vec:
        """The nearest direction to a way in which Ω has no end: P_Ω(t·way)/t for a large t."""
        p, far = way.copy(), FAR / way.norm(PETSc.NormType.INFINITY)
        p.array[:] = self._qp.feasible.project(far * way.array_r) / far
        return p

    def _to_a_bound(self, z: Point, way: Array) -> float:
        """Largest t with λ + t·way ∈ Ω, maybe infinite; rounding ends no way. Collective."""
        held = way if self.face is None else without_slip(self.face, way)
        largest = self._comm.allreduce(float(np.max(np.abs(way), initial=0.0)), op=MPI.MAX)
        held = np.where(np.abs(held) > PROOF * largest, held, 0.0)
        own = self._qp.feasible.max_step(z.lam.array_r, -held)
        return float(self._comm.allreduce(own, op=MPI.MIN))
