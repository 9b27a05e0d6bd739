"""Tear a mesh along its subdomains, which ranks share by numbers of cells."""

import logging
from dataclasses import replace
from weakref import WeakSet

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.compat import create_mesh_in_place
from tfeti_dolfinx.common.parallel import Exchange, bcast_from_root, count_over, offset_of, summed
from tfeti_dolfinx.common.validation import is_whole, shown
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.cell_graph import CellGraph
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.partition import (
    DEFAULT,
    UNKNOWNS,
    GivenSubdomains,
    connected_parts,
    given_subdomains,
    make_parts,
)
from tfeti_dolfinx.mesh.untorn import NO_TAG, UntornMesh, cell_facets

TORN: WeakSet[dmesh.Mesh] = WeakSet()  # meshes torn here: their bodies are in pieces

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


def moved(
    mesh: UntornMesh, rank: Array, values: Array, comm: MPI.Intracomm
) -> tuple[UntornMesh, Array]:
    """Send every cell, and its row of values, to a rank: return the new share. Collective."""
    if comm.size == 1:
        return mesh, values
    # nodes that go to each rank, each once, and the places of the cells' nodes among them
    count, rank = max(len(mesh.node_ids), 1), rank.astype(np.int64)
    pairs, place = np.unique(rank[:, None] * count + mesh.cells, return_inverse=True)
    to, node = np.divmod(pairs, count)
    place = place.reshape(mesh.cells.shape) - np.searchsorted(to, rank)[:, None]
    of_cells, of_nodes = Exchange(comm, rank), Exchange(comm, to)
    node_ids, first, merged = np.unique(
        of_nodes.send(mesh.node_ids[node]), return_index=True, return_inverse=True
    )
    place = of_cells.send(place) + np.searchsorted(of_nodes.source, of_cells.source)[:, None]
    share = replace(
        mesh,
        cells=merged.ravel()[place],
        node_ids=node_ids,
        x=of_nodes.send(mesh.x[node])[first],
        cell_ids=of_cells.send(mesh.cell_ids),
        cell_tags=of_cells.send(mesh.cell_tags),
        facet_tags=of_cells.send(mesh.facet_tags),
    )
    return share, of_cells.send(values)


# --- Tearing ----------------------------------------------------------------------------------

log = logging.getLogger(__name__)


def decomposed(
    untorn: UntornMesh,
    subdomains: GivenSubdomains | None,
    partitioner: str,
    comm: MPI.Intracomm,
    spread: bool = False,
) -> Decomposition:
    """Tear a mesh into a number of subdomains, or those given for its cells. Collective.

    None stands for subdomains of about 4000 displacement unknowns. ``spread`` shares out the cells
    among ranks at first, where one rank has read them.
    """
    total = count_over(comm, len(untorn.cells))
    if subdomains is None:
        per_cell = {"triangle": 0.5, "tetrahedron": 0.2}.get(untorn.cell_type.name, 1.0)
        gdim = untorn.x.shape[1]
        per_cell *= gdim * untorn.element.degree**gdim
        subdomains = max(1, round(total * per_cell / UNKNOWNS))
    number = int(subdomains) if is_whole(subdomains) else 0
    if is_whole(subdomains) and not 1 <= number <= total:
        raise InputError(
            f"subdomains={number}: expected between 1 and {total}, the number of cells"
        )
    if number == 0 and partitioner != DEFAULT:
        raise InputError(
            f"partitioner={shown(partitioner)} with the subdomain of each cell; expected the "
            "number of subdomains that it makes"
        )
    subdomain = np.zeros(len(untorn.cells), dtype=np.int64)
    if number == 0:
        subdomain = given_subdomains(untorn, subdomains, comm)
    if spread and comm.size > 1:
        rank = bisect_points(untorn.midpoints(), comm.size, comm)
        untorn, subdomain = moved(untorn, rank, subdomain, comm)
    graph = CellGraph(untorn, comm)
    if number:
        subdomain = make_parts(untorn, graph, number, partitioner)
    pieces = graph.pieces(subdomain)
    of_piece, split, body = connected_parts(pieces, absorb=number > 0)
    if split and comm.rank == 0:
        log.info("subdomains in several pieces have been split, which does no harm: %s", split)
    return tear(untorn, graph, of_piece[pieces.of_cell], body, split)


def tear(
    untorn: UntornMesh, graph: CellGraph, subdomain: Array, body: Array, split: dict[int, list[int]]
) -> Decomposition:
    """Tear a mesh along the interfaces of its subdomains, each on one rank then. Collective.

    These are connected, and numbered without holes. ``body`` is that of each, ``split`` as of a
    ``Decomposition``.
    """
    comm = graph.comm
    terms = np.column_stack((np.ones(len(subdomain)), untorn.midpoints()))
    sums = summed(comm, sum_rows(subdomain, terms, len(body)))
    ranks = bcast_from_root(comm, deal(sums[:, 0], sums[:, 1:] / sums[:, :1], comm.size))
    on_boundary = graph.across == np.arange(graph.num_cells)[:, None]
    values = np.column_stack((subdomain, on_boundary))
    share, values = moved(untorn, ranks[subdomain], values, comm)
    subdomain, on_boundary = values[:, 0], values[:, 1:] > 0
    order = np.lexsort((share.cell_ids, subdomain))
    # nodes of the torn mesh: one copy for each subdomain
    count = max(len(share.node_ids), 1)
    corners = subdomain[order, None] * count + share.cells[order]
    copies, cells = np.unique(corners, return_inverse=True)
    node, start = copies % count, offset_of(comm, len(copies))
    cells = start + cells.reshape(share.cells.shape)
    mesh = create_mesh_in_place(comm, cells, share.x[node], share.element)
    TORN.add(mesh)
    cell = order[np.asarray(mesh.topology.original_cell_index) - offset_of(comm, len(cells))]
    facets, tdim = cell_facets(mesh), mesh.topology.dim
    boundary = np.sort(facets[on_boundary[cell]])
    mesh.topology.create_connectivity(tdim - 1, tdim)
    tears = np.setdiff1d(dmesh.exterior_facet_indices(mesh.topology), boundary)
    return Decomposition(
        mesh=mesh,
        cell_tags=_tagged(mesh, tdim, np.arange(len(cell)), share.cell_tags[cell], "cell_tags"),
        facet_tags=_tagged(mesh, tdim - 1, facets, share.facet_tags[cell], "facet_tags"),
        names=share.names,
        cell_subdomain=subdomain[cell],
        original_cells=share.cell_ids[cell],
        original_nodes=share.node_ids[node][mesh.geometry.input_global_indices - start],
        body_of_subdomain=body,
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
