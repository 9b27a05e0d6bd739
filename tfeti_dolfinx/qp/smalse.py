"""SMALSE-M: semimonotonic augmented Lagrangians around MPRGP."""

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import norm_over
from tfeti_dolfinx.common.validation import ABOVE_0, Range, described
from tfeti_dolfinx.qp.mprgp import MprgpIterate, MprgpParameters, mprgp
from tfeti_dolfinx.qp.problem import (
    QP,
    STRANGE,
    ConvergedReason,
    Monitor,
    QPResult,
    Start,
    Steps,
    StoppingRule,
    no_monitor,
    product,
)


@dataclass(frozen=True)
class SmalseParameters:
    """Parameters of SMALSE-M and of its inner MPRGP, for F scaled to ‖PFP‖ = 1."""

    rho: float = described(
        1.0, "smalse", "penalty ρ in units of ‖PFP‖", name="smalse_rho", symbol="ρ", fits=ABOVE_0
    )
    M: float = described(
        1.0, "smalse", "M₀ in units of ‖PFP‖", name="smalse_M", symbol="M", fits=ABOVE_0
    )
    beta: float = described(
        0.9,
        "smalse",
        "factor β on M, in (0, 1)",
        name="smalse_beta",
        symbol="β",
        fits=Range("between 0 and 1", lambda value: 0.0 < value < 1.0),
    )
    eta: float = described(
        0.1, "smalse", "η in units of ‖b‖", name="smalse_eta", symbol="η", fits=ABOVE_0
    )
    gamma: float = described(
        1.0, "mprgp", "Γ of the proportioning test", name="mpgp_gamma", symbol="Γ", fits=ABOVE_0
    )
    alpha_bar: float = described(
        1.95,
        "mprgp",
        "step length ᾱ in units of 1/‖A‖",
        name="mpgp_alpha",
        symbol="ᾱ",
        fits=Range("more than 0, at most 2", lambda value: 0.0 < value <= 2.0),
    )
    # of the rule's tolerance: inner problems are not solved more exactly, as M may be too small
    enough: float = 1e-3
    rounding: float = 1e-14  # of the Lagrangian: what its value may be wrong by
    # where nothing fulfils Bx = 0, ‖Bx‖ tends to a limit: a change by less than this share is none;
    # the slowest scenes change by 1e-3 a step
    change: float = 1e-3
    patience: int = 1000  # outer steps without a change of ‖Bx‖ and M that are a stall


