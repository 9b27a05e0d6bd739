"""Tear a mesh along its subdomains, which ranks share by cost."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import permutations

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import create_mesh_in_place
from tfeti_dolfinx.common.parallel import Exchange, bcast_from_root, offset_of, summed
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.partition import absorb_fragments, bisect_points, split_disconnected
from tfeti_dolfinx.mesh.untorn import NO_TAG, UntornMesh, cell_facets, equal_pairs, facet_keys

# --- Equality of subdomains up to a translation -----------------------------------------------

# Of the size of a subdomain, in what is measured of its shape: less is rounding of coordinates,
# more another shape. The root keeps regular grids, which are rational, off the middle between
# two roundings.
SHAPE = 1e-6 * np.sqrt(2.0)


def measured(
    x: Array, tags: Array, subdomain: Array, num: int, comm: MPI.Intracomm
) -> tuple[Array, Array, Array]:
    """Return the number of cells of each subdomain, centre and shape. Collective.

    Args:
        x: Midpoints of this rank's cells, shape ``(n, gdim)``.
        tags: Their material tags.
        subdomain: Their subdomains.
        num: Number of subdomains, N.
        comm: Communicator.

    Returns:
        Shapes ``(N,)``, ``(N, gdim)`` and ``(N, q)``; what is in the last depends neither on the
        place nor on the order of the cells.
    """
    sums = _sums(np.column_stack((np.ones(len(x)), x)), subdomain, num, comm)
    cells, centres = sums[:, 0], sums[:, 1:] / sums[:, :1]
    moments = _sums(_moments(x - centres[subdomain], tags), subdomain, num, comm)
    return cells, centres, _scaled(moments / sums[:, :1], x.shape[1])


def alike(*columns: Array) -> Array:
    """Return a number for each subdomain, the same for those that agree up to ``SHAPE``.

    Args:
        columns: What must agree, shapes ``(N,)`` or ``(N, q)``.
    """
    keys = np.rint(np.column_stack(columns) / SHAPE).astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def bare_sides(
    mesh: UntornMesh, subdomain: Array, cells: Array, centres: Array, comm: MPI.Intracomm
) -> Array:
    """Compute moments of each subdomain's sides that no row will touch. Collective.

    They are facets of one cell only, without a tag: there is nothing to glue, to prescribe or to
    meet. Equal subdomains with the same ones are likely to share S, too.

    Args:
        mesh: This rank's share of the untorn mesh.
        subdomain: Subdomain of each local cell.
        cells: Cells of each subdomain, shape ``(N,)``.
        centres: Their centres, shape ``(N, gdim)``.
        comm: Communicator.

    Returns:
        Moments of the cells with such facets, shape ``(N, q)``.
    """
    sides = np.sum(_is_outer(mesh, comm) & (mesh.facet_tags == NO_TAG), axis=1)
    some = np.flatnonzero(sides)
    of_cells = _moments(mesh.midpoints()[some] - centres[subdomain[some]], np.ones(len(some)))
    moments = _sums(sides[some, None] * of_cells, subdomain[some], len(centres), comm)
    return _scaled(moments / cells[:, None], centres.shape[1])


def _is_outer(mesh: UntornMesh, comm: MPI.Intracomm) -> Array:
    """Return whether facets of cells are facets of no other cell, shape ``(n, num_facets)``."""
    keys = facet_keys(mesh.cells, mesh.cell_type)
    outer = _occur_once(keys.ravel())
    own = keys.ravel()[outer]
    exchange = Exchange(comm, (own % np.uint64(comm.size)).astype(np.int64))
    outer[outer] = exchange.answer(_occur_once(exchange.send(own)))
    return outer.reshape(keys.shape)


def _occur_once(keys: Array) -> Array:
    """Return flags of those that no other one is equal to."""
    order = np.argsort(keys)  # not stable: that takes four times as long
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    once = np.ones(len(keys), dtype=bool)
    once[order[same]] = once[order[same + 1]] = False
    return once


def _moments(d: Array, tags: Array) -> Array:
    """Return moments of cells at d from their subdomain's centre; sums tell shapes apart.

    Degrees 2 and 3 tell mirrored ones from each other, the degree 4 more; tags stand for moduli.
    """
    gdim = d.shape[1]
    pairs = [d[:, i] * d[:, j] for i in range(gdim) for j in range(i, gdim)]
    square = np.sum(d**2, axis=1)
    material = np.sin(tags.astype(float))  # any number of its own for each tag
    return np.column_stack((*pairs, square[:, None] * d, square**2, material, material * square))


def _scaled(moments: Array, gdim: int) -> Array:
    """Mean moments without their units; lengths are those of the largest subdomain."""
    pairs = gdim * (gdim + 1) // 2
    degree = np.array([2] * pairs + [3] * gdim + [4, 0, 2])
    length = np.sqrt(np.max(np.abs(moments[:, :pairs]), initial=0.0)) or 1.0  # of single cells 0
    return np.asarray(moments / length**degree)


def _sums(values: Array, subdomain: Array, num: int, comm: MPI.Intracomm) -> Array:
    """Return sums over the cells of each subdomain. Collective."""
    total = np.zeros((num, values.shape[1]))
    np.add.at(total, subdomain, values)
    return summed(comm, total)


# --- Assignment of subdomains to ranks --------------------------------------------------------

# Of the time and memory of a subdomain that has factors of its own: what one more costs that
# shares them. 0.32 was measured for plane squares of 10 000 nodes, 0.26 for cubes of 2197.
SHARED = 0.3
# Beside what K⁺ and S of a subdomain with factors of its own cost each: what is done for each,
# equal or not, as assembly, gluing and vectors are; roughly, of the same squares and cubes.
ALIKE = 0.12
# sides of a box that are so many times shorter than the longest may be cut across as early as it,
# where ranks cost less by that part
LONG, GAIN = 4.0, 0.02
# of costs beside their mean: those that differ by less are the same but for rounding
DIGITS = 9


def dealt(mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm) -> Array:
    """Return the rank of each subdomain, by what it is likely to cost. Collective.

    Subdomains that look equal but for a translation will share a factor, unless a modulus that
    only the forms know tells them apart, or options do; then ranks are balanced less well.

    Args:
        mesh: This rank's share of the untorn mesh.
        subdomain: Subdomain of each local cell, shape ``(n,)``.
        comm: Communicator.

    Returns:
        Ranks, shape ``(N,)``, the same on all ranks.
    """
    num = comm.allreduce(int(subdomain.max(initial=-1)), op=MPI.MAX) + 1
    if comm.size == 1:
        return np.zeros(num, dtype=np.int32)
    cells, centres, shapes = measured(mesh.midpoints(), mesh.cell_tags, subdomain, num, comm)
    kinds = bcast_from_root(comm, alike(cells, shapes))
    if len(np.unique(kinds)) == num:
        return bcast_from_root(comm, deal(cells, centres, comm.size))
    seen = alike(kinds, bare_sides(mesh, subdomain, cells, centres, comm))
    return deal_shared(cells, centres, (kinds, seen), comm.size, comm)


def deal_shared(
    cells: Array, centres: Array, shared: Sequence[Array], num_ranks: int, comm: MPI.Intracomm
) -> Array:
    """Return rank of each subdomain, in that of a few orders in which ranks share most. Collective.

    Args:
        cells: Cells of each subdomain, shape ``(N,)``.
        centres: Their centres, shape ``(N, gdim)``.
        shared: As for ``dearest``; by the first of them ranks get chunks of equal cost.
        num_ranks: Number of ranks.
        comm: Communicator of those that try; each tries its part of the orders.

    Returns:
        Ranks, shape ``(N,)``, the same on all ranks.
    """
    orders, weights = _orders(centres), costs(cells, shared[0])
    own = range(comm.rank, len(orders), comm.size)
    found = {i: deal(weights, orders[i][0], num_ranks) for i in own}
    tried = [
        (dearest(ranks, cells, shared, num_ranks) * orders[i][1], i) for i, ranks in found.items()
    ]
    _, best = comm.allreduce(min(tried, default=(np.inf, -1)), op=MPI.MIN)
    return np.asarray(comm.bcast(found.get(best), root=best % comm.size))


def _orders(centres: Array) -> list[tuple[Array, float]]:
    """Return coordinates to bisect by, and how much worse each is for the sake of short interfaces.

    Which of several sides that are as long as each other is cut across first is for the order of
    axes to say; sides that are a little shorter are made as long, too.
    """
    sides = np.ptp(centres, axis=0)
    longest = sides.max() or 1.0
    even = centres / np.where(LONG * sides >= longest, sides, longest)
    axes = [list(order) for order in permutations(range(centres.shape[1]))]
    return [
        (x[:, order], worse) for x, worse in ((centres, 1.0), (even, 1.0 + GAIN)) for order in axes
    ]


def costs(cells: Array, kinds: Array) -> Array:
    """Return the cost of subdomains in cells; equal ones share that of their factor.

    Args:
        cells: Cells of each subdomain, shape ``(N,)``.
        kinds: A number for each, the same for equal ones, shape ``(N,)``.
    """
    equal = np.bincount(kinds)[kinds]
    return np.asarray(cells * (SHARED + (1.0 - SHARED) / equal))


def dearest(ranks: Array, cells: Array, shared: Sequence[Array], num_ranks: int) -> float:
    """Return the cost of the slowest ranks over the mean cost if nothing were shared.

    They wait after each thing, say K⁺ of all subdomains, of which a rank makes what equal ones
    share once.

    Args:
        ranks: Rank of each subdomain, shape ``(N,)``.
        cells: Cells of each, shape ``(N,)``.
        shared: For each thing, a number for each subdomain, the same for those that share it.
        num_ranks: Number of ranks.
    """
    each = np.bincount(ranks, cells, minlength=num_ranks)
    waited = ALIKE * each.max()
    for numbers in shared:
        _, first = np.unique(np.stack((ranks, numbers)), axis=1, return_index=True)
        made = np.bincount(ranks[first], cells[first], minlength=num_ranks)
        waited += np.max(SHARED * each + (1.0 - SHARED) * made)
    return round(float(waited * num_ranks / cells.sum()), DIGITS)


def deal(weights: Array, centres: Array, num_ranks: int) -> Array:
    """Return the rank of each subdomain: neighbouring subdomains in chunks of about equal weight.

    Args:
        weights: Cells of each subdomain, shape ``(N,)``.
        centres: Centres of the subdomains, shape ``(N, gdim)``.
        num_ranks: Number of ranks.

    Returns:
        Ranks, shape ``(N,)``; each rank has a subdomain if there are enough of them.
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


