"""Block Newton: faces of Ω one after the other, each by PCPG, with a cost that falls."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.qp.coarse import HELD, imbalance
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.nearest import UNBALANCED, nearest, nearest_or_least
from tfeti_dolfinx.qp.newton_accept import accept, longer
from tfeti_dolfinx.qp.newton_curved import is_rubbing
from tfeti_dolfinx.qp.newton_faces import FaceSolver
from tfeti_dolfinx.qp.newton_iterate import Iterate
from tfeti_dolfinx.qp.parameters import NewtonParameters
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, QPResult, Start, Steps
from tfeti_dolfinx.qp.stopping import StoppingRule


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
    lam = None if is_rubbing(qp, face) else _open(qp, face)
    if lam is None:
        lam = nearest(qp.coarse, qp.feasible, zero).lam
    zero.destroy()
    return lam


def _open(qp: QP, face: Face) -> PETSc.Vec | None:
    """The least λ on a face, None where it does not balance the load."""
    coarse, lam = qp.coarse.on_face(face), qp.d.duplicate()
    coarse.particular(lam)
    held = imbalance(coarse, lam) <= HELD
    coarse.destroy()
    if not held:
        lam.destroy()
    return lam if held else None


def feasible_start(qp: QP, start: Start) -> PETSc.Vec:
    """Step 0: the nearest feasible point to earlier multipliers, or to 0. Collective."""
    return nearest_or_least(qp.coarse, qp.feasible, start.lam).lam


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
    >>> from tfeti_dolfinx.qp.feasible_sets import Bounds
    >>> from tfeti_dolfinx.qp.homogenised import homogenise, image
    >>> from tfeti_dolfinx.qp.stopping import ResidualRule
    >>> F = PETSc.Mat().createDense((3, 3), array=np.diag([1.0, 2.0, 4.0]), comm=PETSc.COMM_SELF)
    >>> d = PETSc.Vec().createWithArray(np.array([1.0, -1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds())
    >>> start = homogenise(qp, image(F, first_point(qp)))
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
    state = Iterate(qp, homogenised, start.mu if start else None)
    faces = FaceSolver(state.qp, rule, parameters, steps, max_it, monitor)
    reason, looked = ConvergedReason.ITERATING, bool(start) or is_rubbing(qp, state.face())
    monitor(steps, "start", state.point.lam, homogenised.b.norm(), 0.0)
    if is_rubbing(qp, state.face()) and imbalance(qp.coarse, state.point.lam) > UNBALANCED:
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
