"""PCPG: preconditioned conjugate projected gradients, for a program without inequalities."""

from __future__ import annotations

from petsc4py import PETSc

from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, QPResult, Steps, project


def pcpg(
    qp: QP,
    homogenised: Homogenised,
    *,
    rtol: float = 1e-6,
    atol: float = 0.0,
    max_it: int = 10_000,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½λᵀFλ − λᵀd, Gλ = e. Collective.

    Farhat, Mandel, Roux, Comput. Methods Appl. Mech. Engrg. 115 (1994) 365–385, section 3.
    Stops when ‖P(d − Fλ)‖ ≤ rtol·b₀. Multiplies by F, and by the preconditioner, once per step.

    Args:
        qp: The program; its feasible set is not looked at.
        homogenised: Its homogenised form.
        rtol: Relative tolerance.
        atol: Absolute tolerance.
        max_it: Most steps.
        monitor: Called after each step.

    Returns:
        The multipliers, the gradient Fλ − d up to the range of Gᵀ, the reason, the residuals.
    """
    tol = homogenised.tolerance(rtol, atol)
    x, r = homogenised.b.duplicate(), homogenised.b.copy()
    p, Fp, z, work = (r.duplicate() for _ in range(4))
    steps, rz, norm = Steps(), 1.0, r.norm()
    reason = ConvergedReason.CONVERGED_RTOL if norm <= tol else ConvergedReason.ITERATING
    monitor(steps, "start", x, norm, 0.0)
    while reason == ConvergedReason.ITERATING:
        # precondition and project: z = P M r
        _precondition(qp, r, z, work)
        # direction
        rz, previous = r.dot(z), rz
        p.aypx(rz / previous if steps.cg else 0.0, z)
        # step
        qp.F.mult(p, Fp)
        project(qp.coarse, Fp, work)
        pFp = p.dot(Fp)
        if not (pFp > 0.0 and rz > 0.0):
            reason = ConvergedReason.DIVERGED_INDEFINITE_MAT
            break
        x.axpy(rz / pFp, p)
        r.axpy(-rz / pFp, Fp)
        # test
        steps.cg += 1
        norm = r.norm()
        monitor(steps, "cg", x, norm, 0.0)
        if norm <= tol:
            reason = ConvergedReason.CONVERGED_RTOL
        elif steps.cg >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
    r.scale(-1.0)
    result = QPResult(
        lam=x,
        mu=qp.coarse.coordinates(r),
        gradient=r,
        reason=reason,
        projected_gradient=norm,
        equality=qp.coarse.norm_Q(x),
        reference=homogenised.reference,
        tolerance=tol,
        norm=0.0,
        steps=steps,
    )
    x.axpy(1.0, homogenised.lam_bar)
    for vec in (p, Fp, z, work):
        vec.destroy()
    return result


def _precondition(qp: QP, r: PETSc.Vec, z: PETSc.Vec, work: PETSc.Vec) -> None:
    """z = P M r, M the preconditioner or the identity."""
    if qp.preconditioner is None:
        r.copy(z)
    else:
        qp.preconditioner.mult(r, z)
        project(qp.coarse, z, work)
