"""An iterate in physical terms: how far bodies move, and what its rows miss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import TINY, Array, sums
from tfeti_dolfinx.dual.closing import closing
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.recovery import missed
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# of the largest forces on a kernel mode: those on a light one beside it count as so large at least,
# since the rounding of the largest reaches them; and that rounding, which is nobody's to mend
LIGHT, ROUNDING = 1e-4, 1e-13


class Scene(Protocol):
    """What a measurement needs to know of the dual problem."""

    constraints: Constraints
    subdomains: Subdomains
    coarse: CoarseSpace
    pressing: Array
    feasible: FeasibleSet

    def recover(self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, error: float) -> Array:
        """This rank's part of u, given the solver's face and error. Collective."""
        ...


@dataclass(frozen=True)
class BodyMeasures:
    """What is known of each body at an iterate, arrays of shape ``(bodies,)``; on all ranks.

    Attributes:
        size: Largest displacement of a node, as a length.
        elastic: The same but for a rigid motion.
        energy: uᵀKu.
        correction: Largest displacement v that closes jumps and overlaps.
        correction_energy: vᵀ diag(K) v, its diagonal as in D the mean at each node.
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
        u: This rank's part of the displacement, shape ``(n,)``.
        bodies: What is known of each body.
        penetration: Deepest overlap, distance of a row that carries a force, or slip that friction
            does not allow.
        balance: Force left on a kernel mode, where it is largest beside the forces there.
        forces: Size of these forces.
        residual: Norm of what rows miss.
        gap: Largest gap of a contact row, or overlap.
        begin: Largest slip that friction counts from.
    """

    u: Array
    bodies: BodyMeasures
    penetration: float
    balance: float
    forces: float
    residual: float
    gap: float
    begin: float

    @property
    def error(self) -> float:
        """Norm of the correction in energy, over all bodies."""
        return float(np.sqrt(self.bodies.correction_energy.sum()))


def measure(
    scene: Scene,
    lam: PETSc.Vec,
    gradient: PETSc.Vec,
    face: Face,
    norm: float,
    error: float,
    before: Array | None = None,
) -> Measures:
    """Recover the displacement of an iterate and see how well it fulfils the rows. Collective.

    Rows miss w = Bu − c: rows of equalities and those that press both ways, others where they
    overlap, or as far as a force on them says that they are not open, min(c − Bu, ‖F‖λ), tangential
    ones what of the slip their force does not allow. v, the least displacement
    in D that closes that, makes u + v admissible; so ‖v‖_K bounds the error of u in energy, as far
    as λ balances the load.

    Args:
        scene: The dual problem.
        lam: The multipliers λ.
        gradient: Fλ − d up to the range of Gᵀ.
        face: The face of λ.
        norm: ‖F‖, or an estimate.
        error: How large multipliers may be by the solver's error alone.
        before: The displacement of an earlier iterate.
    """
    u = scene.recover(lam, gradient, face, error)
    w, (penetration, gap, begin) = _missed(scene, u, lam, norm)
    constraints = scene.constraints
    residual, normals = w.norm(), constraints.sets.normals
    closed = scene.pressing[normals] | (w.array_r[normals] != 0.0)
    closed = np.concatenate((closed, constraints.limits.ravel() > 0.0))
    bodies = _bodies(scene, u, closing(constraints, w, closed), before)
    balance, forces = _balance(scene.coarse, lam)
    w.destroy()
    return Measures(u, bodies, penetration, balance, forces, residual, gap, begin)


def _missed(scene: Scene, u: Array, lam: PETSc.Vec, norm: float) -> tuple[PETSc.Vec, Array]:
    """w, and as lengths the largest of its contact rows, of their gaps and slips at first."""
    constraints = scene.constraints
    w = missed(constraints, u[scene.subdomains.trace])
    normals = constraints.sets.normals
    rows = w.array_r[normals]
    # an open row whose force is not gone yet: of distance and force, as a length, the smaller
    still = _missed_by(scene, lam.array_r, normals, np.minimum(rows, 0.0), norm)
    rows = np.where(scene.pressing[normals] | (rows > 0.0), rows, still)
    w.array[normals] = rows
    lengths = np.abs((rows, constraints.c.array_r[normals])) / constraints.scale
    largest = np.append(np.max(lengths, axis=1, initial=0.0), 0.0)
    tangents = constraints.sets.tangents
    if tangents.size:
        slip = w.array_r[tangents]
        w.array[tangents] = _missed_by(scene, lam.array_r, tangents, slip, norm)
        rows = np.stack((w.array_r[tangents], constraints.c.array_r[tangents]))
        length = np.linalg.norm(rows, axis=2) / constraints.tangent_scale
        largest[[0, 2]] = np.maximum(largest[[0, 2]], length.max(axis=1))
    w.getComm().tompi4py().Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
    return w, largest


def _missed_by(scene: Scene, lam: Array, rows: Array, values: Array, norm: float) -> Array:
    """What of gaps or slips is not normal to the set of forces where the force is.

    A force of a normal allows no gap, but 0 does. A force inside its disc allows no slip, one on
    the circle only a slip that it opposes: then τ is P(τ + q/‖F‖), and ‖F‖ times the difference is
    the slip that is missed. Where it is less than q, no force within the disc makes more of a slip
    than that.

    Args:
        scene: The dual problem.
        lam: The multipliers.
        rows: Local rows, any shape.
        values: Their gaps, negative, or slips, scaled, of the same shape.
        norm: ‖F‖, or an estimate.
    """
    moved = np.array(lam)
    moved[rows] += values / norm
    return np.asarray(norm * (scene.feasible.project(moved) - lam)[rows])


def _bodies(scene: Scene, u: Array, v: Array, before: Array | None) -> BodyMeasures:
    """What is known of each body. Collective."""
    subdomains, motions = scene.subdomains, scene.coarse.bodies
    rigid = subdomains.modes_motion(motions.amounts(motions.part_of(u)))
    change = u - before if before is not None else np.zeros_like(u)
    trace, diagonal = subdomains.trace_parts, subdomains.diagonal
    energy, correction_energy, stiffness = subdomains.body_sums(
        [subdomains.energies(u), sums(diagonal * v**2, trace), sums(diagonal, trace)]
    )
    size, elastic, correction, changed, alone = subdomains.body_maxima(
        [
            subdomains.sizes(u),
            subdomains.sizes(u - rigid),
            subdomains.sizes(subdomains.extended(v)),
            subdomains.sizes(change),
            subdomains.sizes(subdomains.extended(subdomains.pinv_load[subdomains.trace])),
        ]
    )
    return BodyMeasures(
        size=size,
        elastic=elastic,
        energy=energy,
        correction=correction,
        correction_energy=correction_energy,
        change=changed,
        alone=alone,
        stiffness=stiffness,
    )


def _balance(coarse: CoarseSpace, lam: PETSc.Vec) -> tuple[float, float]:
    """Entry of Gλ − e that is largest beside the forces on its mode, and those. Collective."""
    if coarse.dimension == 0:
        return 0.0, 0.0
    forces = coarse.terms(lam)
    most = forces.max()
    forces = np.maximum(forces, LIGHT * most)
    left = np.maximum(np.abs(coarse.G(lam.array_r) - coarse.e) - ROUNDING * most, 0.0)
    worst = int(np.argmax(left / np.maximum(forces, TINY)))
    return float(left[worst]), float(forces[worst])
