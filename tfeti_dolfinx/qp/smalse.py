"""SMALSE-M: semimonotonic augmented Lagrangians for separable and equality constraints."""

from __future__ import annotations

from dataclasses import dataclass

from petsc4py import PETSc

from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.mprgp import EXPANSIONS, Iterate, MprgpParameters, mprgp
from tfeti_dolfinx.qp.problem import QP, Coarse, ConvergedReason, Operator, QPResult, Start, Steps
from tfeti_dolfinx.qp.stopping import StoppingRule

# of the Lagrangian: what its value may be wrong by
ROUNDING = 1e-14
# where nothing fulfils Bx = 0, ‖Bx‖ tends to a limit: that it has changed by less than this share,
# and M not at all, for so many outer steps is a stall; the slowest scenes change by 1e-3 a step
CHANGE, PATIENCE = 1e-3, 1000
# of the tolerance: inner problems are not solved more exactly than that
ENOUGH = 1e-3


class PenalisedOperator:
    """A = P F P + ρ Q.

    Args:
        F: The dual operator.
        coarse: Its projectors.
        rho: Penalty ρ.
        like: A vector of the right layout.
    """

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


class Balance:
    """M, which weighs the projected gradient against ‖Bx‖, and whether ‖Bx‖ still falls.

    Args:
        M: M₀.
        beta: Factor on M when the Lagrangian does not grow enough.
        rho: Penalty ρ.
    """

    def __init__(self, M: float, beta: float, rho: float) -> None:
        self.M, self._beta, self._rho = M, beta, rho
        self._lagrangian, self._equality, self._idle = -float("inf"), float("inf"), 0

    def update(self, lagrangian: float, equality: float) -> None:
        """Step 4: after an outer step, from L(x, μ) before the multipliers' update and ‖Bx‖."""
        growth, self._lagrangian = lagrangian - self._lagrangian, lagrangian
        self._idle += 1
        # a growth that rounding decides says nothing of M
        if growth < 0.5 * self._rho * equality**2 - ROUNDING * abs(lagrangian):
            self.M *= self._beta
            self._idle = 0
        if not abs(equality - self._equality) <= CHANGE * equality:
            self._equality, self._idle = equality, 0

    @property
    def stalled(self) -> bool:
        """Whether neither ‖Bx‖ nor M has changed for long."""
        return self._idle >= PATIENCE


class InnerTest:
    """Ends the inner loop where the rule is content, or x is exact enough for an outer step.

    Args:
        homogenised: The homogenised program.
        coarse: Its projectors.
        rule: The stopping rule.
        balance: Holds M.
        norm: Estimate of ‖F‖.
        eta: Least exactness η.
    """

    def __init__(
        self,
        homogenised: Homogenised,
        coarse: Coarse,
        rule: StoppingRule,
        balance: Balance,
        norm: float,
        eta: float,
    ) -> None:
        self._homogenised, self._coarse, self._rule = homogenised, coarse, rule
        self._balance, self._norm, self._eta = balance, norm, eta
        self._lam, self._verdict = homogenised.b.duplicate(), ConvergedReason.ITERATING

    def __call__(self, state: Iterate) -> bool:
        """Whether the inner loop may end. Collective."""
        equality = self._coarse.norm_Q(state.x)
        gradient = state.projected_gradient
        residual = max(gradient, self._norm * equality)
        if residual <= self._rule.tolerance:
            self._examine(state, residual)
        if self._verdict != ConvergedReason.ITERATING or self._rule.drifted:
            return True
        # much below the tolerance a gradient has no business: M may be too small
        wanted = max(self._balance.M * equality, ENOUGH * self._rule.tolerance)
        return gradient <= min(wanted, self._eta)

    def conclude(self, state: Iterate, reason: ConvergedReason) -> ConvergedReason:
        """Why to stop, given why the inner loop did. Collective."""
        if reason == ConvergedReason.DIVERGED_INDEFINITE_MAT:  # rounding, or a wrong operator
            equality = self._coarse.norm_Q(state.x)
            residual = max(state.projected_gradient, self._norm * equality)
            self._examine(state, residual)
            if self._homogenised.is_rounding(residual):
                reason = ConvergedReason.DIVERGED_ROUNDING
        return reason if self._verdict == ConvergedReason.ITERATING else self._verdict

    def _examine(self, state: Iterate, residual: float) -> None:
        state.x.copy(self._lam)
        self._lam.axpy(1.0, self._homogenised.lam_bar)
        self._verdict = self._rule.examine(self._lam, state.g, residual)

    def destroy(self) -> None:
        """Destroy the work vector. Collective."""
        self._lam.destroy()


