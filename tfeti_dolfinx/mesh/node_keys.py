"""What all torn copies of a node have in common: a key, and the rank of the lowest subdomain."""

from __future__ import annotations

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import geometry_dofmap
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.entities import cell_entities, mix, set_key
from tfeti_dolfinx.parallel import Exchange


def lowest_owners(comm: MPI.Intracomm, key: Array, subdomain: Array) -> Array:
    """For each key the rank that sends it with the lowest subdomain. Collective."""
    exchange = Exchange(comm, (key % np.uint64(comm.size)).astype(np.int64))
    key, subdomain = exchange.send(key), exchange.send(subdomain)
    order = np.lexsort((subdomain, key))
    _, start, inverse = np.unique(key[order], return_index=True, return_inverse=True)
    owner = np.empty(len(key), dtype=np.int64)
    owner[order] = exchange.source[order][start][inverse]
    return exchange.answer(owner)


def node_keys(V: fem.FunctionSpace, decomposition: Decomposition) -> tuple[Array, Array]:
    """For each DOLFINx node its lowest original vertex, and a key that all copies share.

    The key comes from the vertices of the mesh entity that the node belongs to; where an entity
    has several nodes, their relative distances to its vertices tell them apart.
    """
    mesh = V.mesh
    cell_type = mesh.topology.cell_type
    geometry = geometry_dofmap(mesh)[:, : len(cell_entities(cell_type, 0))]
    ids = decomposition.original_nodes[geometry]
    dofs = np.asarray(V.dofmap.list)
    origin = np.empty(V.dofmap.index_map.size_local, dtype=np.int64)
    key = np.empty(len(origin), dtype=np.uint64)
    for dim, entity_dofs in enumerate(V.element.basix_element.entity_dofs):
        for vertices, entity in zip(cell_entities(cell_type, dim), entity_dofs, strict=True):
            for j in entity:
                nodes = dofs[:, j]
                origin[nodes] = ids[:, vertices].min(axis=1)
                key[nodes] = set_key(ids[:, vertices])
                if len(entity) > 1:
                    corners = mesh.geometry.x[geometry[:, vertices]]
                    key[nodes] += _place(V, nodes, corners, ids[:, vertices])
    return origin, key


def _place(V: fem.FunctionSpace, nodes: Array, corners: Array, ids: Array) -> Array:
    """Key of a node's place within an entity: its relative distances to the sorted vertices."""
    x = V.tabulate_dof_coordinates()[nodes]
    distance = np.linalg.norm(corners - x[:, None], axis=2)
    distance = np.take_along_axis(distance, np.argsort(ids, axis=1), axis=1)
    share = np.rint(1e6 * distance / distance.sum(axis=1, keepdims=True))
    return mix((share * (1 + np.arange(share.shape[1]))).sum(axis=1).astype(np.uint64))
