"""How right the displacement of an iterate is, and when a solver may stop for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.operator import trace_slices
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.problem import ConvergedReason
from tfeti_dolfinx.subdomains.block import Block

# Differences that are rounding, in a body that hardly moves as well: of the largest displacement
# of all bodies; of what its load does to its subdomains alone, if that is held where it acts.
NOISE, LOAD_NOISE = 1e-13, 1e-14
# the first look is taken at this power of rtol, to learn how far things move
FIRST_LOOK = 0.5
# a new tolerance aims a little below what was asked for; it never falls by more than LEAP at
# once, since the size of the displacement may have been learnt from a poor iterate
AIM, LEAP = 0.5, 1e-6
# a true residual that fell by fewer digits than this share of those that the solver's own fell by
# has stalled: once, and the gradient is made anew; twice, and rounding has the last word
STALL = 0.5
# of what rounding leaves of a residual: nothing comes down to that
OUT_OF_REACH = 1e-4


class Scene(Protocol):
    """What a measurement needs to know of the dual problem."""

    constraints: Constraints
    blocks: Sequence[Block]
    coarse: CoarseSpace
    body_of_block: Array
    num_bodies: int
    carrying: Array

    def recover(self, lam: PETSc.Vec, gradient: PETSc.Vec, error: float) -> list[Array]:
        """Displacements of this rank's Blocks, given the solver's error. Collective."""
        ...


@dataclass(frozen=True)
class BodyMeasures:
    """What is known of each body at an iterate, arrays of shape ``(bodies,)``; on all ranks.

    Attributes:
        size: Largest displacement.
        elastic: Largest displacement but for a rigid motion.
        energy: uᵀKu.
        correction: Largest displacement v that closes jumps and overlaps.
        correction_energy: vᵀ diag(K) v.
        change: Largest change since the iterate before, or 0.
        alone: Largest displacement K⁺f of the trace.
    """

    size: Array
    elastic: Array
    energy: Array
    correction: Array
    correction_energy: Array
    change: Array
    alone: Array


@dataclass(frozen=True)
class Measures:
    """An iterate in physical terms; the same on all ranks but for the displacements.

    Attributes:
        u: Displacements of this rank's Blocks.
        bodies: What is known of each body.
        penetration: Deepest overlap, or distance of a row that carries a force.
        balance: Largest force left on a kernel mode.
        forces: Size of the forces that act on a kernel mode.
        residual: Norm of what rows miss.
    """

    u: list[Array]
    bodies: BodyMeasures
    penetration: float
    balance: float
    forces: float
    residual: float

    @property
    def error(self) -> float:
        """Norm of the correction in energy, over all bodies."""
        return float(np.sqrt(self.bodies.correction_energy.sum()))


def measure(
    scene: Scene,
    lam: PETSc.Vec,
    gradient: PETSc.Vec,
    error: float,
    before: Sequence[Array] | None = None,
) -> Measures:
    """Recover the displacement of an iterate and see how well it fulfils the rows. Collective.

    Rows miss w = Bu − c: rows of equalities and those that carry a force both ways, others
    where they overlap. v = D⁻¹Bᵀw closes that (rows are orthonormal in D⁻¹), and u + v is
    admissible; so ‖v‖_K bounds the error of u in energy, as far as λ balances the load.

    Args:
        scene: The dual problem.
        lam: The multipliers λ.
        gradient: Fλ − d up to the range of Gᵀ.
        error: How large multipliers may be by the solver's error alone.
        before: Displacements of an earlier iterate.
    """
    u = scene.recover(lam, gradient, error)
    w, penetration = _missed(scene, u)
    v = scene.constraints.B.createVecRight()
    scene.constraints.B.multTranspose(w, v)
    residual = w.norm()
    bodies = _bodies(scene, u, v.array_r / scene.constraints.weights, before)
    balance, forces = _balance(scene.coarse, lam)
    for vec in (w, v):
        vec.destroy()
    return Measures(u, bodies, penetration, balance, forces, residual)


def _missed(scene: Scene, u: list[Array]) -> tuple[PETSc.Vec, float]:
    """w, and the largest of its inequality rows as a length."""
    constraints = scene.constraints
    trace, w = constraints.B.createVecRight(), constraints.c.duplicate()
    for block, part, u_s in zip(scene.blocks, trace_slices(scene.blocks), u, strict=True):
        trace.array[part] = u_s[block.trace_dofs]
    constraints.B.mult(trace, w)
    w.axpy(-1.0, constraints.c)
    bounded = constraints.inequalities
    rows = w.array[bounded]
    rows[:] = np.where(scene.carrying[bounded], rows, np.maximum(rows, 0.0))
    lengths = np.abs(rows) / constraints.scale
    trace.destroy()
    deepest = float(np.max(lengths, initial=0.0))
    return w, float(w.getComm().tompi4py().allreduce(deepest, op=MPI.MAX))


def _bodies(scene: Scene, u: list[Array], v: Array, before: Sequence[Array] | None) -> BodyMeasures:
    """What is known of each body. Collective."""
    comm, count = scene.coarse.comm, scene.num_bodies
    motions = scene.coarse.bodies
    rigid = motions.amounts(motions.part_of(u, scene.blocks))
    sums, largest = np.zeros((2, count)), np.zeros((5, count))
    slices = trace_slices(scene.blocks)
    for s, (block, part, body) in enumerate(
        zip(scene.blocks, slices, scene.body_of_block, strict=True)
    ):
        sums[:, body] += block.energy(u[s]), block.diagonal @ v[part] ** 2
        change = u[s] - before[s] if before is not None else np.zeros(0)
        elastic = u[s] - block.modes @ rigid[body]
        fields = (u[s], elastic, v[part], change, block.condensed_load)
        sizes = [np.max(np.abs(field), initial=0.0) for field in fields]
        largest[:, body] = np.maximum(largest[:, body], sizes)
    comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    size, elastic, correction, change, alone = largest
    return BodyMeasures(size, elastic, sums[0], correction, sums[1], change, alone)


def _balance(coarse: CoarseSpace, lam: PETSc.Vec) -> tuple[float, float]:
    """Largest entry of Gλ − e, and what it is compared with. Collective."""
    if coarse.dimension == 0:
        return 0.0, 0.0
    squares = (coarse.Gt.multiply(coarse.Gt)).sum(axis=0)
    squares = np.ascontiguousarray(squares, dtype=float).ravel()
    coarse.comm.Allreduce(MPI.IN_PLACE, squares, op=MPI.SUM)
    left = np.abs(coarse.G(lam.array_r) - coarse.e).max()
    return float(left), float(np.sqrt(squares.max()) * lam.norm())


@dataclass(frozen=True)
class Tolerances:
    """What an answer has to keep, in physical units.

    Attributes:
        displacement: Error of u for each body, a length, shape ``(bodies,)``.
        jump: Jumps at tears, and distances from Dirichlet values.
        penetration: Overlaps, and distances where a force acts.
        balance: Force left on a kernel mode.
    """

    displacement: Array
    jump: float
    penetration: float
    balance: float


class Accuracy:
    """Stops a solver when the displacement of each body is right to rtol, in the maximum norm.

    A body's error is estimated as what closes its jumps, plus what that does in energy, turned
    into a displacement by the ratio of the two that the solution itself and its last change have
    shown. Stiffness, units and gaps that stay open do not enter. Residuals only decide when to
    look: the first look is taken early, to learn how far things move. Creation is not
    collective; ``examine`` is, and costs one solve in each subdomain.

    Args:
        scene: The dual problem.
        rtol: Relative tolerance of displacements and forces.
        atol: A length that errors may have whatever moves.
        reference: b₀, the norm of the residual at the start.
        rounding: What rounding leaves of a residual at least.
        norm: ‖F‖, or an estimate; residuals over it are errors of multipliers.

    Attributes:
        rtol: Relative tolerance.
        tolerance: Norm of the residuals from which on one looks (again).
        drifted: Whether the solver's gradient has to be made anew.
        measures: What the last look has seen.
        looks: How many looks there were.
    """

    def __init__(
        self,
        scene: Scene,
        rtol: float,
        atol: float,
        reference: float,
        rounding: float,
        norm: float = 1.0,
    ) -> None:
        self._scene, self.rtol, self._atol = scene, rtol, atol
        self._rounding, self._norm = rounding, norm or 1.0
        self._before: Measures | None = None
        self.tolerance = max(rtol**FIRST_LOOK * reference, atol, rounding)
        self.drifted, self.looks, self._stalls, self._claimed = False, 0, 0, 1.0
        self.measures: Measures | None = None

    def look(self, lam: PETSc.Vec, gradient: PETSc.Vec, residual: float) -> Measures:
        """Measure an iterate. Collective."""
        before, error = self.measures, residual / self._norm
        self.measures = measure(self._scene, lam, gradient, error, before.u if before else None)
        self.looks += 1
        self._before = before
        return self.measures

    def examine(self, lam: PETSc.Vec, gradient: PETSc.Vec, residual: float) -> ConvergedReason:
        """Whether an iterate is right. Collective."""
        now = self.look(lam, gradient, residual)
        comm = self._scene.coarse.comm
        ratio, longest = agreed(comm, (self.ratio(), self._longest(now)))
        if ratio <= 1.0:
            return ConvergedReason.CONVERGED_RTOL
        if longest <= self._atol:
            return ConvergedReason.CONVERGED_ATOL
        tolerance = residual * max(AIM / ratio, LEAP)
        self._stalls = self._stalls + 1 if agreed(comm, self._stalled(now, residual)) else 0
        if self._stalls > 1 or agreed(comm, tolerance < OUT_OF_REACH * self._rounding):
            return ConvergedReason.DIVERGED_ROUNDING
        self.drifted = self._stalls > 0
        self.tolerance, self._claimed = tolerance, residual
        return ConvergedReason.ITERATING

    def _stalled(self, now: Measures, residual: float) -> bool:
        """Whether the true residual lags behind the one that the solver claims."""
        if self._before is None or self._before.residual == 0.0:
            return False
        claimed = residual / self._claimed
        return now.residual / self._before.residual > claimed**STALL

    @property
    def balance(self) -> float:
        """Largest force left on a kernel mode at the last look."""
        return self._looked().balance

    @property
    def u(self) -> list[Array]:
        """Displacements of this rank's Blocks at the last look."""
        return self._looked().u

    def errors(self) -> Array:
        """Estimated errors of u at the last look, a length for each body, shape ``(bodies,)``."""
        now, before = self._looked(), self._before
        bodies, energy = now.bodies, np.sqrt(np.maximum(now.bodies.energy, 0.0))
        own = np.sqrt(bodies.correction_energy)
        shown = np.divide(bodies.elastic, energy, out=np.zeros_like(energy), where=energy > 0.0)
        estimate = shown * own
        if before is not None and before.error > 0.0:
            estimate = np.maximum(estimate, bodies.change * (now.error / before.error))
        return np.asarray(estimate + bodies.correction)

    def tolerances(self) -> Tolerances:
        """What the last look is compared with."""
        now = self._looked()
        noise = NOISE * now.bodies.size.max(initial=0.0) + LOAD_NOISE * now.bodies.alone
        displacement = self.rtol * now.bodies.size + noise
        largest = float(displacement.max(initial=0.0))
        balance = max(self.rtol, NOISE) * now.forces
        return Tolerances(displacement, 2.0 * largest, 2.0 * largest, balance)

    def ratio(self) -> float:
        """What must be at most 1: the largest of all errors over their tolerances."""
        now, allowed = self._looked(), self.tolerances()
        pairs = [
            *zip(self.errors(), allowed.displacement, strict=True),
            (now.penetration, allowed.penetration),
            (now.balance, allowed.balance),
        ]
        return max(float(error) / max(float(limit), 1e-300) for error, limit in pairs)

    def relative_error(self) -> float:
        """Largest estimated error of a body over its largest displacement."""
        noise = self.tolerances().displacement / max(self.rtol, NOISE)
        errors = self.errors()
        return float(np.max(errors / np.maximum(noise, 1e-300), initial=0.0))

    def _longest(self, now: Measures) -> float:
        return max(float(now.bodies.correction.max(initial=0.0)), now.penetration)

    def _looked(self) -> Measures:
        if self.measures is None:
            raise RuntimeError("nothing has been measured yet")
        return self.measures
