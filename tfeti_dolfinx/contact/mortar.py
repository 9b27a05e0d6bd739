"""Mortar integrals with dual multipliers, over exact segments."""

from __future__ import annotations

from dataclasses import dataclass, fields

import basix
import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.contact.candidates import centre_normals
from tfeti_dolfinx.contact.clipping import Parts, common_parts, contains, sizes
from tfeti_dolfinx.contact.facet_element import POLYGON, reference_points
from tfeti_dolfinx.contact.facets import FacetKind, Facets
from tfeti_dolfinx.contact.layers import Look, nearest, reachable

# facets whose normals make a larger angle than about 88 degrees with each other do not face
FACING = -0.03
HARDLY_COVERED = 1e-6
# hats of quadrilaterals that are no parallelograms are rational on the plane
PARALLEL, TWISTED = 1e-10, 12


@dataclass(frozen=True)
class Segments:
    """Quadrature points of the common parts of facing facets.

    Attributes:
        secondary: Secondary facet of each point, shape ``(m,)``.
        primary: Primary facet of each point, shape ``(m,)``.
        xi: Reference coordinates on the secondary facet, shape ``(m, tdim)``.
        eta: Reference coordinates on the primary facet, shape ``(m, tdim)``.
        weight: Weights, areas on the secondary facet, shape ``(m,)``.
        averted: Whether facets within reach were passed over because they do not face.
    """

    secondary: Array
    primary: Array
    xi: Array
    eta: Array
    weight: Array
    averted: bool


@dataclass(frozen=True)
class MortarIntegrals:
    """Integrals with the dual multipliers ψ_i of the secondary facets' vertices.

    Attributes:
        facet: Secondary facet of each row of ``own``, ``gap``, ``covered``, shape ``(f,)``.
        own: ∫ψ_i φ_k of the facet's own displacement nodes, shape ``(f, v, t)``.
        gap: ∫ψ_i n_i·(x_primary − x_secondary), shape ``(f, v)``.
        covered: ∫φ_i over the covered part, shape ``(f, v)``.
        pair_secondary: Secondary facet of each row of ``other``, shape ``(q,)``.
        pair_primary: Primary facet of each, shape ``(q,)``.
        other: ∫ψ_i φ_j of the primary facet's displacement nodes, shape ``(q, v, t)``.
    """

    facet: Array
    own: Array
    gap: Array
    covered: Array
    pair_secondary: Array
    pair_primary: Array
    other: Array


@dataclass(frozen=True)
class DualMultipliers:
    """Values of dual multipliers at quadrature points.

    Attributes:
        facet: Facets that have points, shape ``(f,)``.
        row: Place in ``facet`` of each point's facet, shape ``(m,)``.
        weighted: Weight times ψ_i at each point, shape ``(m, v)``.
        covered: ∫φ_i over the part that the points cover, shape ``(f, v)``.
    """

    facet: Array
    row: Array
    weighted: Array
    covered: Array

    def integrals(self, values: Array) -> Array:
        """∫ψ_i f on each facet, from values of f at the points: ``(m, …)`` to ``(f, v, …)``."""
        extra = (1,) * (values.ndim - 1)
        weighted = self.weighted.reshape(*self.weighted.shape, *extra)
        return sum_rows(self.row, weighted * values[:, None], len(self.facet))


