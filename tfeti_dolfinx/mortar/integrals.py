"""Mortar integrals between facets or the smooth surfaces through them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations_with_replacement

import numpy as np

from tfeti_dolfinx.common.arrays import Array, quotient, sum_rows
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import FacetKind, Facets, points, radii, whole_facets
from tfeti_dolfinx.mortar.multipliers import (
    FacetMultipliers,
    Triplets,
    facet_multipliers,
    held_by_both,
    near_held,
    triplets,
)
from tfeti_dolfinx.mortar.segments import FacingPoints, Segments, tangents
from tfeti_dolfinx.mortar.tolerances import SEARCH

# --- The smooth surface that straight facets stand for ----------------------------------------


def with_curvature(facets: Facets, dofs: TornDofs, kind: FacetKind, across: Array | None) -> Facets:
    """The same facets with the curvature of a smooth surface through their vertices. Collective.

    At each vertex the heights of its neighbours over its tangent plane are fitted by z = a·t + ½
    tᵀKt, a the error of the averaged normal, by least squares of what each neighbour says of the
    curvature. What remains of the normal equations without a is added up over the vertices of a
    facet, so that a vertex at the rim, whose neighbours lie to one side, leaves to the others what
    it does not know. Vertices at edges say nothing; those on planes of symmetry, by flags
    ``across`` of owned groups' components, have mirrored neighbours, too. Facets whose geometry has
    a higher degree are curved themselves, and stay as they are.
    """
    normals = facets.vertex_normals
    cosine = np.einsum("nvg,ng->nv", normals, facets.normal)
    turns = bool(np.any(cosine < 1.0 - SEARCH.turned))
    if kind.geometry.degree > 1 or not any_rank(dofs.comm, turns):
        return facets
    n, v, gdim = normals.shape
    axes = tangents(normals.reshape(-1, gdim)).reshape(n, v, gdim - 1, gdim)
    M, b = _normal_equations(facets.corners, normals, axes)
    if across is not None:
        M, b = _mirrored(M, b, axes, facets.at_vertices(dofs, across))
    sharp = (cosine <= SEARCH.edge).astype(float)
    exchange, asked = dofs.owners_of(facets.vertices.ravel())
    vertex, place = np.unique(asked, return_inverse=True)
    M, b, sharp = (
        sum_rows(place, exchange.send(part.reshape(n * v, *part.shape[2:])), len(vertex))
        for part in (M, b, sharp)
    )
    # the normal equations of K alone: the Schur complement of a, the first unknowns
    a, K = slice(gdim - 1), slice(gdim - 1, None)
    eliminated = M[:, K, a] @ np.linalg.pinv(M[:, a, a], hermitian=True)
    S = M[:, K, K] - eliminated @ M[:, a, K]
    r = b[:, K] - np.einsum("gij,gj->gi", eliminated, b[:, a])
    S[sharp > 0.0], r[sharp > 0.0] = 0.0, 0.0
    S, r = (exchange.answer(part[place]).reshape(n, v, *part.shape[1:]) for part in (S, r))
    return replace(facets, curvature=_on_facets(facets, axes, S, r))


def beside(kind: FacetKind, facets: Facets, rows: Array, xi: Array) -> Array:
    """Vectors, ``(m, gdim)``, from points of facets, ``(m, tdim)``, to the smooth surface.

    What a quadratic surface is beside its interpolant in the vertices, −½ Σφ_i (x_i − x)ᵀK(x_i −
    x), along the facet's normal.
    """
    x, K = facets.x[rows], facets.curvature[rows]
    d = x[:, : kind.hats.size] - points(kind.geometry, x, xi)[:, None]
    height = -0.5 * np.sum(kind.hats.values(xi) * np.sum((d @ K) * d, axis=2), axis=1)
    return height[:, None] * facets.normal[rows]


def _normal_equations(x: Array, normals: Array, axes: Array) -> tuple[Array, Array]:
    """Return matrices and right sides of the least squares for a and K at each vertex, a first.

    Directions count as on the tangent plane, lengths as in space: then a circle has its own
    curvature, however far its points are apart. Shapes ``(n, v, s, s)`` and ``(n, v, s)``.
    """
    d = x[:, None] - x[:, :, None]  # of vertex v to the others
    length = np.linalg.norm(d, axis=3)
    t = np.einsum("nvwg,nvkg->nvwk", d, axes)
    flat = np.linalg.norm(t, axis=3)
    u = t / np.where(flat > 0.0, flat, np.inf)[..., None]
    inverse = quotient(np.ones(length.shape), length)
    # ½ uᵀKu = Σ_k m_k(u) K_k, K_k the entries of K on and above the diagonal
    pairs = combinations_with_replacement(range(u.shape[-1]), 2)
    terms = [(0.5 if i == j else 1.0) * u[..., i] * u[..., j] for i, j in pairs]
    rows = np.concatenate((u * inverse[..., None], np.stack(terms, axis=-1)), axis=3)
    height = np.einsum("nvwg,nvg->nvw", d, normals) * inverse**2
    return rows.swapaxes(2, 3) @ rows, np.einsum("nvwi,nvw->nvi", rows, height)


def _mirrored(M: Array, b: Array, axes: Array, across: Array) -> tuple[Array, Array]:
    """Return normal equations with those of mirrored neighbours, by flags, ``(n, v, gdim)``."""
    pairs = list(combinations_with_replacement(range(axes.shape[2]), 2))
    for k in range(across.shape[2]):
        at = across[:, :, k, None]
        sign = np.where(at & (np.abs(axes[..., k]) > 0.5), -1.0, 1.0)
        products = [sign[..., i] * sign[..., j] for i, j in pairs]
        sign = np.concatenate((sign, np.stack(products, axis=-1)), axis=2)
        M = M + at[..., None] * sign[..., None] * M * sign[:, :, None]
        b = b + at * sign * b
    return M, b


def _on_facets(facets: Facets, axes: Array, S: Array, r: Array) -> Array:
    """Curvature of facets from the equations of their vertices, shape ``(n, gdim, gdim)``."""
    k = axes.shape[2]
    own = tangents(facets.normal)
    turn = _rotations(np.einsum("nvig,njg->nvij", axes, own))
    # K at a vertex, turn K turnᵀ, from the entries of K on the facet
    unit = np.zeros((S.shape[-1], k, k))
    for entry, (i, j) in enumerate(combinations_with_replacement(range(k), 2)):
        unit[entry, i, j] = unit[entry, j, i] = 1.0
    i, j = np.array(list(combinations_with_replacement(range(k), 2))).T
    turn = turn[:, :, None]
    P = (turn @ unit @ turn.swapaxes(3, 4))[..., i, j].swapaxes(2, 3)
    value, vector = np.linalg.eigh(np.sum(P.swapaxes(2, 3) @ S @ P, axis=1))
    right = np.einsum("nvki,nvk->ni", P, r)
    along = np.einsum("nik,ni->nk", vector, right)
    along = np.divide(along, value, out=np.zeros_like(along), where=value > SEARCH.unknown)
    K = np.tensordot(np.einsum("nik,nk->ni", vector, along), unit, axes=1)
    return own.swapaxes(1, 2) @ K @ own


def _rotations(A: Array) -> Array:
    """Return the rotations of tangents of one plane to those of another, from their products."""
    if A.shape[-1] == 1:
        return np.ones_like(A)
    cosine, sine = A[..., 0, 0] + A[..., 1, 1], A[..., 1, 0] - A[..., 0, 1]
    length = np.hypot(cosine, sine)
    turn = np.array([[cosine, -sine], [sine, cosine]]) / np.where(length > 0.0, length, 1.0)
    return np.moveaxis(turn, (0, 1), (-2, -1))


# --- Integrals --------------------------------------------------------------------------------


@dataclass(frozen=True)
class GapIntegrals:
    """Pointwise gaps along the normals of the secondary facets' vertices, n_i·(x_p − x_s) = g."""

    total: Array  # ∫ψ_i g, shape (f, v)
    lowest: Array  # smallest g on the covered part, shape (f, v)
    highest: Array  # the largest one, infinite where a facet is covered in part, shape (f, v)


