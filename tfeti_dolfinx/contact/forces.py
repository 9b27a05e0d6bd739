"""Contact forces on nodes, surfaces and bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from dolfinx.fem.petsc import interpolation_matrix
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.parallel import summed
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import hat_integrals


@dataclass(frozen=True)
class Resultant:
    """Resultant of forces on nodes, the same on all ranks.

    Attributes:
        force: Shape ``(gdim,)``, of each body ``(bodies, gdim)``; with a thickness, that on all of
            it.
        moment: About the origin, shape ``(3,)`` or ``(bodies, 3)``; in 2D only its last component
            is not 0. In finite strain forces act where nodes are, at X + u, else at X.
    """

    force: Array
    moment: Array


def resultant(comm: MPI.Intracomm, points: Array, forces: Array) -> Resultant:
    """Resultant of forces, ``(n, gdim)``, at points of this rank, ``(n, 3)``. Collective."""
    own = summed(comm, np.sum(_with_moments(points, forces), axis=0))
    return Resultant(own[:-3], own[-3:])


def _with_moments(points: Array, forces: Array) -> Array:
    """Return forces and their moments about the origin, shape ``(n, gdim + 3)``."""
    spatial = np.zeros((len(forces), 3))
    spatial[:, : forces.shape[1]] = forces
    return np.column_stack((forces, np.cross(points, spatial)))


def condition_areas(
    records: ContactRecords, dofs: TornDofs, surfaces: list[str | int], thickness: Any = 1.0
) -> Array:
    """∫φ_i of each condition, ``(n,)``, times a number or a scalar in UFL. Collective.

    Where a pair covers a part of the node's surface, the thickness is its mean over the whole.
    """
    if isinstance(thickness, float):
        return thickness * records.area
    volume = hat_integrals(dofs, surfaces, thickness)[records.group]
    return records.area * volume / hat_integrals(dofs, surfaces)[records.group]


def body_forces(points: Array, forces: Array, dofs: TornDofs) -> Resultant:
    """Resultants of forces on the owned groups, which are at these points. Collective."""
    lowest = dofs.copy_subdomains[dofs.copy_offsets[:-1]]
    body, num_bodies = dofs.decomposition.body_of_subdomain[lowest], dofs.decomposition.num_bodies
    sums = summed(dofs.comm, sum_rows(body, _with_moments(points, forces), num_bodies))
    return Resultant(sums[:, : forces.shape[1]], sums[:, forces.shape[1] :])


def vertex_tractions(
    forces: Array, dofs: TornDofs, names: list[str | int], thickness: Any = 1.0
) -> tuple[Array, Array]:
    """Tractions whose moments with the hats of degree 1 are those of nodal forces. Collective.

    Return force / ∫φ_i for each owned group that is a vertex of the surfaces of these names, else
    0, shape ``(g, gdim)``; and ∫φ_i, times the thickness, shape ``(g,)``.
    """
    area = hat_integrals(dofs, names, thickness)
    if dofs.V.element.basix_element.degree > 1:
        forces = _on_hats(forces, dofs)
    on_surface = (area > 0.0)[:, None]
    return np.divide(forces, area[:, None], out=np.zeros_like(forces), where=on_surface), area


def _on_hats(forces: Array, dofs: TornDofs) -> Array:
    """Return moments with the hats of degree 1: Πᵀf, Π the interpolation from degree 1."""
    W, node = dofs.hats
    S, dof = dofs.scalar
    interpolation = interpolation_matrix(W, S)
    interpolation.assemble()
    source, target = interpolation.createVecLeft(), interpolation.createVecRight()
    share = dofs.spread(forces / dofs.multiplicity[:, None])
    result = np.zeros_like(share)
    for component in range(forces.shape[1]):
        source.array[dof] = share[:, component]
        interpolation.multTranspose(source, target)
        result[node, component] = target.array_r
    for item in (source, target, interpolation):
        item.destroy()
    return dofs.reduce(result, np.add, 0.0)
