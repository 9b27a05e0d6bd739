"""Flat interfaces of parts: cells join the part that surrounds them."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array, eye_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.entities import mix
from tfeti_dolfinx.mesh.untorn import UntornMesh

# rounds in which cells change sides, half of those that want to
ROUNDS = 10
# what a facet counts beside a vertex that two cells share
FACET = 12.0
# of the mean number of cells: what no part gains, or loses, any more
LARGEST, SMALLEST = 1.08, 0.93


def flatten_interfaces(mesh: UntornMesh, pairs: tuple[Array, Array], part: Array) -> Array:
    """Let cells join a neighbour's part that has more of what is around them.

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
        moving &= (size[best] < LARGEST) & (size[part[near]] > SMALLEST)
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
