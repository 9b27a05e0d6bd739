"""Mortar segments: who meets whom, clipped to common parts, all pairs at once."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import chain

import basix
import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange, any_rank
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import (
    POLYGON,
    FacetKind,
    Facets,
    densities,
    facet_kind,
    facing_shares,
    points,
    reference_points,
    unit,
)
from tfeti_dolfinx.mortar.tolerances import SEARCH

# --- Common parts of projected facets ---------------------------------------------------------


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


# --- Orthonormal frames of contact nodes ------------------------------------------------------


def frames(normal: Array) -> Array:
    """Right-handed frames of unit normals, normal first, then ``tangents``: ``(n, gdim, gdim)``."""
    return np.concatenate((normal[:, None], tangents(normal)), axis=1)


def aligned(frame: Array, direction: Array) -> tuple[Array, Array]:
    """Frames, ``(n, 3, 3)``, whose first tangent is along a unit vector, as far as it can be.

    Return them, and how long the direction's tangential part is, shape ``(n,)``; where it is 0 the
    frame is as it was.
    """
    normal = frame[:, 0]
    first = direction - np.sum(direction * normal, axis=1, keepdims=True) * normal
    length = np.linalg.norm(first, axis=1)
    known = (length > 0.0)[:, None]
    first = np.where(known, first / np.where(known, length[:, None], 1.0), frame[:, 1])
    # what rounding has left of the normal in a short tangent
    first -= np.sum(first * normal, axis=1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((normal, first, np.cross(normal, first)), axis=1), length


def tangents(normal: Array) -> Array:
    """Return orthonormal tangents of unit normals: ``(n, gdim)`` to ``(n, gdim - 1, gdim)``.

    In 2D the normal turned left by a right angle. In 3D the x axis without its normal part (the y
    axis where the normal is within 26° of the x axis), and the normal times that. They are
    continuous in the normal but for this switch. A scalar space has none.
    """
    gdim = normal.shape[1]
    if gdim == 1:
        return np.empty((len(normal), 0, 1))
    if gdim == 2:
        return np.stack((-normal[:, 1], normal[:, 0]), axis=1)[:, None]
    axis = np.eye(3)[(np.abs(normal[:, 0]) >= SEARCH.axis_switch).astype(np.int64)]
    first = axis - np.sum(axis * normal, axis=1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(normal, first)), axis=1)


# --- Search for pairs of facets ---------------------------------------------------------------


def rendezvous(
    secondary: Facets, primary: Facets, distance: float, comm: MPI.Intracomm
) -> tuple[Facets, Facets]:
    """Bring facets that may meet to the same rank. Collective.

    Each secondary facet goes to one rank, in chunks of equal number that are compact in space; a
    primary facet goes to every rank whose box it comes near, up to a distance beside their own
    sizes.
    """
    here = secondary.sent(Exchange(comm, bisect_points(secondary.centre, comm.size, comm)))
    size = here.radius.max(initial=0.0)
    x, gdim = here.x, here.x.shape[2]
    low, high = x.min(axis=(0, 1), initial=np.inf), x.max(axis=(0, 1), initial=-np.inf)
    boxes = np.empty((comm.size, 2, gdim))
    comm.Allgather(np.stack((low - size, high + size)), boxes)
    margin = distance + primary.radius[:, None]
    low, high = primary.x.min(axis=1) - margin, primary.x.max(axis=1) + margin
    # ranks that some facet may meet first: they are few, of however many
    reach = low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)
    near = np.flatnonzero(np.all((reach[0] <= boxes[:, 1]) & (reach[1] >= boxes[:, 0]), axis=1))
    meets = (low[:, None] <= boxes[near, 1]) & (high[:, None] >= boxes[near, 0])
    facet, place = np.nonzero(np.all(meets, axis=2))
    return here, primary[facet].sent(Exchange(comm, near[place]))


def possible_pairs(secondary: Facets, primary: Facets, distance: float) -> tuple[Array, Array]:
    """Find pairs of facets that may meet along the secondary facets' normals.

    A primary facet is found if it comes within a secondary facet's radius of the line through that
    facet's centre along its averaged normal, no farther than ``distance`` and the facets' sizes to
    both sides. Those of each size, up to a factor of 2, have a tree of their own, so that a graded
    mesh does not make large facets meet small ones in vain.
    """
    s_centre, s_size = secondary.centre, secondary.radius
    p_centre, p_size = primary.centre, primary.radius
    direction = unit(secondary.vertex_normals.sum(axis=1))
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


def _march(
    tree: cKDTree, origin: Array, direction: Array, radius: Array, half_length: Array
) -> tuple[Array, Array]:
    """Return points of a tree within a radius of line segments: steps as long as nothing is near.

    A segment has its middle, a unit vector, a radius and half its length. Some of the pairs of a
    segment and a point come more than once.
    """
    segments: list[Array] = [np.empty(0, dtype=np.int64)]
    points: list[Array] = [np.empty(0, dtype=np.int64)]
    front = -half_length  # all before it has been seen
    active = np.arange(len(origin))
    while len(active):
        t = front[active] + radius[active]
        x = origin[active] + t[:, None] * direction[active]
        distance, _ = tree.query(x)
        close = distance <= 2.0 * radius[active]
        hits = tree.query_ball_point(x[close], 2.0 * radius[active[close]])
        count = np.fromiter(map(len, hits), dtype=np.int64, count=len(hits))
        segments.append(np.repeat(active[close], count))
        points.append(np.fromiter(chain.from_iterable(hits), dtype=np.int64, count=count.sum()))
        front[active] = t + np.where(close, radius[active], distance - radius[active])
        active = active[front[active] < half_length[active]]
    return np.concatenate(segments), np.concatenate(points)


# --- Segments and their quadrature points -----------------------------------------------------


@dataclass(frozen=True)
class FacingPoints:
    """Points of secondary facets, and points of primary facets that they face."""

    secondary: Array  # secondary facet of each, shape (m,)
    primary: Array  # primary facet of each, shape (m,)
    xi: Array  # reference coordinates on the secondary facet, shape (m, tdim)
    eta: Array  # reference coordinates on the primary facet, shape (m, tdim)


@dataclass(frozen=True)
class Segments:
    """The common parts of facing facets."""

    points: FacingPoints  # quadrature points
    weight: Array  # their weights, areas on the secondary facet, shape (m,)
    corners: FacingPoints  # the corners of the parts
    whole: Array  # whether each secondary facet is covered wholly, shape (n,)
    averted: bool  # whether facets near enough were passed over because they do not face


def find_segments(
    kind: FacetKind,
    secondary: Facets,
    primary: Facets,
    pairs: tuple[Array, Array],
    depth: float,
    height: float,
    aside: bool,
) -> Segments:
    """Clip pairs of facets on the secondary facets' averaged normal planes.

    Facets that overlap by more than the depth along the normal, or are farther apart than the
    height, do not meet; these lengths are exceeded by the facets' own sizes, so that no facet
    within them is covered in part only. They may be reached from the side, ``aside``, or not.
    """
    planes = _Planes(kind, secondary, primary)
    # 1. common parts of facets that are neither too far nor seen from the side
    found = planes.meetings(*pairs)
    slack = secondary.radius[found.s] + primary.radius[found.p]
    within = (found.distance >= -depth - slack) & (found.distance <= height + slack)
    found = found[within & (np.abs(found.cosine) > -SEARCH.facing)]
    # 2. those that face each other, not through a thin body
    facing = found.cosine < SEARCH.facing
    averted = not np.all(facing)
    found = found[facing & ~planes.behind(found, facing)]
    # 3. of several layers the first
    found = found[planes.first_layer(found)]
    # 4. a body reaches into another from the side where it lies deeper in it than it is wide there
    share = np.bincount(found.s, found.parts.size, minlength=len(secondary)) / planes.size
    partly = aside & (share < 1.0 - SEARCH.uncovered)
    width = np.where(partly, 2.0 * share * secondary.radius, np.inf)
    found = found[found.distance >= -width[found.s]]
    # 5. quadrature on the planes, and the points of both facets over it
    pair, y, weight = found.parts.quadrature(_degree(kind, secondary, primary))
    at, s = planes.facing(found, pair, y), found.s[pair]
    on_plane = densities(kind.geometry, planes.nodes[s], at.xi)
    slant = densities(kind.geometry, secondary.x[s], at.xi) / on_plane
    covered = np.bincount(found.s, found.parts.size, minlength=len(secondary))
    return Segments(
        points=at,
        weight=weight * slant,
        corners=planes.facing(found, *found.parts.corners()),
        whole=covered >= (1.0 - SEARCH.uncovered) * planes.size,
        averted=averted,
    )


def met_at_edges(
    dofs: TornDofs,
    edges: tuple[Array, Array],
    normals: Array,
    segments: Segments,
    secondary: Facets,
    primary: Facets,
    across: Array | None,
) -> tuple[Array, Array, Facets, Segments]:
    """Return normals, corners, secondary facets and segments of surfaces with edges. Collective.

    The mean of an edge's faces is no direction in which an edge that slides is stopped, and a side
    that stands on what the other body has there does not bear. Owned groups have flags ``edges`` of
    both surfaces, as at rest, and ``normals`` of the secondary one; on planes of symmetry, by flags
    ``across`` of components, these stay in them. Corners are flags of edges that meet two sides.
    """
    at, edge = segments.points, edges[0]
    if not any_rank(dofs.comm, bool(np.any(edges))):
        return normals, edge, secondary, segments
    # 1. facets count as they face each other, beside those at the same vertices that do so most
    hats, vertices, s = facet_kind(dofs).hats, secondary.vertices, at.secondary
    cosine = np.maximum(-np.sum(secondary.normal[s] * primary.normal[at.primary], axis=1), 0.0)
    seen = facing_shares(dofs, vertices, s, cosine, edge, SEARCH.aslant)
    segments = replace(segments, weight=segments.weight * seen)
    # 2. the mean of what an edge meets is its normal, unless that turns as at an edge
    share = segments.weight[:, None] * hats.values(at.xi)
    faced = -points(hats, primary.vertex_normals[at.primary], at.eta)
    faced = np.column_stack((faced, np.ones(len(faced))))
    faced = (share[:, :, None] * faced[:, None]).reshape(-1, dofs.bs + 1)
    *_, total = (sums := dofs.reduce_on_owners(vertices[s].ravel(), faced)).T
    corner = edge & (np.linalg.norm(faced := sums[:, :-1], axis=1) < SEARCH.edge * total)
    faced = unit(faced if across is None else np.where(across, 0.0, faced))
    normals = np.where(edge[:, None] & np.any(faced != 0.0, axis=1, keepdims=True), faced, normals)
    turned = replace(secondary, vertex_normals=secondary.at_vertices(dofs, normals))
    return normals, corner, turned, segments


@dataclass(frozen=True)
class _Meetings:
    """Pairs of facets with a common part on the secondary facet's plane."""

    s: Array  # secondary facet of each pair, shape (n,)
    p: Array  # primary facet
    corners: Array  # the primary facet's vertices on the plane, shape (n, v, tdim)
    parts: CommonParts  # the common parts
    cosine: Array  # of the facets' normals
    distance: Array  # along the normal, at the middle of the common part

    def __getitem__(self, rows: Array) -> _Meetings:
        return _Meetings(*(getattr(self, f.name)[rows] for f in fields(self)))


