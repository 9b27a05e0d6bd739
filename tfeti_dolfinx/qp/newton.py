"""Block Newton: faces of Ω one after the other, each by PCPG, with a cost that falls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, norm_over, summed
from tfeti_dolfinx.qp.coarse import HELD, imbalance
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.newton_faces import FaceSolver, NewtonParameters
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
    FeasiblePoint,
    WithinFace,
    project_onto_feasible,
)
from tfeti_dolfinx.qp.sets import Face, Status, face_of

# --- Step 0: start ----------------------------------------------------------------------------


def first_point(qp: QP) -> Array:
    """Step 0: the least λ with open contact if that balances the load, else that of a foundation.

    With friction the latter: what is open would slip far first. Where e = 0 it is 0. Collective;
    multiplies by nothing.
    """
    zero = qp.feasible.project(np.zeros(len(qp.d)))
    if not np.any(qp.coarse.e) and not any_rank(qp.comm, bool(np.any(zero))):
        return zero
    face = qp.feasible.face(zero, zero)
    if not _has_friction(qp, face):
        coarse = qp.coarse.on_face(face)
        lam = coarse.particular()
        held = imbalance(coarse, lam) <= HELD
        # where 0 is inside of Ω, as with adhesion, rows of contact are free and may leave it
        out = bool(np.any(qp.feasible.project(lam) != lam))
        if held and not any_rank(qp.comm, out):
            return lam
    return _on_foundation(qp, project_onto_feasible(qp.coarse, qp.feasible, zero))


@dataclass(frozen=True)
class FoundationParameters:
    """Parameters of the foundation that a first point balances the load on.

    Attributes:
        max_it: Most projections.
        alike: Share by which the numbers of rows that carry may differ at the end.
    """

    max_it: int = 20
    alike: float = 0.1


FOUNDATION = FoundationParameters()


def _on_foundation(qp: QP, least: FeasiblePoint) -> Array:
    """Return forces of rigid bodies on springs that balance the load: which rows touch first.

    It is the feasible point nearest to the forces of springs that gaps press. How many rows carry
    depends on how soft springs are, and that on how many carry: found by turns. Where the least λ
    of Ω does not balance the load, it is that. Collective.
    """
    if qp.foundation is None or least.missing > UNBALANCED:
        return least.lam
    count, lam = 1, least.lam
    for _ in range(FOUNDATION.max_it):
        lam = project_onto_feasible(qp.coarse, qp.feasible, qp.foundation(count)).lam
        touching = qp.feasible.face(lam, -lam).status == Status.TOUCHING
        before = count
        count = max(int(summed(qp.comm, np.array([np.sum(touching & (lam != 0.0))]))[0]), 1)
        if abs(count - before) <= FOUNDATION.alike * before:
            break
    return lam


def feasible_start(qp: QP, start: Start) -> Array:
    """Step 0: the nearest feasible point to earlier multipliers, or the first. Collective.

    What was open stays open, if the others can restore Gλ = e: else each would carry a little.
    From forces far beyond small discs, as the bounds of another load step are, the way to Gλ = e
    has so many kinks that the projection may end before.
    """
    on = qp.feasible.project(start.lam)
    for within in (WithinFace(qp.feasible, qp.feasible.face(on, -on)), qp.feasible):
        found = project_onto_feasible(qp.coarse, within, start.lam)
        if found.missing <= UNBALANCED:
            return found.lam
    return first_point(qp)


def multipliers_at(qp: QP, z: Point) -> Array:
    """Return the μ of least squares at λ: that of the rows that hold what they multiply there.

    Open rows and those on the boundary of a disc, which slip, do not. Collective.
    """
    face = qp.feasible.face(z.lam, -z.lam)
    holds = (face.status == Status.FREE) | (face.holding & (z.lam != 0.0))
    coarse = qp.coarse.on_face(face_of(holds, face.status))
    return coarse.coordinates(z.g)


def _has_friction(qp: QP, face: Face) -> bool:
    """Return whether a row of some rank sticks or slips. Collective."""
    rubs = np.isin(face.status, (Status.STICK, Status.SLIP))
    return any_rank(qp.comm, bool(np.any(rubs)))


# --- State of the iteration -------------------------------------------------------------------


@dataclass
class NewtonState:
    """Feasible iterate with its optimality residuals; vectors are this rank's parts.

    Attributes:
        z: λ and Fλ − d.
        mu: Multipliers μ of Gλ = e, replicated.
        s: Multipliers of Ω, Fλ − d − Gᵀμ: 0 where λ is free, if it is optimal.
        back: λ̂, the nearest feasible point to λ − ᾱs.
        residual: ‖g^P‖, g^P = (λ − λ̂)/ᾱ.
        norm: Estimate of ‖F‖; ᾱ is its inverse.
        rounding: What rounding may make of ‖g^P‖ alone.
        least: The last ‖g^P‖ that was half of the one before.
        idle: So many looks in a row have found neither q nor ‖g^P‖ lower.
        resume: Whether λ is where PCPG has stopped.
    """

    z: Point
    mu: Array
    s: Array
    back: Array
    residual: float = np.inf
    norm: float = 1.0
    rounding: float = 0.0
    least: float = np.inf
    idle: int = 0
    resume: bool = False


class _Newton:
    """Steps 1, 2 and 4, which read and change the state; the solver does step 3. Collective."""

    def __init__(
        self,
        qp: QP,
        solver: FaceSolver,
        parameters: NewtonParameters,
        state: NewtonState,
    ) -> None:
        self.qp, self.solver, self.parameters, self.state = qp, solver, parameters, state
        self.feasible, self.coarse = qp.feasible, qp.coarse

    def look(self) -> None:
        """Step 1: how far a gradient step, brought back to the feasible set, moves."""
        state, qp, normal = self.state, self.qp, self.coarse.combined
        if self.solver.directions.norm == 0.0:
            self._learn_norm()
        state.norm = self.solver.directions.norm or 1.0
        if state.resume:
            mu = self.solver.multipliers(state.z.g)
            s = state.z.g - normal(mu)
            # of motions that the face does not see μ is rounding over rounding
            left, size = qp.dot((s, s), (state.z.g, state.z.g))
            state.mu = mu if left <= self.parameters.unfelt**2 * size else 0.0 * mu
        # not λ − ᾱ(Fλ − d): what Gᵀμ takes from it may be large
        state.s = state.z.g - normal(state.mu)
        wanted = state.z.lam - state.s / state.norm
        found = project_onto_feasible(self.coarse, self.feasible, wanted)
        state.back, state.mu = found.lam, state.mu + state.norm * found.alpha
        state.s = state.z.g - normal(state.mu)
        moved = state.z.lam - state.back
        square, size = qp.dot((moved, moved), (state.z.lam, state.z.lam))
        state.residual = state.norm * np.sqrt(square)
        state.rounding = self.parameters.lost * state.norm * np.sqrt(size)
        state.idle += 1
        if state.residual <= 0.5 * state.least:
            state.least, state.idle = state.residual, 0

    def examine(self, rule: StoppingRule) -> ConvergedReason:
        """Apply the stopping rule where ‖g^P‖ is small enough."""
        state = self.state
        if state.residual > max(rule.tolerance, state.rounding):
            return ConvergedReason.ITERATING
        rule.norm = state.norm
        return rule.examine(state.z.lam, state.s, self.pressed_face(), state.residual)

    def _learn_norm(self) -> None:
        """Take Rayleigh quotients of F at λ, which alone may be far below ‖F‖, and at Ps."""
        qp, z = self.qp, self.state.z
        p, Fz = self.coarse.project(z.g), z.g + qp.d
        energy, size, pp, gg = qp.dot((z.lam, Fz), (z.lam, z.lam), (p, p), (z.g, z.g))
        self.solver.directions.seen(energy, size)
        if pp > self.parameters.short**2 * gg:
            (curvature,) = qp.dot((p, qp.F(p)))
            self.solver.directions.seen(curvature, pp)

    def pressed_face(self) -> Face:
        """Return the face of λ̂: a row that carries less than it is open by, λ_i < ᾱs_i, is open.

        Where forces are rounding of 0 they do not say which rows touch.
        """
        return self.feasible.face(self.state.back, self.state.s)

    def wanted_face(self) -> tuple[Point, Face]:
        """Step 2: start and face of the next solve.

        The face is that of λ, with the rows that want to carry if the chopped gradient β dominates
        the free one. Near its circle a point that sticks, and whose gradient points outwards, would
        leave by far, in a direction of no use; so would, with friction, one that touches with less
        force than it is open by. Where there are any the solve begins at λ̂, on its face, for one
        multiplication by F.
        """
        state, z = self.state, self.state.z
        phi, beta = self.feasible.split(z.lam, state.s)
        face = self.feasible.face(z.lam, state.s)
        along = face.restricted(beta)  # along a boundary that is curved
        beta = beta - along
        phi = phi + along
        free, chopped = self.qp.dot((phi, phi), (beta, beta))
        if state.resume:  # what PCPG has left on the face, and not what ᾱ makes of μ
            free = self.solver.left**2
        if chopped > self.parameters.gamma**2 * free:
            moved = self.feasible.project(z.lam - beta / state.norm)
            face = self.feasible.face(0.5 * (z.lam + moved), state.s)
        pressed = self.pressed_face()
        early = (face.status == Status.STICK) & (pressed.status == Status.SLIP)
        if _has_friction(self.qp, face):
            early |= (face.status == Status.TOUCHING) & (pressed.status == Status.OPEN)
        if not any_rank(self.qp.comm, bool(np.any(early))):
            return z, face
        state.resume = False
        return self.qp.moved(z, state.back), pressed

    def gain(self, to: Point) -> float:
        """Return q(λ) − q(to), without terms that Gλ = e makes constant."""
        z = self.state.z
        (double,) = self.qp.dot((z.lam - to.lam, to.g - z.g + 2.0 * self.state.s))
        return 0.5 * double

    def accept(self, end: Point, feasible: bool) -> bool:
        """Step 4: go where q falls enough; return whether q could be lowered.

        That is the end of step 3, else the projected gradient step or the part of it where q is
        least.
        """
        state = self.state
        looked = np.isfinite(state.residual)
        enough = self.parameters.enough * 0.5 / state.norm * state.residual**2 if looked else 0.0
        # on circles s and λ are both large: their product's rounding hides changes of q
        (hidden,) = self.qp.dot((np.abs(state.z.lam), np.abs(state.s)))
        gain = self.gain(end)
        taken = feasible and gain >= enough - self.parameters.hidden * hidden
        state.resume = taken
        if taken:
            self._go(end, gain)
        if not taken and not looked:
            self.look()
        return taken or self._descend()

    def _descend(self) -> bool:
        """Go along λ̂ − λ; return whether q falls."""
        state, z = self.state, self.state.z
        p = state.back - z.lam
        Fp = self.qp.F(p)
        slope, curvature, size = self.qp.dot((-state.s, p), (p, Fp), (p, p))
        if size <= 0.0 or slope <= 0.0:
            return False
        self.solver.directions.seen(curvature, size)
        length = min(1.0, slope / curvature) if curvature > 0.0 else 1.0
        lam = self.feasible.project(z.lam + length * p)
        self._go(Point(lam, z.g + length * Fp), 0.5 * length * slope)
        return True

    def _go(self, to: Point, gain: float) -> None:
        """Move to a point where q is lower by ``gain``."""
        z = self.state.z
        work, load = self.qp.dot((z.lam, z.g), (z.lam, self.qp.d))
        if gain > self.parameters.hidden * (abs(work) + abs(load)):
            self.state.idle = 0
        self.state.z = to


# --- Block Newton -----------------------------------------------------------------------------


def newton(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    parameters: NewtonParameters = NewtonParameters(),
    *,
    max_it: int = 10_000,
    start: Start | None = None,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Minimise q(λ) = ½λᵀFλ − λᵀd subject to Gλ = e, λ ∈ Ω. Collective.

    Iterates are feasible, and q falls in each step. A step solves on a face of Ω by PCPG, drops
    what leaves Ω, all at once, and solves again on the smaller face. The numbers of the steps are
    those of docs/theory.md; docs/developers/implementation.md has a diagram. It begins at λ̄, which
    is feasible, with the μ of ``start``.

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
    >>> from tfeti_dolfinx.qp.coarse import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> from tfeti_dolfinx.qp.homogenised import homogenise, operator_product
    >>> from tfeti_dolfinx.qp.problem import StoppingRule
    >>> F, d = np.diag([1.0, 2.0, 4.0]).__matmul__, np.array([1.0, -1.0, 2.0])
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds())
    >>> start = homogenise(qp, operator_product(F, qp.comm, first_point(qp)))
    >>> result = newton(qp, start, StoppingRule(1e-10))
    >>> result.reason.name, result.lam.round(6).tolist()
    ('CONVERGED_RTOL', [0.6, 0.0, 0.4])
    """
    steps = Steps()
    solver = FaceSolver(qp, rule, parameters, steps, max_it, monitor)
    # Step 0: a feasible start
    z = Point(homogenised.lam_bar, homogenised.gradient)
    mu = np.zeros(qp.coarse.dimension) if start is None else start.mu
    if mu is None:
        mu = multipliers_at(qp, z)
    state = NewtonState(z, mu, z.g, z.lam)
    method = _Newton(qp, solver, parameters, state)
    monitor(steps, "start", homogenised.lam_bar, norm_over(qp.comm, homogenised.b), 0.0)
    friction = _has_friction(qp, qp.feasible.face(z.lam, z.g))
    reason = ConvergedReason.ITERATING
    if friction and imbalance(qp.coarse, homogenised.lam_bar) > UNBALANCED:
        # no point of Ω balances the load; without friction that is known before
        reason = ConvergedReason.DIVERGED_STALLED
        method.look()
    # without friction and an earlier λ the first solve is on the face of the start, as it shows ‖F‖
    looks = start is not None or friction
    while reason == ConvergedReason.ITERATING:
        first, face = state.z, qp.feasible.face(state.z.lam, state.s)
        if looks:
            # Step 1: optimality
            method.look()
            monitor(steps, "outer", state.z.lam, state.residual, 0.0)
            reason = method.examine(rule)
            if rule.drifted:
                state.z = qp.at(state.z.lam)
                state.resume = rule.drifted = False
                continue
            if reason == ConvergedReason.ITERATING and max(steps.outer, steps.cg) >= max_it:
                reason = ConvergedReason.DIVERGED_ITS
            if reason != ConvergedReason.ITERATING:
                break
            # Step 2: the face
            first, face = method.wanted_face()
        # Step 3: solve on the face, drop what leaves Ω, restore Gλ = e
        end, feasible = solver.solve(first, face, state.residual, state.resume)
        # Step 4: accept where q falls enough
        if solver.excluding is not None:
            reason = ConvergedReason.DIVERGED_CONTRADICTION
        elif not method.accept(end, feasible) or state.idle >= parameters.patience:
            reason = ConvergedReason.DIVERGED_ROUNDING
        steps.outer, looks = steps.outer + 1, True
    none = np.empty(0, dtype=np.int64)
    return QPResult(
        lam=state.z.lam,
        mu=state.mu,
        gradient=state.s,
        face=method.pressed_face(),
        reason=reason,
        projected_gradient=state.residual,
        equality=qp.coarse.norm_Q(state.z.lam - homogenised.lam_bar),
        reference=homogenised.scale.reference,
        norm=state.norm,
        steps=steps,
        excluding=none if solver.excluding is None else solver.excluding,
    )
