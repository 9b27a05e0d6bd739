"""Round parts of a distributed mesh: balanced k-means, then smooth interfaces."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from tfeti_dolfinx.common.arrays import TINY, Array, Entries, entries_of_rows, sum_rows
from tfeti_dolfinx.common.parallel import any_rank, box_over_ranks, summed
from tfeti_dolfinx.mesh.bisection import PARAMETERS as BISECTION
from tfeti_dolfinx.mesh.bisection import bisect_points, sizes_of
from tfeti_dolfinx.mesh.cell_graph import CellGraph, incidence
from tfeti_dolfinx.mesh.untorn import UntornMesh, mix


@dataclass(frozen=True)
class RoundParameters:
    """Parameters of round parts."""

    # of k-means: points of each part that are looked at, rounds with them, and the share of the way
    # to the means that centres go in a round. Few points find the centres roughly, more make them
    # better, and all points find the parts
    stages: tuple[tuple[float, int, float], ...] = (
        (300, 50, 0.5),
        (1000, 10, 0.5),
        (np.inf, 2, 0.0),
    )
    influence_step: float = 1.1  # factor by which a part's influence changes in a round at most
    # of the distance to the next centre, which a part's influence is at most
    influence: float = 0.8
    fewest: int = 20  # cells of a part in the mean, below which parts are those of bisection
    # weight of a facet over that of a vertex that a cell shares with another part
    facet: float = 12.0
    flattening: int = 10  # rounds in which cells change sides, until interfaces are flat
    # size over the mean, above which a part gains no cells where interfaces are flattened
    gains: float = 1.08
    loses: float = 0.93  # and below which it loses none; between the two sizes are balanced
    bits: int = 20  # of the whole numbers that midpoints become along each axis
    # points of a group, large and small, for which parts are left out together
    groups: tuple[int, int] = (64, 8)


ROUND = RoundParameters()


def round_parts(mesh: UntornMesh, graph: CellGraph, num_parts: int) -> Array:
    """Part of each cell, by balanced k-means with smooth interfaces. Collective.

    Each body gets a share of the parts by its number of cells, and at least one. Bodies of flat
    cells, and of few cells a part, get parts by bisection, whose cuts follow layers. Some parts may
    not be connected. The parts do not depend on how ranks share the cells.
    """
    comm, bodies = graph.comm, graph.pieces(np.zeros(graph.num_cells, dtype=np.int64))
    body, sizes = bodies.of_cell, bodies.size
    # by largest remainders
    exact = sizes / max(sizes.sum(), 1) * num_parts
    shares = np.maximum(np.floor(exact).astype(np.int64), 1)
    shares[np.argsort(shares - exact, kind="stable")[: max(num_parts - shares.sum(), 0)]] += 1
    shares = np.minimum(shares, sizes)
    if np.all(shares == 1):
        return body
    extents = mesh.extents()
    flat = BISECTION.flat * extents.min(axis=1, initial=np.inf) <= extents.max(axis=1, initial=0.0)
    boxes = 2 * sizes_of(body[flat], len(sizes), comm) > sizes
    boxes |= (sizes < ROUND.fewest * shares) | (shares == 1)
    # integers, so that sums do not depend on how ranks share the points
    x = mesh.midpoints()
    low, high = box_over_ranks(comm, x)
    grid = np.rint((x - low) * (2.0**ROUND.bits / max(np.max(high - low), TINY)))
    key = np.zeros(len(x), dtype=np.uint64)
    for c in grid.T:
        key = mix(key ^ c.astype(np.uint64))
    home = np.repeat(np.arange(len(sizes)), shares)
    part: Array = np.zeros(len(x), dtype=np.int64)
    if not np.all(boxes):
        some = ~boxes[body]
        part[some] = balanced_kmeans(grid[some], key[some], body[some], shares, comm)
        boxes[home[sizes_of(part[some], len(home), comm) == 0]] = True
    if np.any(boxes):
        some = boxes[body]
        part[some] = bisect_points(x[some], shares, comm, extents[some], body=body[some])
    return flatten_interfaces(graph, part, key, np.where(boxes, 0.0, sizes / shares)[home])


# --- Balanced k-means: parts of round shape and equal size ------------------------------------


def balanced_kmeans(x: Array, key: Array, body: Array, shares: Array, comm: MPI.Intracomm) -> Array:
    """Balanced k-means of points, whole numbers ``(n, gdim)``, in so many parts a body. Collective.

    A point is in the part of its body with the least ‖x − c_k‖/w_k, the centre c_k being the mean
    of the part, and the influence w_k what gives all parts the same number of points, so that parts
    are round where a mesh is graded, too (von Looz, Tzovas, Meyerhenke, ICPP 2018,
    doi:10.1145/3225058.3225148). It is below the distance to the next centre: beyond that a small
    part, whose influence grows until it has points enough, soon has those of all around it. Cells
    stay where they are: sums travel. The keys, ``(n,)``, draw a sample, whose bisection is the
    beginning. Return the part of each point.
    """
    home = np.repeat(np.arange(len(shares)), shares)
    total, gdim = int(sizes_of(body, len(shares), comm).sum()), x.shape[1]
    centre = np.zeros((len(home), gdim))
    # points of a body follow each other, in it those near each other
    order = cKDTree(x, ROUND.groups[-1], compact_nodes=False, balanced_tree=False).indices
    order = order[np.argsort(body[order], kind="stable")]
    x, key, body = x[order], key[order], body[order]
    for stage, (sample, rounds, way) in enumerate(ROUND.stages):
        some: Array = np.arange(len(x))
        if sample * len(home) < total:
            some = np.flatnonzero(key % np.uint64(total // (sample * len(home))) == 0)
        y, of = x[some], body[some]
        groups = _Groups(y, of)
        if stage == 0:
            own = bisect_points(y, shares, comm, body=of)
            centre = _means(y, own, centre, comm)
            away = np.rint(np.sqrt(_squares(y.T, centre[own].T)))
            spread = summed(comm, sum_rows(own, away, len(home)))
            influence = np.maximum(spread / np.maximum(sizes_of(own, len(home), comm), 1), 1.0)
        else:
            own = groups.nearest(centre, influence, shares)
        goal = (sizes_of(of, len(shares), comm) / shares)[home]
        for _ in range(rounds):
            size = np.maximum(sizes_of(own, len(home), comm), 1)
            if way:
                centre += way * (_means(y, own, centre, comm) - centre)
            elif np.all((size < ROUND.gains * goal) & (size > ROUND.loses * goal)):
                break
            step = ROUND.influence_step
            influence *= np.clip((goal / size) ** (1.0 / gdim), 1.0 / step, step)
            # bodies are along one more axis
            tree = cKDTree(np.column_stack((centre, 2.0 ** (ROUND.bits + 2) * home)))
            next_one = tree.query(tree.data, k=2)[0][:, 1]
            influence = np.minimum(influence, ROUND.influence * np.maximum(next_one, 1.0))
            own = groups.nearest(centre, influence, shares)
    part = np.empty_like(own)
    part[order] = own
    return part


def _means(x: Array, part: Array, before: Array, comm: MPI.Intracomm) -> Array:
    """Return the means of the parts; means of empty parts do not change."""
    sums = summed(comm, sum_rows(part, np.vstack((np.ones(len(x)), x.T)).T, len(before)))
    size = sums[:, :1]
    return np.where(size > 0, sums[:, 1:] / np.maximum(size, 1.0), before)


def _squares(x: Any, c: Any) -> Array:
    """‖x − c‖² of coordinates along each axis, each in the same way wherever it stands."""
    found: Array = x[0] - c[0]
    found *= found
    for k in range(1, len(x)):
        apart = x[k] - c[k]
        apart *= apart
        found += apart
    return found


class _Groups:
    """Points in small groups, and these in large ones, each of one body.

    Points of a group follow each other, bodies too.
    """

    def __init__(self, x: Array, body: Array) -> None:
        axes = np.ascontiguousarray(x.T)
        number = np.arange(len(x)) - np.searchsorted(body, np.arange(body.max(initial=0) + 1))[body]
        within, self._levels = body, list[tuple[Array, Array, Array]]()
        for size in ROUND.groups:
            begins = number % size == 0
            start = np.flatnonzero(begins)
            low, high = (of.reduceat(axes, start, axis=1) for of in (np.minimum, np.maximum))
            # farther than the farthest point, by more than rounding to single precision
            radius = 0.5 * np.sqrt(_squares(high, low)) + 2.0
            around = (0.5 * (low + high)).astype(np.float32), radius.astype(np.float32)
            self._levels.append((within[start], *around))
            within = np.cumsum(begins) - 1
        last = np.append(start[1:], len(x)) - 1
        self._points = np.minimum(start[:, None] + np.arange(size), last[:, None])
        self._x = [along[self._points] for along in axes]

    def nearest(self, centre: Array, influence: Array, shares: Array) -> Array:
        """Return the part of its body with the least ‖x − c_k‖/w_k for each point.

        A group is looked at with those parts that may be nearest to a point of the ball around it.
        """
        axes, w = centre.T, influence.astype(np.float32)
        part: Array = np.arange(len(centre))
        near = Entries(w, part, np.concatenate(([0], np.cumsum(shares))), (len(shares), len(part)))
        for within, middle, radius in self._levels:
            entries, start = entries_of_rows(near, within)
            part, count = near.indices[entries], np.diff(start)
            c = [along.astype(np.float32)[part] for along in axes]
            away = np.sqrt(_squares([np.repeat(along, count) for along in middle], c))
            off, of = np.repeat(radius, count), w[part]
            least = np.repeat(np.minimum.reduceat((away + off) / of, start[:-1]), count)
            kept = np.flatnonzero(away - off <= least * of)
            near = near._replace(indices=part[kept], indptr=np.searchsorted(kept, start))
        found = np.empty(self._points[-1:].max(initial=-1) + 1, dtype=np.int64)
        found[self._points] = near.indices[near.indptr[:-1], None]
        several = np.flatnonzero(np.diff(near.indptr) > 1)
        entries, start = entries_of_rows(near, several)
        part, count = near.indices[entries], np.diff(start)
        group = np.repeat(several, count)
        rows = [along.take(group, axis=0) for along in self._x]
        squares = _squares(rows, [along[part, None] for along in axes])
        squares /= np.square(influence[part])[:, None]
        least = np.repeat(np.minimum.reduceat(squares, start[:-1]), count, axis=0)
        pair, point = np.divmod(np.flatnonzero(squares == least), squares.shape[1])
        found[self._points[group[pair], point][::-1]] = part[pair][::-1]  # of equal ones the first
        return found


# --- Smoothing of interfaces between parts ----------------------------------------------------


def flatten_interfaces(graph: CellGraph, part: Array, key: Array, wanted: Array) -> Array:
    """Move cells to the neighbouring part that most of their surroundings belong to. Collective.

    Of each part count the cells that share a vertex with a cell, once for each such vertex, and
    those that share a facet with it twelve times more. A cell that counts more of a neighbour's
    part than of its own joins it, which takes off what sticks out of an interface. Some of the new
    parts may no longer be connected through facets. ``wanted`` is the number of cells that each
    part should have, 0 where it stays as it is; the keys of the cells, ``(n,)``, draw lots.
    """
    n, num_parts, comm = graph.num_cells, len(wanted), graph.comm
    around = incidence(graph.vertices, graph.num_nodes + 1).T.tocsr()
    every = graph.with_ghosts(part.astype(np.int32))
    near = np.flatnonzero(np.any(every[graph.across] != every[:n, None], axis=1))
    for turn in range(ROUND.flattening):
        near = near[np.any(every[graph.across[near]] != every[near, None], axis=1)]
        own = every[near]
        mine, most, best = _majority(every, graph.vertices[near], around, near, graph.across[near])
        wants = (most > mine) & (wanted[own] > 0)
        if not any_rank(comm, wants):
            break
        # half of those that want to move, so that neighbours do not just exchange their parts
        lot = mix(key[near] + np.uint64(turn)) & np.uint64(1)
        size = sizes_of(every[:n], num_parts, comm) / np.maximum(wanted, 1.0)
        moving = wants & (lot == 0)
        moving &= (size[best] < ROUND.gains) & (size[own] > ROUND.loses)
        part = every[:n].copy()
        part[near[moving]] = best[moving]
        now = graph.with_ghosts(part)
        touched = np.zeros(graph.num_nodes + 1, dtype=bool)
        touched[graph.vertices[now != every]] = True
        touched[-1] = False
        active = np.zeros(len(every), dtype=bool)
        active[around[np.flatnonzero(touched)].indices] = True
        active[near[wants]] = True
        near, every = np.flatnonzero(active[:n]), now
    return every[:n]


def _majority(
    every: Array, corners: Array, around: csr_array, cell: Array, across: Array
) -> tuple[Array, Array, Array]:
    """Return of each cell its own part's count, and of the others' the highest and its part.

    ``around`` has the cells at each node, ``across`` those across a facet of each of these cells.
    """
    num_parts, own = int(every.max(initial=0)) + 1, every[cell]
    seen = np.zeros(around.shape[0], dtype=bool)
    seen[corners] = True
    place = (np.cumsum(seen) - 1)[corners]
    met = around[np.flatnonzero(seen)] @ incidence(every[:, None], num_parts)
    facets = incidence(every[np.column_stack((cell, across))], num_parts)
    facets.data[:] = np.column_stack((np.ones(len(cell)), across != cell[:, None])).ravel()
    facets.sum_duplicates()
    counted = incidence(place, met.shape[0]) @ met
    counted = csr_array(counted.multiply(facets > 0) + ROUND.facet * facets)
    counted.sort_indices()
    is_own = counted.indices == np.repeat(own, np.diff(counted.indptr))
    mine, start = counted.data[is_own] - ROUND.facet, counted.indptr[:-1]
    counted.data[is_own] = 0.0
    most = np.maximum.reduceat(counted.data, start) if len(own) else mine
    less = counted.data < np.repeat(most, np.diff(counted.indptr))
    part = np.where(less, num_parts, counted.indices)  # of equal ones the first
    return mine, most, np.minimum.reduceat(part, start) if len(own) else own
