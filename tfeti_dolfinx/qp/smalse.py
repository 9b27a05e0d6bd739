"""SMALSE-M: semimonotonic augmented Lagrangians for separable and equality constraints."""

from __future__ import annotations

from petsc4py import PETSc

from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.masked import masked
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.mprgp import Iterate, mprgp
from tfeti_dolfinx.qp.parameters import SmalseParameters
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Operator, QPResult, Start, Steps
from tfeti_dolfinx.qp.smalse_parts import InnerPrecision, InnerTest, PenalisedOperator
from tfeti_dolfinx.qp.stopping import StoppingRule


def smalse(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    parameters: SmalseParameters = SmalseParameters(),
    *,
    max_it: int = 10_000,
    start: Start | None = None,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½xᵀFx − bᵀx, x ∈ Ω − λ̄, Gx = 0, and return λ = x + λ̄. Collective.

    Dostál, Optimal Quadratic Programming Algorithms, Springer 2009, chapter 6 (SMALBE-M);
    Dostál, Kozubek, Math. Program. 135 (2012) 195–220. Step numbers are those of the talk.
    B is an orthonormalised G, so that ‖Bx‖ = ‖Qx‖; Bᵀμ = y is kept instead of μ.

    ===========================  =================================================================
    reason                       when
    ===========================  =================================================================
    the rule's                   max(‖g^P‖, ‖F‖‖Qx‖) ≤ ``rule.tolerance``, and the rule is content
    ``DIVERGED_ITS``             ``max_it`` inner or outer steps are not enough
    ``DIVERGED_STALLED``         ‖Qx‖ tends to a limit that is not 0
    ``DIVERGED_ROUNDING``        no positive curvature, but residuals that are rounding
    ``DIVERGED_INDEFINITE_MAT``  a direction has no positive curvature
    ===========================  =================================================================

    >>> import numpy as np
    >>> from petsc4py import PETSc
    >>> from tfeti_dolfinx.qp.coarse import DenseCoarse
    >>> from tfeti_dolfinx.qp.feasible_sets import Bounds
    >>> from tfeti_dolfinx.qp.homogenised import homogenise
    >>> from tfeti_dolfinx.qp.stopping import ResidualRule
    >>> F = PETSc.Mat().createDense((3, 3), array=np.diag([1.0, 2.0, 4.0]), comm=PETSc.COMM_SELF)
    >>> d = PETSc.Vec().createWithArray(np.array([1.0, -1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds(), norm=4.0)
    >>> result = smalse(qp, homogenise(qp), ResidualRule(1e-10))
    >>> result.reason.name, result.lam.array.round(6).tolist()
    ('CONVERGED_RTOL', [0.6, 0.0, 0.4])

    Args:
        qp: The program; parameters are relative to its norm. ``preconditioner_on`` preconditions
            the conjugate gradient steps.
        homogenised: Its homogenised form.
        rule: Says when ‖g^P‖ and ‖F‖‖Qx‖ are small enough; asked in the inner loop too.
        parameters: ρ, M, β, η, Γ, ᾱ, expansion.
        max_it: Most inner steps, and most outer ones.
        start: Where to start; default x = P_Ω(0), μ = 0.
        monitor: Called after each step.

    Returns:
        The multipliers, their gradient, the reason and the residuals.
    """
    b, feasible, coarse, norm = homogenised.b, homogenised.feasible, qp.coarse, qp.norm
    rho, eta = parameters.rho * norm, parameters.eta * b.norm()
    precision = InnerPrecision(parameters.M * norm, parameters.beta, rho)
    A = PenalisedOperator(qp.F, coarse, rho, b)
    x, y, Qx = _start(start, homogenised), b.duplicate(), b.duplicate()
    if start is not None:
        coarse.combine(start.mu, y)
    state = Iterate(A, x, _gradient(A, x, b, y), feasible, masked(qp, rho))
    inner = parameters.inner(max(norm, rho) or 1.0)
    steps, test = Steps(), InnerTest(homogenised, coarse, rule, precision, norm, eta)
    reason = ConvergedReason.ITERATING
    while reason == ConvergedReason.ITERATING:
        # Step 1: x with ‖g^P(x, μ)‖ ≤ min(M‖Bx‖, η)
        broken = mprgp(state, inner, test, steps, max_it, monitor)
        # Step 2: test
        coarse.apply_Q(x, Qx)
        monitor(steps, "outer", x, state.projected_gradient, Qx.norm())
        reason = test.conclude(state, broken)
        if reason != ConvergedReason.ITERATING:
            break
        if rule.drifted:
            y.copy(Qx)
            Qx.axpy(-1.0, b)
            state.refresh(Qx)
            rule.drifted = False
            continue
        # Step 4 needs L(x, μ) = ½xᵀAx − bᵀx + yᵀx before the update, g = Ax − b + y
        lagrangian = 0.5 * (x.dot(state.g) - x.dot(b) + x.dot(y))
        # Step 3: update multipliers
        y.axpy(rho, Qx)
        state.g.axpy(rho, Qx)
        state.split()
        # Step 4: update M
        precision.update(lagrangian, Qx.norm())
        # Step 5
        steps.outer += 1
        if precision.stalled:
            reason = ConvergedReason.DIVERGED_STALLED
        elif steps.outer >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
    state.project(x)  # what rounding left off its bound by a hair is on it
    result = QPResult(
        lam=x,
        mu=coarse.coordinates(y),
        gradient=state.g,
        face=state.face(),
        reason=reason,
        projected_gradient=state.projected_gradient,
        equality=Qx.norm(),
        reference=homogenised.scale.reference,
        norm=norm,
        steps=steps,
    )
    x.axpy(1.0, homogenised.lam_bar)
    for item in (A, state, test, y, Qx):
        item.destroy()
    return result


def _start(start: Start | None, homogenised: Homogenised) -> PETSc.Vec:
    """x in Ω − λ̄: the projection of 0, or of a given λ − λ̄."""
    x = homogenised.b.duplicate()
    if start is not None:
        start.lam.copy(x)
        x.axpy(-1.0, homogenised.lam_bar)
    x.array[:] = homogenised.feasible.project(x.array_r)
    return x


def _gradient(A: Operator, x: PETSc.Vec, b: PETSc.Vec, y: PETSc.Vec) -> PETSc.Vec:
    """A x − b + y, without a multiplication where x = 0."""
    g = b.duplicate()
    if x.norm() > 0.0:
        A.mult(x, g)
    g.axpy(-1.0, b)
    g.axpy(1.0, y)
    return g