@dataclass(frozen=True)
class MortarIntegrals:
    """Contributions of facets of a surface to the conditions of their vertices."""

    vertices: Array  # global groups of the facets' vertices, shape (f, v)
    covered: Array  # ∫φ_i over the covered part of each facet, shape (f, v)
    gap: GapIntegrals  # gap g along the node's normal, between the facets or of an obstacle
    curved_gap: GapIntegrals  # that between the smooth surfaces that facets stand for
    # triplets (multiplier's group, displacement's group, ∫ψ_i φ_k with its sign)
    entries: tuple[Triplets, ...]
    # triplets (group of a vertex whose multiplier is a point, a neighbour's group, share of ∫φ_d)
    shares: Triplets


def integrate(
    kind: FacetKind,
    secondary: Facets,
    primary: Facets,
    segments: Segments,
    moved: bool,
    curved: bool,
) -> MortarIntegrals:
    """Return integrals over segments of the secondary facets' multipliers.

    They are dual ones; but where nodes have ``moved``, which rows have to follow, hats take a part
    on facets that are covered by little, or where a mean is below all gaps that it is of: of
    ``curved`` gaps, whose curvature rows do not follow, it may be.
    """
    at = segments.points
    corners, near = segments.corners, near_held(kind, secondary, primary, segments)
    weight = segments.weight * radii(kind, secondary, at.secondary, at.xi)
    enough = SEARCH.extrapolated if moved else SEARCH.hardly_covered
    dual = facet_multipliers(kind, secondary, at.secondary, at.xi, weight, near, enough)
    apart = [_apart(kind, secondary, primary, of, curved=False) for of in (at, corners)]
    if moved and not curved:
        dual = _above_lowest(kind, secondary, segments, dual, weight, apart)
    if np.any(secondary.held) and np.any(primary.held):
        corner, *held = held_by_both(kind, secondary, primary, corners, dual.facet)
        dual, used = dual.with_points(kind, *held)
        both = ((getattr(at, f.name), getattr(corners, f.name)[corner[used]]) for f in fields(at))
        at = FacingPoints(*map(np.concatenate, both))
        segments = replace(segments, points=at)
        apart[0] = np.concatenate((apart[0], apart[1][corner[used]]))
    gap = curved_gap = _gaps(secondary, segments, dual, apart)
    if np.any(secondary.curvature) or np.any(primary.curvature):
        apart = [_apart(kind, secondary, primary, of, curved=True) for of in (at, corners)]
        curved_gap = _gaps(secondary, segments, dual, apart)
    own = dual.integrals(kind.displacement.values(at.xi))
    pair, place = np.unique(at.secondary * len(primary) + at.primary, return_inverse=True)
    theirs = kind.displacement.values(at.eta)
    other = sum_rows(place, dual.weighted[:, :, None] * theirs[:, None], len(pair))
    s, p = np.divmod(pair, max(len(primary), 1))
    return MortarIntegrals(
        vertices=secondary.vertices[dual.facet],
        covered=dual.covered,
        gap=gap,
        curved_gap=curved_gap,
        entries=(
            triplets(secondary.vertices[dual.facet], secondary.groups[dual.facet], own),
            triplets(secondary.vertices[s], primary.groups[p], -other),
        ),
        shares=dual.neighbours(secondary),
    )


