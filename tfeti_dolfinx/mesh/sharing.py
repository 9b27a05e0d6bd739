"""Nodes of the untorn mesh that bodies have in common: they meet there, but share no facet."""

from __future__ import annotations

import numpy as np
from dolfinx import mesh as dmesh

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import geometry_dofmap
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.parallel import Exchange


def shared_by_bodies(decomposition: Decomposition) -> tuple[Array, Array]:
    """Pairs of bodies with nodes in common, and how many; the same on all ranks. Collective.

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
    every = np.concatenate(comm.allgather(own))
    pairs, place = np.unique(every, axis=0, return_inverse=True)
    counts = np.zeros(len(pairs), dtype=np.int64)
    np.add.at(counts, place.ravel(), np.concatenate(comm.allgather(count)))
    return pairs, counts
