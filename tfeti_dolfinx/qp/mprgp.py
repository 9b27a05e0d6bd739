"""MPRGP, modified proportioning with reduced gradient projections; MPGP on curved sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.masked import MaskedPreconditioner
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.problem import ConvergedReason, Operator, Steps
from tfeti_dolfinx.qp.tangent_steps import projected_step, step_on_face

StoppingTest = Callable[["Iterate"], bool]
Expansion = Callable[["Iterate", float, float, float], None]


class Iterate:
    """An iterate of min ½xᵀAx − bᵀx on Ω, with its gradient g = Ax − b and its parts.

    Args:
        A: Symmetric positive (semi)definite operator.
        x: Starting point in Ω; updated in place.
        g: Its gradient; updated in place.
        feasible: The set Ω.
        preconditioner: Preconditions in face; taken over.
    """

    def __init__(
        self,
        A: Operator,
        x: PETSc.Vec,
        g: PETSc.Vec,
        feasible: FeasibleSet,
        preconditioner: MaskedPreconditioner | None = None,
    ) -> None:
        self.A, self.x, self.g, self.feasible = A, x, g, feasible
        self._comm = x.getComm().tompi4py()
        self.phi, self.beta, self.p, self.Ap = (x.duplicate() for _ in range(4))
        self._preconditioner = preconditioner
        self.z = self.phi if preconditioner is None else x.duplicate()
        self.free_squared = self.chopped_squared = 0.0
        self.split()

    def split(self) -> None:
        """Find φ and β at x."""
        self.phi.array[:], self.beta.array[:] = self.feasible.split(self.x.array_r, self.g.array_r)
        self.free_squared = self.phi.dot(self.phi)
        self.chopped_squared = self.beta.dot(self.beta)

    def precondition(self) -> None:
        """z = M_f φ on the face of x; without a preconditioner z is φ."""
        if self._preconditioner is not None:
            self._preconditioner.apply(self.face(), self.phi, self.z)

    @property
    def projected_gradient(self) -> float:
        """‖g^P‖ = ‖φ + β‖."""
        return float((self.free_squared + self.chopped_squared) ** 0.5)

    def project(self, x: PETSc.Vec) -> None:
        """x ← P_Ω(x)."""
        x.array[:] = self.feasible.project(x.array_r)

    def reduced_squared(self, alpha: float) -> float:
        """φ̃ᵀφ."""
        phi = self.phi.array_r
        own = float(self.feasible.reduced(self.x.array_r, phi, alpha) @ phi)
        return float(self._comm.allreduce(own))

    def max_step(self, p: PETSc.Vec) -> float:
        """Largest α with x − α p ∈ Ω."""
        own = self.feasible.max_step(self.x.array_r, p.array_r)
        return float(self._comm.allreduce(own, op=MPI.MIN))

    def face(self) -> Face:
        """The face of x."""
        return self.feasible.face(self.x.array_r, self.g.array_r)

    def move(self, alpha: float, p: PETSc.Vec, Ap: PETSc.Vec) -> None:
        """x ← x − α p and the gradient with it."""
        self.x.axpy(-alpha, p)
        self.g.axpy(-alpha, Ap)

    def move_to(self, target: PETSc.Vec) -> None:
        """x ← target; multiplies by A once, and overwrites the direction p."""
        target.copy(self.p)
        self.p.axpy(-1.0, self.x)
        self.A.mult(self.p, self.Ap)
        self.g.axpy(1.0, self.Ap)
        target.copy(self.x)  # not x + (target − x), which rounds: what is on its bound stays there

    def refresh(self, linear: PETSc.Vec) -> None:
        """g = A x + c anew, for what rounding has added up in it; multiplies by A once."""
        self.A.mult(self.x, self.g)
        self.g.axpy(1.0, linear)
        self.split()

    def destroy(self) -> None:
        """Destroy the work vectors, not x and g. Collective."""
        for vec in (self.phi, self.beta, self.p, self.Ap):
            vec.destroy()
        if self._preconditioner is not None:
            self._preconditioner.destroy()
            self.z.destroy()


def fixed_step(state: Iterate, alpha_f: float, alpha_cg: float, alpha_bar: float) -> None:
    """Expansion by a step −ᾱφ from the face's edge, projected (Dostál, Schöberl 2005)."""
    state.move(alpha_f, state.p, state.Ap)
    state.project(state.x)
    state.split()
    target = state.x.copy()
    target.axpy(-alpha_bar, state.phi)
    state.project(target)
    state.move_to(target)
    target.destroy()


def projected_cg(state: Iterate, alpha_f: float, alpha_cg: float, alpha_bar: float) -> None:
    """Expansion by the whole conjugate gradient step, projected.

    Taken if the cost falls at least as far as along the part of the step that is feasible;
    else the fixed step follows, at the price of one more multiplication.
    """
    target, Ad = state.x.copy(), state.x.duplicate()
    target.axpy(-alpha_cg, state.p)
    state.project(target)
    target.axpy(-1.0, state.x)
    state.A.mult(target, Ad)
    slope = state.g.dot(target)
    decrease = slope + 0.5 * target.dot(Ad)
    gp, pAp = state.g.dot(state.p), state.p.dot(state.Ap)
    if decrease <= -alpha_f * gp + 0.5 * alpha_f**2 * pAp:
        state.move(-1.0, target, Ad)
        state.project(state.x)
    else:
        fixed_step(state, alpha_f, alpha_cg, alpha_bar)
    target.destroy()
    Ad.destroy()


