"""What SMALSE-M is made of: its operator, the precision of inner problems and their end."""

from __future__ import annotations

from petsc4py import PETSc

from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.mprgp import Iterate
from tfeti_dolfinx.qp.problem import ConvergedReason, Operator
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


class InnerPrecision:
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
        precision: Holds M.
        norm: Estimate of ‖F‖.
        eta: Least exactness η.
    """

    def __init__(
        self,
        homogenised: Homogenised,
        coarse: Coarse,
        rule: StoppingRule,
        precision: InnerPrecision,
        norm: float,
        eta: float,
    ) -> None:
        self._homogenised, self._coarse, self._rule = homogenised, coarse, rule
        self._precision, self._norm, self._eta = precision, norm, eta
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
        wanted = max(self._precision.M * equality, ENOUGH * self._rule.tolerance)
        return gradient <= min(wanted, self._eta)

    def conclude(self, state: Iterate, reason: ConvergedReason | None) -> ConvergedReason:
        """Why to stop, or ITERATING, given why the inner loop broke off. Collective."""
        if reason == ConvergedReason.DIVERGED_INDEFINITE_MAT:  # rounding, or a wrong operator
            equality = self._coarse.norm_Q(state.x)
            residual = max(state.projected_gradient, self._norm * equality)
            self._examine(state, residual)
            if self._homogenised.is_rounding(residual):
                reason = ConvergedReason.DIVERGED_ROUNDING
        if self._verdict != ConvergedReason.ITERATING or reason is None:
            return self._verdict
        return reason

    def _examine(self, state: Iterate, residual: float) -> None:
        state.x.copy(self._lam)
        self._lam.axpy(1.0, self._homogenised.lam_bar)
        self._verdict = self._rule.examine(self._lam, state.g, state.face(), residual)

    def destroy(self) -> None:
        """Destroy the work vector. Collective."""
        self._lam.destroy()
