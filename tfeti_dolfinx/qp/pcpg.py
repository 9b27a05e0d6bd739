"""PCPG: preconditioned conjugate projected gradients, for a program without inequalities."""

from __future__ import annotations

from petsc4py import PETSc

from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, QPResult, Steps, project
from tfeti_dolfinx.qp.stopping import StoppingRule


def pcpg(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    *,
    max_it: int = 10_000,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½λᵀFλ − λᵀd, Gλ = e. Collective.

    Farhat, Mandel, Roux, Comput. Methods Appl. Mech. Engrg. 115 (1994) 365–385, section 3.
    Multiplies by F, and by the preconditioner, once per step.

    Args:
        qp: The program; its feasible set is not looked at.
        homogenised: Its homogenised form.
        rule: Says when ‖P(d − Fλ)‖ is small enough.
        max_it: Most steps.
        monitor: Called after each step.

    Returns:
        The multipliers, the gradient Fλ − d up to the range of Gᵀ, the reason, the residuals.
    """
    lam, r = homogenised.lam_bar.copy(), homogenised.b.copy()
    p, Fp, z, g = (r.duplicate() for _ in range(4))
    steps, rz, fresh, norm = Steps(), 1.0, True, r.norm()
    reason = ConvergedReason.ITERATING
    monitor(steps, "start", lam, norm, 0.0)
    while True:
        # test
        if norm <= rule.tolerance:
            reason = _examine(rule, lam, r, g)
        if rule.drifted:
            _residual(qp, lam, r, g)
            fresh, rule.drifted = True, False
        if reason == ConvergedReason.ITERATING and steps.cg >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
        if reason != ConvergedReason.ITERATING:
            break
        # precondition and project: z = P M r
        _precondition(qp, r, z, g)
        # direction
        rz, previous = r.dot(z), rz
        p.aypx(0.0 if fresh else rz / previous, z)
        # step
        qp.F.mult(p, Fp)
        project(qp.coarse, Fp, g)
        pFp = p.dot(Fp)
        if not (pFp > 0.0 and rz > 0.0):
            reason = _broken(rule, lam, r, g, homogenised)
            break
        lam.axpy(rz / pFp, p)
        r.axpy(-rz / pFp, Fp)
        fresh, norm = False, r.norm()
        steps.cg += 1
        monitor(steps, "cg", lam, norm, 0.0)
    r.scale(-1.0)
    lam.copy(z)
    z.axpy(-1.0, homogenised.lam_bar)
    result = QPResult(
        lam=lam,
        mu=qp.coarse.coordinates(r),
        gradient=r,
        reason=reason,
        projected_gradient=norm,
        equality=qp.coarse.norm_Q(z),
        reference=homogenised.reference,
        norm=0.0,
        steps=steps,
    )
    for vec in (p, Fp, z, g):
        vec.destroy()
    return result


def _examine(rule: StoppingRule, lam: PETSc.Vec, r: PETSc.Vec, g: PETSc.Vec) -> ConvergedReason:
    """Ask the rule; its gradient is g = −r."""
    r.copy(g)
    g.scale(-1.0)
    return rule.examine(lam, g, r.norm())


def _broken(
    rule: StoppingRule, lam: PETSc.Vec, r: PETSc.Vec, g: PETSc.Vec, homogenised: Homogenised
) -> ConvergedReason:
    """Why there is no direction with a positive curvature: all is done, rounding, or F."""
    reason = _examine(rule, lam, r, g)
    if reason != ConvergedReason.ITERATING:
        return reason
    if homogenised.is_rounding(r.norm()):
        return ConvergedReason.DIVERGED_ROUNDING
    return ConvergedReason.DIVERGED_INDEFINITE_MAT


def _residual(qp: QP, lam: PETSc.Vec, r: PETSc.Vec, work: PETSc.Vec) -> None:
    """r = P(d − Fλ), anew."""
    qp.F.mult(lam, r)
    r.aypx(-1.0, qp.d)
    project(qp.coarse, r, work)


def _precondition(qp: QP, r: PETSc.Vec, z: PETSc.Vec, work: PETSc.Vec) -> None:
    """z = P M r, M the preconditioner or the identity."""
    if qp.preconditioner is None:
        r.copy(z)
    else:
        qp.preconditioner.mult(r, z)
        project(qp.coarse, z, work)
