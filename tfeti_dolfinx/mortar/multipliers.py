"""Multipliers of facets: dual ones, and hats and points at vertices that conditions hold.

A vertex that Dirichlet conditions hold along its normal does not give way. On facets near it
multipliers are hats. Where it meets what is held, too, or rigid, its multiplier is a point there,
so that its gap is that of prescribed displacements alone; its neighbours share the rest, and say
what pressure it bears.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.common.arrays import Array, quotient, sum_rows
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import FacetKind, Facets, radii
from tfeti_dolfinx.mortar.segments import FacingPoints, Segments
from tfeti_dolfinx.mortar.tolerances import SEARCH

Triplets = tuple[Array, Array, Array]


def triplets(rows: Array, columns: Array, values: Array) -> Triplets:
    """Row groups, column groups and values of many small matrices."""
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    return i.ravel(), j.ravel(), values.ravel()


@dataclass(frozen=True)
class FacetMultipliers:
    """Values of multipliers at quadrature points: dual ones, or hats near what is held."""

    facet: Array  # facets that have points, shape (f,)
    place: Array  # place in `facet` of each point's facet, shape (m,)
    weighted: Array  # weight times ψ_i at each point, shape (m, v)
    covered: Array  # ∫φ_i over the part that the points cover, shape (f, v)
    # of ∫φ_d of a vertex d whose multiplier is a point: shares of neighbours k, shape (f, d, k)
    shares: Array

    def integrals(self, values: Array) -> Array:
        """∫ψ_i f on each facet, from values of f at the points: ``(m, …)`` to ``(f, v, …)``."""
        extra = (1,) * (values.ndim - 1)
        weighted = self.weighted.reshape(*self.weighted.shape, *extra)
        return sum_rows(self.place, weighted * values[:, None], len(self.facet))

    def neighbours(self, of: Facets) -> Triplets:
        """Return the shares of neighbours as triplets of groups."""
        vertices = of.vertices[self.facet]
        of_point, to, share = triplets(vertices, vertices, self.shares)
        return of_point[share > 0.0], to[share > 0.0], share[share > 0.0]

    def with_points(
        self, kind: FacetKind, held: Array, spot: Array, vertex: Array
    ) -> tuple[FacetMultipliers, Array]:
        """Multipliers of which those at vertices that both sides hold have become points.

        On a facet ψ_d of such a vertex d, by flags of shape ``(f, v)``, becomes D_d δ_d, and its
        neighbours share ψ_d − D_d δ_d; where all are held the first one takes that. So the sum of
        all stays. Each of these d has spots: ``vertex`` of the facet ``facet[spot]``. Return also
        which spots are points now, the last ones.
        """
        v, held = held.shape[1], held.copy()
        held[held.all(axis=1), 0] = False
        to = np.repeat(~held[:, :, None], v, axis=2)
        beside = to & kind.hats.neighbours
        to = np.where(beside.any(axis=1, keepdims=True), beside, to) & held[:, None]
        share = to / np.maximum(to.sum(axis=1, keepdims=True), 1)
        used = held[spot, vertex]
        spot, vertex = spot[used], vertex[used]
        at = np.zeros(held.shape)
        np.add.at(at, (spot, vertex), 1.0)
        dirac = np.eye(v)[vertex] - share[spot, :, vertex]
        dirac *= (self.covered[spot, vertex] / at[spot, vertex])[:, None]
        keeps = np.eye(v) * ~held[:, None] + share
        weighted = np.einsum("mij,mj->mi", keeps[self.place], self.weighted)
        return replace(
            self,
            place=np.append(self.place, spot),
            weighted=np.concatenate((weighted, dirac)),
            shares=share.swapaxes(1, 2) * self.covered[:, :, None],
        ), used


def facet_multipliers(
    kind: FacetKind,
    of: Facets,
    facet: Array,
    xi: Array,
    weight: Array,
    near: Array,
    enough: float = SEARCH.hardly_covered,
) -> FacetMultipliers:
    """Multipliers on a facet's part with points: hats if it is near what is held, else dual ones.

    Those are biorthogonal to the hats, ψ = D_e M_e⁻¹ φ with D_e = diag ∫φ_i and M_e = ∫φ_i φ_j
    there. Both sum up to 1, so a uniform pressure is met (Wohlmuth, SIAM J. Numer. Anal. 38, 2000;
    Cichosz, Bischoff, Comput. Methods Appl. Mech. Eng. 200, 2011). A facet that is hardly covered,
    by its area, has no share; below the share ``enough`` dual ones pass into hats. Points have
    their facet, reference coordinates of shape ``(m, tdim)`` and a weight; ``near`` has flags of
    each facet's vertices.
    """
    facets, place = np.unique(facet, return_inverse=True)
    hats = kind.hats.values(xi)
    covered = sum_rows(place, weight[:, None] * hats, len(facets))
    mass = sum_rows(place, weight[:, None, None] * hats[:, :, None] * hats[:, None], len(facets))
    area = of.area[facets] * radii(kind, of, facets, np.full((len(facets), xi.shape[1]), 0.5))
    share = quotient(covered.sum(axis=1), area)  # a facet on the axis has no area
    hardly = share <= SEARCH.hardly_covered
    mass[hardly] = np.eye(kind.hats.size)
    covered[hardly] = 0.0
    part = np.minimum(share / enough, 1.0)[:, None, None]
    dual = part * covered[:, :, None] * np.linalg.inv(mass) + (1.0 - part) * np.eye(kind.hats.size)
    dual[np.any(near[facets], axis=1) & ~hardly] = np.eye(kind.hats.size)
    psi = np.einsum("mij,mj->mi", dual[place], hats)
    shares = np.zeros(mass.shape)
    return FacetMultipliers(facets, place, weight[:, None] * psi, covered, shares)


# --- Vertices that conditions hold ------------------------------------------------------------


def with_held_vertices(facets: Facets, dofs: TornDofs, normals: Array, flag: Array) -> Facets:
    """Return the same facets with flags of vertices that Dirichlet conditions hold. Collective.

    Normals and flags of prescribed components are those of owned groups, shape ``(g, gdim)``.
    """
    fixed = np.all(flag | (np.abs(normals) <= SEARCH.held), axis=1)
    return replace(facets, held=facets.at_vertices(dofs, fixed))


def near_held(kind: FacetKind, secondary: Facets, primary: Facets, segments: Segments) -> Array:
    """Return flags of secondary vertices that are held, or of facets that face what is held.

    Of degree 1, where facets meet vertex to vertex, dual rows are of nodes: there are none.
    """
    at, corners, near = segments.points, segments.corners, secondary.held.copy()
    near[at.secondary[np.any(primary.held[at.primary], axis=1)]] = True
    if kind.displacement.degree == 1:
        hats = [kind.hats.values(xi).max(axis=1, initial=0.0) for xi in (corners.xi, corners.eta)]
        meet = np.ones(len(secondary), dtype=bool)
        meet[corners.secondary[np.minimum(*hats) < 1.0 - SEARCH.held]] = False
        near[meet] = False
    return near


def held_by_both(
    kind: FacetKind, secondary: Facets, primary: Facets, at: FacingPoints, facet: Array
) -> tuple[Array, Array, Array, Array]:
    """Return vertices that both sides hold, and the corners of common parts that are at vertices.

    First the corners, then flags of vertices of the facets, shape ``(f, v)``, the place of each
    corner's facet, and its vertex.
    """
    place = np.searchsorted(facet, at.secondary)
    corner, vertex = np.nonzero(kind.hats.values(at.xi) > 1.0 - SEARCH.held)
    free = np.sum(np.abs(kind.hats.values(at.eta)) * ~primary.held[at.primary], axis=1)[corner]
    held = np.zeros((len(facet), kind.hats.size), dtype=bool)
    held[place[corner], vertex] = True
    held &= secondary.held[facet]
    held[place[corner[free > SEARCH.held]], vertex[free > SEARCH.held]] = False
    return corner, held, place[corner], vertex
