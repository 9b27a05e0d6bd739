"""Solves on faces of the feasible set by PCPG: step 3 of block Newton."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import any_rank, largest, least, norm_over
from tfeti_dolfinx.common.validation import ABOVE_0, Range, described
from tfeti_dolfinx.qp.coarse import HELD, imbalance
from tfeti_dolfinx.qp.krylov import Directions, pcpg
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    FaceOperator,
    Monitor,
    Point,
    Steps,
    StoppingRule,
)
from tfeti_dolfinx.qp.projection import WithinFace, project_onto_feasible
from tfeti_dolfinx.qp.sets import Face, without_slip

# --- Solves on faces --------------------------------------------------------------------------


@dataclass(frozen=True)
class NewtonParameters:
    """Parameters of block Newton; options say themselves what they are.

    Attributes:
        enough: Share of (ᾱ/2)‖g^P‖², which the gradient step promises, that a step lowers q by.
        final: Of the rule's tolerance: what no solve goes below, as ‖g^P‖ is not quite ‖P_f g‖.
        stage: What a solve on a face that stays reduces its residual to, before step 1 looks at it.
        patience: Steps in a row that neither halve ‖g^P‖ nor lower q beyond its rounding.
        unfelt: Of the gradient: multipliers of Gλ = e that make it longer than that are rounding of
            motions that a face does not see.
        lost: Of ‖F‖‖λ‖: what rounding of λ − ᾱs leaves of ‖g^P‖.
        rounding: Of the largest entry of a way: less is none.
        hidden: Of the terms of q: what its differences may be wrong by.
        short: Of a gradient: a projection that is shorter may be rounding.
        beyond: Of the way to the first bound, where no curvature ends it: more rows than one are
            to leave.
        apart: Of ‖d‖: rows that want gaps so far apart exclude each other, less may be rounding.
        takes_part: Of the largest force of such a direction: rows with less have no part in it.
        far: How far such a direction is followed, to end in Ω's cone of recession.
        unseen: Of ‖F‖‖w‖: what may be left of Fw where F is not to see a direction w.
        purifying: Most steps of PCPG to that.
    """

    gamma: float = described(
        1.0,
        "newton",
        "Γ of the proportioning test between two faces",
        name="newton_gamma",
        symbol="Γ",
        fits=ABOVE_0,
    )
    reduction: float = described(
        0.5,
        "newton",
        "what a solve on a face that may change reduces its residual to, in (0, 1)",
        name="newton_reduction",
        fits=Range("between 0 and 1", lambda value: 0.0 < value < 1.0),
    )
    enough: float = 0.1
    final: float = 0.9
    stage: float = 0.1
    patience: int = 10
    unfelt: float = 1e6
    lost: float = 2e-15
    rounding: float = 1e-10
    hidden: float = 1e-15
    short: float = 1e-6
    beyond: float = 10.0
    apart: float = 1e-8
    takes_part: float = 1e-3
    far: float = 1e30
    unseen: float = 1e-14
    purifying: int = 200


class FaceSolver:
    """PCPG on faces; keeps projectors, preconditioner and directions while the face stays.

    Attributes:
        directions: Those of PCPG, with an estimate of ‖F‖.
        left: ‖P_f(Fλ − d)‖ where PCPG has stopped.
        excluding: Local rows that exclude each other, if a solve has found that; else None.
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
        self.directions = Directions(qp)
        self.directions.norm = qp.seen
        self._face: Face | None = None
        self._on_face, self._curved = qp, False
        self._preconditioner: FaceOperator | None = None
        self.excluding: Array | None = None
        self.left = np.inf

    def multipliers(self, g: Array) -> Array:
        """Return the μ of the face entered: (G_fG_fᵀ)⁺G_fZᵀg, replicated. Collective."""
        return self._on_face.coarse.coordinates(g)

    def solve(
        self, start: Point, face: Face, optimality: float, resume: bool
    ) -> tuple[Point, bool]:
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
            if not out or self._steps.cg >= self._max_it:
                break
            if (restored := self._restored(end)) is None:
                break
            z = restored
        # Step 3c: slipping rows, which followed their tangents, come back onto their boundary
        if self._curved and not out:
            assert self._face is not None
            boundary = WithinFace(self._qp.feasible, self._face, slipping=True)
            found = project_onto_feasible(self._qp.coarse, boundary, end.lam)
            end, out = self._qp.moved(end, found.lam), found.missing > HELD
        return end, not out

    def _enter(self, face: Face) -> bool:
        """Make projectors and preconditioner of a face; return whether it is the last one.

        A curved face is made anew, with its new tangents. Along it the Hessian of q is, to second
        order, F + Z diag(κ) Zᵀ.
        """
        qp, before = self._qp, self._face
        same = before is not None and not _any(qp, face.status != before.status)
        if same and not self._curved:
            return True
        self._preconditioner = None
        self._steps.faces += not same
        self._face, self._curved = face, any_rank(qp.comm, face.curved)
        self._on_face = replace(qp, coarse=qp.coarse.on_face(face), held=face.held)
        if self._curved:

            def bent(x: Array) -> Array:
                return qp.F(x) + face.bend(x)

            self._on_face = replace(self._on_face, F=bent, recycled=None)
        return same

    def _restored(self, end: Point) -> Point | None:
        """Enter the face of P_Ω(λ), and return its point next to that with Gλ = e.

        Where that face holds a body no longer, the nearest feasible point within the face before
        names rows that do, so that faces shrink and steps end. None if there is none.
        """
        qp, before = self._qp, self._face
        assert before is not None
        on = qp.feasible.project(end.lam)
        s = end.g - qp.coarse.combined(self.multipliers(end.g))
        self._enter(qp.feasible.face(on, s))
        coarse = self._on_face.coarse
        lam = on + coarse.combined(coarse.solve(qp.coarse.residual(on)))
        if imbalance(qp.coarse, lam) > HELD:
            within = WithinFace(qp.feasible, before, slipping=True)
            found = project_onto_feasible(qp.coarse, within, on)
            if found.missing > HELD:
                return None
            lam, on = found.lam, 0.5 * (on + found.lam)
            self._enter(qp.feasible.face(on, s))
        return qp.at(lam)

    def _has_left(self, z: Point) -> bool:
        """Return whether rows that do not slip are outside of Ω."""
        assert self._face is not None
        apart = self._qp.feasible.project(z.lam) - z.lam
        return _any(self._qp, without_slip(self._face, apart) != 0.0)

    def _to_a_bound(self, lam: Array, way: Array) -> float:
        """Return the largest t with λ + t·way ∈ Ω, maybe infinite; rounding ends no way."""
        assert self._face is not None
        qp, held = self._qp, without_slip(self._face, way)
        small = self._parameters.rounding * largest(qp.comm, way)
        own = qp.feasible.max_step(lam, -np.where(np.abs(held) > small, held, 0.0))
        return least(qp.comm, max(own, 0.0))

    def _along_null_space(self, z: Point) -> Point:
        """Go beyond a bound along a direction without curvature, where PCPG has found one.

        Where no bound ends the way, neither F nor G sees it and q falls along it, rows that depend
        on each other want gaps that exclude each other: ``excluding`` says so.
        """
        own, qp, given = self.directions, self._qp, self._parameters
        for way in (own.p, own.r):
            size, Fw = largest(qp.comm, way), qp.F(way)
            curvature, square = qp.dot((way, Fw), (way, way))
            if size == 0.0 or own.seen(curvature, square):
                continue
            way, Fw = self._unseen(way, Fw)
            length = self._to_a_bound(z.lam, way)
            if np.isfinite(length):
                step = given.beyond * length
                return Point(z.lam + step * way, z.g + step * Fw)
            # Farkas: p in the cone of recession of Ω with Fp = 0, Gp = 0 and dᵀp > 0
            p = qp.feasible.project(given.far / size * way) * (size / given.far)
            Qp, d, Fp = p - qp.coarse.project(p), qp.d, qp.F(p)
            FF, QQ, pp, pd, dd = qp.dot((Fp, Fp), (Qp, Qp), (p, p), (p, d), (d, d))
            unseen = max(FF / max(own.norm, TINY) ** 2, QQ) <= given.rounding**2 * pp
            if pp > 0.0 and unseen and pd > given.apart * np.sqrt(dd * pp):
                most = largest(qp.comm, p)
                self.excluding = np.flatnonzero(np.abs(p) > given.takes_part * most)
            break
        return z

    def _unseen(self, way: Array, Fw: Array) -> tuple[Array, Array]:
        """Return w − (PFP)⁺Fw by PCPG, with its image: the part of w ≠ 0 that F does not see.

        What PCPG has left of the others in w is small beside it, but its bounds would end the way.
        """
        qp, given = self._qp, self._parameters
        exact = given.unseen * self.directions.norm * float(np.sqrt(qp.dot((way, way))[0]))
        program = replace(
            self._on_face, F=qp.F, preconditioner=self._preconditioner, d=Fw, recycled=None
        )
        point, own = Point(np.zeros(len(way)), -Fw), Directions(replace(qp, keeps=True))
        pcpg(program, point, StoppingRule(exact), Steps(), given.purifying, directions=own)
        return way - point.lam, -point.g

    def _pcpg(self, z: Point, optimality: float, resume: bool) -> tuple[Point, bool]:
        """Run PCPG on the face entered; return its end, and whether rounding has ended it."""
        qp, given, face, own = self._qp, self._parameters, self._face, self.directions
        assert face is not None
        if self._preconditioner is None and qp.preconditioner_on is not None:
            self._preconditioner = qp.preconditioner_on(face)
        on_face = replace(self._on_face, preconditioner=self._preconditioner)
        own.fresh = own.fresh or not resume or self._curved
        share = given.stage if resume else given.reduction
        target = share * min(norm_over(qp.comm, on_face.coarse.project(z.g)), optimality)
        rule = StoppingRule(max(target, given.final * self._rule.aim))
        end, norm = Point(z.lam, z.g), own.norm
        reason = pcpg(on_face, end, rule, self._steps, self._max_it, self._monitor, own)
        self.left = norm_over(qp.comm, own.r)
        if self._curved:
            end.g = end.g - face.bend(end.lam - z.lam)
            own.norm = norm  # small circles bend far more than F does
        ended = self._steps.cg >= self._max_it
        return end, reason != ConvergedReason.CONVERGED_RTOL and not ended


def _any(qp: QP, flags: Array) -> bool:
    """Return whether a flag is set on some rank. Collective."""
    return any_rank(qp.comm, bool(np.any(flags)))
