"""Block Newton: faces of Ω one after the other, each by PCPG, with a cost that falls."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import any_rank, count_over, largest, least, norm_over, steering
from tfeti_dolfinx.common.validation import ABOVE_0, Range, described
from tfeti_dolfinx.qp.coarse import HELD, Coarse, imbalance
from tfeti_dolfinx.qp.krylov import Directions, PcpgParameters, pcpg
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    Monitor,
    Point,
    QPResult,
    Start,
    Steps,
    StoppingRule,
    no_monitor,
)
from tfeti_dolfinx.qp.projection import (
    UNBALANCED,
    ProjectionParameters,
    WithinFace,
    project_onto_feasible,
)
from tfeti_dolfinx.qp.sets import Face, Status, face_at

RUBS = Status.STICK  # least status of rows with friction


@dataclass(frozen=True)
class NewtonParameters:
    """Parameters of block Newton; options say themselves what they are."""

    gamma: float = described(
        1.0,
        "newton",
        "Γ of the proportioning test between two active sets",
        name="newton_gamma",
        symbol="Γ",
        fits=ABOVE_0,
    )
    reduction: float = described(
        0.5,
        "newton",
        "what a solve on an active set that may change reduces its residual to, in (0, 1)",
        name="newton_reduction",
        fits=Range("between 0 and 1", lambda value: 0.0 < value < 1.0),
    )
    # share of (ᾱ/2)‖g^P‖², which the gradient step promises, that a step lowers q by
    enough: float = 0.1
    # of the rule's tolerance: what no solve goes below, as ‖g^P‖ is not quite ‖P_f g‖
    final: float = 0.9
    # what a solve on a face that stays reduces its residual to, before step 1 looks at it
    stage: float = 0.1
    patience: int = 10  # steps in a row that neither halve ‖g^P‖ nor lower q beyond its rounding
    # steps in a row that do not halve it: from then on steps may be taken in part, and rows leave
    # one by one where a solve has ended without balance
    in_part: int = 3
    one_by_one: int = 20  # most rows that leave a face so, before all leave that are outside
    circle: int = 300  # steps in a row that do not halve ‖g^P‖: q falls by what Gλ = e lacks
    lost: float = 2e-15  # of ‖F‖‖λ‖: what rounding of λ − ᾱs leaves of ‖g^P‖
    # of a direction's largest entry: less is none; and of ‖F‖: a curvature that rounding may hide
    rounding: float = 1e-10
    hidden: float = 1e-15  # of the terms of q: what its differences may be wrong by
    short: float = 1e-6  # of a gradient: a projection that is shorter may be rounding
    past: float = 1e-15  # of a step to a bound: so far past it, or rounding leaves a force there
    # of the step to the first bound, where no curvature ends it: more rows than one are to leave
    beyond: float = 10.0
    apart: float = 1e-8  # of ‖d‖: rows that want gaps so far apart exclude each other
    takes_part: float = 1e-3  # of such a direction's largest force: rows with less have no part
    far: float = 1e30  # how far such a direction is followed, to end in Ω's cone of recession
    unseen: float = 1e-14  # of ‖F‖‖w‖: what may be left of Fw where F is not to see a direction w
    purifying: int = 200  # most steps of PCPG to that
    # whether rows leave a face one by one after all together have raised q, or left no balance
    cautious: bool = True
    pcpg: PcpgParameters = PcpgParameters()  # those of solves on faces


# --- Step 0: start ----------------------------------------------------------------------------


def first_point(qp: QP) -> Array:
    """Step 0: the least λ with open contact if that balances the load, else that of a foundation.

    With friction or soft springs the latter: what is open would slip far first, or stretch springs
    as far. Where e = 0 it is 0. Collective; multiplies by nothing.
    """
    zero = qp.feasible.project(np.zeros(len(qp.d)))
    if not np.any(qp.coarse.e) and not any_rank(qp.coarse.comm, zero):
        return zero
    face = qp.feasible.face(zero, zero)
    if not qp.sprung and not any_rank(qp.coarse.comm, face.status >= RUBS):
        coarse = qp.coarse.on_face(face)
        lam = coarse.particular()
        held = imbalance(coarse, lam) <= HELD
        # where 0 is inside of Ω, as with adhesion, rows of contact are free and may leave it
        if held and not any_rank(qp.coarse.comm, qp.feasible.project(lam) != lam):
            return lam
    return _on_foundation(qp)


def _on_foundation(qp: QP, max_it: int = 20, alike: float = 0.1, roughly: float = 1e-3) -> Array:
    """Return forces of rigid bodies on springs that balance the load: which rows touch first.

    It is the feasible point nearest to the forces of springs that gaps press, or the least λ of Ω
    where that does not balance the load. How many rows carry depends on how soft springs are, and
    that on how many carry: found in turns that balance the load up to the share ``roughly``, until
    both numbers differ by no more than the share ``alike``. Collective.
    """
    whole = qp.coarse.solve(qp.coarse.e)
    lam, alpha = project_onto_feasible(qp.coarse, qp.feasible, np.zeros(len(qp.d)), whole)
    if qp.foundation is None or imbalance(qp.coarse, lam) > UNBALANCED:
        return lam

    def carrying() -> int:
        touching = qp.feasible.face(lam, -lam).status == Status.TOUCHING
        return max(count_over(qp.coarse.comm, touching & (lam != 0.0)), 1)

    count, turn = carrying(), ProjectionParameters(balanced=roughly)
    for _ in range(max_it):
        springs, before = qp.foundation(count), count
        lam, alpha = project_onto_feasible(qp.coarse, qp.feasible, springs, alpha, turn)
        count = carrying()
        if abs(count - before) <= alike * before:
            break
    return project_onto_feasible(qp.coarse, qp.feasible, qp.foundation(count), alpha)[0]


def feasible_start(qp: QP, lam: Array) -> Array:
    """Step 0: the nearest feasible point to earlier multipliers, or the first. Collective.

    What was open stays open, if the others can restore Gλ = e: else each would carry a little.
    From forces far beyond small discs, as the bounds of another load step are, the way to Gλ = e
    has so many kinks that the projection may end before. Where a load grows, cλ, whose image is
    known, is in its place if it is feasible and about as near to λ.
    """
    coarse, on = qp.coarse, qp.feasible.project(lam)
    for within in (WithinFace(qp.feasible, qp.feasible.face(on, -on)), qp.feasible):
        found, _ = project_onto_feasible(coarse, within, lam)
        if imbalance(coarse, found) <= UNBALANCED:
            grown = growth(coarse, lam) * lam
            far, shortest = qp.dot((grown - lam, grown - lam), (found - lam, found - lam))
            leaves = any_rank(coarse.comm, qp.feasible.project(grown) != grown)
            leaves |= imbalance(coarse, grown) > HELD
            return found if far > 4.0 * shortest or leaves else grown
    return first_point(qp)


def growth(coarse: Coarse, lam: Array) -> float:
    """Return the c for which cλ balances the load, 1 if there is none. Collective."""
    held = coarse.G(lam)
    (c,) = steering(coarse.comm, float(held @ coarse.e) / max(float(held @ held), TINY))
    return float(c) if c > 0.0 and imbalance(coarse, c * lam) <= HELD else 1.0


def multipliers_at(qp: QP, z: Point) -> Array:
    """Return the μ of least squares at λ, on the rows that hold what they multiply. Collective.

    Open rows and those on the boundary of a disc, which slip, do not.
    """
    face = qp.feasible.face(z.lam, -z.lam)
    holds = (face.status == Status.FREE) | (face.holding & (z.lam != 0.0))
    return qp.coarse.on_face(Face(holds, face.status)).coordinates(z.g)


def seen_norm(qp: QP, z: Point, short: float = NewtonParameters.short) -> float:
    """Return the larger Rayleigh quotient of F at λ, which alone may be far below ‖F‖, and at Pg.

    Multiply once, unless Pg is shorter than the share ``short`` of g. Collective.
    """
    p = qp.coarse.project(z.g)
    energy, size, pp, gg = qp.dot((z.lam, z.g + qp.d), (z.lam, z.lam), (p, p), (z.g, z.g))
    norm = energy / size if size > 0.0 else 0.0
    return max(norm, qp.dot((p, qp.roughly(p)))[0] / pp) if pp > short**2 * gg else norm


# --- State of the iteration -------------------------------------------------------------------


class NewtonIteration:
    """Steps 1, 2 and 4, with the feasible iterate and its residuals; step 3 is the solver's.

    Creation is not collective, all methods are. Vectors are this rank's parts.

    Attributes:
        z: λ and Fλ − d.
        mu: Multipliers μ of Gλ = e, replicated.
        s: Multipliers of Ω, Fλ − d − Gᵀμ: 0 where λ is free, if it is optimal.
        lam_hat: λ̂, the nearest feasible point to λ − ᾱs.
        face_hat: Its face: a row is open whose force is less than ᾱ times its gap, λ_i < ᾱs_i.
            Where forces are rounding of 0 they do not say which rows touch.
        residual: ‖g^P‖, g^P = (λ − λ̂)/ᾱ; infinite before the first look.
        norm: Estimate of ‖F‖; ᾱ is its inverse.
        rounding: What rounding of λ − ᾱs may make of ‖g^P‖ alone.
        halved: The last ‖g^P‖ that was at most half of the ``halved`` before.
        idle: Looks in a row that have found neither q lower nor ‖g^P‖ halved.
        not_halved: Looks in a row that have not found ‖g^P‖ halved.
        solved: The solve on a face whose end λ is; None where λ is another point.
        cautious: Whether rows leave as they block, after q rose, or an end did not balance.
    """

    def __init__(
        self, qp: QP, solver: FaceSolver, parameters: NewtonParameters, z: Point, mu: Array
    ) -> None:
        self.qp, self.solver, self.parameters = qp, solver, parameters
        self.feasible, self.coarse = qp.feasible, qp.coarse
        self.z, self.mu, self.s, self.lam_hat = z, mu, z.g, z.lam
        self.face_hat = qp.feasible.face(z.lam, z.g)
        self.residual, self.halved, self.norm, self.rounding = np.inf, np.inf, 1.0, 0.0
        self.idle, self.not_halved, self.cautious = 0, 0, False
        self.solved: FaceSolution | None = None

    def look(self) -> None:
        """Step 1: how far a gradient step, brought back to the feasible set, moves."""
        qp, Gt, z, directions = self.qp, self.coarse.combined, self.z, self.solver.directions
        directions.norm = directions.norm or seen_norm(qp, z, self.parameters.short)
        self.norm = directions.norm or 1.0
        if self.solved:
            self.mu = self.solver.coarse.coordinates(z.g)
        # not λ − ᾱ(Fλ − d): what Gᵀμ takes from it may be large
        self.s = self.z.g - Gt(self.mu)
        wanted = self.z.lam - self.s / self.norm
        self.lam_hat, alpha = project_onto_feasible(self.coarse, self.feasible, wanted)
        self.mu = self.mu + self.norm * alpha
        self.s = self.z.g - Gt(self.mu)
        self.face_hat = self.feasible.face(self.lam_hat, self.s)
        moved = self.z.lam - self.lam_hat
        square, size = qp.dot((moved, moved), (self.z.lam, self.z.lam))
        self.residual = self.norm * np.sqrt(square)
        self.rounding = self.parameters.lost * self.norm * np.sqrt(size)
        self.idle, self.not_halved = self.idle + 1, self.not_halved + 1
        if self.residual <= 0.5 * self.halved:
            self.halved, self.idle, self.not_halved = self.residual, 0, 0

    def examine(self, rule: StoppingRule) -> ConvergedReason:
        """Apply the stopping rule where ‖g^P‖ is small enough, or hardly falls."""
        stalls = self.not_halved > 0 and self.not_halved % self.parameters.patience == 0
        if self.residual > max(rule.tolerance, self.rounding) and not stalls:
            return ConvergedReason.ITERATING
        reason = rule.examine(self.z.lam, self.s, self.face_hat, self.residual, self.norm)
        if reason == ConvergedReason.ITERATING and self.qp.rough is not None:
            self.z = self.z if rule.gradient is None else Point(self.z.lam, rule.gradient)
        return reason

    def wanted_face(self) -> tuple[Point, Face]:
        """Step 2: start and face of the next solve.

        The face is that of λ, with the rows that want to carry if the chopped gradient β dominates
        the free one. Where points would leave by far, that stick near their circle with a gradient
        outwards, or with friction touch with less force than they are open by, the solve begins at
        λ̂, on its face, for one multiplication by F.
        """
        z = self.z
        face = face_at(self.feasible, z.lam, self.s)
        along = face.restricted(face.beta)  # along a boundary that is curved
        phi, beta = np.where(face.free, self.s, along), face.beta - along
        free, chopped = self.qp.dot((phi, phi), (beta, beta))
        if self.solved:  # what PCPG has left on the face, and not what ᾱ makes of μ
            free = self.solved.left**2
        if chopped > self.parameters.gamma**2 * free:
            moved = self.feasible.project(z.lam - beta / self.norm)
            face = self.feasible.face(0.5 * (z.lam + moved), self.s)
        hat = self.face_hat.status
        early = (face.status == Status.STICK) & (hat == Status.SLIP)
        if any_rank(self.qp.coarse.comm, face.status >= RUBS):
            early |= (face.status == Status.TOUCHING) & (hat == Status.OPEN)
        if not any_rank(self.qp.coarse.comm, early):
            return z, face
        self.solved = None
        return Point(self.lam_hat, z.g + self.qp.roughly(self.lam_hat - z.lam)), self.face_hat

    def accept(self, solved: FaceSolution) -> bool:
        """Step 4: go where q falls enough; return whether q could be lowered.

        That is the end of step 3, the point between where q is least, or the projected
        gradient step or the part of it where q is least.
        """
        z, end, given, looked = self.z, solved.end, self.parameters, np.isfinite(self.residual)
        enough = given.enough * 0.5 / self.norm * self.residual**2 if looked else 0.0
        # on circles s and λ are both large: their product's rounding hides changes of q; what falls
        # is q without terms that Gλ = e makes constant
        step, image, sizes = end.lam - z.lam, end.g - z.g, (np.abs(z.lam), np.abs(self.s))
        product, slope, curvature = self.qp.dot(sizes, (step, -self.s), (step, image))
        hidden = given.hidden * product
        gain, needed = slope - 0.5 * curvature, enough - hidden
        stuck = self.not_halved >= given.in_part
        self.solved = solved if solved.feasible and gain >= needed else None
        rose = 2.0 * gain < -hidden and solved.rounds > 1 and self.idle < 2
        self.cautious = given.cautious and (rose or (stuck and not solved.feasible))
        if self.solved:
            self._go(end, gain)
            return True
        inside = stuck and solved.feasible and 0.0 < slope < curvature
        if inside and 0.5 * slope**2 >= needed * curvature:
            t = slope / curvature  # all of the step is in Ω, which is convex; q is least here
            self._go(Point(z.lam + t * step, z.g + t * image), 0.5 * t * slope)
            return True
        if not looked:
            self.look()
        return self._descend()

    def _descend(self) -> bool:
        """Go along λ̂ − λ; return whether q falls."""
        z = self.z
        p = self.lam_hat - z.lam
        Fp = self.qp.roughly(p)
        slope, curvature, size = self.qp.dot((-self.s, p), (p, Fp), (p, p))
        if size <= 0.0 or slope <= 0.0:
            return False
        self.solver.directions.record_curvature(curvature, size)
        length = min(1.0, slope / curvature) if curvature > 0.0 else 1.0
        lam = self.feasible.project(z.lam + length * p)
        self._go(Point(lam, z.g + length * Fp), 0.5 * length * slope)
        return True

    def _go(self, to: Point, gain: float) -> None:
        """Move to a point where q is lower by ``gain``."""
        work, load = self.qp.dot((self.z.lam, self.z.g), (self.z.lam, self.qp.d))
        given, terms = self.parameters, abs(work) + abs(load)
        if gain > given.hidden * terms and self.not_halved < given.circle:
            self.idle = 0
        self.z = to


# --- Step 3: a solve on a face of the feasible set --------------------------------------------


class FaceSolution(NamedTuple):
    """The end of a solve on a face."""

    end: Point  # where PCPG has ended on the last face
    feasible: bool  # whether that is in Ω and fulfils Gλ = e
    left: float  # ‖P_f(Fλ − d)‖ there
    rounds: int  # runs of PCPG, each on a smaller face
    excluding: Array | None  # local rows that exclude each other, if it has found such


class FaceSolver:
    """PCPG on faces; keeps projectors, preconditioner and directions while the face stays.

    Attributes:
        directions: Those of PCPG, with an estimate of ‖F‖.
        coarse: Gλ = e on the face entered; its ``coordinates`` of a gradient are the μ there.
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
        self.directions = Directions(qp, parameters.pcpg)
        self.directions.norm = qp.norm
        self._face: Face  # that entered
        self._on_face, self.coarse, self._curved = qp, qp.coarse, False

    def solve(
        self, start: Point, face: Face, optimality: float, resume: bool, cautious: bool
    ) -> FaceSolution:
        """Step 3: solve on a face; drop what leaves Ω, restore Gλ = e, solve again. Collective.

        ‖g^P‖ is that at the start, a feasible point of the face; ``resume``: PCPG has stopped
        there, and goes on if the face stays; ``cautious``: rows leave as they block.
        """
        z, stays, rounds, excluding = start, self._enter(face) and resume, 0, None
        while True:
            rounds += 1
            # Step 3a: PCPG on the face; where F does not see a direction, along it past a bound
            end, broken = self._pcpg(z, optimality, stays)
            if broken and not self._has_left(end):
                end, excluding = self._along_null_space(end)
            # Step 3b: rows that have left Ω leave the face, where Gλ = e is restored
            out, stays = self._has_left(end), False
            if not out or excluding is not None or self._steps.cg >= self._max_it:
                break
            if cautious and rounds <= self._parameters.one_by_one:
                z = self._blocked(z, end)
                continue
            if (restored := self._restored(end)) is None:
                break
            z = restored
        # Step 3c: slipping rows, which followed their tangents, come back onto their boundary
        if self._curved and not out:
            boundary = WithinFace(self._qp.feasible, self._face, slipping=True)
            found, _ = project_onto_feasible(self._qp.coarse, boundary, end.lam)
            end = Point(found, end.g + self._qp.roughly(found - end.lam))
            out = imbalance(self._qp.coarse, found) > HELD
        left = norm_over(self._qp.coarse.comm, self.directions.r)
        return FaceSolution(end, not out, left, rounds, excluding)

    def _enter(self, face: Face) -> bool:
        """Make projectors and preconditioner of a face; return whether it is the last one.

        A curved face is made anew; along it the Hessian of q is, to second order, F + Z diag(κ) Zᵀ.
        """
        qp, same = self._qp, False
        if self._steps.faces:
            same = not any_rank(qp.coarse.comm, face.status != self._face.status)
        if same and not self._curved:
            return True
        self._steps.faces += not same
        slips = ~face.held & (face.status == Status.SLIP)
        self._face = face
        self._curved = any_rank(qp.coarse.comm, slips)
        self.coarse = qp.coarse.on_face(face)
        self._on_face = replace(qp, coarse=self.coarse, preconditioner=None)
        if self._curved:
            bent = replace(self._on_face, F=lambda x: qp.roughly(x) + face.bend(x))
            self._on_face = replace(bent, rough=None, recycled=None)
        return same

    def _blocked(self, z: Point, end: Point) -> Point:
        """Go towards the end just past the first bound of rows that do not slip, onto its face."""
        qp, step, slips = self._qp, end.lam - z.lam, self._face.status == Status.SLIP
        bound = qp.feasible.max_step(z.lam, -np.where(slips, 0.0, step))
        length = min(least(qp.coarse.comm, bound), 1.0)
        to = z.lam + (1.0 + self._parameters.past) * length * step
        to = np.where(slips, to, qp.feasible.project(to))
        z = Point(to, z.g + length * (end.g - z.g))
        self._enter(qp.feasible.face(to, z.g - qp.coarse.combined(self.coarse.coordinates(z.g))))
        return z

    def _restored(self, end: Point) -> Point | None:
        """Enter the face of P_Ω(λ), and return its point next to that with Gλ = e; None: none."""
        qp = self._qp
        on = qp.feasible.project(end.lam)
        s = end.g - qp.coarse.combined(self.coarse.coordinates(end.g))
        self._enter(qp.feasible.face(on, s))
        lam = on + self.coarse.combined(self.coarse.solve(qp.coarse.residual(on)))
        return None if imbalance(qp.coarse, lam) > HELD else qp.moved(end, lam)

    def _has_left(self, z: Point) -> bool:
        """Return whether rows that do not slip are outside of Ω."""
        apart = self._qp.feasible.project(z.lam) - z.lam
        return any_rank(self._qp.coarse.comm, (apart != 0.0) & (self._face.status != Status.SLIP))

    def _along_null_space(self, z: Point) -> tuple[Point, Array | None]:
        """Go beyond a bound along a direction without curvature, where PCPG has found one.

        Where no bound ends it, neither F nor G sees it and q falls along it, rows that depend
        on each other want gaps that exclude each other: return these, too, else None.
        """
        own, qp, given = self.directions, self._qp, self._parameters
        for w in (own.p, own.r):
            size, Fw = largest(qp.coarse.comm, w), qp.F(w)
            curvature, square = qp.dot((w, Fw), (w, w))
            if size == 0.0 or curvature > given.rounding * own.norm * square:
                continue
            w, Fw = self._unseen(w, Fw)
            if own.record_curvature(*qp.dot((w, Fw), (w, w))):
                continue
            # to the first bound, maybe infinite; rounding ends none
            small = given.rounding * largest(qp.coarse.comm, w)
            moves = (self._face.status != Status.SLIP) & (np.abs(w) > small)
            bound = qp.feasible.max_step(z.lam, -np.where(moves, w, 0.0))
            length = least(qp.coarse.comm, max(bound, 0.0))
            if np.isfinite(length):
                step = given.beyond * length
                return Point(z.lam + step * w, z.g + step * Fw), None
            # Farkas: p in the cone of recession of Ω with Fp = 0, Gp = 0 and dᵀp > 0
            p = qp.feasible.project(given.far / size * w) * (size / given.far)
            Qp, d, Fp = p - qp.coarse.project(p), qp.d, qp.F(p)
            FF, QQ, pp, pd, dd = qp.dot((Fp, Fp), (Qp, Qp), (p, p), (p, d), (d, d))
            unseen = max(FF / max(own.norm, TINY) ** 2, QQ) <= given.rounding**2 * pp
            if pp > 0.0 and unseen and pd > given.apart * np.sqrt(dd * pp):
                most = largest(qp.coarse.comm, p)
                return z, np.flatnonzero(np.abs(p) > given.takes_part * most)
            break
        return z, None

    def _unseen(self, w: Array, Fw: Array) -> tuple[Array, Array]:
        """Return w − (PFP)⁺Fw by PCPG, with its image: the part of w ≠ 0 that F does not see.

        What PCPG has left of the others in w is small beside it, but its bounds would end it.
        """
        qp, given = self._qp, self._parameters
        exact = given.unseen * self.directions.norm * float(np.sqrt(qp.dot((w, w))[0]))
        program = replace(self._on_face, F=qp.F, rough=None, d=Fw, recycled=None)
        zero, own = Point(np.zeros(len(w)), -Fw), Directions(qp)
        end, _ = pcpg(program, zero, StoppingRule(exact), Steps(), given.purifying, directions=own)
        return w - end.lam, -end.g

    def _pcpg(self, z: Point, optimality: float, resume: bool) -> tuple[Point, bool]:
        """Run PCPG on the face entered; return its end, and whether rounding has ended it."""
        qp, given, face, own = self._qp, self._parameters, self._face, self.directions
        if self._on_face.preconditioner is None and qp.preconditioner_on is not None:
            self._on_face = replace(self._on_face, preconditioner=qp.preconditioner_on(face))
        own.fresh = own.fresh or not resume or self._curved
        share = given.stage if resume else given.reduction
        target = share * min(norm_over(qp.coarse.comm, self.coarse.project(z.g)), optimality)
        lowest = 0.0 if self._rule.waits else given.final * self._rule.tolerance
        rule, norm = StoppingRule(max(target, lowest)), own.norm
        end, reason = pcpg(self._on_face, z, rule, self._steps, self._max_it, self._monitor, own)
        if self._curved:
            end = Point(end.lam, end.g - face.bend(end.lam - z.lam))
            own.norm = norm  # small circles bend far more than F does
        return end, reason != ConvergedReason.CONVERGED_RTOL and self._steps.cg < self._max_it


