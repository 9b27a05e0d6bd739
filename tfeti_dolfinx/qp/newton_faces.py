"""Solves on faces of the feasible set by PCPG: step 3 of block Newton."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import any_rank, largest, summed
from tfeti_dolfinx.qp.coarse import HELD, Coarse, imbalance
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
from tfeti_dolfinx.qp.sets import Face, without_slip

# of a way, beyond its first bound: what blocks it is out there, what goes inwards is off its bound
ONWARDS = 1e-12
# of the way to the first bound, where hardly any curvature ends it: more rows than one are to leave
BEYOND = 10.0
# of d: rows that want gaps so far apart exclude each other, less may be rounding; of the largest
# force of such a direction: rows with less have no part in it; and how far it is followed
APART, TAKES_PART, FAR = 1e-8, 1e-3, 1e30
# of ‖F‖‖w‖: what may be left of Fw where F is not to see w, and most multiplications for that
UNSEEN, PURIFYING = 1e-14, 200

# --- Points and products as numpy arrays ------------------------------------------------------


@dataclass(frozen=True)
class Multipliers:
    """Multipliers with their gradient, this rank's part.

    Attributes:
        lam: λ, shape ``(m,)``.
        g: Fλ − d.
    """

    lam: Array
    g: Array

    def towards(self, end: Multipliers, share: float) -> Multipliers:
        """Return the point at this share of the way to another one."""
        return Multipliers(
            self.lam + share * (end.lam - self.lam), self.g + share * (end.g - self.g)
        )


class LocalProgram:
    """Quadratic program on numpy arrays of this rank's rows. All methods are collective.

    Args:
        qp: The program.
    """

    def __init__(self, qp: QP) -> None:
        self.qp, self.comm = qp, qp.d.getComm().tompi4py()
        self._x, self._y = qp.d.duplicate(), qp.d.duplicate()

    def vec(self, x: Array) -> PETSc.Vec:
        """Return the work vector with these values, valid until the next call."""
        self._x.array[:] = x
        return self._x

    def F(self, x: Array) -> Array:
        """F x: one multiplication."""
        self.qp.F.mult(self.vec(x), self._y)
        return np.array(self._y.array_r)

    def dot(self, *pairs: tuple[Array, Array]) -> list[float]:
        """Return xᵀy of pairs of vectors, rank 0's on every rank."""
        products = summed(self.comm, np.array([x @ y for x, y in pairs]))
        self.comm.Bcast(products, root=0)
        return [float(value) for value in products]

    def moved(self, z: Multipliers, lam: Array) -> Multipliers:
        """Return other multipliers with their gradient: one multiplication by F."""
        return Multipliers(lam, z.g + self.F(lam - z.lam))

    def refreshed(self, lam: Array) -> Multipliers:
        """Return multipliers with a gradient made anew: one multiplication by F."""
        return Multipliers(lam, self.F(lam) - self.qp.d.array_r)

    def normal(self, mu: Array) -> Array:
        """Gᵀμ."""
        self.qp.coarse.combine(mu, self._y)
        return np.array(self._y.array_r)

    def projected(self, z: Multipliers, within: WithinFace | None = None) -> tuple[Array, bool]:
        """Return the nearest point of Ω, or of a part, with Gλ = e; and whether it has that."""
        onto = within or self.qp.feasible
        found = project_onto_feasible(self.qp.coarse, onto, self.vec(z.lam))
        lam = np.array(found.lam.array_r)
        found.lam.destroy()
        return lam, found.missing <= HELD

    def any(self, flags: Array) -> bool:
        """Return whether a flag is set on some rank."""
        return any_rank(self.comm, bool(np.any(flags)))

    def destroy(self) -> None:
        """Destroy the work vectors."""
        self._x.destroy()
        self._y.destroy()


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


# --- Solves on faces --------------------------------------------------------------------------


@dataclass(frozen=True)
class FaceSolve:
    """Result of the solves on faces of one Newton step.

    Attributes:
        last: Where PCPG ended on the last face.
        feasible: Whether ``last`` is in Ω and fulfils Gλ = e.
        rounds: Number of solves.
    """

    last: Multipliers
    feasible: bool
    rounds: int


