"""Tear a mesh along its subdomains, which ranks share by numbers of cells."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.compat import create_mesh_in_place
from tfeti_dolfinx.common.parallel import Exchange, bcast_from_root, offset_of, summed
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.partition import absorb_fragments, bisect_points, split_disconnected
from tfeti_dolfinx.mesh.untorn import (
    NO_TAG,
    UntornMesh,
    cell_facets,
    equal_pairs,
    exchange_by_key,
    facet_keys,
)

# --- Subdomains on ranks ----------------------------------------------------------------------


def deal(weights: Array, centres: Array, num_ranks: int) -> Array:
    """Return the rank of each subdomain: neighbouring subdomains in chunks of about equal weight.

    The weights are their numbers of cells, shape ``(N,)``, the centres ``(N, gdim)``. Each rank has
    a subdomain if there are enough of them.
    """
    n = len(weights)
    order = np.argsort(bisect_points(centres, n, MPI.COMM_SELF), kind="stable")
    sorted_weights = weights[order]
    middle = np.cumsum(sorted_weights) - 0.5 * sorted_weights
    position = np.arange(n)
    rank = np.floor(middle / sorted_weights.sum() * num_ranks).astype(np.int64)
    rank = np.clip(rank, num_ranks - n + position, position)
    rank = np.minimum.accumulate(rank - position) + position
    ranks = np.empty(n, dtype=np.int32)
    ranks[order] = np.clip(rank, 0, num_ranks - 1)
    return ranks


def redistribute(
    mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm
) -> tuple[UntornMesh, Array]:
    """Send every cell to the rank of its subdomain. Collective.

    Return the share after the move, cells sorted by subdomain and then original id, and their
    subdomains, shape ``(n,)`` as before.
    """
    num = comm.allreduce(int(subdomain.max(initial=-1)), op=MPI.MAX) + 1
    terms = np.column_stack((np.ones(len(subdomain)), mesh.midpoints()))
    sums = summed(comm, sum_rows(subdomain, terms, num))
    ranks = bcast_from_root(comm, deal(sums[:, 0], sums[:, 1:] / sums[:, :1], comm.size))
    destination = ranks[subdomain]
    exchange = Exchange(comm, destination)
    per_cell = ("cells", "cell_ids", "cell_tags", "facet_tags")
    moved = {name: exchange.send(getattr(mesh, name)) for name in per_cell}
    subdomain = exchange.send(subdomain)
    order = np.lexsort((moved["cell_ids"], subdomain))
    # the nodes of the cells that arrive
    local = np.searchsorted(mesh.node_ids, mesh.cells)
    count = max(len(mesh.node_ids), 1)
    rank, node = np.divmod(np.unique(destination[:, None].astype(np.int64) * count + local), count)
    exchange = Exchange(comm, rank)
    node_ids, first = np.unique(exchange.send(mesh.node_ids[node]), return_index=True)
    share = replace(
        mesh,
        node_ids=node_ids,
        x=exchange.send(mesh.x[node])[first],
        **{name: values[order] for name, values in moved.items()},
    )
    return share, subdomain[order]


# --- Tearing ----------------------------------------------------------------------------------

log = logging.getLogger(__name__)


def tear(
    untorn: UntornMesh, subdomain: Array, comm: MPI.Intracomm, absorb: bool = False
) -> Decomposition:
    """Tear this rank's share of a mesh along the interfaces of its subdomains. Collective.

    These are numbered without holes. ``absorb`` lets fragments of a disconnected subdomain join a
    neighbour where they can.
    """
    share, subdomain = redistribute(untorn, subdomain, comm)
    if absorb:
        subdomain = absorb_fragments(share, subdomain, comm)
        share, subdomain = redistribute(share, subdomain, comm)
    subdomain, split = split_disconnected(share, subdomain, comm)
    if split and comm.rank == 0:
        log.warning("subdomains that were not connected have been split: %s", split)
    # nodes of the torn mesh: one copy for each subdomain
    stride = max(len(share.node_ids), 1)
    local = np.searchsorted(share.node_ids, share.cells)
    copies, torn = np.unique(subdomain[:, None] * stride + local, return_inverse=True)
    node, start = copies % stride, offset_of(comm, len(copies))
    cells = start + torn.reshape(share.cells.shape)
    mesh = create_mesh_in_place(comm, cells, share.x[node], share.element)
    cell = np.asarray(mesh.topology.original_cell_index) - offset_of(comm, len(cells))
    facets = cell_facets(mesh)
    tears, boundary, pairs = _tears(mesh, facets, share, cell, subdomain[cell])
    tdim = mesh.topology.dim
    return Decomposition(
        mesh=mesh,
        cell_tags=_tagged(mesh, tdim, np.arange(len(cell)), share.cell_tags[cell], "cell_tags"),
        facet_tags=_tagged(mesh, tdim - 1, facets, share.facet_tags[cell], "facet_tags"),
        names=share.names,
        cell_subdomain=subdomain[cell],
        original_cells=share.cell_ids[cell],
        original_nodes=share.node_ids[node][mesh.geometry.input_global_indices - start],
        body_of_subdomain=_bodies(pairs, subdomain, comm),
        tears=tears,
        boundary=boundary,
        split=split,
    )


def _tagged(mesh: dmesh.Mesh, dim: int, entities: Array, tags: Array, name: str) -> dmesh.MeshTags:
    """Tags of those entities that have one."""
    tagged = tags != NO_TAG
    found, first = np.unique(entities[tagged], return_index=True)
    values = tags[tagged][first].astype(np.int32)
    meshtags = dmesh.meshtags(mesh, dim, found.astype(np.int32), values)
    meshtags.name = name
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
    exchange = exchange_by_key(mesh.comm, keys)
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
