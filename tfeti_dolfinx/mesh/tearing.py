"""Tearing: every subdomain gets vertices of its own."""

from __future__ import annotations

import logging

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import create_mesh_in_place
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.entities import NO_TAG, cell_facets, equal_pairs, facet_keys
from tfeti_dolfinx.mesh.pieces import absorb_fragments, split_disconnected
from tfeti_dolfinx.mesh.redistribute import redistribute
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import Exchange, offset_of

log = logging.getLogger(__name__)


def tear(
    untorn: UntornMesh, subdomain: Array, comm: MPI.Intracomm, absorb: bool = False
) -> Decomposition:
    """Tear a mesh along the interfaces of its subdomains. Collective.

    Args:
        untorn: This rank's share of the mesh.
        subdomain: Subdomain of each of its cells, numbered without holes.
        comm: Communicator of the torn mesh.
        absorb: Let fragments of a disconnected subdomain join a neighbour where they can.

    Returns:
        The torn mesh with its tags.
    """
    share, subdomain = redistribute(untorn, subdomain, comm)
    if absorb:
        subdomain = absorb_fragments(share, subdomain, comm)
        share, subdomain = redistribute(share, subdomain, comm)
    subdomain, split = split_disconnected(share, subdomain, comm)
    if split and comm.rank == 0:
        log.warning("subdomains that were not connected have been split: %s", split)
    mesh, node_ids = _torn_mesh(share, subdomain, comm)
    cell = _input_cells(mesh, len(share.cells))
    facets = cell_facets(mesh)
    facet_tags = _facet_tags(mesh, facets, share.facet_tags[cell])
    tears, boundary, pairs = _tears(mesh, facets, share, cell, subdomain[cell])
    return Decomposition(
        mesh=mesh,
        cell_tags=_cell_tags(mesh, share.cell_tags[cell]),
        facet_tags=facet_tags,
        names=share.names,
        cell_subdomain=subdomain[cell],
        original_cells=share.cell_ids[cell],
        original_nodes=node_ids,
        body_of_subdomain=_bodies(pairs, subdomain, comm),
        tears=tears,
        boundary=boundary,
        split=split,
    )


def _torn_mesh(
    share: UntornMesh, subdomain: Array, comm: MPI.Intracomm
) -> tuple[dmesh.Mesh, Array]:
    """The torn mesh, and the original id of each of its geometry nodes."""
    local = np.searchsorted(share.node_ids, share.cells)
    copies = subdomain[:, None].astype(np.int64) * max(len(share.node_ids), 1) + local
    copies, torn = np.unique(copies, return_inverse=True)
    node = copies % max(len(share.node_ids), 1)
    start = offset_of(comm, len(copies))
    cells = start + torn.reshape(share.cells.shape)
    mesh = create_mesh_in_place(comm, cells, share.x[node], share.element)
    return mesh, share.node_ids[node][mesh.geometry.input_global_indices - start]


def _input_cells(mesh: dmesh.Mesh, num_cells: int) -> Array:
    """Position of each local cell in the array that made the mesh."""
    return np.asarray(mesh.topology.original_cell_index) - offset_of(mesh.comm, num_cells)


def _cell_tags(mesh: dmesh.Mesh, tags: Array) -> dmesh.MeshTags:
    tagged = np.flatnonzero(tags != NO_TAG).astype(np.int32)
    meshtags = dmesh.meshtags(mesh, mesh.topology.dim, tagged, tags[tagged].astype(np.int32))
    meshtags.name = "cell_tags"
    return meshtags


def _facet_tags(mesh: dmesh.Mesh, facets_of_cells: Array, tags: Array) -> dmesh.MeshTags:
    tagged = tags != NO_TAG
    facets, first = np.unique(facets_of_cells[tagged], return_index=True)
    meshtags = dmesh.meshtags(
        mesh,
        mesh.topology.dim - 1,
        facets.astype(np.int32),
        tags[tagged][first].astype(np.int32),
    )
    meshtags.name = "facet_tags"
    return meshtags


def _tears(
    mesh: dmesh.Mesh, facets_of_cells: Array, share: UntornMesh, cell: Array, subdomain: Array
) -> tuple[Array, Array, Array]:
    """Facets on tears, facets on the true boundary, and pairs of subdomains that share a tear.

    Keys of all exterior facets meet on the rank that the key names.
    """
    mesh.topology.create_connectivity(mesh.topology.dim - 1, mesh.topology.dim)
    exterior = np.zeros(facets_of_cells.max(initial=-1) + 1, dtype=bool)
    exterior[dmesh.exterior_facet_indices(mesh.topology)] = True
    row, local = np.nonzero(exterior[facets_of_cells])
    facets = facets_of_cells[row, local]
    keys = facet_keys(share.cells[cell], share.cell_type)[row, local]
    exchange = Exchange(mesh.comm, (keys % np.uint64(mesh.comm.size)).astype(np.int64))
    owner = exchange.send(subdomain[row])
    first, second = equal_pairs(exchange.send(keys))
    torn = np.zeros(len(owner), dtype=bool)
    torn[first] = torn[second] = True
    is_tear = exchange.answer(torn)
    pairs = np.unique(np.sort(np.stack((owner[first], owner[second]), axis=1), axis=1), axis=0)
    return np.sort(facets[is_tear]), np.sort(facets[~is_tear]), pairs


def _bodies(pairs: Array, subdomain: Array, comm: MPI.Intracomm) -> Array:
    """Body of every subdomain, numbered by their lowest subdomains."""
    n = comm.allreduce(int(subdomain.max(initial=-1)), op=MPI.MAX) + 1
    edges = np.concatenate(comm.allgather(pairs))
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, body = connected_components(graph, directed=False)
    _, first = np.unique(body, return_index=True)
    return np.argsort(np.argsort(first))[body]
