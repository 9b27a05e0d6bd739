"""Common parts of projected facets, all pairs at once."""

from __future__ import annotations

from dataclasses import dataclass

import basix
import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.mortar.tolerances import SEARCH


@dataclass(frozen=True)
class CommonParts:
    """Convex parts of lines or planes, one for each pair of facets."""

    vertices: Array  # in order, shape (n, k, tdim)
    count: Array  # how many of them are used, 0 where there is no part, shape (n,)
    size: Array  # length or area, shape (n,)

    def __getitem__(self, rows: Array) -> CommonParts:
        return CommonParts(self.vertices[rows], self.count[rows], self.size[rows])

    @property
    def middle(self) -> Array:
        """Mean of the vertices, shape ``(n, tdim)``."""
        used = np.arange(self.vertices.shape[1]) < self.count[:, None]
        total = np.sum(np.where(used[:, :, None], self.vertices, 0.0), axis=1)
        return total / np.maximum(self.count, 1)[:, None]

    def corners(self) -> tuple[Array, Array]:
        """Part of each vertex that is used, and the vertices, shape ``(m, tdim)``."""
        part, place = np.nonzero(np.arange(self.vertices.shape[1]) < self.count[:, None])
        return part, self.vertices[part, place]

    def quadrature(self, degree: int) -> tuple[Array, Array, Array]:
        """Quadrature of all parts that is exact to a degree; polygons are cut into triangles.

        Return the part of each point, points of shape ``(m, tdim)``, weights of shape ``(m,)``.
        """
        y, count = self.vertices, self.count
        if y.shape[2] == 1:
            x, w = basix.make_quadrature(basix.CellType.interval, degree)
            part = np.flatnonzero(count)
            a, sides = y[part, 0], (y[part, 1] - y[part, 0])[:, None]
            scale = np.abs(sides[:, 0, 0])
        else:
            x, w = basix.make_quadrature(basix.CellType.triangle, degree)
            part, k = np.nonzero(np.arange(2, y.shape[1]) < count[:, None])
            a = y[part, 0]
            sides = np.stack((y[part, k + 1], y[part, k + 2]), axis=1) - a[:, None]
            scale = np.abs(np.linalg.det(sides))
        points = (a[:, None] + x @ sides).reshape(-1, y.shape[2])
        return np.repeat(part, len(w)), points, (scale[:, None] * w).ravel()


def common_parts(subject: Array, clip: Array) -> CommonParts:
    """Intersect pairs of intervals, or of convex polygons (Sutherland, Hodgman 1974).

    Vertices are in order, shapes ``(n, k, tdim)`` and ``(n, l, tdim)``. Parts have up to 2 or k + l
    vertices; there are none where facets are apart or meet in a sliver only.
    """
    whole = sizes(clip)
    if subject.shape[2] == 1:
        low = np.maximum(subject.min(axis=1), clip.min(axis=1))
        high = np.minimum(subject.max(axis=1), clip.max(axis=1))
        vertices, count = np.stack((low, high), axis=1), np.full(len(clip), 2)
        size = (high - low)[:, 0]
    else:
        n, sides = clip.shape[:2]
        turned = (_signed_area(clip, np.full(n, sides)) < 0.0)[:, None, None]
        clip = np.where(turned, clip[:, ::-1], clip)
        count = np.full(n, subject.shape[1])
        vertices = np.concatenate((subject, np.zeros((n, sides, 2))), axis=1)
        for side in range(sides):
            start, end = clip[:, side], clip[:, (side + 1) % sides]
            vertices, count = _cut(vertices, count, start, end - start)
        size = np.abs(_signed_area(vertices, count))
    met = size > SEARCH.sliver * whole
    return CommonParts(vertices, np.where(met, count, 0), np.where(met, size, 0.0))


def sizes(polygon: Array) -> Array:
    """Length of intervals or area of polygons with vertices in order, shape ``(n, k, tdim)``."""
    if polygon.shape[2] == 1:
        return np.ptp(polygon[:, :, 0], axis=1)
    return np.abs(_signed_area(polygon, np.full(len(polygon), polygon.shape[1])))


def contains(polygon: Array, y: Array) -> Array:
    """Tell which intervals or convex polygons, ``(n, k, d)``, contain their point, ``(n, d)``."""
    if polygon.shape[2] == 1:
        return np.all((polygon.min(axis=1) < y) & (y < polygon.max(axis=1)), axis=1)
    edge = np.roll(polygon, -1, axis=1) - polygon
    offset = y[:, None] - polygon
    side = edge[:, :, 0] * offset[:, :, 1] - edge[:, :, 1] * offset[:, :, 0]
    return np.all(side > 0.0, axis=1) | np.all(side < 0.0, axis=1)


def _cut(polygon: Array, count: Array, point: Array, direction: Array) -> tuple[Array, Array]:
    """Keep what lies to the left of a line through a point."""
    n, room = polygon.shape[:2]
    k = np.arange(room)
    used = k < count[:, None]
    following = np.where(k + 1 < count[:, None], k + 1, 0)
    offset = polygon - point[:, None]
    side = direction[:, :1] * offset[:, :, 1] - direction[:, 1:] * offset[:, :, 0]
    next_side = np.take_along_axis(side, following, axis=1)
    next_vertex = np.take_along_axis(polygon, following[:, :, None], axis=1)
    stays = used & (side >= 0.0)
    crosses = used & ((side >= 0.0) != (next_side >= 0.0))
    gap = np.where(crosses, side - next_side, 1.0)
    crossing = polygon + (side / gap)[:, :, None] * (next_vertex - polygon)
    # in order: a vertex that stays, then the crossing of the edge that leaves it
    emitted = np.stack((stays, crosses), axis=2).reshape(n, 2 * room)
    vertices = np.stack((polygon, crossing), axis=2).reshape(n, 2 * room, 2)
    place = np.cumsum(emitted, axis=1) - 1
    row, source = np.nonzero(emitted & (place < room))
    result = np.zeros_like(polygon)
    result[row, place[row, source]] = vertices[row, source]
    return result, np.minimum(emitted.sum(axis=1), room)


def _signed_area(polygon: Array, count: Array) -> Array:
    k = np.arange(polygon.shape[1])
    following = np.where(k + 1 < count[:, None], k + 1, 0)
    after = np.take_along_axis(polygon, following[:, :, None], axis=1)
    cross = polygon[:, :, 0] * after[:, :, 1] - polygon[:, :, 1] * after[:, :, 0]
    return 0.5 * np.sum(np.where(k < count[:, None], cross, 0.0), axis=1)