EXPANSIONS: dict[str, Expansion] = {"fixed": fixed_step, "projcg": projected_cg}


@dataclass(frozen=True)
class MprgpParameters:
    """Parameters of MPRGP.

    Attributes:
        alpha_bar: Fixed step length ᾱ, in (0, 2/‖A‖].
        gamma: Γ > 0 of the proportioning test.
        expansion: The expansion step.
    """

    alpha_bar: float
    gamma: float = 1.0
    expansion: Expansion = fixed_step


def mprgp(
    state: Iterate,
    parameters: MprgpParameters,
    stop: StoppingTest,
    steps: Steps,
    max_it: int,
    monitor: Monitor = no_monitor,
) -> ConvergedReason | None:
    """Minimise ½xᵀAx − bᵀx on Ω, from ``state`` on and in place. Collective.

    Dostál, Schöberl, Comput. Optim. Appl. 30 (2005) 23–43; Dostál, Optimal Quadratic
    Programming Algorithms, Springer 2009, section 5.8, whose steps are numbered here, and 5.10
    for preconditioning in face. Where Ω has curved sets it is MPGP (Dostál, Kozubek, Math.
    Program. 135 (2012) 195–220): a proportioning step of less than ᾱ along −β would do nothing.
    A step on the face takes its place, tangents of the boundary included, or P_Ω(x − ᾱg).

    Multiplications by A: one per CG or proportioning step, two per expansion step; by M_f: one
    per CG or expansion step.

    ===========================  =====================================
    reason                       when
    ===========================  =====================================
    None                         ``stop`` said so, before a step
    ``DIVERGED_ITS``             ``max_it`` steps are not enough
    ``DIVERGED_INDEFINITE_MAT``  a direction has no positive curvature
    ===========================  =====================================

    >>> import numpy as np
    >>> from tfeti_dolfinx.qp.feasible_sets import Bounds
    >>> A = PETSc.Mat().createDense((2, 2), array=np.diag([1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> x = PETSc.Vec().createWithArray(np.zeros(2), comm=PETSc.COMM_SELF)
    >>> g = PETSc.Vec().createWithArray(np.array([-3.0, 4.0]), comm=PETSc.COMM_SELF)  # Ax − b
    >>> state, steps = Iterate(A, x, g, Bounds()), Steps()
    >>> mprgp(state, MprgpParameters(0.9), lambda s: s.projected_gradient <= 1e-9, steps, 100)
    >>> x.array.round(6).tolist(), steps.inner > 0
    ([3.0, 0.0], True)

    Args:
        state: The iterate; holds the solution afterwards.
        parameters: Step length, Γ, expansion.
        stop: Called with the iterate before each step; True ends the loop.
        steps: Counts the steps.
        max_it: Most steps in ``steps``.
        monitor: Called after each step.

    Returns:
        None if ``stop`` ended the loop, else why it could not go on.
    """
    A, alpha_bar = state.A, parameters.alpha_bar
    x, g, p, Ap, z, beta = state.x, state.g, state.p, state.Ap, state.z, state.beta
    conjugate, pAp = False, 1.0
    while not stop(state):
        if steps.inner >= max_it:
            return ConvergedReason.DIVERGED_ITS
        # Step 1: is x strictly proportional?
        if state.chopped_squared <= parameters.gamma**2 * state.reduced_squared(alpha_bar):
            # Step 2: trial conjugate gradient step, z = M_f φ
            state.precondition()
            if conjugate:
                p.aypx(-z.dot(Ap) / pAp, z)
            else:
                z.copy(p)
            A.mult(p, Ap)
            pAp = p.dot(Ap)
            if not pAp > 0.0:
                return ConvergedReason.DIVERGED_INDEFINITE_MAT
            alpha_cg, alpha_f = g.dot(p) / pAp, state.max_step(p)
            if alpha_cg <= alpha_f:
                # Step 3: conjugate gradient step
                state.move(alpha_cg, p, Ap)
                state.split()
                conjugate = True
                steps.cg += 1
                monitor(steps, "cg", x, state.projected_gradient, -1.0)
                continue
            # Step 4: expansion step
            parameters.expansion(state, alpha_f, alpha_cg, alpha_bar)
            steps.expansion += 1
            kind = "expansion"
        else:
            # Step 5: proportioning step
            room = state.max_step(beta)
            if room < alpha_bar:
                cg = step_on_face(state, alpha_bar)
                steps.cg += cg
                if cg == 0:
                    projected_step(state, alpha_bar)
            else:
                A.mult(beta, Ap)
                bAb = beta.dot(Ap)
                if not bAb > 0.0:
                    return ConvergedReason.DIVERGED_INDEFINITE_MAT
                state.move(min(g.dot(beta) / bAb, room), beta, Ap)
            steps.proportioning += 1
            kind = "proportioning"
        state.split()
        conjugate = False
        monitor(steps, kind, x, state.projected_gradient, -1.0)
    return None