def find_segments(
    kind: FacetKind,
    secondary: Facets,
    primary: Facets,
    pairs: tuple[Array, Array],
    depth: float,
    reach: float,
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
        reach: Nor do facets farther apart than this.
    """
    planes = _Planes(kind, secondary, primary)
    found = planes.meetings(*pairs)
    slack = secondary.radius[found.s] + primary.radius[found.p]
    within = (found.distance >= -depth - slack) & (found.distance <= reach + slack)
    found = found[within & (np.abs(found.cosine) > -FACING)]
    facing, length = found.cosine < FACING, secondary.radius
    averted = bool(np.any(~facing))
    found = found[reachable(found.s, found.distance, facing, length, planes.look(found))]
    size = found.parts.size, planes.size
    found = found[nearest(found.s, found.distance, length, *size, planes.look(found))]
    pair, y, weight = found.parts.quadrature(_degree(kind, secondary, primary))
    s, p = found.s[pair], found.p[pair]
    slope = np.abs(np.sum(planes.normal * secondary.normal, axis=1))
    return Segments(
        secondary=s,
        primary=p,
        xi=reference_points(kind.facet, planes.corners[s], y),
        eta=reference_points(kind.facet, found.corners[pair], y),
        weight=weight / slope[s],
        averted=averted,
    )


def dual_multipliers(
    kind: FacetKind, area: Array, facet: Array, xi: Array, weight: Array
) -> DualMultipliers:
    """Multipliers that are biorthogonal to the hats on the part of a facet with points.

    ψ = D_e M_e⁻¹ φ with D_e = diag ∫φ_i and M_e = ∫φ_i φ_j there. They sum up to 1, so a uniform
    pressure is met (Wohlmuth, SIAM J. Numer. Anal. 38, 2000; Cichosz, Bischoff, Comput. Methods
    Appl. Mech. Eng. 200, 2011). A facet that is hardly covered has no share.

    Args:
        kind: Elements on the facets.
        area: Areas of all facets.
        facet: Facet of each point, shape ``(m,)``.
        xi: Reference coordinates of the points, shape ``(m, tdim)``.
        weight: Weights, shape ``(m,)``.
    """
    facets, row = np.unique(facet, return_inverse=True)
    hats = kind.hats.values(xi)
    covered = sum_rows(row, weight[:, None] * hats, len(facets))
    mass = sum_rows(row, weight[:, None, None] * hats[:, :, None] * hats[:, None], len(facets))
    hardly = covered.sum(axis=1) <= HARDLY_COVERED * area[facets]
    mass[hardly] = np.eye(kind.num_vertices)
    covered[hardly] = 0.0
    dual = covered[:, :, None] * np.linalg.inv(mass)
    psi = np.einsum("mij,mj->mi", dual[row], hats)
    return DualMultipliers(facets, row, weight[:, None] * psi, covered)


def integrate(
    kind: FacetKind, secondary: Facets, primary: Facets, segments: Segments
) -> MortarIntegrals:
    """Integrals of the dual multipliers over segments."""
    s, p = segments.secondary, segments.primary
    dual = dual_multipliers(kind, secondary.area, s, segments.xi, segments.weight)
    # from the vertices: a multiplier is negative somewhere, so the mean of a curved gap with it
    # would be below 0 where facets of second order touch
    apart = at_hats(kind, primary.x[p], segments.eta) - at_hats(kind, secondary.x[s], segments.xi)
    gap = dual.integrals(apart)
    stride = max(len(primary), 1)
    pair, pair_row = np.unique(s * stride + p, return_inverse=True)
    theirs = kind.displacement.values(segments.eta)
    return MortarIntegrals(
        facet=dual.facet,
        own=dual.integrals(kind.displacement.values(segments.xi)),
        gap=np.sum(gap * secondary.vertex_normals[dual.facet], axis=2),
        covered=dual.covered,
        pair_secondary=pair // stride,
        pair_primary=pair % stride,
        other=sum_rows(pair_row, dual.weighted[:, :, None] * theirs[:, None], len(pair)),
    )


def whole_facets(kind: FacetKind, facets: Facets, degree: int) -> tuple[Array, Array, Array]:
    """Quadrature points of whole facets.

    Returns:
        Facet of each point, reference coordinates of shape ``(m, tdim)``, weights.
    """
    xi, w = basix.make_quadrature(getattr(basix.CellType, kind.facet), degree)
    n, q = len(facets), len(w)
    facet = np.repeat(np.arange(n), q)
    slopes = np.einsum("tqg,ngd->nqtd", kind.geometry.slopes(xi), facets.x)
    if slopes.shape[2] == 1:
        density = np.linalg.norm(slopes[:, :, 0], axis=2)
    else:
        density = np.linalg.norm(np.cross(slopes[:, :, 0], slopes[:, :, 1]), axis=2)
    return facet, np.tile(xi, (n, 1)), (density * w).ravel()


def hat_areas(kind: FacetKind, facets: Facets) -> Array:
    """∫φ_i over whole facets, shape ``(n, v)``."""
    facet, xi, weight = whole_facets(kind, facets, 2 * kind.geometry.degree)
    return sum_rows(facet, weight[:, None] * kind.hats.values(xi), len(facets))


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
    parts: Parts
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
        self._centre, self._tangents = corners.mean(axis=1), _tangents(self.normal)
        self.corners = self._on_planes(corners, np.arange(len(secondary)))
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

    def _on_planes(self, x: Array, s: Array) -> Array:
        """Coordinates on planes s: shape ``(n, v, gdim)`` to ``(n, v, gdim - 1)``."""
        return np.einsum("nvg,ntg->nvt", x - self._centre[s][:, None], self._tangents[s])

    def _distance(self, s: Array, p: Array, corners: Array, y: Array) -> Array:
        """Distance along the normal at points y of the planes, p's vertices there given."""
        kind = self._kind
        xi = reference_points(kind.facet, self.corners[s], y)
        eta = reference_points(kind.facet, corners, y)
        apart = at_hats(kind, self._primary.x[p], eta) - at_hats(kind, self._secondary.x[s], xi)
        return np.sum(apart * self.normal[s], axis=1)


def _tangents(normal: Array) -> Array:
    """Orthonormal tangents of unit normals, shape ``(n, gdim - 1, gdim)``."""
    if normal.shape[1] == 2:
        return np.stack((-normal[:, 1], normal[:, 0]), axis=1)[:, None]
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(normal, first)), axis=1)


def _degree(kind: FacetKind, secondary: Facets, primary: Facets) -> int:
    """Degree of the quadrature: exact on intervals, triangles and parallelograms."""
    exact = 1 + kind.displacement.degree
    if kind.facet != "quadrilateral":
        return exact
    for facets in (secondary, primary):
        a, b, c, d = facets.corners(4).transpose(1, 0, 2)
        if np.any(np.linalg.norm(a - b - c + d, axis=1) > PARALLEL * facets.radius):
            return TWISTED
    return 2 * exact


def at_hats(kind: FacetKind, x: Array, xi: Array) -> Array:
    """Points at reference coordinates of the plane facets with geometry nodes x."""
    return np.einsum("mv,mvd->md", kind.hats.values(xi), x[:, : kind.num_vertices])