class FaceSolver:
    """PCPG on faces; keeps projectors, preconditioner and directions while the face stays.

    Args:
        program: The program on all rows.
        rule: Its tolerance bounds the target of each solve.
        parameters: Tolerances.
        steps: Counts.
        max_it: Most conjugate gradient steps.
        monitor: Called after each.

    Attributes:
        left: ‖P_f(Fλ − d)‖ where PCPG has stopped.
        excluding: Local rows that exclude each other, if a solve has found that; else None.
    """

    def __init__(
        self,
        program: LocalProgram,
        rule: StoppingRule,
        parameters: NewtonParameters,
        steps: Steps,
        max_it: int,
        monitor: Monitor,
    ) -> None:
        self._program, self._qp, self._rule = program, program.qp, rule
        self._parameters, self._steps, self._max_it = parameters, steps, max_it
        self._monitor = monitor
        self._directions = Directions(self._qp.d, self._qp.keeps)
        self._directions.norm = self._qp.seen
        self._point = Point(self._qp.d.duplicate(), self._qp.d.duplicate())
        self._face: Face | None = None
        self._on_face, self._preconditioner = self._qp, cast(FaceOperator | None, None)
        self.left, self.excluding = np.inf, cast(Array | None, None)

    @property
    def norm(self) -> float:
        """Largest Rayleigh quotient of F seen; at most ‖F‖."""
        return self._directions.norm

    def saw(self, curvature: float, size: float) -> None:
        """Update the estimate of ‖F‖ by another Rayleigh quotient."""
        self._directions.seen(curvature, size)

    def multipliers(self, g: Array) -> Array:
        """Return the μ of the face entered: (G_fG_fᵀ)⁺G_fZᵀg, replicated. Collective."""
        return self._on_face.coarse.coordinates(self._program.vec(g))

    def solve(self, start: Multipliers, face: Face, optimality: float, resume: bool) -> FaceSolve:
        """Solve on a face; drop what leaves Ω, restore Gλ = e, solve again. Collective.

        Args:
            start: A feasible point of the face.
            face: The face.
            optimality: ‖g^P‖ there.
            resume: Whether PCPG has stopped at ``start``: it goes on if the face stays.
        """
        feasible, z, rounds = self._qp.feasible, start, 0
        stays = self._enter(face) and resume
        while True:
            # PCPG on the face
            end, broken = self._pcpg(z, optimality, stays)
            rounds, stays = rounds + 1, False
            if broken and not self._has_left(end):
                end = self._along_null_space(end)
            out = self._has_left(end)
            if not out or rounds == self._parameters.most_rounds or self._ended:
                break
            # rows that have left Ω leave the face, and Gλ = e is restored in the smaller one
            if not broken and not self._curved and self._is_loose(z, end):
                end = self._up_to_bound(z, end, BEYOND)
            smaller = self._restored(feasible.project(end.lam), end.g)
            if smaller is None:
                break
            z = smaller
        if self._curved and not out:
            end, held = self._onto_boundary(end)
            out = not held
        return FaceSolve(end, not out, rounds)

    @property
    def _ended(self) -> bool:
        return self._steps.cg >= self._max_it

    @property
    def _curved(self) -> bool:
        return isinstance(self._on_face.F, CurvedHessian)

    def _enter(self, face: Face) -> bool:
        """Make projectors and preconditioner of a face; return whether it is the last one.

        A curved face is made anew, with its new tangents.
        """
        same = self._face is not None and not self._program.any(face.status != self._face.status)
        if same and not self._curved:
            return True
        self._leave()
        self._steps.faces += not same
        self._set_face(face, self._qp.coarse.on_face(face))
        return same

    def _set_face(self, face: Face, coarse: Coarse) -> None:
        curved = any_rank(self._program.comm, face.curved)
        F = CurvedHessian(self._qp.F, face) if curved else self._qp.F
        past = None if curved or self._qp.recycled is None else self._qp.recycled.on(face)
        self._face = face
        self._on_face = replace(self._qp, F=F, coarse=coarse, preconditioner=None, recycled=past)

    def _restored(self, on: Array, g: Array) -> Multipliers | None:
        """Return the point of the face of ``on`` with Gλ = e next to it; one multiplication by F.

        Where the smaller face no longer holds a body, the nearest feasible point within the one
        before names rows that do. None where there is no such point.
        """
        qp, program, before = self._qp, self._program, self._face
        assert before is not None
        self._enter(qp.feasible.face(on, g))
        coarse = self._on_face.coarse
        missing = qp.coarse.residual(program.vec(on))
        coarse.combine(coarse.solve(missing), self._point.lam)
        lam = on + self._point.lam.array_r
        if imbalance(qp.coarse, program.vec(lam)) > HELD:
            near = project_within_face(qp.coarse, qp.feasible, before, program.vec(on))
            lam = np.array(near.array_r)
            near.destroy()
            on = 0.5 * (on + lam)
            self._enter(qp.feasible.face(on, g))
        z = program.refreshed(lam)
        if self._curved and self._face is not None:
            self._set_face(self._bent(on, z.g), self._on_face.coarse)
        return z

    def _bent(self, on: Array, g: Array) -> Face:
        """Return the face entered with the curvature κ of another gradient."""
        assert self._face is not None
        s = g - self._program.normal(self.multipliers(g))
        return replace(self._face, curvature=self._qp.feasible.face(on, s).curvature)

    def _is_loose(self, z: Multipliers, end: Multipliers) -> bool:
        """Return whether F hardly sees a way, which goes far then: rows depend on each other."""
        way = end.lam - z.lam
        curvature, size = self._program.dot((way, end.g - z.g), (way, way))
        return curvature <= self._parameters.loose * self.norm * size

    def _has_left(self, z: Multipliers) -> bool:
        """Return whether rows that do not slip are outside of Ω."""
        assert self._face is not None
        apart = self._qp.feasible.project(z.lam) - z.lam
        return self._program.any(without_slip(self._face, apart) != 0.0)

    def _to_a_bound(self, lam: Array, way: Array) -> float:
        """Return the largest t with λ + t·way ∈ Ω, maybe infinite; rounding ends no way."""
        assert self._face is not None
        held, small = without_slip(self._face, way), self._parameters.rounding
        held = np.where(np.abs(held) > small * largest(self._program.comm, way), held, 0.0)
        own = self._qp.feasible.max_step(lam, -held)
        return float(self._program.comm.allreduce(max(own, 0.0), op=MPI.MIN))

    def _up_to_bound(self, z: Multipliers, end: Multipliers, times: float) -> Multipliers:
        """Return where the segment from z leaves Ω, or so many times as far, in Ω.

        What blocks it is at its bound there. Once as far q is lower, Gλ = e is kept, and F
        multiplied by nothing.
        """
        length = self._to_a_bound(z.lam, end.lam - z.lam)
        # what has just come into the face, at its bound as yet, stays in it if it goes inwards
        part = z.towards(end, min(times * length + ONWARDS, 1.0))
        return Multipliers(self._qp.feasible.project(part.lam), part.g)

    def _along_null_space(self, z: Multipliers) -> Multipliers:
        """Go beyond a bound along a direction without curvature, where PCPG has found one.

        Rows depend on each other. Where no bound ends the way, neither F nor G sees it and q falls
        along it, they want gaps that exclude each other: ``excluding`` says so.
        """
        program, own, qp = self._program, self._directions, self._qp
        for vec in (own.p, own.r):
            way = np.array(vec.array_r)
            size = largest(program.comm, way)
            Fw = program.F(way)
            curvature, square = program.dot((way, Fw), (way, way))
            if size == 0.0 or own.seen(curvature, square):
                continue
            way, Fw = self._unseen(way, Fw)
            length = self._to_a_bound(z.lam, way)
            if np.isfinite(length):
                return Multipliers(z.lam + BEYOND * length * way, z.g + BEYOND * length * Fw)
            # in the cone of recession of Ω
            p = qp.feasible.project(FAR / size * way) * (size / FAR)
            Pp = program.vec(p)
            qp.coarse.project(Pp)
            Qp, d = p - Pp.array_r, qp.d.array_r
            Fp = program.F(p)
            FF, QQ, pp, pd, dd = program.dot((Fp, Fp), (Qp, Qp), (p, p), (p, d), (d, d))
            unseen = max(FF / max(self.norm, TINY) ** 2, QQ) <= self._parameters.rounding**2 * pp
            if pp > 0.0 and unseen and pd > APART * np.sqrt(dd * pp):
                most = largest(program.comm, p)
                self.excluding = np.flatnonzero(np.abs(p) > TAKES_PART * most)
            break
        return z

    def _unseen(self, way: Array, Fw: Array) -> tuple[Array, Array]:
        """Return w − (PFP)⁺Fw by PCPG, with its image: the part of w ≠ 0 that F does not see.

        What PCPG has left of the others in w is small beside it, but its bounds would end the way.
        """
        own, program = Directions(self._qp.d), self._program
        on_face = replace(self._on_face, F=self._qp.F, preconditioner=self._preconditioner)
        point = Point(self._qp.d.duplicate(), self._qp.d.duplicate())
        point.g.array[:] = -Fw
        (square,) = program.dot((way, way))
        exact = TargetRule(UNSEEN * self.norm * float(np.sqrt(square)))
        on_face = replace(on_face, d=-point.g, recycled=None)
        pcpg(on_face, point, exact, Steps(), PURIFYING, directions=own)
        way, Fw = way - point.lam.array_r, -np.array(point.g.array_r)
        for held in (own, point, on_face.d):
            held.destroy()
        return way, Fw

    def _onto_boundary(self, z: Multipliers) -> tuple[Multipliers, bool]:
        """Retract z to Gz = e with slipping points on their boundaries; one multiplication by F.

        Returns:
            The point, and whether there is one near by.
        """
        assert self._face is not None
        within = WithinFace(self._qp.feasible, self._face, slipping=True)
        lam, held = self._program.projected(z, within)
        return self._program.moved(z, lam), held

    def _pcpg(self, z: Multipliers, optimality: float, resume: bool) -> tuple[Multipliers, bool]:
        """Run PCPG on the face entered; return its end, and whether rounding has ended it."""
        if self._preconditioner is None and self._qp.preconditioner_on is not None:
            assert self._face is not None
            self._preconditioner = self._qp.preconditioner_on(self._face)
        on_face, own = replace(self._on_face, preconditioner=self._preconditioner), self._directions
        own.fresh = own.fresh or not resume or self._curved
        self._point.lam.array[:], self._point.g.array[:] = z.lam, z.g
        z_residual = self._program.vec(z.g)
        on_face.coarse.project(z_residual)
        share = self._parameters.stage if resume else self._parameters.reduction
        target = share * min(float(z_residual.norm()), optimality)
        rule = TargetRule(max(target, self._parameters.final * self._rule.aim))
        norm = own.norm
        reason = pcpg(on_face, self._point, rule, self._steps, self._max_it, self._monitor, own)
        (square,) = self._program.dot((own.r.array_r, own.r.array_r))
        self.left = float(np.sqrt(square))
        lam, g = np.array(self._point.lam.array_r), np.array(self._point.g.array_r)
        if isinstance(on_face.F, CurvedHessian):
            g -= on_face.F.bend(lam - z.lam)
            own.norm = norm  # small circles bend far more than F does
        return Multipliers(lam, g), reason != ConvergedReason.CONVERGED_RTOL and not self._ended

    def _leave(self) -> None:
        """Free projectors and preconditioner of the face."""
        if self._face is not None:
            self._on_face.coarse.destroy()
        if self._preconditioner is not None:
            self._preconditioner.destroy()
        self._face, self._preconditioner = None, None

    def destroy(self) -> None:
        """Free what it holds. Collective."""
        self._leave()
        self._directions.destroy()
        self._point.destroy()
