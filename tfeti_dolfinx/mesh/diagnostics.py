"""Quality of cells, and nodes that bodies share."""

from __future__ import annotations

import basix
import numpy as np
from dolfinx import mesh as dmesh

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.parallel import Exchange
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.untorn import cell_entities

# --- Quality of cells -------------------------------------------------------------------------

# columns: the edges of a regular simplex that leave its first vertex
REGULAR = {
    "triangle": np.array([[1.0, 0.5], [0.0, 0.75**0.5]]),
    "tetrahedron": np.array(
        [[1.0, 0.5, 0.5], [0.0, 0.75**0.5, 12**-0.5], [0.0, 0.0, (2 / 3) ** 0.5]]
    ),
}


def flatness(mesh: dmesh.Mesh) -> Array:
    """‖J‖‖J⁻¹‖/gdim of each local cell, in Frobenius norms: 1 for a regular one, shape ``(c,)``.

    J is the map from a regular cell, in its middle. A box whose longest edge is a times its
    shortest has about a/2; cells without volume have as much as a float can be.
    """
    cell_type = mesh.topology.cell_type
    cell = getattr(basix.CellType, cell_type.name)
    corners = geometry_dofmap(mesh)[:, : len(cell_entities(cell_type, 0))]
    gdim = mesh.geometry.dim
    element = basix.create_element(basix.ElementFamily.P, cell, 1)
    middle = basix.geometry(cell).mean(axis=0)[None]
    slopes = element.tabulate(1, middle)[1:, 0, :, 0]
    J = np.einsum("dv,cvg->cgd", slopes, mesh.geometry.x[corners, :gdim])
    if cell_type.name in REGULAR:
        J = J @ np.linalg.inv(REGULAR[cell_type.name])
    return np.asarray(np.minimum(np.linalg.cond(J, "fro") / gdim, 1.0 / TINY))


# --- Nodes that bodies share without a common facet -------------------------------------------


def shared_by_bodies(decomposition: Decomposition) -> tuple[Array, Array]:
    """Return pairs of bodies with nodes in common, and how many; the same on all ranks. Collective.

    Returns:
        The pairs, shape ``(p, 2)``, and the numbers, shape ``(p,)``.
    """
    comm, mesh = decomposition.comm, decomposition.mesh
    if decomposition.num_bodies == 1:
        return np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64)
    geometry = geometry_dofmap(mesh)
    body = np.zeros(len(decomposition.original_nodes), dtype=np.int64)
    body[geometry] = decomposition.body_of_subdomain[decomposition.cell_subdomain][:, None]
    fdim = mesh.topology.dim - 1
    mesh.topology.create_connectivity(fdim, fdim + 1)
    facets = decomposition.boundary
    node = np.empty(0, dtype=np.int32)  # DOLFINx does not bear quadrilaterals without a cell
    if len(facets):
        node = np.unique(dmesh.entities_to_geometry(mesh, fdim, facets))
    ids = decomposition.original_nodes[node].astype(np.int64)
    exchange = Exchange(comm, ids % comm.size)
    met = np.stack((exchange.send(ids), exchange.send(body[node])), axis=1)
    met = np.unique(met, axis=0)
    same = met[1:, 0] == met[:-1, 0]
    local = np.stack((met[:-1, 1], met[1:, 1]), axis=1)[same]
    own, count = np.unique(local, axis=0, return_counts=True)  # few pairs, however many nodes
    every, counts = map(np.concatenate, zip(*comm.allgather((own, count)), strict=True))
    pairs, place = np.unique(every, axis=0, return_inverse=True)
    return pairs, np.bincount(place.ravel(), counts, minlength=len(pairs)).astype(np.int64)
