"""An iterate in physical terms: how far bodies move, and what its rows miss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.closing import closing
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.operator import trace_slices
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.subdomains.block import Block

# of the largest forces on a kernel mode: those on a light one beside it count as so large at least,
# since the rounding of the largest reaches them
LIGHT = 1e-4


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
        stiffness: Trace of K on the trace unknowns.
    """

    size: Array
    elastic: Array
    energy: Array
    correction: Array
    correction_energy: Array
    change: Array
    alone: Array
    stiffness: Array


@dataclass(frozen=True)
class Measures:
    """An iterate in physical terms; the same on all ranks but for the displacements.

    Attributes:
        u: Displacements of this rank's Blocks.
        bodies: What is known of each body.
        penetration: Deepest overlap, or distance of a row that carries a force.
        balance: Force left on a kernel mode, where it is largest beside the forces there.
        forces: Size of these forces.
        residual: Norm of what rows miss.
        gap: Largest gap of a contact row, or overlap.
    """

    u: list[Array]
    bodies: BodyMeasures
    penetration: float
    balance: float
    forces: float
    residual: float
    gap: float

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
    where they overlap. v, the least displacement in D that closes that, makes u + v admissible;
    so ‖v‖_K bounds the error of u in energy, as far as λ balances the load.

    Args:
        scene: The dual problem.
        lam: The multipliers λ.
        gradient: Fλ − d up to the range of Gᵀ.
        error: How large multipliers may be by the solver's error alone.
        before: Displacements of an earlier iterate.
    """
    u = scene.recover(lam, gradient, error)
    w, penetration, gap = _missed(scene, u)
    residual, bounded = w.norm(), scene.constraints.inequalities
    closed = scene.carrying[bounded] | (w.array_r[bounded] > 0.0)
    bodies = _bodies(scene, u, closing(scene.constraints, w, closed), before)
    balance, forces = _balance(scene.coarse, lam)
    w.destroy()
    return Measures(u, bodies, penetration, balance, forces, residual, gap)


def _missed(scene: Scene, u: list[Array]) -> tuple[PETSc.Vec, float, float]:
    """w, and as lengths the largest of its inequality rows and the largest of their gaps."""
    constraints = scene.constraints
    trace, w = constraints.B.createVecRight(), constraints.c.duplicate()
    for block, part, u_s in zip(scene.blocks, trace_slices(scene.blocks), u, strict=True):
        trace.array[part] = u_s[block.trace_dofs]
    constraints.B.mult(trace, w)
    w.axpy(-1.0, constraints.c)
    bounded = constraints.inequalities
    rows = w.array[bounded]
    rows[:] = np.where(scene.carrying[bounded], rows, np.maximum(rows, 0.0))
    lengths = np.abs((rows, constraints.c.array_r[bounded])) / constraints.scale
    trace.destroy()
    largest = np.max(lengths, axis=1, initial=0.0)
    w.getComm().tompi4py().Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    return w, float(largest[0]), float(largest[1])


def _bodies(scene: Scene, u: list[Array], v: Array, before: Sequence[Array] | None) -> BodyMeasures:
    """What is known of each body. Collective."""
    comm, count = scene.coarse.comm, scene.num_bodies
    motions = scene.coarse.bodies
    rigid = motions.amounts(motions.part_of(u, scene.blocks))
    sums, largest = np.zeros((3, count)), np.zeros((5, count))
    slices = trace_slices(scene.blocks)
    for s, (block, part, body) in enumerate(
        zip(scene.blocks, slices, scene.body_of_block, strict=True)
    ):
        diagonal = block.diagonal
        sums[:, body] += block.energy(u[s]), diagonal @ v[part] ** 2, diagonal.sum()
        change = u[s] - before[s] if before is not None else np.zeros(0)
        elastic = u[s] - block.modes @ rigid[body]
        fields = (u[s], elastic, v[part], change, block.condensed_load)
        sizes = [np.max(np.abs(field), initial=0.0) for field in fields]
        largest[:, body] = np.maximum(largest[:, body], sizes)
    comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    size, elastic, correction, change, alone = largest
    return BodyMeasures(size, elastic, sums[0], correction, sums[1], change, alone, sums[2])


def _balance(coarse: CoarseSpace, lam: PETSc.Vec) -> tuple[float, float]:
    """Entry of Gλ − e that is largest beside the forces on its mode, and those. Collective."""
    if coarse.dimension == 0:
        return 0.0, 0.0
    forces = np.asarray(abs(coarse.Gt).T @ np.abs(lam.array_r))
    coarse.comm.Allreduce(MPI.IN_PLACE, forces, op=MPI.SUM)
    forces = np.maximum(forces, LIGHT * forces.max())
    left = np.abs(coarse.G(lam.array_r) - coarse.e)
    worst = int(np.argmax(left / np.maximum(forces, 1e-300)))
    return float(left[worst]), float(forces[worst])
