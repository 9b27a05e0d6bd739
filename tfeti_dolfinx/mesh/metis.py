"""METIS parts of a mesh that lies on one rank, made round."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.compact import compact_parts
from tfeti_dolfinx.mesh.flatten import flatten_interfaces
from tfeti_dolfinx.mesh.partition import without_holes
from tfeti_dolfinx.mesh.pieces import absorb_fragments
from tfeti_dolfinx.mesh.untorn import UntornMesh

# of the facets that METIS cuts in a body: parts that cut more are not taken; those of boxes less
# readily, since what is not cut along their layers is a staircase
CUT, CUT_BOXES = 1.1, 1.0

# midpoints of cells that are nearer to each other than this part of their size are those of flat
# cells, which hold each other by the square of that; a cut between them counts so much at most
FLAT, MOST = 12.0, 100.0
SIMPLICES = ("triangle", "tetrahedron")


def metis(mesh: UntornMesh, num_parts: int, comm: MPI.Intracomm) -> Array:
    """METIS parts of the facet graph, for a mesh that lies on one rank, made round. Collective.

    Each body gets a share of the parts by its number of cells, and at least one. METIS cuts few
    facets, but leaves parts that are long, or that hang together thinly; what F makes of their
    soft motions costs conjugate gradients many steps.

    Returns:
        Part of each local cell.
    """
    with raised_on_all_ranks(comm):
        n = len(mesh.cells)
        first, second = mesh.neighbours()
        weights = _weights(mesh, first, second)
        graph = coo_array((weights, (first, second)), shape=(n, n)).tocsr()
        graph = (graph + graph.T).tocsr()
        num_bodies, body = connected_components(graph, directed=False)
        shares = _shares(np.bincount(body, minlength=num_bodies), num_parts)
        part: Array = np.zeros(n, dtype=np.int64)
        start = 0
        for b in range(num_bodies):
            cells = np.flatnonzero(body == b)
            part[cells] = start + _metis_of(graph[cells][:, cells], int(shares[b]))
            start += int(shares[b])
        del graph
        made_round = flatten_interfaces(
            mesh, (first, second), _made_round(mesh, part, body, shares)
        )
    made_round = absorb_fragments(mesh, made_round, comm)
    with raised_on_all_ranks(comm):
        cuts = [
            np.bincount(
                body[first], weights=weights * (which[first] != which[second]), minlength=num_bodies
            )
            for which in (part, made_round)
        ]
        simplices = mesh.cell_type.name in SIMPLICES
        taken = cuts[1] <= (CUT if simplices else CUT_BOXES) * cuts[0]
        part = np.where(taken[body], made_round, part)
    return without_holes(part, comm)


def _weights(mesh: UntornMesh, first: Array, second: Array) -> Array:
    """What a cut between two cells counts: 1, more within columns of flat cells, whole numbers."""
    if mesh.cell_type.name in SIMPLICES:  # in columns of these midpoints say little
        return np.ones(len(first))
    x, size = mesh.midpoints(), np.linalg.norm(mesh.extents(), axis=1)
    apart = np.linalg.norm(x[first] - x[second], axis=1)
    flat = np.minimum(size[first], size[second]) / np.maximum(apart, TINY)
    return np.rint(np.clip((flat / FLAT) ** 2, 1.0, MOST))


def _metis_of(graph: Any, num_parts: int) -> Array:
    import pymetis

    if num_parts == 1:
        return np.zeros(graph.shape[0], dtype=np.int64)
    options = pymetis.Options(contig=True, seed=1)
    adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
    weights = graph.data.astype(np.int64)
    _, part = pymetis.part_graph(
        num_parts, adjacency, eweights=weights, options=options, recursive=False
    )
    return np.asarray(part, dtype=np.int64)


def _shares(weights: Array, num_parts: int) -> Array:
    """Split a number of parts by weights (largest remainders), at least one each."""
    if len(weights) == 0:
        return np.zeros(0, dtype=np.int64)
    exact = weights / weights.sum() * num_parts
    shares = np.maximum(np.floor(exact).astype(np.int64), 1)
    for b in np.argsort(shares - exact)[: max(num_parts - shares.sum(), 0)]:
        shares[b] += 1
    return np.minimum(shares, weights)


def _made_round(mesh: UntornMesh, part: Array, body: Array, shares: Array) -> Array:
    """Round parts in the place of the given ones, in each body."""
    x, measure, result = mesh.midpoints(), np.prod(mesh.extents(), axis=1), part.copy()
    starts = np.cumsum(shares) - shares
    for b, (start, share) in enumerate(zip(starts, shares, strict=True)):
        cells = np.flatnonzero(body == b)
        of_cells = (x[cells], measure[cells], mesh.cell_ids[cells], part[cells] - start)
        result[cells] = start + compact_parts(*of_cells, int(share), MPI.COMM_SELF)
    return result
