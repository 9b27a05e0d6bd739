"""Parts of a mesh: by bisection or as given, each connected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import TINY, Array, ArrayLike
from tfeti_dolfinx.common.parallel import box_over_ranks
from tfeti_dolfinx.common.validation import is_whole, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.untorn import UntornMesh, equal_pairs, exchange_by_key, facet_keys

Subdomains = int | ArrayLike | Callable[[Array], ArrayLike]


@dataclass(frozen=True)
class PartitionParameters:
    """Parameters of partitions.

    Attributes:
        unknowns: Displacement unknowns of a subdomain where nobody gives a number: its factor is
            cheap, and kernels and interfaces are still few.
        flat: Cells that are so many times as long as thick make cuts follow layers and columns.
        layer_gap: Midpoints farther apart than this, over the mean extent of a part's cells, are of
            different layers; those of the simplices of a box are a third of it apart.
        same_place: Over that gap: midpoints nearer to each other than this are at one place.
        layer_places: Places that a layer has at most, six with the simplices of a box.
        moved: A cut moves by this share of a part's cells at most, to lie between layers.
        sample: Points of each part that find the centres of round parts.
        influence_step: Factor by which a part's influence changes in a round at most.
        candidates: Parts that a point may join in a round, those nearest to its own.
        fewest: Cells of a part in the mean, below which parts are not made round.
        largest: Size over the mean, above which round parts are not taken.
        facet: Weight of a facet over that of a vertex that a cell shares with another part.
        flattening: Rounds in which cells change sides, until interfaces are flat.
        gains: Size over the mean, above which a part gains no cells where interfaces are flattened.
        loses: Size over the mean, below which it loses none.
    """

    unknowns: int = 4000
    flat: float = 3.0
    layer_gap: float = 0.4
    same_place: float = 0.25
    layer_places: int = 6
    moved: float = 0.25
    sample: int = 300
    influence_step: float = 1.1
    candidates: int = 24
    fewest: int = 20
    largest: float = 1.1
    facet: float = 12.0
    flattening: int = 10
    gains: float = 1.08
    loses: float = 0.93


PARTITION = PartitionParameters()

# --- Recursive coordinate bisection -----------------------------------------------------------


class _Halves(NamedTuple):
    """Plan of a halving of all parts.

    Attributes:
        wanted: Number of points on the left, shape ``(p,)``.
        may: By how many points that may change, shape ``(p,)``.
        axes: The axis that is cut across first, then those that ties are broken by, ``(p, gdim)``.
        gap: Distance of layers along these axes, shape ``(p, gdim)``; -1 in parts without flat
            cells; None if there are none at all.
    """

    wanted: Array
    may: Array
    axes: Array
    gap: Array | None


def bisect_points(
    x: Array, num_parts: int, comm: MPI.Intracomm, extents: Array | None = None
) -> Array:
    """Recursive coordinate bisection of distributed points (Berger, Bokhari 1987). Collective.

    All parts are halved at once, across the longest side of their box; neighbouring part numbers
    are neighbours in space. With the extents of the cells whose midpoints they are, both ``(n,
    gdim)``, cuts lie between layers of cells where some are flat, or at least between columns along
    the axis in which they are flat, if few cells change sides by that.
    """
    # integers on a grid, so that the parts do not depend on how ranks share the points
    low, high = box_over_ranks(comm, x)
    size, last = max(np.max(high - low), TINY), 2.0 ** (62 // x.shape[1]) - 1
    grid = np.rint((x - low) / size * last).astype(np.int64)
    sizes = None
    if extents is not None:
        sizes = np.rint(np.minimum(extents / size, 1.0) * last).astype(np.int64)
    part = np.zeros(len(x), dtype=np.int64)
    targets = np.array([num_parts])
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
) -> _Halves:
    """Plan the halving of parts; targets: numbers of final parts in each, and in its left half."""
    (whole, left), gdim = targets, grid.shape[1]
    box = np.full((2, len(whole), gdim), np.iinfo(np.int64).max)  # of x and of -x
    np.minimum.at(box[0], part, grid)
    np.minimum.at(box[1], part, -grid)
    comm.Allreduce(MPI.IN_PLACE, box, op=MPI.MIN)
    count, gap = _count(part, len(whole), comm), None
    axes = (np.argmax(-box[1] - box[0], axis=1)[:, None] + np.arange(gdim)) % gdim
    if sizes is not None:
        largest = np.maximum(sizes.max(axis=1, initial=1)[:, None], 1)
        is_flat = np.any(PARTITION.flat * sizes <= largest, axis=1)
        total = np.zeros((2, len(whole), gdim), dtype=np.int64)
        np.add.at(total[0], part, sizes)
        np.add.at(total[1], part, (sizes << 10) // largest)
        comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
        flat = _count(part, len(whole), comm, is_flat) > 0
        if gdim == 3:  # of two ties the thinner axis is the last to be cut across
            thick = np.take_along_axis(total[1], axes, axis=1)
            turned = flat & (thick[:, 1] < thick[:, 2])
            axes[turned] = axes[turned][:, [0, 2, 1]]
        mean = np.take_along_axis(total[0], axes, axis=1) / np.maximum(count, 1)[:, None]
        gap = np.where(flat[:, None], (PARTITION.layer_gap * mean).astype(np.int64), -1)
    wanted = np.rint(count * left / whole)
    spare = np.minimum(wanted - left, (count - wanted) - (whole - left))  # a point for each part
    may = np.minimum(np.maximum(PARTITION.moved * count / whole, 1.0), spare)
    return _Halves(wanted, may, axes, gap)


def _after(grid: Array, part: Array, halves: _Halves, comm: MPI.Intracomm) -> Array:
    """Return whether points come after the cut of their part.

    A cut that goes through a layer moves to one of its ends if few points change sides by that;
    else it is made inside the layer along the next axis, where it may lie between columns.
    """
    num_parts, gdim = halves.axes.shape
    digits, bits = np.take_along_axis(grid, halves.axes[part], axis=1), 62 // gdim
    result, before = np.zeros(len(grid), dtype=bool), np.zeros(num_parts, dtype=np.int64)
    inside = np.arange(len(grid))  # points of layers that cuts go through
    for k in range(gdim):
        own, c = part[inside], digits[inside, k]
        key = np.zeros(len(own), dtype=np.int64)
        for axis in range(k, gdim):
            key = (key << bits) | digits[inside, axis]
        kth = _kth_smallest(key, own, halves.wanted - before, comm)
        result[inside] = key > kth[own]
        if halves.gap is None or k == gdim - 1 or np.all(halves.gap < 0):
            break
        at, gap = kth >> (bits * (gdim - 1 - k)), halves.gap[:, k]
        low, is_low = _end_of_layer(c, own, at, gap, comm)
        high, is_high = _end_of_layer(-c, own, -at, gap, comm)
        same = (PARTITION.same_place * gap).astype(np.int64)
        ends = np.stack((low - same - 1, same - high))  # the largest coordinates on the left
        left = np.stack([before + _count(own, num_parts, comm, c <= end[own]) for end in ends])
        off = np.where([is_low, is_high], np.abs(left - halves.wanted), np.inf)
        better, parts = np.argmin(off, axis=0), np.arange(num_parts)
        moves = (gap >= 0) & (off[better, parts] <= halves.may)
        result[inside] = np.where(moves[own], c > ends[better, parts][own], result[inside])
        through = ((gap >= 0) & is_low & is_high & ~moves)[own]
        inside = inside[through & (c > ends[0][own]) & (c <= ends[1][own])]
        before = left[0]
    return result


def _end_of_layer(
    c: Array, part: Array, at: Array, gap: Array, comm: MPI.Intracomm
) -> tuple[Array, Array]:
    """Find the lower ends of layers around ``at``, and whether they end, both of shape ``(p,)``."""
    places, same = PARTITION.layer_places, (PARTITION.same_place * gap).astype(np.int64)
    end, found = at.copy(), np.zeros(len(at), dtype=bool)
    near = np.abs(c - at[part]) <= (places + 1) * gap[part]
    c, part = c[near], part[near]
    for _ in range(places):
        beyond = c < (end - same)[part]
        following = np.full(len(at), np.iinfo(np.int64).min)
        np.maximum.at(following, part[beyond], c[beyond])
        comm.Allreduce(MPI.IN_PLACE, following, op=MPI.MAX)
        found |= following < end - gap
        end = np.where(found, end, following)
        if np.all(found):
            break
    return end, found


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


# --- Facet-connected pieces of subdomains -----------------------------------------------------


class _Pieces(NamedTuple):
    """Connected pieces of this rank's subdomains.

    Attributes:
        of_cell: Piece of each cell.
        subdomain: Subdomain of each piece.
        is_main: Whether a piece is the largest of its subdomain (ties: lowest cell id).
        order: The pieces sorted by subdomain, the main one first, then by lowest cell id.
    """

    of_cell: Array
    subdomain: Array
    is_main: Array
    order: Array


def _pieces(mesh: UntornMesh, subdomain: Array) -> _Pieces:
    n = len(subdomain)
    first, second = mesh.neighbours(colours=subdomain)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    _, start, of_cell, size = np.unique(
        label, return_index=True, return_inverse=True, return_counts=True
    )
    owner = subdomain[start]
    lowest = np.full(len(start), np.iinfo(np.int64).max)
    np.minimum.at(lowest, of_cell, mesh.cell_ids)
    order = np.lexsort((lowest, -size, owner))
    is_main = np.ones(len(start), dtype=bool)
    is_main[order[1:]] = owner[order[1:]] != owner[order[:-1]]
    return _Pieces(of_cell, owner, is_main, order)


def split_disconnected(
    mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm
) -> tuple[Array, dict[int, list[int]]]:
    """Give the pieces of a subdomain ids of their own. Collective.

    Cells are on the ranks of their subdomains. The largest piece keeps the id, the others get ids
    after the last. Return the subdomains of the cells after the split, and for each that was
    split its new ids.
    """
    pieces = _pieces(mesh, subdomain)
    new = pieces.order[~pieces.is_main[pieces.order]]
    owner = pieces.subdomain[new]
    total = comm.allreduce(int(subdomain.max(initial=-1)), op=MPI.MAX) + 1
    everyone = np.sort(np.concatenate(comm.allgather(owner)))
    ids = pieces.subdomain.copy()
    ids[new] = total + np.searchsorted(everyone, owner)
    ids[new] += np.arange(len(new)) - np.searchsorted(owner, owner)
    split = {int(s): [int(s), *(total + np.flatnonzero(everyone == s)).tolist()] for s in everyone}
    return ids[pieces.of_cell], split


def absorb_fragments(mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm) -> Array:
    """Let the smaller pieces of a subdomain join the neighbour they share most facets with.

    Collective. Only main pieces of other subdomains take fragments in; what finds none stays.
    Return the new subdomains of the cells.
    """
    pieces = _pieces(mesh, subdomain)
    main = pieces.is_main[pieces.of_cell]
    keys = facet_keys(mesh.cells, mesh.cell_type)
    exchange = exchange_by_key(comm, keys.ravel())
    owner = exchange.send(np.repeat(np.where(main, subdomain, -1), keys.shape[1]))
    first, second = equal_pairs(exchange.send(keys.ravel()))
    across = np.full(len(owner), -1)
    across[first], across[second] = owner[second], owner[first]
    neighbour = exchange.answer(across).reshape(keys.shape)
    cell, facet = np.nonzero((neighbour >= 0) & ~main[:, None])
    joined = pieces.subdomain.copy()
    contacts = np.stack((pieces.of_cell[cell], neighbour[cell, facet]), axis=1)
    (pair, count) = np.unique(contacts, axis=0, return_counts=True)
    best = np.lexsort((-pair[:, 1], count, pair[:, 0]))
    joined[pair[best, 0]] = pair[best, 1]
    return joined[pieces.of_cell]


# --- Assignment of cells to subdomains --------------------------------------------------------


def default_count(mesh: UntornMesh, comm: MPI.Intracomm) -> int:
    """Return the number of subdomains of about 4000 displacement unknowns each. Collective."""
    per_cell = {"triangle": 0.5, "tetrahedron": 0.2}.get(mesh.cell_type.name, 1.0)
    per_cell *= mesh.gdim * mesh.element.degree**mesh.gdim
    return max(1, round(comm.allreduce(len(mesh.cells)) * per_cell / PARTITION.unknowns))


def assign_subdomains(
    mesh: UntornMesh,
    subdomains: Subdomains,
    comm: MPI.Intracomm,
    partition: Callable[[UntornMesh, int, MPI.Intracomm], Array],
) -> Array:
    """Subdomain of each local cell, numbered 0, 1, ... without holes. Collective.

    Given are their number, for which ``partition`` makes parts; or one id per local cell; or a
    callable that gets cell midpoints, shape ``(3, n)``, and returns one id per cell.

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
    return without_holes(ids, comm)


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


def without_holes(ids: Array, comm: MPI.Intracomm) -> Array:
    """Renumber ids to 0, 1, ... in their order."""
    used = np.unique(np.concatenate(comm.allgather(np.unique(ids))))
    return np.searchsorted(used, ids)


def coordinate_bisection(mesh: UntornMesh, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Recursive coordinate bisection of a distributed mesh, along its layers. Collective.

    The parts depend on the cells' vertices only, not on how ranks share the cells.
    """
    part = bisect_points(mesh.midpoints(), num_parts, comm, np.ptp(mesh.corners(), axis=1))
    return without_holes(part, comm)
