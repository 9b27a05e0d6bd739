"""Block Newton: faces of Ω one after the other, each by PCPG, with a cost that falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.qp.coarse import HELD, imbalance
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.krylov import SHORT
from tfeti_dolfinx.qp.newton_faces import (
    PARTS,
    FaceSolver,
    Trial,
    brought_back,
    gradient_on,
    has_friction_rows,
    is_curved,
    part_of_way,
    projected_part,
    slipping_start,
    slipping_work,
)
from tfeti_dolfinx.qp.parameters import NewtonParameters
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
from tfeti_dolfinx.qp.projection import UNBALANCED, project_onto_feasible, project_or_least
from tfeti_dolfinx.qp.sets import Face

# --- The iterate: optimality and choice of the face -------------------------------------------

# of Fλ − d: where Gᵀμ is nearly all of it, as where gaps are large, it is taken out of d
MOST = 0.1
# times Fλ − d: multipliers that are larger are rounding, for Gᵀμ is to be as large as that
WILD = 1e3
# so many steps in a row that neither lower q by what stands out from its rounding, nor halve
# ‖g^P‖; so many that do not halve it, whatever q does
PATIENCE, LONG, ROUNDING = 10, 100, 1e-15
# of ‖F‖‖λ‖: what rounding of λ − ᾱs leaves of ‖g^P‖; times that: where each step down is one
LOST, FAR = 2e-15, 1e3


class NewtonIterate:
    """Feasible iterate with its optimality residuals.

    Args:
        qp: The program.
        homogenised: Holds the start.
        mu: Multipliers of Gλ = e there, where they are known.

    Attributes:
        qp: The same program, but for a d' = d + Gᵀμ', which adds a constant to q.
        point: λ and Fλ − d'.
        s: Multipliers of Ω: Fλ − d' − Gᵀμ; 0 where λ is free, if it is optimal.
        mu: Multipliers μ of Gλ = e in the program with d'.
        back: The nearest feasible point to λ − ᾱ(Fλ − d).
        residual: ‖g^P‖, g^P = (λ − back)/ᾱ.
        norm: Estimate of ‖F‖; ᾱ is its inverse.
        rounding: What rounding may make of ‖g^P‖ alone.
        idle: So many looks in a row have found neither q nor ‖g^P‖ lower.
        slow: So many have not found ‖g^P‖ halved.
    """

    def __init__(self, qp: QP, homogenised: Homogenised, mu: Array | None = None) -> None:
        self._given, self._homogenised = qp, homogenised
        self.qp = replace(qp, d=qp.d.copy())
        self.comm = qp.d.getComm().tompi4py()
        self.point = Point(homogenised.lam_bar.copy(), homogenised.gradient.copy())
        self.s = qp.d.duplicate()
        self.back: PETSc.Vec | None = None
        self.mu: Array = np.zeros(qp.coarse.dimension) if mu is None else mu
        self._taken: Array = np.zeros(qp.coarse.dimension)
        self._set_multipliers()
        self.residual, self._best, self.norm, self.rounding = np.inf, np.inf, 1.0, 0.0
        self.idle = self.slow = 0

    def face(self) -> Face:
        """Return the face of λ."""
        return self.qp.feasible.face(self.point.lam.array_r, self.s.array_r)

    def pressed_face(self) -> Face:
        """The face of ``back``: a row that carries less than it is open by, λ_i < ᾱs_i, is open.

        Where forces are rounding of 0 they do not say which rows touch.
        """
        if self.back is None:
            return self.face()
        return self.qp.feasible.face(self.back.array_r, self.s.array_r)

    def multipliers_on(self, faces: FaceSolver) -> None:
        """μ and s that belong to the face entered.

        A face that lacks rank says nothing of motions that it leaves free, but its factor may.
        """
        last, self.mu = self.mu, faces.coarse.coordinates(self.point.g)
        self._set_multipliers()
        self.mu = self.mu + faces.coarse.coordinates(self.s)  # rounding of Fλ − d, not of s
        self._set_multipliers()
        if bcast_from_root(self.comm, self.s.norm() > WILD * self.point.g.norm()):
            self.mu = last
            self._set_multipliers()

    def look(self, faces: FaceSolver) -> None:
        """Optimality: how far a gradient step, brought back to the feasible set, moves."""
        self._set_multipliers()
        if faces.norm == 0.0:
            self._learn_norm(faces)
        self.norm = faces.norm or 1.0
        if faces.settled:
            self.multipliers_on(faces)
        target = self.point.lam.copy()
        target.axpy(-1.0 / self.norm, self.s)  # not Fλ − d: what Gᵀμ takes from it may be large
        found = project_onto_feasible(self.qp.coarse, self.qp.feasible, target)
        self.mu = self.mu + self.norm * found.alpha
        self._set_multipliers()
        self._take_out()
        if self.back is not None:
            self.back.destroy()
        self.back = found.lam
        self.point.lam.copy(target)
        target.axpy(-1.0, self.back)
        self.residual = self.norm * target.norm()
        target.destroy()
        self.rounding = bcast_from_root(self.comm, LOST * self.norm * self.point.lam.norm())
        self.idle, self.slow = self.idle + 1, self.slow + 1
        if self.residual <= 0.5 * self._best:
            self._best, self.idle, self.slow = self.residual, 0, 0

    def _learn_norm(self, faces: FaceSolver) -> None:
        """Rayleigh quotients at λ, which alone may be far below ‖F‖, and at Ps."""
        lam, way, image = self.point.lam, self.s.copy(), self.s.duplicate()
        faces.saw(lam.dot(self.point.g) + lam.dot(self.qp.d), lam.dot(lam))
        self.qp.coarse.project(way)
        if bcast_from_root(self.comm, way.norm() > SHORT * self.s.norm()):
            self.qp.F.mult(way, image)
            faces.saw(way.dot(image), way.dot(way))
        way.destroy()
        image.destroy()

    def _set_multipliers(self) -> None:
        self.qp.coarse.combine(self.mu, self.s)
        self.s.aypx(-1.0, self.point.g)

    def _take_out(self) -> None:
        """Put Gᵀμ into d', where it is most of Fλ − d'. q changes by a constant."""
        if bcast_from_root(self.comm, self.s.norm() > MOST * self.point.g.norm()):
            return
        self._taken, self.mu = self._taken + self.mu, np.zeros_like(self.mu)
        self.qp.coarse.combine(self._taken, self.qp.d)
        self.qp.d.axpy(1.0, self._given.d)
        self.s.copy(self.point.g)

    def wanted_face(self, gamma: float, faces: FaceSolver) -> Face:
        """Choose the next face: the free set, released by the chopped gradient if that dominates.

        The rest is what PCPG has left on the face, if it has stopped at λ.
        """
        lam, s, feasible = self.point.lam.array_r, self.s.array_r, self.qp.feasible
        phi, beta = feasible.split(lam, s)
        phi = feasible.reduced(lam, phi, 1.0 / self.norm)  # what soon stops at a bound is little
        within = self.face().restricted(beta)  # along a boundary that is curved
        beta = beta - within
        sums = np.array([phi @ phi + within @ within, beta @ beta])
        free, chopped = self.comm.allreduce(sums, op=MPI.SUM)
        if faces.settled:
            free = faces.left**2
        if bcast_from_root(self.comm, chopped > gamma**2 * free):
            moved = feasible.project(lam - beta / self.norm)
            return feasible.face(0.5 * (lam + moved), s)
        return self.face()

    def begun(self, face: Face) -> tuple[Point, Face]:
        """Return start and face of a solve: λ, or ``back`` where more points slip there."""
        back = self.point.lam if self.back is None else self.back
        return slipping_start(self.qp, self.point, face, back, self.pressed_face())

    @property
    def stalled(self) -> bool:
        """True if neither q nor ‖g^P‖ has decreased for long."""
        return bcast_from_root(self.comm, self.idle >= PATIENCE or self.slow >= LONG)

    def take(self, to: Point, gain: float) -> None:
        """Move to a point where q is lower by ``gain``."""
        self.went_down(gain)
        self.point.take(to)

    def went_down(self, gain: float) -> None:
        """Reset the count of idle steps if q falls by more than its rounding."""
        sizes = abs(self.point.lam.dot(self.point.g)) + abs(self.point.lam.dot(self.qp.d))
        if gain > (0.0 if self.residual > FAR * self.rounding else ROUNDING * sizes):
            self.idle = 0

    def gain(self, to: Point) -> float:
        """Return q(λ) − q(to), without terms that Gλ = e makes constant. Collective."""
        apart, gradient = to.lam.copy(), to.g.copy()
        apart.axpy(-1.0, self.point.lam)
        gradient.axpy(-1.0, self.point.g)
        gradient.axpy(2.0, self.s)
        value = -0.5 * float(apart.dot(gradient))
        apart.destroy()
        gradient.destroy()
        return value

    def result(self, reason: ConvergedReason, steps: Steps) -> QPResult:
        """Return the result; takes λ and s over."""
        moved = self.point.lam.copy()
        moved.axpy(-1.0, self._homogenised.lam_bar)
        equality = self.qp.coarse.norm_Q(moved)
        moved.destroy()
        return QPResult(
            lam=self.point.lam.copy(),
            mu=self._taken + self.mu,
            gradient=self.s.copy(),
            face=self.pressed_face(),
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
        for vec in (self.s, self.qp.d, self.back):
            if vec is not None:
                vec.destroy()


# --- Globalisation: acceptance of steps -------------------------------------------------------

# of what the gradient step promises at least, (ᾱ/2)‖g^P‖²: a step must lower q by that share
ENOUGH = 0.1
# of a way along a face that is curved, where q is not low enough at its end
SHORTER = 0.5
# of the way to the first bound: what ends there is put on it, and not left inside by rounding
PAST = 1.0 + 1e-14
# solves on a face that stays, after the one at whose end q was not low enough
LONGER = 2
# solves on smaller and smaller faces that are few enough to let rows go one by one in the next step
FEW_ROUNDS = 10


def _enough(state: NewtonIterate) -> float:
    """Return the sufficient decrease of q that a step must reach."""
    known = np.isfinite(state.residual)
    return ENOUGH * 0.5 / state.norm * state.residual**2 if known else 0.0


def longer(state: NewtonIterate, trial: Trial, faces: FaceSolver) -> Trial:
    """Continue the solve if the face changed under way, now stays, but q is not low enough.

    What restores Gλ = e after rows are dropped raises q; some more steps of conjugate gradients
    lower it again. Collective.

    Args:
        state: The iterate.
        trial: What solves on faces have come to; taken over.
        faces: The solver.

    Returns:
        The trial, maybe with another end.
    """
    for _ in range(LONGER):
        changed = trial.feasible and trial.rounds > 1 and not faces.dependent.contradicts
        if not (changed and bcast_from_root(state.comm, state.gain(trial.last) < _enough(state))):
            break
        face = _face_at(state, trial.last, faces)
        if not faces.stays_on(face):
            break
        faces.settle()
        more = faces.solve(trial.last, face, faces.left)
        more.first.destroy()
        trial.last.destroy()
        trial = replace(trial, last=more.last, feasible=more.feasible)
    return trial


def _face_at(state: NewtonIterate, at: Point, faces: FaceSolver) -> Face:
    """Return the face of a point, with multipliers of the face entered."""
    s = gradient_on(state.qp, faces.coarse, at.g)
    face = state.qp.feasible.face(at.lam.array_r, s.array_r)
    s.destroy()
    return face


def accept(state: NewtonIterate, trial: Trial, faces: FaceSolver) -> bool:
    """Go where q falls enough: trial, the feasible part of its first step, or downhill. Collective.

    Args:
        state: The iterate; moved.
        trial: What solves on faces have come to.
        faces: The solver; it is told whether it may go on from there, and whether to let rows go
            as boldly next time.

    Returns:
        Whether q could be lowered.
    """
    known, enough = np.isfinite(state.residual), _enough(state)
    gain = state.gain(trial.last)
    hidden = ROUNDING * slipping_work(state.point.lam, state.s, trial.face)
    # what is left is not on the face, but maybe Gλ ≠ e
    stays = gain <= 0.0 and state.idle > (0 if gain == 0.0 else 1)
    taken = trial.feasible and bcast_from_root(state.comm, gain >= enough - hidden and not stays)
    raised = not taken and trial.rounds > 1
    faces.cautious = raised or (faces.cautious and trial.rounds <= FEW_ROUNDS)
    if taken:
        state.take(trial.last, gain)
        faces.settle()
        return True
    faces.forget()
    if bcast_from_root(state.comm, gain == 0.0):  # nothing has moved
        return _descend(state, known, faces)
    length = trial.feasible_part(state.qp.feasible, state.point)
    curved = is_curved(state.qp, trial.face)
    shares = [length] if not curved or trial.rounds > 1 else []
    shares += [SHORTER * length, SHORTER**2 * length] if curved else []
    for share in PARTS if curved else ():
        if _went_to(state, projected_part(state.qp, state.point, trial.first, share), enough):
            return True
    taken = any(_shortened(state, trial, share, curved, enough) for share in shares)
    return taken or _descend(state, known, faces)


def _shortened(
    state: NewtonIterate, trial: Trial, length: float, curved: bool, enough: float
) -> bool:
    """Take the feasible part of the first solve's step if q falls enough there."""
    shorter, held = part_of_way(state.point, trial.first, PAST * length), length > 0.0
    if curved:
        held = brought_back(state.qp, trial.face, shorter) and held
    else:
        shorter.lam.array[:] = state.qp.feasible.project(shorter.lam.array_r)
    return _went_to(state, shorter, enough, held)


