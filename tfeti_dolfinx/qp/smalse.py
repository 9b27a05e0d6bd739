"""SMALSE-M: semimonotonic augmented Lagrangians for separable and equality constraints."""

from __future__ import annotations

from dataclasses import dataclass

from petsc4py import PETSc

from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.mprgp import EXPANSIONS, Iterate, MprgpParameters, mprgp
from tfeti_dolfinx.qp.problem import QP, Coarse, ConvergedReason, Operator, QPResult, Start, Steps


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
    parameters: SmalseParameters = SmalseParameters(),
    *,
    rtol: float = 1e-6,
    atol: float = 0.0,
    max_it: int = 10_000,
    start: Start | None = None,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½xᵀFx − bᵀx, x ∈ Ω − λ̄, Gx = 0, and return λ = x + λ̄. Collective.

    Dostál, Optimal Quadratic Programming Algorithms, Springer 2009, chapter 6 (SMALBE-M);
    Dostál, Kozubek, Math. Program. 135 (2012) 195–220. Step numbers are those of the talk.
    B is an orthonormalised G, so that ‖Bx‖ = ‖Qx‖; Bᵀμ = y is kept instead of μ.

    Stops when ‖g^P‖ ≤ rtol·b₀ and ‖F‖‖Qx‖ ≤ rtol·b₀ (or atol), tested in the inner loop too.

    Args:
        qp: The program.
        homogenised: Its homogenised form.
        norm: Estimate of ‖PFP‖; parameters are relative to it.
        parameters: ρ, M, β, η, Γ, ᾱ, expansion.
        rtol: Relative tolerance.
        atol: Absolute tolerance on both residuals.
        max_it: Most inner steps.
        start: Where to start; default x = P_Ω(0), μ = 0.
        monitor: Called after each step.

    Returns:
        The multipliers, their gradient, the reason and the residuals.
    """
    b, feasible, coarse = homogenised.b, homogenised.feasible, qp.coarse
    tol = homogenised.tolerance(rtol, atol)
    rho, M, eta = parameters.rho * norm, parameters.M * norm, parameters.eta * b.norm()
    A = PenalisedOperator(qp.F, coarse, rho, b)
    x, y, Qx = _start(start, homogenised), b.duplicate(), b.duplicate()
    if start is not None:
        coarse.combine(start.mu, y)
    g = _gradient(A, x, b, y)
    state = Iterate(A, x, g, feasible)
    scale = max(norm, rho) or 1.0
    inner = MprgpParameters(
        parameters.alpha_bar / scale, parameters.gamma, EXPANSIONS[parameters.expansion]
    )
    steps, solved, lagrangian = Steps(), False, -float("inf")

    def stop(state: Iterate) -> bool:
        nonlocal solved
        equality = coarse.norm_Q(state.x)
        gP = state.projected_gradient
        solved = gP <= tol and norm * equality <= tol
        return solved or gP <= min(M * equality, eta)

    reason = ConvergedReason.ITERATING
    while reason == ConvergedReason.ITERATING:
        # Step 1: x with ‖g^P(x, μ)‖ ≤ min(M‖Bx‖, η)
        reason = mprgp(state, inner, stop, steps, max_it, monitor)
        # Step 2: test
        coarse.apply_Q(x, Qx)
        monitor(steps, "outer", x, state.projected_gradient, Qx.norm())
        if solved:
            reason = ConvergedReason.CONVERGED_RTOL
        if reason != ConvergedReason.ITERATING:
            break
        # Step 4 needs L(x, μ) = ½xᵀAx − bᵀx + yᵀx before the update, g = Ax − b + y
        previous, lagrangian = lagrangian, 0.5 * (x.dot(g) - x.dot(b) + x.dot(y))
        # Step 3: update multipliers
        y.axpy(rho, Qx)
        g.axpy(rho, Qx)
        state.split()
        # Step 4: update M
        if steps.outer > 0 and lagrangian < previous + 0.5 * rho * Qx.dot(Qx):
            M *= parameters.beta
        # Step 5
        steps.outer += 1
    result = QPResult(
        lam=x,
        mu=coarse.coordinates(y),
        gradient=g,
        reason=reason,
        projected_gradient=state.projected_gradient,
        equality=Qx.norm(),
        reference=homogenised.reference,
        tolerance=tol,
        norm=norm,
        steps=steps,
    )
    x.axpy(1.0, homogenised.lam_bar)
    for item in (A, state, y, Qx):
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