def _above_lowest(
    kind: FacetKind,
    secondary: Facets,
    segments: Segments,
    dual: FacetMultipliers,
    weight: Array,
    apart: Sequence[Array],
) -> FacetMultipliers:
    """Let multipliers of facets pass into hats until no mean of gaps is below all of a facet.

    By ``SEARCH.below`` of the facet it may be. ψ_i is negative somewhere, hats are not. Then rows
    are those of the means, as they are not where means have a bound: (1 − p)ψ_i + pφ_i has the
    integral of ψ_i, and the sum 1.
    """
    normals = secondary.vertex_normals[segments.points.secondary]
    gap = np.einsum("md,mvd->mv", apart[0], normals)
    hats = weight[:, None] * kind.hats.values(segments.points.xi)
    both = (sum_rows(dual.place, w * gap, len(dual.facet)) for w in (dual.weighted, hats))
    mean, of_hats = (quotient(total, dual.covered) for total in both)
    low = _gaps(secondary, segments, dual, apart).lowest
    low -= SEARCH.below * secondary.radius[dual.facet, None]
    short = np.where(dual.covered > 0.0, np.maximum(low - mean, 0.0), 0.0)
    part = np.minimum(quotient(short, of_hats - mean).max(axis=1, initial=0.0), 1.0)
    part = part[dual.place, None]
    return replace(dual, weighted=(1.0 - part) * dual.weighted + part * hats)


