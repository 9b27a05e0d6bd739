"""Segments: where facets of two surfaces face each other, and quadrature points there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mortar.clipping import CommonParts, common_parts, contains, sizes
from tfeti_dolfinx.mortar.facet_element import POLYGON
from tfeti_dolfinx.mortar.facet_maps import densities, points, reference_points
from tfeti_dolfinx.mortar.facets import FacetKind, Facets
from tfeti_dolfinx.mortar.frames import tangents
from tfeti_dolfinx.mortar.layers import Look, nearest, truly_overlapping
from tfeti_dolfinx.mortar.pairing import centre_normals

# Facets whose normals make a larger angle than about 88 degrees with each other do not face: seen
# from the side they have no common part but slivers, and rounding must not decide.
FACING = -0.03
# hats of quadrilaterals that are no parallelograms (by more than rounding, of their radius) are
# rational on the plane: no degree is exact, this one leaves less than the mesh does
PARALLEL, TWISTED = 1e-10, 12
# on curved facets areas are no polynomials: so many degrees more than on plane ones
CURVED = 2
# share of a facet that rounding of the common parts may leave uncovered
WHOLE = 1e-6


@dataclass(frozen=True)
class FacingPoints:
    """Points of secondary facets, and points of primary facets that they face.

    Attributes:
        secondary: Secondary facet of each, shape ``(m,)``.
        primary: Primary facet of each, shape ``(m,)``.
        xi: Reference coordinates on the secondary facet, shape ``(m, tdim)``.
        eta: Reference coordinates on the primary facet, shape ``(m, tdim)``.
    """

    secondary: Array
    primary: Array
    xi: Array
    eta: Array


@dataclass(frozen=True)
class Segments:
    """The common parts of facing facets.

    Attributes:
        points: Quadrature points.
        weight: Their weights, areas on the secondary facet, shape ``(m,)``.
        corners: The corners of the parts.
        whole: Whether each secondary facet is covered wholly, shape ``(n,)``.
        averted: Whether facets near enough were passed over because they do not face.
    """

    points: FacingPoints
    weight: Array
    corners: FacingPoints
    whole: Array
    averted: bool


def find_segments(
    kind: FacetKind,
    secondary: Facets,
    primary: Facets,
    pairs: tuple[Array, Array],
    depth: float,
    height: float,
) -> Segments:
    """Clip pairs of facets on the secondary facets' averaged normal planes.

    Of several primary facets over the same place the first one is met; facets that face each
    other through thin bodies do not meet (``layers``). Lengths are exceeded by the facets' own
    sizes, so that no facet within them is covered in part only.

    Args:
        kind: Elements on the facets.
        secondary: Secondary facets with averaged normals.
        primary: Primary facets.
        pairs: Secondary and primary facet of each pair.
        depth: Facets that overlap by more than this along the normal do not meet.
        height: Nor do facets farther apart than this.
    """
    planes = _Planes(kind, secondary, primary)
    found = planes.meetings(*pairs)
    slack = secondary.radius[found.s] + primary.radius[found.p]
    within = (found.distance >= -depth - slack) & (found.distance <= height + slack)
    found = found[within & (np.abs(found.cosine) > -FACING)]
    facing, length = found.cosine < FACING, secondary.radius
    averted = bool(np.any(~facing))
    found = found[truly_overlapping(found.s, found.distance, facing, length, planes.look(found))]
    size = found.parts.size, planes.size
    found = found[nearest(found.s, found.distance, length, *size, planes.look(found))]
    pair, y, weight = found.parts.quadrature(_degree(kind, secondary, primary))
    at = planes.facing(found, pair, y)
    covered = np.bincount(found.s, found.parts.size, minlength=len(secondary))
    return Segments(
        points=at,
        weight=weight * planes.slant(at),
        corners=planes.facing(found, *found.parts.corners()),
        whole=covered >= (1.0 - WHOLE) * planes.size,
        averted=averted,
    )


@dataclass(frozen=True)
class _Meetings:
    """Pairs of facets with a common part on the secondary facet's plane.

    Attributes:
        s: Secondary facet of each pair, shape ``(n,)``.
        p: Primary facet.
        corners: The primary facet's vertices on the plane, shape ``(n, v, tdim)``.
        parts: The common parts.
        cosine: Of the facets' normals.
        distance: Along the normal, at the middle of the common part.
    """

    s: Array
    p: Array
    corners: Array
    parts: CommonParts
    cosine: Array
    distance: Array

    def __getitem__(self, rows: Array) -> _Meetings:
        return _Meetings(*(getattr(self, f.name)[rows] for f in fields(self)))


class _Planes:
    """The planes of secondary facets: through their centres, along their averaged normals."""

    def __init__(self, kind: FacetKind, secondary: Facets, primary: Facets) -> None:
        self._kind, self._secondary, self._primary = kind, secondary, primary
        self._order = POLYGON[kind.facet]
        corners = secondary.corners(kind.num_vertices)
        self.normal = centre_normals(secondary)
        self._centre, self._tangents = corners.mean(axis=1), tangents(self.normal)
        self._nodes = self._on_planes(secondary.x, np.arange(len(secondary)))
        self.corners = self._nodes[:, : kind.num_vertices]
        self.size = sizes(self.corners[:, self._order])

    def meetings(self, s: Array, p: Array) -> _Meetings:
        """Those of the pairs that have a common part."""
        corners = self._on_planes(self._primary.corners(self._kind.num_vertices)[p], s)
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

    def look(self, found: _Meetings) -> Look:
        """Whether the primary facet of pair b lies over pair a's middle, and how far."""
        middle = found.parts.middle

        def at(a: Array, b: Array) -> tuple[Array, Array]:
            over = contains(found.corners[b][:, self._order], middle[a])
            there = np.full(len(a), np.inf)
            a, b = a[over], b[over]
            there[over] = self._distance(found.s[a], found.p[b], found.corners[b], middle[a])
            return over, there

        return at

    def facing(self, found: _Meetings, pair: Array, y: Array) -> FacingPoints:
        """What lies over points y of the planes on both facets of pairs, curved or not."""
        s, p = found.s[pair], found.p[pair]
        element, there = self._kind.geometry, self._on_planes(self._primary.x[found.p], found.s)
        return FacingPoints(
            secondary=s,
            primary=p,
            xi=reference_points(element, self._nodes[s], y),
            eta=reference_points(element, there[pair], y),
        )

    def slant(self, at: FacingPoints) -> Array:
        """Area on the secondary facet per area on its plane, shape ``(m,)``."""
        element, s = self._kind.geometry, at.secondary
        area = densities(element, self._secondary.x[s], at.xi)
        return area / densities(element, self._nodes[s], at.xi)

    def _on_planes(self, x: Array, s: Array) -> Array:
        """Coordinates on planes s: shape ``(n, v, gdim)`` to ``(n, v, gdim - 1)``."""
        return np.einsum("nvg,ntg->nvt", x - self._centre[s][:, None], self._tangents[s])

    def _distance(self, s: Array, p: Array, corners: Array, y: Array) -> Array:
        """Distance along the normal at points y of the planes, p's vertices there given.

        From the vertices of the facets: it decides what meets what, and is no gap.
        """
        hats = self._kind.hats
        xi = reference_points(hats, self.corners[s], y)
        eta = reference_points(hats, corners, y)
        apart = points(hats, self._primary.x[p], eta) - points(hats, self._secondary.x[s], xi)
        return np.sum(apart * self.normal[s], axis=1)


def _degree(kind: FacetKind, secondary: Facets, primary: Facets) -> int:
    """Degree of the quadrature: exact on plane intervals, triangles and parallelograms."""
    exact = 1 + kind.displacement.degree + (CURVED if kind.geometry.degree > 1 else 0)
    if kind.facet != "quadrilateral":
        return exact
    for facets in (secondary, primary):
        a, b, c, d = facets.corners(4).transpose(1, 0, 2)
        if np.any(np.linalg.norm(a - b - c + d, axis=1) > PARALLEL * facets.radius):
            return TWISTED
    return 2 * exact
