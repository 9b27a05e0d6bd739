"""Which subdomain a cell belongs to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array, ArrayLike
from tfeti_dolfinx.checks import is_whole, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import box_over_ranks

Subdomains = int | ArrayLike | Callable[[Array], ArrayLike]

# displacement unknowns: a factor of that size is cheap, and kernels and interfaces are still few
UNKNOWNS_PER_SUBDOMAIN = 4000


def default_count(mesh: UntornMesh, comm: MPI.Intracomm) -> int:
    """Number of subdomains that leaves each about 4000 displacement unknowns. Collective."""
    per_cell = 0.5 if mesh.cell_type.name == "triangle" else 1.0
    per_cell = 0.2 if mesh.cell_type.name == "tetrahedron" else per_cell
    unknowns = comm.allreduce(len(mesh.cells)) * per_cell * mesh.gdim * mesh.degree**mesh.gdim
    return max(1, round(unknowns / UNKNOWNS_PER_SUBDOMAIN))


def assign_subdomains(
    mesh: UntornMesh,
    subdomains: Subdomains,
    comm: MPI.Intracomm,
    partition: Callable[[UntornMesh, int, MPI.Intracomm], Array],
) -> Array:
    """Subdomain of each local cell, numbered 0, 1, ... without holes. Collective.

    Args:
        mesh: The untorn mesh.
        subdomains: Their number; or one id per local cell; or a callable that gets cell
            midpoints, shape ``(3, n)``, and returns one id per cell.
        comm: Communicator.
        partition: Partitions a mesh into a number of parts.

    Raises:
        InputError: The number is not between 1 and the number of cells, the ids are not one
            whole number per cell, or an id is negative.
    """
    total = comm.allreduce(len(mesh.cells))
    if is_whole(subdomains):
        if not 1 <= subdomains <= total:
            raise InputError(
                f"subdomains={subdomains}: expected between 1 and {total}, the number of cells"
            )
        return partition(mesh, int(subdomains), comm)
    with raised_on_all_ranks(comm):
        if callable(subdomains):
            midpoints = np.zeros((3, len(mesh.cells)))
            midpoints[: mesh.gdim] = mesh.midpoints().T
            with named("callable subdomains"):
                found = subdomains(midpoints)
            ids = _checked_ids(found, len(mesh.cells), "callable subdomains")
        else:
            ids = _checked_ids(subdomains, len(mesh.cells), "array subdomains")
    return _without_holes(ids, comm)


def _checked_ids(ids: ArrayLike, num_cells: int, what: str) -> Array:
    with named(what):
        array = np.asarray(ids)
    if array.ndim == 0 or array.dtype.kind not in "biuf":
        raise InputError(
            f"{what}: expected a number of subdomains, one whole number for each cell or a "
            f"callable that returns them, got {shown(ids)}"
        )
    if array.shape != (num_cells,):
        raise InputError(
            f"{what}: expected one id for each of the {num_cells} cells of this rank, "
            f"got an array of shape {array.shape}"
        )
    whole = np.where(np.isfinite(array), array, -1).astype(np.int64)
    if np.any(whole != array) or np.any(whole < 0):
        wrong = array[(whole != array) | (whole < 0)][0]
        raise InputError(f"{what}: expected whole numbers from 0 up, got {wrong}")
    return whole


def _without_holes(ids: Array, comm: MPI.Intracomm) -> Array:
    """Renumber ids to 0, 1, ... in their order."""
    used = np.unique(np.concatenate(comm.allgather(np.unique(ids))))
    return np.searchsorted(used, ids)


def metis(mesh: UntornMesh, num_parts: int, comm: MPI.Intracomm) -> Array:
    """METIS parts of the facet graph, for a mesh that lies on one rank. Collective.

    Each body gets a share of the parts by its number of cells, and at least one.
    """
    with raised_on_all_ranks(comm):
        n = len(mesh.cells)
        first, second = mesh.neighbours()
        graph = coo_array((np.ones(len(first)), (first, second)), shape=(n, n)).tocsr()
        graph = (graph + graph.T).tocsr()
        num_bodies, body = connected_components(graph, directed=False)
        shares = _shares(np.bincount(body, minlength=num_bodies), num_parts)
        part = np.zeros(n, dtype=np.int64)
        start = 0
        for b in range(num_bodies):
            cells = np.flatnonzero(body == b)
            part[cells] = start + _metis_of(graph[cells][:, cells], int(shares[b]))
            start += int(shares[b])
    return _without_holes(part, comm)


def _metis_of(graph: Any, num_parts: int) -> Array:
    import pymetis

    if num_parts == 1:
        return np.zeros(graph.shape[0], dtype=np.int64)
    options = pymetis.Options(contig=True, seed=1)
    adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
    _, part = pymetis.part_graph(num_parts, adjacency, options=options, recursive=False)
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


def coordinate_bisection(mesh: UntornMesh, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Recursive coordinate bisection of a distributed mesh. Collective.

    The parts depend on the cells' midpoints only, not on how ranks share the cells.
    """
    return _without_holes(bisect_points(mesh.midpoints(), num_parts, comm), comm)


