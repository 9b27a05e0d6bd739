"""MPRGP and MPGP: gradient projection with proportioning and reduced steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    FaceOperator,
    Monitor,
    Operator,
    Steps,
    no_monitor,
)
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status, face_of

# --- Tangent and projected steps of MPGP ------------------------------------------------------

# Conjugate gradients on a face: what they reduce the residual to, and most of them. One more
# multiplication then brings the point back to the boundary. Measured on the cube of tresca_3d.py,
# 8 subdomains, reductions of 0.3, 0.1, 0.03: 125, 144, 158 multiplications.
REDUCTION, MOST_STEPS = 0.3, 30
# of the slope: what the cost must fall by for a step to be taken; of ‖g‖‖x‖: what is lost
# to rounding, since g does not vanish where the boundary is pushed against
ENOUGH, ROUNDING = 0.1, 1e-15
# of ‖β‖²: so much must be tangential for the face to be where work is left
TANGENTIAL = 0.5


class TangentIterate(Protocol):
    """Protocol of an iterate that tangent steps need."""

    A: Operator
    x: PETSc.Vec
    g: PETSc.Vec
    beta: PETSc.Vec
    feasible: FeasibleSet
    chopped_squared: float


def projected_step(state: TangentIterate, alpha_bar: float) -> None:
    """x ← P_Ω(x − ᾱg); multiplies by A once."""
    target = state.x.copy()
    target.array[:] = state.feasible.project(state.x.array_r - alpha_bar * state.g.array_r)
    step, image = target.copy(), target.duplicate()
    step.axpy(-1.0, state.x)
    state.A.mult(step, image)
    state.g.axpy(1.0, image)
    target.copy(state.x)
    for vec in (target, step, image):
        vec.destroy()


def step_on_face(state: TangentIterate, alpha_bar: float) -> int:
    """Newton's step on the face of x, by conjugate gradients, projected back. Collective.

    On the face Zt is free, and the cost of P_Ω(x + Zt) is gᵀZt + ½tᵀ(ZᵀAZ + diag κ)t to second
    order. The residual is brought down to 0.3, or as far as t stays in the face. Multiplies
    by A once more than there are steps.

    Args:
        state: The iterate; moved if the cost falls.
        alpha_bar: Fixed step length ᾱ, about 1/‖A‖.

    Returns:
        The conjugate gradient steps; 0 where little of β is tangential, or the cost does not fall.
    """
    comm, face = state.x.getComm().tompi4py(), state.feasible.face(state.x.array_r, state.g.array_r)
    on_face = face.Z.T @ state.beta.array_r
    if comm.allreduce(float(on_face @ on_face)) < TANGENTIAL * state.chopped_squared:
        return 0
    cg = _FaceGradients(state, face, alpha_bar)
    while cg.advance():
        pass
    target, image = state.x.duplicate(), state.x.duplicate()
    target.array[:] = state.feasible.project(state.x.array_r + cg.d.array_r)
    bend = target.copy()
    bend.axpy(-1.0, state.x)
    bend.axpy(-1.0, cg.d)
    state.A.mult(bend, image)
    image.axpy(1.0, cg.Ad)
    bend.axpy(1.0, cg.d)  # all of the step
    change = state.g.dot(bend) + 0.5 * bend.dot(image)
    allowed = ENOUGH * state.g.dot(cg.d) + ROUNDING * state.g.norm() * state.x.norm()
    falls = bcast_from_root(comm, bool(change <= allowed))
    if falls:
        state.g.axpy(1.0, image)
        target.copy(state.x)
    for item in (target, image, bend, cg):
        item.destroy()
    return cg.steps if falls else 0


class _FaceGradients:
    """Conjugate gradients for (ZᵀAZ + diag κ)t = −Zᵀg, scaled with 1/(1 + ᾱκ)."""

    def __init__(self, state: TangentIterate, face: Face, alpha_bar: float) -> None:
        self._state, self._face, self._comm = state, face, state.x.getComm().tompi4py()
        self._inside = face.status != Status.SLIP
        self._scale = 1.0 / (1.0 + alpha_bar * face.curvature)
        self.d, self.Ad, self._p, self._Ap = (state.x.duplicate() for _ in range(4))
        self.d.set(0.0)
        self.Ad.set(0.0)
        self._r = -(face.Z.T @ state.g.array_r)
        self._direction = self._scale * self._r
        self._rz, residual = self._sums(self._r, self._direction)
        self._target, self.steps = REDUCTION**2 * residual, 0

    def _sums(self, r: Array, z: Array) -> tuple[float, float]:
        rz, rr = self._comm.allreduce(np.array([r @ z, r @ r]))
        return float(rz), float(rr)

    def advance(self) -> bool:
        """One step; whether another one may follow."""
        Z, t = self._face.Z, self._direction
        self._p.array[:] = Z @ t
        self._state.A.mult(self._p, self._Ap)
        Ht = Z.T @ self._Ap.array_r + self._face.curvature * t
        curvature = float(self._comm.allreduce(float(t @ Ht)))
        if not curvature > 0.0:
            return False
        wanted, room = self._rz / curvature, self._room()
        length = min(wanted, room)
        self.d.axpy(length, self._p)
        self.Ad.axpy(length, self._Ap)
        self.steps += 1
        self._r -= length * Ht
        z, before = self._scale * self._r, self._rz
        self._rz, residual = self._sums(self._r, z)
        self._direction = z + self._rz / before * t
        return wanted <= room and residual > self._target and self.steps < MOST_STEPS

    def _room(self) -> float:
        """Return the largest feasible step along p, rows that do not slip alone."""
        x = self._state.x.array_r + self.d.array_r
        p = np.where(self._inside, self._p.array_r, 0.0)
        own = self._state.feasible.max_step(np.where(self._inside, x, self._state.x.array_r), -p)
        return float(self._comm.allreduce(own, op=MPI.MIN))

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self.d, self.Ad, self._p, self._Ap):
            vec.destroy()


# --- Preconditioning in face ------------------------------------------------------------------


class MaskedPreconditioner:
    """z = I_f(P M_f P + ρ⁻¹Q)φ, I_f the rows that hold: nearly (I_f(PFP + ρQ)I_f)⁻¹φ.

    Conjugate gradients stay on the face, and bounds are kept, because z is 0 where φ is. M_f is
    made anew when the face has changed (Dostál, Optimal Quadratic Programming Algorithms,
    Springer 2009, section 5.10: preconditioning in face).

    Args:
        make: Makes M_f, an approximate inverse of F on a face.
        coarse: P and Q of all rows.
        rho: Penalty ρ.
        like: A vector of the right layout.
    """

    def __init__(
        self,
        make: Callable[[Face], FaceOperator],
        coarse: Coarse,
        rho: float,
        like: PETSc.Vec,
    ) -> None:
        self._make, self._coarse, self._rho = make, coarse, rho
        self._comm = like.getComm().tompi4py()
        self._open: Array | None = None
        self._on_face: FaceOperator | None = None
        self._Qphi, self._work = like.duplicate(), like.duplicate()

    def apply(self, face: Face, phi: PETSc.Vec, z: PETSc.Vec) -> None:
        """z for the free gradient φ on a face. Collective.

        Raises:
            InputError: φ is not 0 where the face does not hold.
            FactorError: M_f could not be made.
        """
        M_f = self._of(face, phi)
        self._coarse.apply_Q(phi, self._Qphi)
        phi.copy(self._work)
        self._work.axpy(-1.0, self._Qphi)
        M_f.mult(self._work, z)
        self._coarse.apply_Q(z, self._work)
        z.axpy(-1.0, self._work)
        z.axpy(1.0 / self._rho, self._Qphi)
        z.array[self._open] = 0.0

    def _of(self, face: Face, phi: PETSc.Vec) -> FaceOperator:
        """M_f, the present one if the face is the same on all ranks."""
        changed = self._open is None or not np.array_equal(self._open, ~face.holding)
        if self._on_face is None or any_rank(self._comm, changed):
            self._leave()
            self._open = ~face.holding
            if any_rank(self._comm, bool(np.any(phi.array_r[self._open] != 0.0))):
                raise InputError(
                    "preconditioning in face: the free gradient of the feasible set is not 0 on "
                    "rows that are open or slip at its face; expected a set that splits "
                    "gradients as its face says, or pc_type none"
                )
            self._on_face = self._make(face_of(face.holding, face.status))
        return self._on_face

    def _leave(self) -> None:
        if self._on_face is not None:
            self._on_face.destroy()
            self._on_face = None

    def destroy(self) -> None:
        """Destroy M_f and the work vectors. Collective."""
        self._leave()
        self._Qphi.destroy()
        self._work.destroy()


def masked(qp: QP, rho: float) -> MaskedPreconditioner | None:
    """Return the preconditioner of PFP + ρQ on faces of a program; None if it has none."""
    if qp.preconditioner_on is None:
        return None
    return MaskedPreconditioner(qp.preconditioner_on, qp.coarse, rho, qp.d)


# --- MPRGP and MPGP ---------------------------------------------------------------------------

StoppingTest = Callable[["MprgpIterate"], bool]
Expansion = Callable[["MprgpIterate", float, float, float], None]


class MprgpIterate:
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
        """Return the largest α with x − α p ∈ Ω."""
        own = self.feasible.max_step(self.x.array_r, p.array_r)
        return float(self._comm.allreduce(own, op=MPI.MIN))

    def face(self) -> Face:
        """Return the face of x."""
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


def fixed_step(state: MprgpIterate, alpha_f: float, alpha_cg: float, alpha_bar: float) -> None:
    """Expansion by a step −ᾱφ from the face's edge, projected (Dostál, Schöberl 2005)."""
    state.move(alpha_f, state.p, state.Ap)
    state.project(state.x)
    state.split()
    target = state.x.copy()
    target.axpy(-alpha_bar, state.phi)
    state.project(target)
    state.move_to(target)
    target.destroy()


def projected_cg(state: MprgpIterate, alpha_f: float, alpha_cg: float, alpha_bar: float) -> None:
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
    state: MprgpIterate,
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
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> A = PETSc.Mat().createDense((2, 2), array=np.diag([1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> x = PETSc.Vec().createWithArray(np.zeros(2), comm=PETSc.COMM_SELF)
    >>> g = PETSc.Vec().createWithArray(np.array([-3.0, 4.0]), comm=PETSc.COMM_SELF)  # Ax − b
    >>> state, steps = MprgpIterate(A, x, g, Bounds()), Steps()
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
