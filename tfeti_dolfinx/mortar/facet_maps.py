"""Maps from reference facets: points, areas, and back from a plane."""

from __future__ import annotations

import basix
import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mortar.facet_element import FacetElement, from_first
from tfeti_dolfinx.mortar.facets import FacetKind, Facets

# Newton's method from the affine map: facets that are not folded take 3 or 4 steps. It ends at
# rounding (of the facet's size); where it stalls above that, a point may still be as good as FAR.
MAX_STEPS, CLOSE, FAR = 20, 1e-14, 1e-8


def points(element: FacetElement, x: Array, xi: Array) -> Array:
    """Points at reference coordinates of facets with nodes x: ``(m, nodes, d)`` to ``(m, d)``."""
    return np.einsum("mv,mvd->md", element.values(xi), x[:, : element.size])


def densities(element: FacetElement, x: Array, xi: Array) -> Array:
    """Area per area of the reference facet, shape ``(m,)``; arguments as of ``points``."""
    nodes = from_first(x[:, : element.size])
    return _areas(np.einsum("tmv,mvd->mtd", element.slopes(xi), nodes))


def reference_points(element: FacetElement, nodes: Array, y: Array) -> Array:
    """Reference coordinates of points in facets that lie in a line or a plane.

    Args:
        element: Element of the facets.
        nodes: Nodes of the facet of each point, shape ``(m, nodes, tdim)``.
        y: The points, shape ``(m, tdim)``.

    Returns:
        Shape ``(m, tdim)``: at once where the map is affine, else by Newton's method.

    Raises:
        InputError: It does not converge, as facets are folded.
    """
    origin = nodes[:, 0]
    xi = _solve((nodes[:, 1 : 1 + y.shape[1]] - origin[:, None]).transpose(0, 2, 1), y - origin)
    if element.is_affine or len(xi) == 0:
        return xi
    size = np.ptp(nodes, axis=1).max(axis=1)
    for _ in range(MAX_STEPS):
        slopes = np.einsum("tmv,mvd->mdt", element.slopes(xi), nodes[:, : element.size])
        away = y - points(element, nodes, xi)
        if np.all(np.abs(away).max(axis=1) <= CLOSE * size):
            return xi
        xi = xi + _solve(slopes, away)
    left = np.abs(y - points(element, nodes, xi)).max(axis=1)
    if np.any(~(left <= FAR * size)):
        raise InputError("a facet of a contact surface is folded, or too far from a plane one")
    return xi


def whole_facets(kind: FacetKind, facets: Facets, degree: int) -> tuple[Array, Array, Array]:
    """Quadrature points of whole facets.

    Returns:
        Facet of each point, reference coordinates of shape ``(m, tdim)``, weights.
    """
    xi, w = basix.make_quadrature(getattr(basix.CellType, kind.facet), degree)
    n, q = len(facets), len(w)
    slopes = np.einsum("tqv,nvd->nqtd", kind.geometry.slopes(xi), from_first(facets.x))
    weight = _areas(slopes.reshape(n * q, *slopes.shape[2:])) * np.tile(w, n)
    return np.repeat(np.arange(n), q), np.tile(xi, (n, 1)), weight


def hat_areas(kind: FacetKind, facets: Facets) -> Array:
    """∫φ_i over whole facets, shape ``(n, v)``."""
    facet, xi, weight = whole_facets(kind, facets, 2 * kind.geometry.degree)
    return sum_rows(facet, weight[:, None] * kind.hats.values(xi), len(facets))


def _areas(slopes: Array) -> Array:
    """Length or area that tangents span, shape ``(m, tdim, d)`` to ``(m,)``."""
    if slopes.shape[1] == 1:
        return np.linalg.norm(slopes[:, 0], axis=1)
    if slopes.shape[2] == 2:
        return np.abs(np.linalg.det(slopes))
    return np.linalg.norm(np.cross(slopes[:, 0], slopes[:, 1]), axis=1)


def _solve(A: Array, b: Array) -> Array:
    """Solutions of many systems of one or two equations."""
    if b.shape[1] == 1:
        return b / A[:, :, 0]
    (p, q), (r, t) = A.transpose(1, 2, 0)
    x = t * b[:, 0] - q * b[:, 1]
    y = p * b[:, 1] - r * b[:, 0]
    return np.stack((x, y), axis=1) / (p * t - q * r)[:, None]