# --- Redistribution of cells and nodes --------------------------------------------------------


def redistribute(
    mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm
) -> tuple[UntornMesh, Array]:
    """Send every cell to the rank of its subdomain. Collective.

    Args:
        mesh: This rank's share of the untorn mesh.
        subdomain: Subdomain of each local cell, shape ``(n,)``.
        comm: Communicator.

    Returns:
        The share after the move, cells sorted by subdomain and then original id, and their
        subdomains.
    """
    destination = dealt(mesh, subdomain, comm)[subdomain]
    exchange = Exchange(comm, destination)
    moved = mesh.with_cells(
        **{
            name: exchange.send(getattr(mesh, name))
            for name in ("cells", "cell_ids", "cell_tags", "facet_tags")
        }
    )
    subdomain = exchange.send(subdomain)
    node_ids, x = _send_nodes(mesh, destination, comm)
    order = np.lexsort((moved.cell_ids, subdomain))
    return (
        moved.with_cells(
            cells=moved.cells[order],
            cell_ids=moved.cell_ids[order],
            cell_tags=moved.cell_tags[order],
            facet_tags=moved.facet_tags[order],
            node_ids=node_ids,
            x=x,
        ),
        subdomain[order],
    )


def _send_nodes(mesh: UntornMesh, destination: Array, comm: MPI.Intracomm) -> tuple[Array, Array]:
    """Ids and coordinates of the nodes of the cells that arrive, ids ascending."""
    local = np.searchsorted(mesh.node_ids, mesh.cells)
    needed = np.unique(destination[:, None].astype(np.int64) * len(mesh.node_ids) + local)
    rank, node = np.divmod(needed, max(len(mesh.node_ids), 1))
    exchange = Exchange(comm, rank)
    node_ids, first = np.unique(exchange.send(mesh.node_ids[node]), return_index=True)
    return node_ids, exchange.send(mesh.x[node])[first]


# --- Tearing ----------------------------------------------------------------------------------

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
    """Return the torn mesh, and the original id of each of its geometry nodes."""
    local = np.searchsorted(share.node_ids, share.cells)
    copies = subdomain[:, None].astype(np.int64) * max(len(share.node_ids), 1) + local
    copies, torn = np.unique(copies, return_inverse=True)
    node = copies % max(len(share.node_ids), 1)
    start = offset_of(comm, len(copies))
    cells = start + torn.reshape(share.cells.shape)
    mesh = create_mesh_in_place(comm, cells, share.x[node], share.element)
    return mesh, share.node_ids[node][mesh.geometry.input_global_indices - start]


def _input_cells(mesh: dmesh.Mesh, num_cells: int) -> Array:
    """Return the position of each local cell in the array that made the mesh."""
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
