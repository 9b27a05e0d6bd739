"""Parts of round shape and equal size, made from parts of any shape."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.entities import mix
from tfeti_dolfinx.parallel import box_over_ranks, summed

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
    """Coordinates as whole numbers, on a grid over the box of all points."""
    low, high = box_over_ranks(comm, x)
    return np.rint((x - low) * ((2.0**BITS - 1.0) / max(np.max(high - low), 1e-300)))


def _sizes(part: Array, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Number of points of each part."""
    return summed(comm, np.bincount(part, minlength=num_parts).astype(np.float64))


def _means(x: Array, part: Array, before: Array, comm: MPI.Intracomm) -> Array:
    """Means of the parts, as whole numbers; what has no point stays where it was."""
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
    """The part with the least ‖x − c‖/w among those near the present one."""
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
