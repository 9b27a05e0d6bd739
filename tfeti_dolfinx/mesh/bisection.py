"""Recursive coordinate bisection of points that ranks share, along layers of cells."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import box_over_ranks, maxima, summed


@dataclass(frozen=True)
class BisectionParameters:
    """Parameters of recursive coordinate bisection."""

    # cells that are so many times as long as thick make cuts follow layers and columns
    flat: float = 3.0
    # midpoints farther apart than this, over the mean extent of a part's cells, are of different
    # layers; those of the simplices of a box are a third of it apart
    layer_gap: float = 0.4
    # over that gap: midpoints nearer to each other than this are at one place
    same_place: float = 0.25
    layer_places: int = 6  # places that a layer has at most, six with the simplices of a box
    # a cut moves by this share of a part's cells at most, to lie between layers
    moved: float = 0.25


PARAMETERS = BisectionParameters()


# of a halving of all parts: numbers of points on the left, ``(p,)``; by how many these may change,
# ``(p,)``; the axis that is cut across first, then those that ties are broken by, ``(p, gdim)``;
# the distance of layers along these axes, ``(p, gdim)``, -1 in parts without flat cells, or None
Halves = tuple[Array, Array, Array, Array | None]


def bisect_points(
    x: Array,
    num_parts: int | Array,
    comm: MPI.Intracomm,
    extents: Array | None = None,
    body: Array | None = None,
) -> Array:
    """Recursive coordinate bisection of distributed points (Berger, Bokhari 1987). Collective.

    All parts are halved at once, across the longest side of their box; neighbouring part numbers
    are neighbours in space. With the extents of the cells whose midpoints they are, both ``(n,
    gdim)``, cuts lie between layers of cells where some are flat, or at least between columns along
    the axis in which they are flat, if few cells change sides by that. With the body of each point
    ``num_parts`` is one number for each body, whose parts follow those of the bodies before it.
    """
    # integers on a grid, so that the parts do not depend on how ranks share the points
    low, high = box_over_ranks(comm, x)
    size, last = max(np.max(high - low), TINY), 2.0 ** (62 // x.shape[1]) - 1
    grid = np.rint((x - low) / size * last).astype(np.int64)
    sizes = None
    if extents is not None:
        sizes = np.rint(np.minimum(extents / size, 1.0) * last).astype(np.int64)
    part = np.zeros(len(x), dtype=np.int64) if body is None else body
    targets = np.atleast_1d(num_parts)
    while np.any(targets > 1):
        left = np.where(targets > 1, targets // 2, targets)
        after = _after(grid, part, _halves(grid, sizes, part, (targets, left), comm), comm)
        halves = np.where(targets > 1, 2, 1)
        first = np.cumsum(halves) - halves
        part = first[part] + (after & (targets[part] > 1))
        targets = np.repeat(targets, halves)
        targets[first] = left
        targets[first[halves == 2] + 1] -= left[halves == 2]
    return part


def _halves(
    grid: Array, sizes: Array | None, part: Array, targets: tuple[Array, Array], comm: MPI.Intracomm
) -> Halves:
    """Plan the halving of parts; targets: numbers of final parts in each, and in its left half."""
    (whole, left), gdim = targets, grid.shape[1]
    box = np.full((2, len(whole), gdim), np.iinfo(np.int64).min)  # of x and of -x
    for axis, column in enumerate(grid.T):
        np.maximum.at(box[0, :, axis], part, column)
        np.maximum.at(box[1, :, axis], part, -column)
    box = maxima(comm, box)
    count, gap = sizes_of(part, len(whole), comm), None
    axes = (np.argmax(box[0] + box[1], axis=1)[:, None] + np.arange(gdim)) % gdim
    if sizes is not None:
        largest = np.maximum(sizes.max(axis=1, initial=1)[:, None], 1)
        is_flat = np.any(PARAMETERS.flat * sizes <= largest, axis=1)
        total = np.zeros((2, len(whole), gdim), dtype=np.int64)
        np.add.at(total[0], part, sizes)
        np.add.at(total[1], part, (sizes << 10) // largest)
        total = summed(comm, total)
        flat = sizes_of(part[is_flat], len(whole), comm) > 0
        if gdim == 3:  # of two ties the thinner axis is the last to be cut across
            thick = np.take_along_axis(total[1], axes, axis=1)
            turned = flat & (thick[:, 1] < thick[:, 2])
            axes[turned] = axes[turned][:, [0, 2, 1]]
        mean = np.take_along_axis(total[0], axes, axis=1) / np.maximum(count, 1)[:, None]
        gap = np.where(flat[:, None], (PARAMETERS.layer_gap * mean).astype(np.int64), -1)
    wanted = np.rint(count * left / whole)
    spare = np.minimum(wanted - left, (count - wanted) - (whole - left))  # a point for each part
    may = np.minimum(np.maximum(PARAMETERS.moved * count / whole, 1.0), spare)
    return wanted, may, axes, gap


def _after(grid: Array, part: Array, halves: Halves, comm: MPI.Intracomm) -> Array:
    """Return whether points come after the cut of their part.

    A cut that goes through a layer moves to one of its ends if few points change sides by that;
    else it is made inside the layer along the next axis, where it may lie between columns.
    """
    wanted, may, axes, gaps = halves
    num_parts, gdim = axes.shape
    digits, bits = np.take_along_axis(grid, axes[part], axis=1), 62 // gdim
    result, before = np.zeros(len(grid), dtype=bool), np.zeros(num_parts, dtype=np.int64)
    inside = np.arange(len(grid))  # points of layers that cuts go through
    for k in range(gdim):
        own, c = part[inside], digits[inside, k]
        key = np.zeros(len(own), dtype=np.int64)
        for axis in range(k, gdim):
            key = (key << bits) | digits[inside, axis]
        kth = _kth_smallest(key, own, wanted - before, comm)
        result[inside] = key > kth[own]
        if gaps is None or k == gdim - 1 or np.all(gaps < 0):
            break
        at, gap = kth >> (bits * (gdim - 1 - k)), gaps[:, k]
        low, is_low = _end_of_layer(c, own, at, gap, comm)
        high, is_high = _end_of_layer(-c, own, -at, gap, comm)
        same = (PARAMETERS.same_place * gap).astype(np.int64)
        ends = np.stack((low - same - 1, same - high))  # the largest coordinates on the left
        left = np.stack([before + sizes_of(own[c <= end[own]], num_parts, comm) for end in ends])
        off = np.where([is_low, is_high], np.abs(left - wanted), np.inf)
        better, parts = np.argmin(off, axis=0), np.arange(num_parts)
        moves = (gap >= 0) & (off[better, parts] <= may)
        result[inside] = np.where(moves[own], c > ends[better, parts][own], result[inside])
        through = ((gap >= 0) & is_low & is_high & ~moves)[own]
        inside = inside[through & (c > ends[0][own]) & (c <= ends[1][own])]
        before = left[0]
    return result


def _end_of_layer(
    c: Array, part: Array, at: Array, gap: Array, comm: MPI.Intracomm
) -> tuple[Array, Array]:
    """Find the lower ends of layers around ``at``, and whether they end, both of shape ``(p,)``."""
    places, same = PARAMETERS.layer_places, (PARAMETERS.same_place * gap).astype(np.int64)
    end, found = at.copy(), np.zeros(len(at), dtype=bool)
    near = np.abs(c - at[part]) <= (places + 1) * gap[part]
    c, part = c[near], part[near]
    for _ in range(places):
        beyond = c < (end - same)[part]
        following = np.full(len(at), np.iinfo(np.int64).min)
        np.maximum.at(following, part[beyond], c[beyond])
        following = maxima(comm, following)
        found |= following < end - gap
        end = np.where(found, end, following)
        if np.all(found):
            break
    return end, found


def sizes_of(part: Array, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Count the points of each part on all ranks. Collective."""
    return summed(comm, np.bincount(part, minlength=num_parts))


def _kth_smallest(key: Array, part: Array, k: Array, comm: MPI.Intracomm) -> Array:
    """In each part the k-th smallest key, by bisection on the bits of keys that may be it."""
    low: Array = np.zeros(len(k), dtype=np.int64)
    high: Array = np.full(len(k), 2**62 - 1)
    while np.any(low < high):
        middle = (low + high) // 2
        first = key <= middle[part]
        count = sizes_of(part[first], len(k), comm)
        enough = count >= k
        kept = first == enough[part]
        key, part, k = key[kept], part[kept], np.where(enough, k, k - count)
        high = np.where(enough, middle, high)
        low = np.where(enough, low, np.minimum(middle + 1, high))
    return low
