"""Parts by METIS, made round by balanced k-means and smooth interfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array, eye_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import box_over_ranks, summed
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.partition import absorb_fragments, without_holes
from tfeti_dolfinx.mesh.untorn import UntornMesh, mix

# --- Balanced k-means: parts of round shape and equal size ------------------------------------

# points on a grid of so many bits: their sums and squares are exact, so no order decides
BITS = 24
# of each part so many points find centres and influences: rounds in which centres stay, in which
# they go a part of the way to the means, and stay again; then rounds with all points
SAMPLE, HELD, MOVING, LAST, ALL, WAY = 300, 20, 30, 10, 4, 0.5
# an influence grows or shrinks by so much in a round at most
STEP = 1.1
# parts that a point may join in a round: those nearest to its own
NEAREST = 24
# of the mean number of points, or of the longest part given: with a larger or longer part than that
# parts stay as they were given; so they do with fewer points in the mean
LARGEST, LONGER, FEWEST = 1.1, 1.5, 20


def compact_parts(
    x: Array, measure: Array, ids: Array, part: Array, num_parts: int, comm: MPI.Intracomm
) -> Array:
    """Balanced k-means, begun at given parts. Collective.

    A point is in the part with the least ‖x − c_k‖/w_k, the centre c_k being the mean of the
    part, and the influence w_k what gives all parts the same number of points, so that parts are
    round where a mesh is graded, too (von Looz, Tzovas, Meyerhenke, ICPP 2018,
    doi:10.1145/3225058.3225148). The result does not depend on how ranks share the points.

    Args:
        x: Midpoints of this rank's cells, shape ``(n, gdim)``.
        measure: Their volumes, up to a factor, shape ``(n,)``.
        ids: Their ids, shape ``(n,)``.
        part: Their parts, shape ``(n,)``; none is empty.
        num_parts: Number of parts.
        comm: Communicator.

    Returns:
        New parts, shape ``(n,)``; the given ones where these are small, or where the new ones are
        not balanced, or one of them is far longer.
    """
    total = comm.allreduce(len(x))
    if num_parts == 1 or total < FEWEST * num_parts:
        return part
    grid = _on_grid(x, comm)
    some = mix(ids) % np.uint64(max(total // (SAMPLE * num_parts), 1)) == 0
    y, own = grid[some], part[some]
    centre = _means(y, own, np.zeros((num_parts, x.shape[1])), comm)
    influence = _radii(y, own, centre, np.ones(len(y)), comm)[0]
    for k in range(HELD + MOVING + LAST + ALL):
        if k == HELD + MOVING + LAST:
            y, own = grid, _nearest(grid, part, centre, influence)
        if HELD <= k < HELD + MOVING:
            centre += np.rint(WAY * (_means(y, own, centre, comm) - centre))
        size = _sizes(own, num_parts, comm)
        wanted = (size.sum() / num_parts / np.maximum(size, 1.0)) ** (1.0 / x.shape[1])
        influence *= np.clip(wanted, 1.0 / STEP, STEP)
        own = _nearest(y, own, centre, influence)
    size = _sizes(own, num_parts, comm)
    if size.max() > LARGEST * total / num_parts or size.min() == 0.0:
        return part
    longest = [_length(grid, which, measure, num_parts, comm) for which in (part, own)]
    return own if longest[1] <= LONGER * longest[0] else part


def _on_grid(x: Array, comm: MPI.Intracomm) -> Array:
    """Return coordinates as whole numbers, on a grid over the box of all points."""
    low, high = box_over_ranks(comm, x)
    return np.rint((x - low) * ((2.0**BITS - 1.0) / max(np.max(high - low), 1e-300)))


def _sizes(part: Array, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Return the number of points of each part."""
    return summed(comm, np.bincount(part, minlength=num_parts).astype(np.float64))


