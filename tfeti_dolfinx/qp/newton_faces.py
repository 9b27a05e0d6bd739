"""Solves on faces of the feasible set by PCPG: step 3 of block Newton."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import any_rank, largest
from tfeti_dolfinx.qp.coarse import HELD, imbalance
from tfeti_dolfinx.qp.krylov import Directions, pcpg
from tfeti_dolfinx.qp.parameters import NewtonParameters
from tfeti_dolfinx.qp.problem import (
    ConvergedReason,
    DualIterate,
    FaceOperator,
    LocalProgram,
    Monitor,
    Operator,
    Point,
    ResidualRule,
    Steps,
    StoppingRule,
)
from tfeti_dolfinx.qp.projection import WithinFace
from tfeti_dolfinx.qp.sets import Face, without_slip

# --- Solves on faces --------------------------------------------------------------------------


class CurvedHessian:
    """Hessian F + Z diag(κ) Zᵀ of q along a curved face, to second order."""

    def __init__(self, F: Operator, face: Face) -> None:
        self._F, self._face = F, face

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (F + Z diag(κ) Zᵀ)x. Collective."""
        self._F.mult(x, y)
        y.array[:] += self.bend(x.array_r)

    def bend(self, x: Array) -> Array:
        """Z diag(κ) Zᵀx."""
        return self._face.bend(x)