@dataclass(frozen=True)
class SmalseParameters:
    """Parameters of SMALSE-M and of its inner MPRGP, for F scaled to ‖PFP‖ = 1.

    Attributes:
        rho: Penalty ρ.
        M: M₀, how exactly inner problems are solved against ‖Bx‖.
        beta: Factor on M when the Lagrangian does not grow enough.
        eta: η as a multiple of ‖b‖, the least exactness of inner problems.
        gamma: Γ of the proportioning test.
        alpha_bar: ᾱ as a multiple of 1/‖A‖.
        expansion: Name of the expansion step.
    """

    rho: float = 1.0
    M: float = 1.0
    beta: float = 0.9
    eta: float = 0.1
    gamma: float = 1.0
    alpha_bar: float = 1.95
    expansion: str = "fixed"


def smalse(
    qp: QP,
    homogenised: Homogenised,
    norm: float,
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

    Args:
        qp: The program.
        homogenised: Its homogenised form.
        norm: Estimate of ‖PFP‖; parameters are relative to it.
        rule: Says when ‖g^P‖ and ‖F‖‖Qx‖ are small enough; asked in the inner loop too.
        parameters: ρ, M, β, η, Γ, ᾱ, expansion.
        max_it: Most inner steps, and most outer ones.
        start: Where to start; default x = P_Ω(0), μ = 0.
        monitor: Called after each step.

    Returns:
        The multipliers, their gradient, the reason and the residuals.
    """
    b, feasible, coarse = homogenised.b, homogenised.feasible, qp.coarse
    rho, eta = parameters.rho * norm, parameters.eta * b.norm()
    balance = Balance(parameters.M * norm, parameters.beta, rho)
    A = PenalisedOperator(qp.F, coarse, rho, b)
    x, y, Qx = _start(start, homogenised), b.duplicate(), b.duplicate()
    if start is not None:
        coarse.combine(start.mu, y)
    state = Iterate(A, x, _gradient(A, x, b, y), feasible)
    scale = max(norm, rho) or 1.0
    inner = MprgpParameters(
        parameters.alpha_bar / scale, parameters.gamma, EXPANSIONS[parameters.expansion]
    )
    steps, test = Steps(), InnerTest(homogenised, coarse, rule, balance, norm, eta)
    reason = ConvergedReason.ITERATING
    while reason == ConvergedReason.ITERATING:
        # Step 1: x with ‖g^P(x, μ)‖ ≤ min(M‖Bx‖, η)
        reason = mprgp(state, inner, test, steps, max_it, monitor)
        # Step 2: test
        coarse.apply_Q(x, Qx)
        monitor(steps, "outer", x, state.projected_gradient, Qx.norm())
        reason = test.conclude(state, reason)
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
        balance.update(lagrangian, Qx.norm())
        # Step 5
        steps.outer += 1
        if balance.stalled:
            reason = ConvergedReason.DIVERGED_STALLED
        elif steps.outer >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
    feasible.project(x)  # what rounding left off its bound by a hair is on it
    result = QPResult(
        lam=x,
        mu=coarse.coordinates(y),
        gradient=state.g,
        reason=reason,
        projected_gradient=state.projected_gradient,
        equality=Qx.norm(),
        reference=homogenised.reference,
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
    homogenised.feasible.project(x)
    return x


def _gradient(A: Operator, x: PETSc.Vec, b: PETSc.Vec, y: PETSc.Vec) -> PETSc.Vec:
    """A x − b + y, without a multiplication where x = 0."""
    g = b.duplicate()
    if x.norm() > 0.0:
        A.mult(x, g)
    g.axpy(-1.0, b)
    g.axpy(1.0, y)
    return g