def _went_to(state: NewtonIterate, to: Point, enough: float, may: bool = True) -> bool:
    """Accept a point if q falls enough; it is taken over."""
    gain = state.gain(to)
    taken = bcast_from_root(state.comm, may and gain >= enough)
    if taken:
        state.take(to, gain)
    to.destroy()
    return taken


def _descend(state: NewtonIterate, known: bool, faces: FaceSolver) -> bool:
    """Take the projected gradient step, or the part of it where q is least."""
    if not known:
        state.look(faces)
    assert state.back is not None
    p, Fp = state.back.copy(), state.s.duplicate()
    p.axpy(-1.0, state.point.lam)
    state.qp.F.mult(p, Fp)
    slope, curvature, size = -state.s.dot(p), p.dot(Fp), p.dot(p)
    if size > SHORT**2 * state.point.lam.dot(state.point.lam):
        faces.saw(curvature, size)
    length = min(1.0, slope / curvature) if curvature > 0.0 else 1.0
    moved = bcast_from_root(state.comm, size > 0.0 and slope > 0.0)
    if moved:
        state.went_down(length * slope)
        state.point.move(length, p, Fp)
        state.point.lam.array[:] = state.qp.feasible.project(state.point.lam.array_r)
    p.destroy()
    Fp.destroy()
    return moved


