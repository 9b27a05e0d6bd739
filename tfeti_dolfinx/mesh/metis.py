"""Parts by METIS, made round by balanced k-means and smooth interfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import TINY, Array, sum_rows
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.partition import PARTITION, absorb_fragments, without_holes
from tfeti_dolfinx.mesh.untorn import UntornMesh, mix


def metis(mesh: UntornMesh, num_parts: int, comm: MPI.Intracomm) -> Array:
    """METIS part of each cell of a mesh that lies on one rank, by facets, made round. Collective.

    Each body gets a share of the parts by its number of cells, and at least one. METIS cuts few
    facets, but leaves parts that are long, or that hang together thinly; what F makes of their soft
    motions costs conjugate gradients many steps.
    """
    with raised_on_all_ranks(comm):
        n, pairs = len(mesh.cells), mesh.neighbours()
        graph = coo_array((np.ones(len(pairs[0])), pairs), shape=(n, n)).tocsr()
        graph = (graph + graph.T).tocsr()
        num_bodies, body = connected_components(graph, directed=False)
        shares = _shares(np.bincount(body, minlength=num_bodies), num_parts)
        x, part = mesh.midpoints(), np.zeros(n, dtype=np.int64)
        for b, start in enumerate(np.cumsum(shares) - shares):
            cells = np.flatnonzero(body == b)
            own = _metis_of(graph[cells][:, cells], int(shares[b]))
            part[cells] = start + compact_parts(x[cells], own, int(shares[b]))
        part = flatten_interfaces(mesh, pairs, part)
    return without_holes(absorb_fragments(mesh, part, comm), comm)


def _metis_of(graph: Any, num_parts: int) -> Array:
    import pymetis

    if num_parts == 1:
        return np.zeros(graph.shape[0], dtype=np.int64)
    adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
    options = pymetis.Options(contig=True, seed=1)
    _, part = pymetis.part_graph(num_parts, adjacency, options=options, recursive=False)
    return np.asarray(part, dtype=np.int64)


def _shares(weights: Array, num_parts: int) -> Array:
    """Split a number of parts by weights (largest remainders), at least one each."""
    exact = weights / max(weights.sum(), 1) * num_parts
    shares = np.maximum(np.floor(exact).astype(np.int64), 1)
    shares[np.argsort(shares - exact)[: max(num_parts - shares.sum(), 0)]] += 1
    return np.minimum(shares, weights)


# --- Balanced k-means: parts of round shape and equal size ------------------------------------


def compact_parts(x: Array, part: Array, num_parts: int) -> Array:
    """Balanced k-means of midpoints, ``(n, gdim)``, begun at given parts, ``(n,)``, none empty.

    A point is in the part with the least ‖x − c_k‖/w_k, the centre c_k being the mean of the part,
    and the influence w_k what gives all parts the same number of points, so that parts are round
    where a mesh is graded, too (von Looz, Tzovas, Meyerhenke, ICPP 2018,
    doi:10.1145/3225058.3225148). The given parts are returned where these are small, or where the
    new ones are not balanced.
    """
    n = len(x)
    if num_parts == 1 or n < PARTITION.fewest * num_parts:
        return part
    some = mix(np.arange(n)) % np.uint64(max(n // (PARTITION.sample * num_parts), 1)) == 0
    y, own = x[some], part[some]
    centre = _means(y, own, np.zeros((num_parts, x.shape[1])))
    squares = sum_rows(own, np.sum((y - centre[own]) ** 2, axis=1), num_parts)
    influence = np.sqrt(np.maximum(squares / np.maximum(np.bincount(own), 1), TINY))
    # a sample finds influences, then centres, half of the way to the means in a round, then
    # influences again; at last all points
    for rounds, way, points in ((20, 0.0, some), (30, 0.5, some), (10, 0.0, some), (4, 0.0, None)):
        if points is None:
            y, own = x, _nearest(x, part, centre, influence)
        for _ in range(rounds):
            centre += way * (_means(y, own, centre) - centre)
            size = np.maximum(np.bincount(own, minlength=num_parts), 1)
            wanted = (len(y) / num_parts / size) ** (1.0 / x.shape[1])
            step = PARTITION.influence_step
            influence *= np.clip(wanted, 1.0 / step, step)
            own = _nearest(y, own, centre, influence)
    size = np.bincount(own, minlength=num_parts)
    balanced = size.max() <= PARTITION.largest * n / num_parts and size.min() > 0
    return own if balanced else part


def _means(x: Array, part: Array, before: Array) -> Array:
    """Return the means of the parts; means of empty parts do not change."""
    size = np.bincount(part, minlength=len(before))[:, None]
    return np.where(size > 0, sum_rows(part, x, len(before)) / np.maximum(size, 1), before)


def _nearest(x: Array, part: Array, centre: Array, influence: Array) -> Array:
    """Return the part with the least ‖x − c‖/w among those near the present one."""
    apart = np.linalg.norm(centre[:, None] - centre, axis=2) / (influence[:, None] + influence)
    near = np.argsort(apart, axis=1, kind="stable")[:, : PARTITION.candidates]
    order = np.argsort(part, kind="stable")
    start = np.searchsorted(part[order], np.arange(len(centre) + 1))
    found = part.copy()
    for k in range(len(centre)):
        own, joined = order[start[k] : start[k + 1]], near[k]
        y, c = x[own] - centre[k], centre[joined] - centre[k]
        squares = np.sum(y**2, axis=1)[:, None] - 2.0 * (y @ c.T) + np.sum(c**2, axis=1)
        found[own] = joined[np.argmin(squares / influence[joined] ** 2, axis=1)]
    return found


# --- Smoothing of interfaces between parts ----------------------------------------------------


def flatten_interfaces(mesh: UntornMesh, pairs: tuple[Array, Array], part: Array) -> Array:
    """Move cells to the neighbouring part that most of their surroundings belong to.

    Of each part count the cells that share a vertex with a cell, once for each such vertex, and
    those that share a facet with it twelve times more. A cell that counts more of a neighbour's
    part than of its own joins it, which takes off what sticks out of an interface. Some of the new
    parts may no longer be connected through facets. The mesh, its pairs of neighbours and the parts
    are those of one rank.
    """
    n, k, num_parts = len(part), mesh.num_vertices, int(part.max(initial=-1)) + 1
    if num_parts < 2:
        return part
    vertices = np.searchsorted(mesh.node_ids, mesh.cells[:, :k])
    start = np.arange(0, n * k + 1, k)
    shape = (n, len(mesh.node_ids))
    around = csr_array((np.ones(n * k), vertices.ravel(), start), shape=shape)
    faces = coo_array((np.ones(len(pairs[0])), pairs), shape=(n, n)).tocsr()
    beside = csr_array(faces + faces.T + eye_array(n, format="csr"))
    part = part.copy()
    for turn in range(PARTITION.flattening):
        flags = csr_array((np.ones(n), part, np.arange(n + 1)), shape=(n, num_parts))
        met = csr_array(around.T @ flags)
        between = (np.diff(met.indptr) > 1).astype(float)
        near = np.flatnonzero(around @ between)
        facets = csr_array(beside[near] @ flags)
        counted = csr_array(
            (around[near] @ met).multiply(facets > 0) + PARTITION.facet * (facets - flags[near])
        )
        best, most = _largest(counted)
        own = np.asarray(counted[np.arange(len(near)), part[near]]).ravel()
        if not np.any(most > own):
            break
        # half of those that want to move, so that neighbours do not just exchange their parts
        lot = mix(mesh.cell_ids[near].astype(np.uint64) + np.uint64(turn) * np.uint64(2**40)) & 1
        size = np.bincount(part, minlength=num_parts) * (num_parts / n)
        moving = (most > own) & (lot == 0)
        moving &= (size[best] < PARTITION.gains) & (size[part[near]] > PARTITION.loses)
        part[near[moving]] = best[moving]
    return part


def _largest(table: csr_array) -> tuple[Array, Array]:
    """Column and value of each row's largest entry; of equal ones the first. No row is empty."""
    if table.shape[0] == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    table.sort_indices()
    most = np.maximum.reduceat(table.data, table.indptr[:-1])
    other = table.data < np.repeat(most, np.diff(table.indptr))
    columns = np.where(other, table.shape[1], table.indices)
    return np.minimum.reduceat(columns, table.indptr[:-1]).astype(np.int64), most
