"""Segments: the common parts of projected facets, all pairs at once."""

from __future__ import annotations

from dataclasses import dataclass

import basix
import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.mortar.tolerances import SEARCH


@dataclass(frozen=True)
class CommonParts:
    """Convex parts of lines or planes, one for each pair of facets.

    Attributes:
        vertices: In order, shape ``(n, k, tdim)``.
        count: How many of them are used, 0 where there is no part, shape ``(n,)``.
        size: Length or area, shape ``(n,)``.
    """

    vertices: Array
    count: Array
    size: Array

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
        """Part of each point, points of shape ``(m, tdim)``, weights, exact up to a degree."""
        if self.vertices.shape[2] == 1:
            return quadrature_on_intervals(self.vertices[:, :, 0], degree)
        return quadrature_on_polygons(self.vertices, self.count, degree)


def common_parts(subject: Array, clip: Array) -> CommonParts:
    """Intersect pairs of intervals or of convex polygons.

    Args:
        subject: Vertices in order, shape ``(n, k, tdim)``.
        clip: Vertices in order, shape ``(n, l, tdim)``.
    """
    if subject.shape[2] == 1:
        ends, met = clip_intervals(subject[:, :, 0], clip[:, :, 0])
        size = np.where(met, ends[:, 1] - ends[:, 0], 0.0)
        return CommonParts(ends[:, :, None], np.where(met, 2, 0), size)
    return clip_polygons(subject, clip)


def sizes(polygon: Array) -> Array:
    """Length of intervals or area of polygons with vertices in order, shape ``(n, k, tdim)``."""
    if polygon.shape[2] == 1:
        return np.ptp(polygon[:, :, 0], axis=1)
    return np.abs(_signed_area(polygon, np.full(len(polygon), polygon.shape[1])))


def contains(polygon: Array, y: Array) -> Array:
    """Return whether intervals or convex polygons contain a point each.

    Args:
        polygon: Vertices in order, shape ``(n, k, tdim)``.
        y: Points, shape ``(n, tdim)``.
    """
    if polygon.shape[2] == 1:
        return np.all((polygon.min(axis=1) < y) & (y < polygon.max(axis=1)), axis=1)
    edge = np.roll(polygon, -1, axis=1) - polygon
    offset = y[:, None] - polygon
    side = edge[:, :, 0] * offset[:, :, 1] - edge[:, :, 1] * offset[:, :, 0]
    return np.all(side > 0.0, axis=1) | np.all(side < 0.0, axis=1)


def clip_intervals(subject: Array, clip: Array) -> tuple[Array, Array]:
    """Common parts of pairs of intervals.

    Args:
        subject: End points, shape ``(n, 2)``.
        clip: End points, shape ``(n, 2)``.

    Returns:
        Their ends, shape ``(n, 2)``, low before high, and whether there is any.
    """
    low = np.maximum(subject.min(axis=1), clip.min(axis=1))
    high = np.minimum(subject.max(axis=1), clip.max(axis=1))
    return np.stack((low, high), axis=1), high - low > SEARCH.sliver * np.ptp(clip, axis=1)


def clip_polygons(subject: Array, clip: Array) -> CommonParts:
    """Common parts of pairs of convex polygons (Sutherland, Hodgman 1974).

    Args:
        subject: Vertices in order, shape ``(n, k, 2)``.
        clip: Vertices in order, shape ``(n, l, 2)``.

    Returns:
        CommonParts of up to k + l vertices; none where polygons are apart or meet in a sliver only.
    """
    clip, whole = _counterclockwise(clip)
    n, sides = len(subject), clip.shape[1]
    polygon = np.zeros((n, subject.shape[1] + sides, 2))
    polygon[:, : subject.shape[1]], _ = _counterclockwise(subject)
    count = np.full(n, subject.shape[1])
    for side in range(sides):
        start, end = clip[:, side], clip[:, (side + 1) % sides]
        polygon, count = _cut(polygon, count, start, end - start)
    area = np.abs(_signed_area(polygon, count))
    count[area <= SEARCH.sliver * whole] = 0
    return CommonParts(polygon, count, np.where(count > 0, area, 0.0))


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


def _counterclockwise(polygon: Array) -> tuple[Array, Array]:
    """Return the polygons, counterclockwise, and their areas."""
    area = _signed_area(polygon, np.full(len(polygon), polygon.shape[1]))
    turned = (area < 0.0)[:, None, None]
    return np.where(turned, polygon[:, ::-1], polygon), np.abs(area)


def quadrature_on_intervals(ends: Array, degree: int) -> tuple[Array, Array, Array]:
    """Gauss points of intervals.

    Args:
        ends: Shape ``(n, 2)``.
        degree: Degree that is integrated exactly.

    Returns:
        Interval of each point, points of shape ``(m, 1)``, weights of shape ``(m,)``.
    """
    x, w = basix.make_quadrature(basix.CellType.interval, degree)
    length = ends[:, 1:] - ends[:, :1]
    points = ends[:, :1] + length * x[:, 0]
    owner = np.repeat(np.arange(len(ends)), len(w))
    return owner, points.reshape(-1, 1), (length * w).ravel()


def quadrature_on_polygons(polygon: Array, count: Array, degree: int) -> tuple[Array, Array, Array]:
    """Quadrature points of convex polygons, cut into triangles from their first vertex.

    Args:
        polygon: Vertices, shape ``(n, k, 2)``.
        count: How many of them are used.
        degree: Degree that is integrated exactly.

    Returns:
        Polygon of each point, points of shape ``(m, 2)``, weights of shape ``(m,)``.
    """
    x, w = basix.make_quadrature(basix.CellType.triangle, degree)
    owner, k = np.nonzero(np.arange(2, polygon.shape[1]) < count[:, None])
    a, b, c = polygon[owner, 0], polygon[owner, k + 1], polygon[owner, k + 2]
    points = a[:, None] + x[:, :1] * (b - a)[:, None] + x[:, 1:] * (c - a)[:, None]
    cross = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    weights = np.abs(cross)[:, None] * w
    return np.repeat(owner, len(w)), points.reshape(-1, 2), weights.ravel()