def _means(x: Array, part: Array, before: Array, comm: MPI.Intracomm) -> Array:
    """Return the means of the parts as integers; means of empty parts do not change."""
    num_parts = len(before)
    size = _sizes(part, num_parts, comm)[:, None]
    sums = np.zeros(before.shape)
    for k, column in enumerate(x.T):
        sums[:, k] = np.bincount(part, weights=column, minlength=num_parts)
    means = np.rint(summed(comm, sums) / np.maximum(size, 1.0))
    return np.where(size > 0.0, means, before)


def _radii(
    x: Array, part: Array, centre: Array, measure: Array, comm: MPI.Intracomm
) -> tuple[Array, Array]:
    """Radii of gyration of the parts, at least 1, and their measures."""
    squares, sums = measure * np.sum((x - centre[part]) ** 2, axis=1), np.zeros((2, len(centre)))
    for k, weights in enumerate((squares, measure)):
        sums[k] = np.bincount(part, weights=weights, minlength=len(centre))
    squared, volume = summed(comm, sums)
    return np.sqrt(np.maximum(squared / np.maximum(volume, 1e-300), 1.0)), volume


def _length(x: Array, part: Array, measure: Array, num_parts: int, comm: MPI.Intracomm) -> float:
    """The largest ratio of a part's radius of gyration to the size that its measure gives it."""
    centre = _means(x, part, np.zeros((num_parts, x.shape[1])), comm)
    radius, volume = _radii(x, part, centre, measure, comm)
    return float(np.max(radius ** x.shape[1] / volume))


def _nearest(x: Array, part: Array, centre: Array, influence: Array) -> Array:
    """Return the part with the least ‖x − c‖/w among those near the present one."""
    apart = np.linalg.norm(centre[:, None] - centre, axis=2) / (influence[:, None] + influence)
    near = np.argsort(apart, axis=1, kind="stable")[:, :NEAREST]
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

# rounds in which cells change sides, half of those that want to
ROUNDS = 10
# what a facet counts beside a vertex that two cells share
FACET = 12.0
# of the mean number of cells: what no part gains, or loses, any more
LARGEST_PART, SMALLEST = 1.08, 0.93


def flatten_interfaces(mesh: UntornMesh, pairs: tuple[Array, Array], part: Array) -> Array:
    """Move cells to the neighbouring part that most of their surroundings belong to.

    Of each part count the cells that share a vertex with a cell, once for each such vertex, and
    those that share a facet with it twelve times more. A cell that counts more of a neighbour's
    part than of its own joins it, which takes off what sticks out of an interface.

    Args:
        mesh: A mesh that lies on this rank.
        pairs: Its neighbours.
        part: Part of each cell, shape ``(n,)``.

    Returns:
        New parts, shape ``(n,)``; some may no longer be connected through facets.
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
    for turn in range(ROUNDS):
        flags = csr_array((np.ones(n), part, np.arange(n + 1)), shape=(n, num_parts))
        met = csr_array(around.T @ flags)
        between = (np.diff(met.indptr) > 1).astype(float)
        near = np.flatnonzero(around @ between)
        facets = csr_array(beside[near] @ flags)
        counted = (around[near] @ met).multiply(facets > 0) + FACET * (facets - flags[near])
        best, most = _largest(csr_array(counted))
        own = np.asarray(csr_array(counted)[np.arange(len(near)), part[near]]).ravel()
        lot = mix(mesh.cell_ids[near].astype(np.uint64) + np.uint64(turn) * np.uint64(2**40)) & 1
        moving = (most > own) & (lot == 0)
        if not np.any(most > own):
            break
        size = np.bincount(part, minlength=num_parts) * (num_parts / n)
        moving &= (size[best] < LARGEST_PART) & (size[part[near]] > SMALLEST)
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


# --- METIS partition on one rank --------------------------------------------------------------

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
        made_round = part
        if "round_parts" not in PETSc.Options("tfeti_").getString("without", "").split(","):
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
    """Return the cost of a cut between two cells: 1, more within columns of flat cells; integer."""
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
