"""Steps of MPGP on curved sets: along the face with its tangents, and projected ones."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.faces import Face, Status
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.problem import Operator

# Conjugate gradients on a face: what they reduce the residual to, and most of them. One more
# multiplication then brings the point back to the boundary. Measured on the cube of tresca_3d.py,
# 8 subdomains, reductions of 0.3, 0.1, 0.03: 125, 144, 158 multiplications.
REDUCTION, MOST_STEPS = 0.3, 30
# of the slope: what the cost must fall by for a step to be taken; of ‖g‖‖x‖: what is lost
# to rounding, since g does not vanish where the boundary is pushed against
ENOUGH, ROUNDING = 0.1, 1e-15
# of ‖β‖²: so much must be tangential for the face to be where work is left
TANGENTIAL = 0.5


class Point(Protocol):
    """What is asked of an iterate."""

    A: Operator
    x: PETSc.Vec
    g: PETSc.Vec
    beta: PETSc.Vec
    feasible: FeasibleSet
    chopped_squared: float


def projected_step(state: Point, alpha_bar: float) -> None:
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


def step_on_face(state: Point, alpha_bar: float) -> int:
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
    falls = agreed(comm, bool(change <= allowed))
    if falls:
        state.g.axpy(1.0, image)
        target.copy(state.x)
    for item in (target, image, bend, cg):
        item.destroy()
    return cg.steps if falls else 0


class _FaceGradients:
    """Conjugate gradients for (ZᵀAZ + diag κ)t = −Zᵀg, scaled with 1/(1 + ᾱκ)."""

    def __init__(self, state: Point, face: Face, alpha_bar: float) -> None:
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
        """How far rows that do not slip may go along p."""
        x = self._state.x.array_r + self.d.array_r
        p = np.where(self._inside, self._p.array_r, 0.0)
        own = self._state.feasible.max_step(np.where(self._inside, x, self._state.x.array_r), -p)
        return float(self._comm.allreduce(own, op=MPI.MIN))

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self.d, self.Ad, self._p, self._Ap):
            vec.destroy()
