"""Which facets of two surfaces may meet: rendezvous of ranks, then a tree on each."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mortar.facets import Facets
from tfeti_dolfinx.parallel import Exchange

# asked of a tree at first, and twice as many where that was not all: facets of one size class have
# about 20 neighbours within their radii
NEIGHBOURS = 64


def rendezvous(
    secondary: Facets, primary: Facets, distance: float, comm: MPI.Intracomm
) -> tuple[Facets, Facets]:
    """Bring facets that may meet to the same rank. Collective.

    Each secondary facet goes to one rank, in chunks of equal number that are compact in space;
    a primary facet goes to every rank whose box it comes near.

    Args:
        secondary: Secondary facets of this rank.
        primary: Primary facets of this rank.
        distance: How far apart facets may be, their own sizes not counted.
        comm: Communicator.

    Returns:
        The secondary and the primary facets that have come to this rank.
    """
    here = secondary.sent(Exchange(comm, bisect_points(secondary.centre, comm.size, comm)))
    size = here.radius.max(initial=0.0)
    low, high = here.box()
    gdim = low.shape[1]
    box = np.stack((low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)))
    boxes = np.empty((comm.size, 2, gdim))
    comm.Allgather(box + np.array([[-size], [size]]), boxes)
    low, high = primary.box()
    margin = distance + primary.radius[:, None]
    low, high = low - margin, high + margin
    # ranks that some facet may meet first: they are few, of however many
    reach = low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)
    near = np.flatnonzero(np.all((reach[0] <= boxes[:, 1]) & (reach[1] >= boxes[:, 0]), axis=1))
    meets = np.ones((len(primary), len(near)), dtype=bool)
    for axis in range(gdim):
        meets &= low[:, axis, None] <= boxes[None, near, 1, axis]
        meets &= high[:, axis, None] >= boxes[None, near, 0, axis]
    facet, place = np.nonzero(meets)
    return here, primary.sent(Exchange(comm, near[place]), facet)


def possible_pairs(secondary: Facets, primary: Facets, distance: float) -> tuple[Array, Array]:
    """Pairs of facets that may meet when one looks along the secondary facets' normals.

    A primary facet is found if it comes within a secondary facet's radius of the line through
    that facet's centre along its averaged normal, no farther than ``distance`` and the facets'
    sizes from the centre. Primary facets are sorted into classes of equal size up to a factor of 2,
    each with a tree of its own, so that a graded mesh does not make large facets meet small ones
    in vain.

    Args:
        secondary: Secondary facets, with averaged normals.
        primary: Primary facets.
        distance: How far to look, to both sides.

    Returns:
        Secondary and primary facet of each pair.
    """
    s_centre, s_size = secondary.centre, secondary.radius
    p_centre, p_size = primary.centre, primary.radius
    direction = centre_normals(secondary)
    keys: list[Array] = [np.empty(0, dtype=np.int64)]
    classes = np.floor(np.log2(np.maximum(p_size, 1e-300))).astype(np.int64)
    for size_class in np.unique(classes) if len(secondary) else ():
        members = np.flatnonzero(classes == size_class)
        radius = s_size + p_size[members].max()
        s, hit = _march(cKDTree(p_centre[members]), s_centre, direction, radius, distance + radius)
        p = members[hit]
        offset = p_centre[p] - s_centre[s]
        along = np.sum(offset * direction[s], axis=1)
        aside = np.linalg.norm(offset - along[:, None] * direction[s], axis=1)
        sizes = s_size[s] + p_size[p]
        close = (aside <= sizes) & (np.abs(along) <= distance + sizes + p_size[p])
        keys.append(s[close] * len(primary) + p[close])
    return np.divmod(np.unique(np.concatenate(keys)), max(len(primary), 1))


def centre_normals(facets: Facets) -> Array:
    """Mean of each facet's averaged vertex normals, of unit length, shape ``(n, gdim)``."""
    total = facets.vertex_normals.sum(axis=1)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def _march(
    tree: cKDTree, origin: Array, direction: Array, radius: Array, half_length: Array
) -> tuple[Array, Array]:
    """Points of a tree within a radius of line segments: steps as long as nothing is near.

    Args:
        tree: The points.
        origin: Middle of each segment, shape ``(n, gdim)``.
        direction: Unit vectors, shape ``(n, gdim)``.
        radius: One per segment, shape ``(n,)``.
        half_length: Half the length of each segment, shape ``(n,)``.

    Returns:
        Segment and point of each pair, some more than once.
    """
    found_s: list[Array] = [np.empty(0, dtype=np.int64)]
    found_p: list[Array] = [np.empty(0, dtype=np.int64)]
    front = -half_length  # all before it has been seen
    active = np.arange(len(origin))
    while len(active):
        t = front[active] + radius[active]
        x = origin[active] + t[:, None] * direction[active]
        nearest, _ = tree.query(x)
        close = nearest <= 2.0 * radius[active]
        rows, points = _within(tree, x[close], 2.0 * radius[active[close]])
        found_s.append(active[close][rows])
        found_p.append(points)
        front[active] = t + np.where(close, radius[active], nearest - radius[active])
        active = active[front[active] < half_length[active]]
    return np.concatenate(found_s), np.concatenate(found_p)


def _within(tree: cKDTree, x: Array, radius: Array) -> tuple[Array, Array]:
    """Points of a tree within a radius of each x: row and point of each pair."""
    found: list[tuple[Array, Array]] = [(np.empty(0, dtype=np.int64),) * 2]
    rows, k = np.arange(len(x)), min(NEIGHBOURS, tree.n)
    while len(rows):
        distance, point = tree.query(
            x[rows], k=np.arange(1, k + 1), distance_upper_bound=np.nextafter(radius.max(), np.inf)
        )
        inside = distance <= radius[rows, None]
        row, column = np.nonzero(inside)
        full = inside[:, -1] & (k < tree.n)
        settled = ~full[row]
        found.append((rows[row[settled]], point[row[settled], column[settled]]))
        rows, k = rows[full], min(2 * k, tree.n)
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))