class _Planes:
    """The planes of secondary facets: through their centres, along their averaged normals."""

    def __init__(self, kind: FacetKind, secondary: Facets, primary: Facets) -> None:
        self._kind, self._secondary, self._primary = kind, secondary, primary
        self._order = POLYGON[kind.hats.facet]
        self.normal = unit(secondary.vertex_normals.sum(axis=1))
        self._centre, self._tangents = secondary.corners.mean(axis=1), tangents(self.normal)
        self.nodes = self._on_planes(secondary.x, np.arange(len(secondary)))
        self.corners = self.nodes[:, : kind.hats.size]
        self.size = sizes(self.corners[:, self._order])

    def meetings(self, s: Array, p: Array) -> _Meetings:
        """Those of the pairs that have a common part."""
        corners = self._on_planes(self._primary.corners[p], s)
        low, high = self.corners.min(axis=1)[s], self.corners.max(axis=1)[s]
        boxes_meet = np.all((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low), axis=1)
        s, p, corners = s[boxes_meet], p[boxes_meet], corners[boxes_meet]
        parts = common_parts(corners[:, self._order], self.corners[s][:, self._order])
        met = parts.count > 0
        s, p, corners, parts = s[met], p[met], corners[met], parts[met]
        return _Meetings(
            s=s,
            p=p,
            corners=corners,
            parts=parts,
            cosine=np.sum(self._primary.normal[p] * self.normal[s], axis=1),
            distance=self._distance(s, p, corners, parts.middle),
        )

    def behind(self, found: _Meetings, facing: Array) -> Array:
        """Return which overlaps are none: a way out of the primary body lies before them.

        If that ends at a facet that looks the same way as the secondary one, the pair is one of two
        faces that look away from each other through thin bodies.
        """
        same = SEARCH.same_layer * self._secondary.radius[found.s]
        deep = found.distance < -same
        a, there = self._over(found, np.flatnonzero(facing & deep), np.flatnonzero(~facing & deep))
        behind = np.zeros(len(found.s), dtype=bool)
        behind[a[(found.distance[a] < there) & (there < -same[a])]] = True
        return behind

    def first_layer(self, found: _Meetings) -> Array:
        """Return the pairs with no other primary facet before theirs."""
        covered = np.bincount(found.s, found.parts.size, minlength=len(self.size))
        twice = covered > (1.0 + SEARCH.uncovered) * self.size
        several = np.flatnonzero(twice[found.s])
        a, there = self._over(found, several, several)
        first = np.ones(len(found.s), dtype=bool)
        same = SEARCH.same_layer * self._secondary.radius[found.s[a]]
        first[a[there < found.distance[a] - same]] = False
        return first

    def _over(self, found: _Meetings, first: Array, second: Array) -> tuple[Array, Array]:
        """First pairs whose middle a second one of the same facet lies over, and its distance."""
        ordered = second[np.argsort(found.s[second], kind="stable")]
        start = np.searchsorted(found.s[ordered], found.s[first], side="left")
        count = np.searchsorted(found.s[ordered], found.s[first], side="right") - start
        offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        a, b = np.repeat(first, count), ordered[np.repeat(start, count) + offset]
        middle = found.parts.middle
        over = (a != b) & contains(found.corners[b][:, self._order], middle[a])
        a, b = a[over], b[over]
        return a, self._distance(found.s[a], found.p[b], found.corners[b], middle[a])

    def facing(self, found: _Meetings, pair: Array, y: Array) -> FacingPoints:
        """Return the points of both facets of pairs, curved or not, over points y of the planes."""
        s, p = found.s[pair], found.p[pair]
        element, there = self._kind.geometry, self._on_planes(self._primary.x[found.p], found.s)
        return FacingPoints(
            secondary=s,
            primary=p,
            xi=reference_points(element, self.nodes[s], y),
            eta=reference_points(element, there[pair], y),
        )

    def _on_planes(self, x: Array, s: Array) -> Array:
        """Return coordinates on planes s: shape ``(n, v, gdim)`` to ``(n, v, gdim - 1)``."""
        return np.einsum("nvg,ntg->nvt", x - self._centre[s][:, None], self._tangents[s])

    def _distance(self, s: Array, p: Array, corners: Array, y: Array) -> Array:
        """Distance of the vertices' interpolants along the normal at points y of the planes."""
        hats = self._kind.hats
        xi = reference_points(hats, self.corners[s], y)
        eta = reference_points(hats, corners, y)
        apart = points(hats, self._primary.x[p], eta) - points(hats, self._secondary.x[s], xi)
        return np.sum(apart * self.normal[s], axis=1)


def _degree(kind: FacetKind, secondary: Facets, primary: Facets) -> int:
    """Degree of the quadrature: exact on plane intervals, triangles and parallelograms."""
    exact = 1 + kind.displacement.degree + (SEARCH.curved_degree if kind.geometry.degree > 1 else 0)
    exact += kind.axisymmetric
    if kind.hats.facet != "quadrilateral":
        return exact
    for facets in (secondary, primary):
        a, b, c, d = facets.corners.transpose(1, 0, 2)
        if np.any(np.linalg.norm(a - b - c + d, axis=1) > SEARCH.parallel * facets.radius):
            return SEARCH.rational_degree
    return 2 * exact