# --- Block Newton -----------------------------------------------------------------------------


def first_point(qp: QP) -> PETSc.Vec:
    """Step 0: the least λ with open contact if that balances the load, else the least of Ω.

    With friction the latter: what is open would slip far first. Where e = 0 it is 0. Collective;
    multiplies by nothing.
    """
    zero = qp.d.duplicate()
    zero.set(0.0)
    zero.array[:] = qp.feasible.project(zero.array_r)
    if not np.any(qp.coarse.e) and zero.norm() == 0.0:
        return zero
    face = qp.feasible.face(zero.array_r, zero.array_r)
    lam = None if has_friction_rows(qp, face) else _open(qp, face)
    if lam is None:
        lam = project_onto_feasible(qp.coarse, qp.feasible, zero).lam
    zero.destroy()
    return lam


def _open(qp: QP, face: Face) -> PETSc.Vec | None:
    """Return the least λ on a face, or None if it does not balance the load."""
    coarse, lam = qp.coarse.on_face(face), qp.d.duplicate()
    coarse.particular(lam)
    held = imbalance(coarse, lam) <= HELD
    coarse.destroy()
    if not held:
        lam.destroy()
    return lam if held else None


def feasible_start(qp: QP, start: Start) -> PETSc.Vec:
    """Step 0: the nearest feasible point to earlier multipliers, or to 0. Collective."""
    return project_or_least(qp.coarse, qp.feasible, start.lam).lam


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
    those of docs/theory.md.

    ===========================  =================================================================
    reason                       when
    ===========================  =================================================================
    the rule's                   ‖g^P‖ ≤ ``rule.tolerance``, and the rule is content
    ``DIVERGED_STALLED``         friction does not suffice for Gλ = e, as the start shows
    ``DIVERGED_ITS``             ``max_it`` faces or conjugate gradient steps are not enough
    ``DIVERGED_ROUNDING``        no step lowers q any more by what stands out from rounding, or
                                 PCPG ends so twice in a row
    ``DIVERGED_CONTRADICTION``   rows that depend on each other exclude each other: q has no end
    ===========================  =================================================================

    >>> import numpy as np
    >>> from tfeti_dolfinx.qp.coarse import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> from tfeti_dolfinx.qp.homogenised import homogenise, operator_product
    >>> from tfeti_dolfinx.qp.problem import ResidualRule
    >>> F = PETSc.Mat().createDense((3, 3), array=np.diag([1.0, 2.0, 4.0]), comm=PETSc.COMM_SELF)
    >>> d = PETSc.Vec().createWithArray(np.array([1.0, -1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds())
    >>> start = homogenise(qp, operator_product(F, first_point(qp)))
    >>> result = newton(qp, start, ResidualRule(1e-10))
    >>> result.reason.name, result.lam.array.round(6).tolist()
    ('CONVERGED_RTOL', [0.6, 0.0, 0.4])

    Args:
        qp: The program; ``preconditioner_on`` makes preconditioners of faces.
        homogenised: Its homogenised form, whose λ̄ is feasible: the start.
        rule: Says when ‖g^P‖ is small enough.
        parameters: Γ and what inner solves reduce.
        max_it: Most conjugate gradient steps, and most faces.
        start: Where it begins, if that may be optimal: this is looked at first, with its μ.
        monitor: Called after each step.

    Returns:
        The multipliers, their gradient s, the reason and the residuals.
    """
    steps = Steps()
    state = NewtonIterate(qp, homogenised, start.mu if start else None)
    faces = FaceSolver(state.qp, rule, parameters, steps, max_it, monitor)
    reason, looked = ConvergedReason.ITERATING, bool(start) or has_friction_rows(qp, state.face())
    monitor(steps, "start", state.point.lam, homogenised.b.norm(), 0.0)
    if has_friction_rows(qp, state.face()) and imbalance(qp.coarse, state.point.lam) > UNBALANCED:
        # no point of Ω balances the load; without friction that is known before
        reason = ConvergedReason.DIVERGED_STALLED
        state.look(faces)
    elif start is None:
        faces.enter(state.face())
        state.multipliers_on(faces)
    while reason == ConvergedReason.ITERATING:
        if looked:
            # Step 1: optimality
            state.look(faces)
            monitor(steps, "outer", state.point.lam, state.residual, 0.0)
            if state.residual <= max(rule.tolerance, state.rounding):
                rule.norm = state.norm
                face = state.pressed_face()
                reason = rule.examine(state.point.lam, state.s, face, state.residual)
            if rule.drifted:
                state.point.refresh(state.qp)
                faces.forget()
                rule.drifted = False
                continue
        if reason == ConvergedReason.ITERATING and max(steps.outer, steps.cg) >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
        if reason != ConvergedReason.ITERATING:
            break
        # Step 2: the face
        face = state.wanted_face(parameters.gamma, faces) if looked else state.face()
        # Step 3: solve on the face, drop what leaves Ω, restore Gλ = e
        first, begun = state.begun(face)
        if begun is not face:
            faces.forget()  # PCPG may have stopped on that face, but elsewhere
        trial = faces.solve(first, begun, state.residual)
        first.destroy()
        trial = longer(state, trial, faces)
        # Step 4: accept where q falls enough
        if faces.dependent.contradicts:
            reason = ConvergedReason.DIVERGED_CONTRADICTION
        elif not accept(state, trial, faces) or state.stalled or faces.rounded > 1:
            reason = ConvergedReason.DIVERGED_ROUNDING
        trial.destroy()
        steps.outer, looked = steps.outer + 1, True
    result = state.result(reason, steps)
    result.excluding = faces.dependent.excluding
    faces.destroy()
    state.destroy()
    return result