class FaceSolver:
    """PCPG on faces; keeps projectors, preconditioner and directions while the face stays.

    Attributes:
        directions: Those of PCPG, with an estimate of ‖F‖.
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
        self.directions = Directions(self._qp.d, self._qp.keeps)
        self.directions.norm = self._qp.seen
        self._point = Point(self._qp.d.duplicate(), self._qp.d.duplicate())
        self._face: Face | None = None
        self._on_face, self._preconditioner = self._qp, cast(FaceOperator | None, None)
        self.excluding: Array | None = None
        self.left = np.inf

    def multipliers(self, g: Array) -> Array:
        """Return the μ of the face entered: (G_fG_fᵀ)⁺G_fZᵀg, replicated. Collective."""
        return self._on_face.coarse.coordinates(self._program.vec(g))

    def solve(
        self, start: DualIterate, face: Face, optimality: float, resume: bool
    ) -> tuple[DualIterate, bool]:
        """Step 3: solve on a face; drop what leaves Ω, restore Gλ = e, solve again. Collective.

        Args:
            start: A feasible point of the face.
            face: The face.
            optimality: ‖g^P‖ there.
            resume: Whether PCPG has stopped at ``start``: it goes on if the face stays.

        Returns:
            Where PCPG ended on the last face, and whether that is in Ω and fulfils Gλ = e.
        """
        z, stays = start, self._enter(face) and resume
        while True:
            # Step 3a: PCPG on the face; where F does not see a direction, along it past a bound
            end, broken = self._pcpg(z, optimality, stays)
            if broken and not self._has_left(end):
                end = self._along_null_space(end)
            # Step 3b: rows that have left Ω leave the face, where Gλ = e is restored
            out, stays = self._has_left(end), False
            if not out or self._ended:
                break
            z = self._restored(end)
        # Step 3c: slipping rows, which followed their tangents, come back onto their boundary
        if self._curved and not out:
            assert self._face is not None
            boundary = WithinFace(self._qp.feasible, self._face, slipping=True)
            lam, _, missing = self._program.projected(end.lam, boundary)
            end, out = self._program.moved(end, lam), missing > HELD
        return end, not out

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
        curved, coarse = any_rank(self._program.comm, face.curved), self._qp.coarse.on_face(face)
        F = CurvedHessian(self._qp.F, face) if curved else self._qp.F
        past = None if curved else self._qp.recycled
        self._face = face
        self._on_face = replace(self._qp, F=F, coarse=coarse, recycled=past, held=face.held)
        return same

    def _restored(self, end: DualIterate) -> DualIterate:
        """Enter the face of P_Ω(λ), and return its point next to that with Gλ = e.

        Where that face holds a body no longer, the nearest feasible point names rows that do:
        within the face before, so that faces shrink and steps end, or if there is none, in Ω.
        """
        qp, program, before = self._qp, self._program, self._face
        assert before is not None
        on, s = qp.feasible.project(end.lam), end.g - program.normal(self.multipliers(end.g))
        self._enter(qp.feasible.face(on, s))
        coarse = self._on_face.coarse
        coarse.combine(coarse.solve(qp.coarse.residual(program.vec(on))), self._point.lam)
        lam = on + self._point.lam.array_r
        if imbalance(qp.coarse, program.vec(lam)) > HELD:
            lam, _, missing = program.projected(on, WithinFace(qp.feasible, before))
            if missing > HELD:
                lam, *_ = program.projected(on)
            on = 0.5 * (on + lam)
            self._enter(qp.feasible.face(on, s))
        return program.refreshed(lam)

    def _has_left(self, z: DualIterate) -> bool:
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

    def _along_null_space(self, z: DualIterate) -> DualIterate:
        """Go beyond a bound along a direction without curvature, where PCPG has found one.

        Where no bound ends the way, neither F nor G sees it and q falls along it, rows that depend
        on each other want gaps that exclude each other: ``excluding`` says so.
        """
        program, own, qp, given = self._program, self.directions, self._qp, self._parameters
        for vec in (own.p, own.r):
            way = np.array(vec.array_r)
            size, Fw = largest(program.comm, way), program.F(way)
            curvature, square = program.dot((way, Fw), (way, way))
            if size == 0.0 or own.seen(curvature, square):
                continue
            way, Fw = self._unseen(way, Fw)
            length = self._to_a_bound(z.lam, way)
            if np.isfinite(length):
                step = given.beyond * length
                return DualIterate(z.lam + step * way, z.g + step * Fw)
            # Farkas: p in the cone of recession of Ω with Fp = 0, Gp = 0 and dᵀp > 0
            p = qp.feasible.project(given.far / size * way) * (size / given.far)
            Pp = program.vec(p)
            qp.coarse.project(Pp)
            Qp, d, Fp = p - Pp.array_r, qp.d.array_r, program.F(p)
            FF, QQ, pp, pd, dd = program.dot((Fp, Fp), (Qp, Qp), (p, p), (p, d), (d, d))
            unseen = max(FF / max(own.norm, TINY) ** 2, QQ) <= given.rounding**2 * pp
            if pp > 0.0 and unseen and pd > given.apart * np.sqrt(dd * pp):
                most = largest(program.comm, p)
                self.excluding = np.flatnonzero(np.abs(p) > given.takes_part * most)
            break
        return z

    def _unseen(self, way: Array, Fw: Array) -> tuple[Array, Array]:
        """Return w − (PFP)⁺Fw by PCPG, with its image: the part of w ≠ 0 that F does not see.

        What PCPG has left of the others in w is small beside it, but its bounds would end the way.
        """
        own, program, given = Directions(self._qp.d), self._program, self._parameters
        on_face = replace(self._on_face, F=self._qp.F, preconditioner=self._preconditioner)
        point = Point(self._qp.d.duplicate(), self._qp.d.duplicate())
        point.g.array[:] = -Fw
        (square,) = program.dot((way, way))
        exact = ResidualRule(given.unseen * self.directions.norm * float(np.sqrt(square)))
        on_face = replace(on_face, d=-point.g, recycled=None)
        pcpg(on_face, point, exact, Steps(), given.purifying, directions=own)
        way, Fw = way - point.lam.array_r, -np.array(point.g.array_r)
        for held in (own, point, on_face.d):
            held.destroy()
        return way, Fw

    def _pcpg(self, z: DualIterate, optimality: float, resume: bool) -> tuple[DualIterate, bool]:
        """Run PCPG on the face entered; return its end, and whether rounding has ended it."""
        if self._preconditioner is None and self._qp.preconditioner_on is not None:
            assert self._face is not None
            self._preconditioner = self._qp.preconditioner_on(self._face)
        on_face, own = replace(self._on_face, preconditioner=self._preconditioner), self.directions
        own.fresh = own.fresh or not resume or self._curved
        self._point.lam.array[:], self._point.g.array[:] = z.lam, z.g
        z_residual = self._program.vec(z.g)
        on_face.coarse.project(z_residual)
        share = self._parameters.stage if resume else self._parameters.reduction
        target = share * min(float(z_residual.norm()), optimality)
        rule = ResidualRule(max(target, self._parameters.final * self._rule.aim))
        norm = own.norm
        reason = pcpg(on_face, self._point, rule, self._steps, self._max_it, self._monitor, own)
        (square,) = self._program.dot((own.r.array_r, own.r.array_r))
        self.left = float(np.sqrt(square))
        lam, g = np.array(self._point.lam.array_r), np.array(self._point.g.array_r)
        if isinstance(on_face.F, CurvedHessian):
            g -= on_face.F.bend(lam - z.lam)
            own.norm = norm  # small circles bend far more than F does
        return DualIterate(lam, g), reason != ConvergedReason.CONVERGED_RTOL and not self._ended

    def _leave(self) -> None:
        """Forget projectors and preconditioner of the face."""
        self._face, self._preconditioner = None, None

    def destroy(self) -> None:
        """Free what it holds. Collective."""
        self.directions.destroy()
        self._point.destroy()