# --- Block Newton -----------------------------------------------------------------------------


def newton(
    qp: QP,
    start: Start,
    rule: StoppingRule,
    parameters: NewtonParameters = NewtonParameters(),
    *,
    max_it: int = 10_000,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Minimise q(λ) = ½λᵀFλ − λᵀd subject to Gλ = e, λ ∈ Ω. Collective.

    Iterates are feasible, and q falls in each step. A step solves on a face of Ω by PCPG, drops
    what leaves Ω, all at once, and solves again on the smaller face. The numbers of the steps are
    those of docs/theory.md; docs/developers/implementation.md has a diagram. It begins at λ̄, which
    is feasible, with the earlier μ.

    ===========================  =================================================================
    reason                       when
    ===========================  =================================================================
    the rule's                   ‖g^P‖ ≤ ``rule.tolerance``, and the rule is content
    ``DIVERGED_STALLED``         friction does not suffice for Gλ = e, as the start shows
    ``DIVERGED_ITS``             ``max_it`` faces or conjugate gradient steps are not enough
    ``DIVERGED_ROUNDING``        no step lowers q any more by what stands out from rounding
    ``DIVERGED_CONTRADICTION``   rows that depend on each other exclude each other: q has no end
    ===========================  =================================================================

    >>> import numpy as np
    >>> from tfeti_dolfinx.testing import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> from tfeti_dolfinx.qp.problem import StoppingRule, homogenise
    >>> F, d = np.diag([1.0, 2.0, 4.0]).__matmul__, np.array([1.0, -1.0, 2.0])
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds())
    >>> result = newton(qp, homogenise(qp, first_point(qp)), StoppingRule(1e-10))
    >>> result.reason.name, result.lam.round(6).tolist()
    ('CONVERGED_RTOL', [0.6, 0.0, 0.4])
    """
    steps = Steps()
    solver = FaceSolver(qp, rule, parameters, steps, max_it, monitor)
    # Step 0: a feasible start
    z, mu = start.at, np.zeros(qp.coarse.dimension) if start.lam is None else start.mu
    if mu is None:
        mu = multipliers_at(qp, z)
    state = NewtonIteration(qp, solver, parameters, z, mu)
    monitor(steps, "start", z.lam, norm_over(qp.coarse.comm, start.b), 0.0)
    friction = any_rank(qp.coarse.comm, state.face_hat.status >= RUBS)
    reason = ConvergedReason.ITERATING
    if friction and imbalance(qp.coarse, z.lam) > UNBALANCED:
        # no point of Ω balances the load; without friction that is known before
        reason = ConvergedReason.DIVERGED_STALLED
        state.look()
    # without friction and an earlier λ the first solve is on the face of the start, as it shows ‖F‖
    looks, excluding = start.lam is not None or friction, None
    while reason == ConvergedReason.ITERATING:
        first, face = state.z, state.face_hat
        if looks:
            # Step 1: optimality
            state.look()
            monitor(steps, "outer", state.z.lam, state.residual, 0.0)
            reason = state.examine(rule)
            if reason == ConvergedReason.ITERATING and max(steps.outer, steps.cg) >= max_it:
                reason = ConvergedReason.DIVERGED_ITS
            if reason != ConvergedReason.ITERATING:
                break
            # Step 2: the face
            first, face = state.wanted_face()
        # Step 3: solve on the face, drop what leaves Ω, restore Gλ = e
        solved = solver.solve(first, face, state.residual, bool(state.solved), state.cautious)
        # Step 4: accept where q falls enough
        if (excluding := solved.excluding) is not None:
            reason = ConvergedReason.DIVERGED_CONTRADICTION
        elif not state.accept(solved) or state.idle >= parameters.patience:
            reason = ConvergedReason.DIVERGED_ROUNDING
        steps.outer, looks = steps.outer + 1, True
    return QPResult(
        lam=state.z.lam,
        mu=state.mu,
        gradient=state.s,
        face=state.face_hat,
        reason=reason,
        projected_gradient=state.residual,
        equality=qp.coarse.norm_Q(state.z.lam - start.at.lam),
        reference=start.reference,
        norm=solver.directions.norm,
        steps=steps,
        excluding=np.empty(0, np.int64) if excluding is None else excluding,
    )
