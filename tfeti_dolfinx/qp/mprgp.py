"""MPRGP and MPGP: gradient projection with proportioning and reduced steps."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import dot_over, least, summed
from tfeti_dolfinx.qp.problem import ConvergedReason, Monitor, Operator, Steps, no_monitor
from tfeti_dolfinx.qp.sets import FeasibleSet, Status, face_at


@dataclass(frozen=True)
class MprgpParameters:
    """Parameters of MPRGP."""

    alpha_bar: float  # fixed step length ᾱ, in (0, 2/‖A‖]
    gamma: float = 1.0  # Γ > 0 of the proportioning test
    # of ‖β‖²: so much must be tangential for the face to be where work is left
    tangential: float = 0.5
    # what conjugate gradients on a face reduce their residual to: one more multiplication then
    # brings the point back to the boundary
    reduction: float = 0.3
    most_steps: int = 30  # most of them
    enough: float = 0.1  # of the slope: what the cost must fall by for a step on a face to be taken
    # of ‖g‖‖x‖: what the cost may be wrong by, as g does not vanish where the boundary is pushed
    # against
    rounding: float = 1e-15


class MprgpIterate:
    """An iterate x ∈ Ω of min ½xᵀAx − bᵀx, with its gradient g = Ax − b and its parts.

    Attributes:
        face: That of x and g.
        phi: Free gradient φ.
        beta: Chopped gradient β.
        chopped_squared: ‖β‖².
        projected_gradient: ‖g^P‖ = ‖φ + β‖.
    """

    def __init__(
        self, A: Operator, x: Array, g: Array, feasible: FeasibleSet, comm: MPI.Intracomm
    ) -> None:
        self.A, self.x, self.g, self.feasible, self.comm = A, x, g, feasible, comm
        self.split()

    def split(self) -> None:
        """Find φ and β at x. Collective."""
        self.face = face_at(self.feasible, self.x, self.g)
        self.phi, self.beta = np.where(self.face.free, self.g, 0.0), self.face.beta
        squares = dot_over(self.comm, (self.phi, self.phi), (self.beta, self.beta))
        self.chopped_squared, self.projected_gradient = squares[1], sum(squares) ** 0.5

    def is_proportional(self, parameters: MprgpParameters) -> bool:
        """Return whether ‖β‖² ≤ Γ² φ̃ᵀφ, φ̃ = (x − P_Ω(x − ᾱφ))/ᾱ. Collective."""
        x, phi, alpha = self.x, self.phi, parameters.alpha_bar
        trial = x - alpha * phi
        projected = self.feasible.project(trial)
        own = float(np.where(projected == trial, phi, (x - projected) / alpha) @ phi)
        (square,) = summed(self.comm, np.array([own]))
        return bool(self.chopped_squared <= parameters.gamma**2 * square)

    def move_to(self, target: Array) -> None:
        """x ← P_Ω(target); multiplies by A once. Collective."""
        projected = self.feasible.project(target)
        self.g = self.g + self.A(projected - self.x)
        self.x = projected  # x + p rounds: what is on its bound stays there


def step_on_face(state: MprgpIterate, parameters: MprgpParameters) -> int:
    """Newton's step on the face of x, by conjugate gradients, projected back. Collective.

    On the face Zt is free, and the cost of P_Ω(x + Zt) is gᵀZt + ½tᵀ(ZᵀAZ + diag κ)t to second
    order. The residual is brought down to ``reduction``, or as far as t stays in the face.
    Multiplies by A once more than there are steps. Return the conjugate gradient steps; 0 where
    little of β is tangential, or the cost does not fall.
    """
    x, g, comm, face = state.x, state.g, state.comm, state.face
    Z, kappa, inside = face.Z, face.bends, face.status != Status.SLIP
    on_face = Z.T @ state.beta
    if dot_over(comm, (on_face, on_face))[0] < parameters.tangential * state.chopped_squared:
        return 0
    # Step 1: (ZᵀAZ + diag κ)t = −Zᵀg, scaled with 1/(1 + ᾱκ)
    scale = 1.0 / (1.0 + parameters.alpha_bar * kappa)
    r, d, Ad, steps = -(Z.T @ g), np.zeros_like(x), np.zeros_like(x), 0
    t = z = scale * r
    rz, residual = dot_over(comm, (r, z), (r, r))
    target, wanted, room = parameters.reduction**2 * residual, 0.0, np.inf
    while wanted <= room and residual > target and steps < parameters.most_steps:
        p = Z @ t
        Ap = state.A(p)
        Ht = Z.T @ Ap + kappa * t
        (curvature,) = dot_over(comm, (t, Ht))
        if not curvature > 0.0:
            break
        # rows that do not slip keep the face
        up = np.where(inside, -p, 0.0)
        room = least(comm, state.feasible.max_step(np.where(inside, x + d, x), up))
        wanted = rz / curvature
        length = min(wanted, room)
        d, Ad, r = d + length * p, Ad + length * Ap, r - length * Ht
        z, before = scale * r, rz
        rz, residual = dot_over(comm, (r, z), (r, r))
        t = z + rz / before * t
        steps += 1
    # Step 2: back to the boundary, where the cost falls
    target_x = state.feasible.project(x + d)
    step = target_x - x
    image = Ad + state.A(step - d)
    slope, change, gg, xx = dot_over(comm, (g, d), (g + 0.5 * image, step), (g, g), (x, x))
    if change > parameters.enough * slope + parameters.rounding * np.sqrt(gg * xx):
        return 0
    state.g, state.x = state.g + image, target_x
    return steps


def mprgp(
    state: MprgpIterate,
    parameters: MprgpParameters,
    stop: Callable[[MprgpIterate], bool],
    steps: Steps,
    max_it: int,
    monitor: Monitor = no_monitor,
) -> ConvergedReason | None:
    """Minimise ½xᵀAx − bᵀx on Ω, from ``state`` on and in place. Collective.

    Dostál, Schöberl, Comput. Optim. Appl. 30 (2005) 23–43; Dostál, Optimal Quadratic
    Programming Algorithms, Springer 2009, section 5.8, whose steps are numbered here. Where Ω has
    curved sets it is MPGP (Dostál, Kozubek, Math. Program. 135 (2012) 195–220): a proportioning
    step of less than ᾱ along −β would do nothing. A step on the face takes its place, tangents of
    the boundary included, or P_Ω(x − ᾱg).

    Multiplications by A: one per CG or proportioning step, two per expansion step.

    ===========================  =====================================
    reason                       when
    ===========================  =====================================
    None                         ``stop`` said so, before a step
    ``DIVERGED_ITS``             ``max_it`` steps are not enough
    ``DIVERGED_INDEFINITE_MAT``  a direction has no positive curvature
    ===========================  =====================================

    >>> import numpy as np
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> A, x, g = np.diag([1.0, 2.0]).__matmul__, np.zeros(2), np.array([-3.0, 4.0])  # g = Ax − b
    >>> state, steps = MprgpIterate(A, x, g, Bounds(), MPI.COMM_SELF), Steps()
    >>> mprgp(state, MprgpParameters(0.9), lambda s: s.projected_gradient <= 1e-9, steps, 100)
    >>> state.x.round(6).tolist(), steps.inner > 0
    ([3.0, 0.0], True)
    """
    A, alpha_bar, comm = state.A, parameters.alpha_bar, state.comm
    p = Ap = np.zeros_like(state.x)
    conjugate, pAp = False, 1.0
    while not stop(state):
        if steps.inner >= max_it:
            return ConvergedReason.DIVERGED_ITS
        # Step 1: is x strictly proportional?
        if state.is_proportional(parameters):
            # Step 2: trial conjugate gradient step
            p = state.phi - dot_over(comm, (state.phi, Ap))[0] / pAp * p if conjugate else state.phi
            Ap = A(p)
            pAp, gp = dot_over(comm, (p, Ap), (state.g, p))
            if not pAp > 0.0:
                return ConvergedReason.DIVERGED_INDEFINITE_MAT
            alpha_cg, alpha_f = gp / pAp, least(comm, state.feasible.max_step(state.x, p))
            conjugate, alpha = alpha_cg <= alpha_f, min(alpha_cg, alpha_f)
            state.x, state.g = state.x - alpha * p, state.g - alpha * Ap
            if conjugate:
                # Step 3: conjugate gradient step
                steps.cg += 1
                kind = "cg"
            else:
                # Step 4: expansion step: to the edge of the face, then by −ᾱφ, projected
                state.x = state.feasible.project(state.x)
                state.split()
                state.move_to(state.x - alpha_bar * state.phi)
                steps.expansion += 1
                kind = "expansion"
        else:
            # Step 5: proportioning step
            beta, conjugate = state.beta, False
            room = least(comm, state.feasible.max_step(state.x, beta))
            if room < alpha_bar:
                cg = step_on_face(state, parameters)
                steps.cg += cg
                if cg == 0:
                    state.move_to(state.x - alpha_bar * state.g)
            else:
                Ab = A(beta)
                bAb, gb = dot_over(comm, (beta, Ab), (state.g, beta))
                if not bAb > 0.0:
                    return ConvergedReason.DIVERGED_INDEFINITE_MAT
                alpha = min(gb / bAb, room)
                state.x, state.g = state.x - alpha * beta, state.g - alpha * Ab
            steps.proportioning += 1
            kind = "proportioning"
        state.split()
        monitor(steps, kind, state.x, state.projected_gradient, -1.0)
    return None
