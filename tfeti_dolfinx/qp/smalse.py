"""SMALSE-M: semimonotonic augmented Lagrangians around MPRGP."""

from __future__ import annotations

from petsc4py import PETSc

from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.mprgp import MprgpIterate, mprgp
from tfeti_dolfinx.qp.parameters import SmalseParameters
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    Monitor,
    Operator,
    QPResult,
    Start,
    Steps,
    StoppingRule,
    no_monitor,
)


class PenalisedOperator:
    """A = P F P + ρ Q."""

    def __init__(self, F: Operator, coarse: Coarse, rho: float, like: PETSc.Vec) -> None:
        self.F, self.coarse, self.rho = F, coarse, rho
        self._Qx, self._work = like.duplicate(), like.duplicate()

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x; multiplies by F once. Collective."""
        self.coarse.apply_Q(x, self._Qx)
        x.copy(self._work)
        self._work.axpy(-1.0, self._Qx)
        self.F.mult(self._work, y)
        self.coarse.apply_Q(y, self._work)
        y.axpy(-1.0, self._work)
        y.axpy(self.rho, self._Qx)

    def destroy(self) -> None:
        """Destroy the work vectors. Collective."""
        self._Qx.destroy()
        self._work.destroy()


class InnerTest:
    """Ends the inner loop where the rule is content, or x is exact enough for an outer step.

    Attributes:
        M: Weighs the projected gradient against ‖Bx‖.
        reason: The rule's reason to stop.
        idle: So many outer steps have changed neither ‖Bx‖ nor M.
    """

    def __init__(
        self, qp: QP, homogenised: Homogenised, rule: StoppingRule, parameters: SmalseParameters
    ) -> None:
        self._qp, self._homogenised, self._rule = qp, homogenised, rule
        self._parameters = parameters
        self._eta = parameters.eta * homogenised.b.norm()
        self.M, self.reason, self.idle = parameters.M * qp.norm, ConvergedReason.ITERATING, 0
        self._lagrangian, self._equality = -float("inf"), float("inf")

    def __call__(self, state: MprgpIterate) -> bool:
        """Return whether the inner loop may end. Collective."""
        equality, gradient = self._equality_at(state), state.projected_gradient
        if max(gradient, self._qp.norm * equality) <= self._rule.tolerance:
            self.examine(state)
        if self.reason != ConvergedReason.ITERATING or self._rule.drifted:
            return True
        wanted = max(self.M * equality, self._parameters.enough * self._rule.tolerance)
        return gradient <= min(wanted, self._eta)

    def examine(self, state: MprgpIterate) -> float:
        """Apply the stopping rule, and return the residual. Collective."""
        residual = max(state.projected_gradient, self._qp.norm * self._equality_at(state))
        self.reason = self._rule.examine(state.x, state.g, state.face(), residual)
        return residual

    def _equality_at(self, state: MprgpIterate) -> float:
        """‖Q(λ − λ̄)‖."""
        x = state.x.copy()
        x.axpy(-1.0, self._homogenised.lam_bar)
        equality = self._qp.coarse.norm_Q(x)
        x.destroy()
        return equality

    def update(self, lagrangian: float, equality: float) -> None:
        """Step 4: M after an outer step, from L(x, μ) before the multipliers' update and ‖Bx‖."""
        parameters = self._parameters
        growth, self._lagrangian = lagrangian - self._lagrangian, lagrangian
        least = 0.5 * parameters.rho * self._qp.norm * equality**2
        self.idle += 1
        # a growth that rounding decides says nothing of M
        if growth < least - parameters.rounding * abs(lagrangian):
            self.M *= parameters.beta
            self.idle = 0
        if not abs(equality - self._equality) <= parameters.change * equality:
            self._equality, self.idle = equality, 0


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
    """Solve min ½xᵀFx − bᵀx, Gx = 0, where x = λ − λ̄ and λ ∈ Ω, for λ. Collective.

    Dostál, Optimal Quadratic Programming Algorithms, Springer 2009, chapter 6 (SMALBE-M);
    Dostál, Kozubek, Math. Program. 135 (2012) 195–220. Step numbers are those of the talk.
    B is an orthonormalised G, so that ‖Bx‖ = ‖Qx‖; Bᵀμ = y is kept instead of μ. Preconditioners
    are not used. Without a start it begins at P_Ω(λ̄) with μ = 0.

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
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> from tfeti_dolfinx.qp.homogenised import homogenise
    >>> from tfeti_dolfinx.qp.problem import ResidualRule
    >>> F = PETSc.Mat().createDense((3, 3), array=np.diag([1.0, 2.0, 4.0]), comm=PETSc.COMM_SELF)
    >>> d = PETSc.Vec().createWithArray(np.array([1.0, -1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds(), norm=4.0)
    >>> result = smalse(qp, homogenise(qp), ResidualRule(1e-10))
    >>> result.reason.name, result.lam.array.round(6).tolist()
    ('CONVERGED_RTOL', [0.6, 0.0, 0.4])
    """
    b, coarse, norm, rho = homogenised.b, qp.coarse, qp.norm, parameters.rho * qp.norm
    A, steps = PenalisedOperator(qp.F, coarse, rho, b), Steps()
    test = InnerTest(qp, homogenised, rule, parameters)
    # λ = P_Ω(λ̄), or that of a start; x = λ − λ̄; g = Ax − b + y
    lam, x, g, y, Qx = (b.duplicate() for _ in range(5))
    if start is not None and start.mu is not None:
        coarse.combine(start.mu, y)
    begin = homogenised.lam_bar if start is None else start.lam
    lam.array[:] = qp.feasible.project(begin.array_r)
    lam.copy(x)
    x.axpy(-1.0, homogenised.lam_bar)
    if x.norm() > 0.0:
        A.mult(x, g)
    g.axpy(-1.0, b)
    g.axpy(1.0, y)
    state, inner = MprgpIterate(A, lam, g, qp.feasible), parameters.inner(norm)
    reason = ConvergedReason.ITERATING
    while reason == ConvergedReason.ITERATING:
        # Step 1: x with ‖g^P(x, μ)‖ ≤ min(M‖Bx‖, η)
        broken = mprgp(state, inner, test, steps, max_it, monitor)
        # Step 2: test
        lam.copy(x)
        x.axpy(-1.0, homogenised.lam_bar)
        coarse.apply_Q(x, Qx)
        monitor(steps, "outer", lam, state.projected_gradient, Qx.norm())
        indefinite = broken == ConvergedReason.DIVERGED_INDEFINITE_MAT  # or rounding
        if indefinite and homogenised.is_rounding(test.examine(state)):
            broken = ConvergedReason.DIVERGED_ROUNDING
        reason = test.reason or broken or ConvergedReason.ITERATING
        if reason != ConvergedReason.ITERATING:
            break
        if rule.drifted:
            A.mult(x, g)
            g.axpy(-1.0, b)
            g.axpy(1.0, y)
            state.split()
            rule.drifted = False
            continue
        # Step 4 needs L(x, μ) = ½xᵀAx − bᵀx + yᵀx before the update, g = Ax − b + y
        lagrangian = 0.5 * (x.dot(g) - x.dot(b) + x.dot(y))
        # Step 3: update multipliers
        y.axpy(rho, Qx)
        g.axpy(rho, Qx)
        state.split()
        # Step 4: update M
        test.update(lagrangian, Qx.norm())
        # Step 5
        steps.outer += 1
        if test.idle >= parameters.patience:
            reason = ConvergedReason.DIVERGED_STALLED
        elif steps.outer >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
    lam.array[:] = qp.feasible.project(lam.array_r)  # rounding may leave it off its bounds
    result = QPResult(
        lam=lam,
        mu=coarse.coordinates(y),
        gradient=g,
        face=state.face(),
        reason=reason,
        projected_gradient=state.projected_gradient,
        equality=Qx.norm(),
        reference=homogenised.scale.reference,
        norm=norm,
        steps=steps,
    )
    for item in (A, state, x, y, Qx):
        item.destroy()
    return result