def bisect_points(x: Array, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Recursive coordinate bisection of distributed points (Berger, Bokhari 1987). Collective.

    All parts are halved at once, across the longest side of their box; neighbouring part
    numbers are neighbours in space.

    Args:
        x: Points of this rank, shape ``(n, gdim)``.
        num_parts: Number of parts.
        comm: Communicator.

    Returns:
        Part of each local point, shape ``(n,)``.
    """
    grid = _on_grid(x, comm)
    part = np.zeros(len(x), dtype=np.int64)
    targets = np.array([num_parts])
    while np.any(targets > 1):
        key = _split_keys(grid, part, len(targets), comm)
        count = _count(part, len(targets), comm)
        left = np.where(targets > 1, targets // 2, targets)
        threshold = _kth_smallest(key, part, np.rint(count * left / targets), comm)
        halves = np.where(targets > 1, 2, 1)
        first = np.cumsum(halves) - halves
        part = first[part] + ((key > threshold[part]) & (targets[part] > 1))
        targets = np.repeat(targets, halves)
        targets[first] = left
        second = first[halves == 2] + 1
        targets[second] -= left[halves == 2]
    return part


def _on_grid(x: Array, comm: MPI.Intracomm) -> Array:
    """Coordinates as integers on a grid over the box of all points."""
    gdim = x.shape[1]
    low, high = box_over_ranks(comm, x)
    bits = 62 // gdim
    return np.rint((x - low) / max(np.max(high - low), 1e-300) * (2.0**bits - 1)).astype(np.int64)


def _split_keys(grid: Array, part: Array, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Order of the points across the longest side of their part, ties by the other sides."""
    gdim = grid.shape[1]
    low = np.full((num_parts, gdim), np.iinfo(np.int64).max)
    high = np.full((num_parts, gdim), -1)
    np.minimum.at(low, part, grid)
    np.maximum.at(high, part, grid)
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, op=MPI.MAX)
    axis = np.argmax(high - low, axis=1)[part]
    key = np.zeros(len(grid), dtype=np.int64)
    for shift in range(gdim):
        digits = grid[np.arange(len(grid)), (axis + shift) % gdim]
        key = (key << (62 // gdim)) | digits
    return key


def _count(part: Array, num_parts: int, comm: MPI.Intracomm, chosen: Array | None = None) -> Array:
    counts = np.bincount(part if chosen is None else part[chosen], minlength=num_parts)
    comm.Allreduce(MPI.IN_PLACE, counts, op=MPI.SUM)
    return counts


def _kth_smallest(key: Array, part: Array, k: Array, comm: MPI.Intracomm) -> Array:
    """In each part the k-th smallest key, by bisection on its bits."""
    low: Array = np.zeros(len(k), dtype=np.int64)
    high: Array = np.full(len(k), 2**62 - 1)
    while np.any(low < high):
        middle = (low + high) // 2
        enough = _count(part, len(k), comm, key <= middle[part]) >= k
        high = np.where(enough, middle, high)
        low = np.where(enough, low, np.minimum(middle + 1, high))
    return low
