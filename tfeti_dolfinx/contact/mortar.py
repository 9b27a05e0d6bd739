"""Mortar integrals with dual multipliers, over exact segments."""

from __future__ import annotations

from dataclasses import dataclass

import basix
import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.contact.candidates import centre_normals
from tfeti_dolfinx.contact.clipping import (
    clip_intervals,
    clip_polygons,
    quadrature_on_intervals,
    quadrature_on_polygons,
)
from tfeti_dolfinx.contact.facet_element import POLYGON, reference_points
from tfeti_dolfinx.contact.facets import FacetKind, Facets

# facets whose normals make a larger angle than about 88 degrees with each other do not face
FACING = -0.03
HARDLY_COVERED = 1e-6


@dataclass(frozen=True)
class Segments:
    """Quadrature points of the common parts of facing facets.

    Attributes:
        secondary: Secondary facet of each point, shape ``(m,)``.
        primary: Primary facet of each point, shape ``(m,)``.
        xi: Reference coordinates on the secondary facet, shape ``(m, tdim)``.
        eta: Reference coordinates on the primary facet, shape ``(m, tdim)``.
        weight: Weights, areas on the secondary facet, shape ``(m,)``.
        deepest: Largest overlap of facing facets that were passed over as too deep, or 0.
        averted: Whether facets within reach were passed over because they do not face.
    """

    secondary: Array
    primary: Array
    xi: Array
    eta: Array
    weight: Array
    deepest: float
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
    radius: float,
    reach: float,
    degree: int,
) -> Segments:
    """Clip pairs of facets on the secondary facets' averaged normal planes.

    Args:
        kind: Elements on the facets.
        secondary: Secondary facets with averaged normals.
        primary: Primary facets.
        pairs: Secondary and primary facet of each pair.
        radius: Facets that overlap by more than this along the normal do not meet.
        reach: Nor do facets farther apart than this.
        degree: Degree of the quadrature.
    """
    s, p = pairs
    v, tdim = kind.num_vertices, secondary.x.shape[2] - 1
    centre, normal, tangents = _planes(secondary, v)
    corners_s = _on_planes(secondary.corners(v), centre, tangents)
    corners_p = _on_planes(primary.corners(v)[p], centre[s], tangents[s])
    boxes_meet = np.all(
        (corners_p.min(axis=1) <= corners_s.max(axis=1)[s])
        & (corners_p.max(axis=1) >= corners_s.min(axis=1)[s]),
        axis=1,
    )
    s, p, corners_p = s[boxes_meet], p[boxes_meet], corners_p[boxes_meet]
    cosine = np.sum(primary.normal[p] * normal[s], axis=1)
    facing = cosine < FACING
    order = POLYGON[kind.facet]
    if tdim == 1:
        ends, met = clip_intervals(corners_p[:, :, 0], corners_s[s, :, 0])
        middle = ends.mean(axis=1, keepdims=True)
    else:
        polygon, count = clip_polygons(corners_p[:, order], corners_s[s][:, order])
        met = count > 0
        used = np.arange(polygon.shape[1]) < count[:, None]
        total = np.sum(np.where(used[:, :, None], polygon, 0.0), axis=1)
        middle = total / np.maximum(count, 1)[:, None]
    met &= np.abs(cosine) > -FACING
    distance = np.full(len(s), np.inf)
    distance[met] = _distance(
        kind, secondary, primary, s[met], p[met], middle[met], corners_s, corners_p[met], normal
    )
    near = met & (distance >= -radius) & (distance <= reach)
    deep = met & facing & (distance < -radius) & (distance >= -reach)
    kept = np.flatnonzero(near & facing)
    if tdim == 1:
        owner, y, weight = quadrature_on_intervals(ends[kept], degree)
    else:
        owner, y, weight = quadrature_on_polygons(polygon[kept], count[kept], degree)
    pair = kept[owner]
    slope = np.abs(np.sum(normal * secondary.normal, axis=1))
    return Segments(
        secondary=s[pair],
        primary=p[pair],
        xi=reference_points(kind.facet, corners_s[s[pair]], y),
        eta=reference_points(kind.facet, corners_p[pair], y),
        weight=weight / slope[s[pair]],
        deepest=float(-distance[deep].min(initial=0.0)),
        averted=bool(np.any(near & ~facing)),
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
    apart = positions(kind, primary.x[p], segments.eta) - positions(
        kind, secondary.x[s], segments.xi
    )
    gap = dual.integrals(apart)
    key = s.astype(np.int64) * max(len(primary), 1) + p
    pair, pair_row = np.unique(key, return_inverse=True)
    theirs = kind.displacement.values(segments.eta)
    return MortarIntegrals(
        facet=dual.facet,
        own=dual.integrals(kind.displacement.values(segments.xi)),
        gap=np.sum(gap * secondary.vertex_normals[dual.facet], axis=2),
        covered=dual.covered,
        pair_secondary=pair // max(len(primary), 1),
        pair_primary=pair % max(len(primary), 1),
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


def _planes(facets: Facets, num_vertices: int) -> tuple[Array, Array, Array]:
    """Centre, averaged normal and tangents of each facet's plane."""
    normal = centre_normals(facets)
    if normal.shape[1] == 2:
        tangents = np.stack((-normal[:, 1], normal[:, 0]), axis=1)[:, None]
    else:
        axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
        first = np.cross(normal, axis)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        tangents = np.stack((first, np.cross(normal, first)), axis=1)
    return facets.corners(num_vertices).mean(axis=1), normal, tangents


def _on_planes(x: Array, centre: Array, tangents: Array) -> Array:
    """Coordinates on planes: shape ``(n, v, gdim)`` to ``(n, v, gdim - 1)``."""
    return np.einsum("nvg,ntg->nvt", x - centre[:, None], tangents)


def _distance(
    kind: FacetKind,
    secondary: Facets,
    primary: Facets,
    s: Array,
    p: Array,
    y: Array,
    corners_s: Array,
    corners_p: Array,
    normal: Array,
) -> Array:
    """Distance of the facets along the normal, at a point of each pair's plane."""
    x_s = positions(kind, secondary.x[s], reference_points(kind.facet, corners_s[s], y))
    x_p = positions(kind, primary.x[p], reference_points(kind.facet, corners_p, y))
    return np.sum((x_p - x_s) * normal[s], axis=1)


def positions(kind: FacetKind, x: Array, xi: Array) -> Array:
    """Points at reference coordinates of facets with geometry nodes x."""
    return np.einsum("mg,mgd->md", kind.geometry.values(xi), x)