class InnerTest:
    """Ends the inner loop where the rule is content, or x is exact enough for an outer step.

    Attributes:
        M: Weighs the projected gradient against ‖Bx‖.
        reason: The rule's reason to stop.
        idle: So many outer steps have changed neither ‖Bx‖ nor M.
    """

    def __init__(
        self, qp: QP, start: Start, rule: StoppingRule, parameters: SmalseParameters
    ) -> None:
        self._qp, self._start, self._rule, self._parameters = qp, start, rule, parameters
        self._eta = parameters.eta * norm_over(qp.coarse.comm, start.b)
        self.M, self.reason, self.idle = parameters.M * qp.norm, ConvergedReason.ITERATING, 0
        self._lagrangian, self._equality = -float("inf"), float("inf")

    def __call__(self, state: MprgpIterate) -> bool:
        """Return whether the inner loop may end. Collective."""
        equality = self._qp.coarse.norm_Q(state.x - self._start.at.lam)
        gradient = state.projected_gradient
        if max(gradient, self._qp.norm * equality) <= self._rule.tolerance:
            self.examine(state, equality)
        if self.reason != ConvergedReason.ITERATING:
            return True
        wanted = max(self.M * equality, self._parameters.enough * self._rule.tolerance)
        return gradient <= min(wanted, self._eta)

    def examine(self, state: MprgpIterate, equality: float) -> float:
        """Apply the stopping rule, given ‖Q(λ − λ̄)‖; return the residual. Collective."""
        residual = max(state.projected_gradient, self._qp.norm * equality)
        self.reason = self._rule.examine(state.x, state.g, state.face, residual, self._qp.norm)
        return residual

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
    start: Start,
    rule: StoppingRule,
    parameters: SmalseParameters = SmalseParameters(),
    *,
    max_it: int = 10_000,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½xᵀFx − bᵀx, Gx = 0, where x = λ − λ̄ and λ ∈ Ω, for λ. Collective.

    Dostál, Optimal Quadratic Programming Algorithms, Springer 2009, chapter 6 (SMALBE-M);
    Dostál, Kozubek, Math. Program. 135 (2012) 195–220. Step numbers are those of the talk.
    B is an orthonormalised G, so that ‖Bx‖ = ‖Qx‖; Bᵀμ = y is kept instead of μ. Preconditioners
    are not used. It begins at P_Ω(λ) of an earlier λ, with its μ, else at P_Ω(λ̄) with μ = 0.

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
    >>> from tfeti_dolfinx.testing import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> from tfeti_dolfinx.qp.problem import StoppingRule, homogenise
    >>> F, d = np.diag([1.0, 2.0, 4.0]).__matmul__, np.array([1.0, -1.0, 2.0])
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Bounds(), norm=4.0)
    >>> result = smalse(qp, homogenise(qp), StoppingRule(1e-10))
    >>> result.reason.name, result.lam.round(6).tolist()
    ('CONVERGED_RTOL', [0.6, 0.0, 0.4])
    """
    b, coarse, norm, rho = start.b, qp.coarse, qp.norm, parameters.rho * qp.norm

    def A(x: Array) -> Array:  # (P F P + ρ Q)x
        Qx = coarse.Q(x)
        FPx = qp.F(x - Qx)
        return FPx - coarse.Q(FPx) + rho * Qx

    test, steps = InnerTest(qp, start, rule, parameters), Steps()
    # λ = P_Ω(λ̄), or that of a start; x = λ − λ̄; g = Ax − b + y
    lam_bar = start.at.lam
    y = np.zeros_like(b) if start.mu is None else coarse.combined(start.mu)
    lam = qp.feasible.project(lam_bar if start.lam is None else start.lam)
    x = lam - lam_bar
    g = product(A, qp.coarse.comm, x) - b + y
    state = MprgpIterate(A, lam, g, qp.feasible, qp.coarse.comm)
    inner = MprgpParameters(parameters.alpha_bar / (max(norm, rho) or 1.0), parameters.gamma)
    reason = ConvergedReason.ITERATING
    while reason == ConvergedReason.ITERATING:
        # Step 1: x with ‖g^P(x, μ)‖ ≤ min(M‖Bx‖, η)
        broken = mprgp(state, inner, test, steps, max_it, monitor)
        # Step 2: test
        x = state.x - lam_bar
        Qx = coarse.Q(x)
        equality = norm_over(qp.coarse.comm, Qx)
        monitor(steps, "outer", state.x, state.projected_gradient, equality)
        indefinite = broken == ConvergedReason.DIVERGED_INDEFINITE_MAT  # or rounding
        if indefinite and test.examine(state, equality) <= STRANGE * start.rounding:
            broken = ConvergedReason.DIVERGED_ROUNDING
        reason = test.reason or broken or ConvergedReason.ITERATING
        if reason != ConvergedReason.ITERATING:
            break
        # Step 4 needs L(x, μ) = ½xᵀAx − bᵀx + yᵀx before the update, g = Ax − b + y
        lagrangian = 0.5 * sum(qp.dot((x, state.g), (x, y - b)))
        # Step 3: update multipliers
        y = y + rho * Qx
        state.g = state.g + rho * Qx
        state.split()
        # Step 4: update M
        test.update(lagrangian, equality)
        # Step 5
        steps.outer += 1
        if test.idle >= parameters.patience:
            reason = ConvergedReason.DIVERGED_STALLED
        elif steps.outer >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
    return QPResult(
        lam=qp.feasible.project(state.x),  # rounding may leave it off its bounds
        mu=coarse.coordinates(y),
        gradient=state.g,
        face=state.face,
        reason=reason,
        projected_gradient=state.projected_gradient,
        equality=equality,
        reference=start.reference,
        norm=norm,
        steps=steps,
    )