def integrate_distance(
    kind: FacetKind, facets: Facets, distance: Array, share: Array
) -> MortarIntegrals:
    """Return integrals over facets' shares with an obstacle's distance at vertices, ``(n, v)``."""
    # exact for ψ_i φ_k on plane facets, and enough on curved ones
    facet, xi, weight = whole_facets(kind, facets, 4 * kind.displacement.degree)
    weight = weight * share[facet]
    held = facets.held & (kind.displacement.degree > 1)
    dual = facet_multipliers(kind, facets, facet, xi, weight, held)
    if np.any(held):
        spot, vertex = np.nonzero(held[dual.facet])
        dual, used = dual.with_points(kind, held[dual.facet], spot, vertex)
        xi = np.concatenate((xi, kind.hats.points[vertex[used]]))
    at_vertices, vertices = distance[dual.facet], facets.vertices[dual.facet]
    gap = GapIntegrals(at_vertices * dual.covered, at_vertices, at_vertices)
    own = dual.integrals(kind.displacement.values(xi))
    entries = triplets(vertices, facets.groups[dual.facet], own)
    return MortarIntegrals(vertices, dual.covered, gap, gap, (entries,), dual.neighbours(facets))


def _gaps(
    secondary: Facets, segments: Segments, dual: FacetMultipliers, apart: Sequence[Array]
) -> GapIntegrals:
    """Return gaps over segments from what closes them at points and corners, see ``_apart``."""
    normals, both = secondary.vertex_normals[dual.facet], (segments.points, segments.corners)
    # n_i·(x_p − x_s) at points and corners
    place = np.searchsorted(dual.facet, np.concatenate([of.secondary for of in both]))
    gap = np.einsum("md,mvd->mv", np.concatenate(apart), normals[place])
    lowest, highest = np.full(dual.covered.shape, np.inf), np.full(dual.covered.shape, -np.inf)
    np.minimum.at(lowest, place, gap)
    np.maximum.at(highest, place, gap)
    # covered in part a multiplier extrapolates: upwards that is right, downwards it could overlap
    highest[~segments.whole[dual.facet]] = np.inf
    counts = dual.covered.sum(axis=1) > 0.0  # what is hardly covered has no multipliers
    lowest[~counts], highest[~counts] = np.inf, -np.inf
    return GapIntegrals(np.sum(dual.integrals(apart[0]) * normals, axis=2), lowest, highest)


def _apart(
    kind: FacetKind, secondary: Facets, primary: Facets, at: FacingPoints, curved: bool
) -> Array:
    """Vectors along the surface's normal that close the gap, shape ``(m, gdim)``.

    From one facet to the other one looks along the normal of a whole facet; what closes the gap
    of curved bodies is the part along the normal at the point, interpolated from the vertices.
    """
    there = points(kind.geometry, primary.x[at.primary], at.eta)
    here = points(kind.geometry, secondary.x[at.secondary], at.xi)
    if curved:
        there = there + beside(kind, primary, at.primary, at.eta)
        here = here + beside(kind, secondary, at.secondary, at.xi)
    normal = points(kind.hats, secondary.vertex_normals[at.secondary], at.xi)
    distance = np.sum((there - here) * normal, axis=1) / np.sum(normal**2, axis=1)
    return distance[:, None] * normal
