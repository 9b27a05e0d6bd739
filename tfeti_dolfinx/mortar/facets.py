"""Facets of contact surfaces: elements on them, places, integrals of hats, maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.arrays import Array, quotient, sum_rows
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.parallel import Exchange, any_rank, box_over_ranks, count_over
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import cells_at, facet_points
from tfeti_dolfinx.mortar.tolerances import SEARCH

create_element = cache(basix.create_element)  # each is made once
# vertices of a facet in the order of its polygon; DOLFINx numbers quadrilaterals as tensors
POLYGON = {"interval": [0, 1], "triangle": [0, 1, 2], "quadrilateral": [0, 1, 3, 2]}
FACET_OF = {
    "triangle": "interval",
    "quadrilateral": "interval",
    "tetrahedron": "triangle",
    "hexahedron": "quadrilateral",
}


class FacetElement:
    """Lagrange element of a degree on a facet, vertices first.

    The facet is an interval, triangle or quadrilateral; the variant is one of basix.
    """

    def __init__(self, facet: str, degree: int, variant: Any) -> None:
        self.facet, self.degree = facet, degree
        self._cell = getattr(basix.CellType, facet)
        self._element = create_element(basix.ElementFamily.P, self._cell, degree, variant)
        self.points = self._element.points
        self.size = self._element.dim
        # which vertices an edge joins; opposite ones of a quadrilateral add up to 3
        vertex = np.arange(len(POLYGON[facet]))
        apart = (vertex[:, None] + vertex != 3) | (facet != "quadrilateral")
        self.neighbours = apart & (vertex[:, None] != vertex)

    def values(self, xi: Array) -> Array:
        """Basis functions at reference points: shape ``(n, tdim)`` to ``(n, size)``."""
        if len(xi) == 0:
            return np.zeros((0, self.size))
        return self._element.tabulate(0, np.ascontiguousarray(xi))[0, :, :, 0]

    def slopes(self, xi: Array) -> Array:
        """Derivatives at reference points: shape ``(n, tdim)`` to ``(tdim, n, size)``."""
        if len(xi) == 0:
            return np.zeros((self.points.shape[1], 0, self.size))
        return self._element.tabulate(1, np.ascontiguousarray(xi))[1:, :, :, 0]


facet_element = cache(FacetElement)  # each is made once


# --- Facets of contact surfaces ---------------------------------------------------------------


@dataclass(frozen=True)
class FacetKind:
    """Cell type and elements that all contact facets of a problem have in common."""

    hats: FacetElement  # P1 (Q1) element of the multipliers
    displacement: FacetElement  # element of the displacement's trace
    geometry: FacetElement  # element of the geometry
    axisymmetric: bool  # whether integrals are weighted with the radius x[0]


@dataclass(frozen=True)
class Facets:
    """Some facets, one row each."""

    x: Array  # geometry nodes, vertices first, shape (n, g, gdim)
    groups: Array  # global groups of the displacement's nodes, vertices first, shape (n, t)
    normal: Array  # outward unit normal at the centre, shape (n, gdim)
    # unit normals at the vertices, at first the facet's own, then averaged ones, shape (n, v, gdim)
    vertex_normals: Array
    area: Array  # area (length in 2D), shape (n,)
    # second derivatives of the height of a smooth surface over the facet's tangent plane
    # (`with_curvature`), negative where the body is convex; at first 0, shape (n, gdim, gdim)
    curvature: Array
    # whether Dirichlet conditions hold a vertex along its normal, at first not, shape (n, v)
    held: Array

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, rows: Array) -> Facets:
        return Facets(*(getattr(self, f.name)[rows] for f in fields(self)))

    def sent(self, exchange: Exchange) -> Facets:
        """Return the facets that an exchange brings here. Collective."""
        return Facets(*(exchange.send(getattr(self, f.name)) for f in fields(self)))

    def at_vertices(self, dofs: TornDofs, table: Array) -> Array:
        """Rows of the owned groups at the vertices, ``(g, ...)`` to ``(n, v, ...)``. Collective."""
        (found,) = dofs.lookup(self.vertices.ravel(), table)
        return found.reshape(*self.vertices.shape, *table.shape[1:])

    def on_groups(
        self, dofs: TornDofs, values: Array, op: np.ufunc = np.add, initial: Any = 0
    ) -> Array:
        """Combine values at the vertices, ``(n, v, ...)`` to ``(g, ...)``. Collective."""
        values = values.reshape(-1, *values.shape[2:])
        return dofs.reduce_on_owners(self.vertices.ravel(), values, op, initial)

    @property
    def corners(self) -> Array:
        """Vertices, shape ``(n, v, gdim)``."""
        return self.x[:, : self.vertex_normals.shape[1]]

    @property
    def vertices(self) -> Array:
        """Global groups of the vertices, shape ``(n, v)``."""
        return self.groups[:, : self.vertex_normals.shape[1]]

    @property
    def centre(self) -> Array:
        """Mean of the geometry nodes, shape ``(n, gdim)``."""
        return self.x.mean(axis=1)

    @property
    def radius(self) -> Array:
        """Radius of a ball around the centre that holds the geometry nodes, shape ``(n,)``."""
        return np.linalg.norm(self.x - self.centre[:, None], axis=2).max(axis=1, initial=0.0)


def facet_kind(dofs: TornDofs) -> FacetKind:
    """Elements on the facets of a displacement space's mesh."""
    mesh, element = dofs.V.mesh, dofs.V.element.basix_element
    facet = FACET_OF[mesh.topology.cell_type.name]
    geometry = mesh.ufl_domain().ufl_coordinate_element()
    return FacetKind(
        hats=facet_element(facet, 1, element.lagrange_variant),
        displacement=facet_element(facet, element.degree, element.lagrange_variant),
        geometry=facet_element(facet, geometry.degree, geometry.lagrange_variant),
        axisymmetric=dofs.axisymmetric,
    )


def local_facets(
    dofs: TornDofs, facets: Array, kind: FacetKind, across: Array | None = None
) -> Facets:
    """Data of local facets of the true boundary, without averaged normals. Collective.

    Those in planes of symmetry, inside of the whole, are left out, unless all are. ``across`` has
    flags of owned groups' components, shape ``(g, gdim)``; None: there is no such plane.
    """
    mesh = dofs.V.mesh
    gdim, (cell, place) = mesh.geometry.dim, cells_at(mesh, facets)
    coordinate = mesh.ufl_domain().ufl_coordinate_element()
    of_cell = create_element(
        basix.ElementFamily.P, coordinate.cell_type, coordinate.degree, coordinate.lagrange_variant
    )
    on_facet = np.array(of_cell.entity_closure_dofs[-2])[place]
    nodes = geometry_dofmap(mesh)[cell]
    x = mesh.geometry.x[np.take_along_axis(nodes, on_facet, axis=1)][:, :, :gdim]
    inside = mesh.geometry.x[nodes].mean(axis=1)[:, :gdim]
    hats, corners = kind.hats, x[:, : kind.hats.size]
    (normal,) = _normals(hats, corners, hats.points.mean(axis=0)[None])
    area = (0.5 if kind.hats.facet == "triangle" else 1.0) * np.linalg.norm(normal, axis=1)
    outward = np.sum(normal * (corners.mean(axis=1) - inside), axis=1)
    normal = unit(np.where(outward < 0.0, -1.0, 1.0)[:, None] * normal)
    at_vertices = _normals(kind.geometry, x, hats.points)
    sign = np.sign(np.sum(at_vertices * normal, axis=2, keepdims=True))
    found = Facets(
        x=np.ascontiguousarray(x),
        groups=dofs.group[dofs.facet_nodes(facets)],
        normal=normal,
        vertex_normals=np.ascontiguousarray((sign * unit(at_vertices)).swapaxes(0, 1)),
        area=area,
        curvature=np.zeros((len(x), gdim, gdim)),
        held=np.zeros((len(x), hats.size), dtype=bool),
    )
    if across is None:
        return found
    at = found.at_vertices(dofs, across).all(axis=1)
    # others reach from one plane to another, in a slab of one cell
    kept = ~np.any(at & (np.abs(found.normal) > 1.0 - SEARCH.held), axis=1)
    return found[kept] if any_rank(dofs.comm, kept) else found


def with_averaged_normals(
    facets: Facets, dofs: TornDofs, across: Array | None
) -> tuple[Facets, Array, Array]:
    """Return the same facets with normals averaged at the vertices, weighted by area. Collective.

    On a plane of symmetry they lie in it, as those of the whole surface, unless that has an edge
    there at rest. Return the averaged normal of each owned group, too, 0 off them, shape ``(g,
    gdim)``, and its ``edges_at_rest``.
    """
    rest = normals_at_rest(facets, dofs)
    averaged = unit(facets.on_groups(dofs, facets.vertex_normals * facets.area[:, None, None]))
    if across is not None:
        averaged = unit(np.where(across & ~_edges(facets, rest[1], dofs, across), 0.0, averaged))
    turned = replace(facets, vertex_normals=facets.at_vertices(dofs, averaged))
    return turned, averaged, edges_at_rest(facets, rest, dofs, across)


def _edges(facets: Facets, averaged: Array, dofs: TornDofs, across: Array) -> Array:
    """Return where the whole surface has edges on planes of symmetry, flags of groups. Collective.

    There normals of the next vertices, ``averaged`` at rest, are turned by no more than those on
    the plane. An edge that begins or ends with an iterate would turn normals, which Newton's method
    does not follow.
    """
    turned = facets.at_vertices(dofs, np.where(across, 0.0, np.abs(averaged)))
    turned[:] = turned.max(axis=1, keepdims=True)
    turned = facets.on_groups(dofs, turned, np.maximum)
    return np.abs(averaged) > np.maximum(turned / SEARCH.bends, SEARCH.held)


def normals_at_rest(facets: Facets, dofs: TornDofs) -> tuple[Array, Array]:
    """Return normals of facets as they were meshed, and their means at owned groups. Collective."""
    normal, corners = facets.normal, facets.corners
    if dofs.nodes is not None:
        hats = facet_kind(dofs).hats
        rest = facets.at_vertices(dofs, dofs.reduce(dofs.points(at_rest=True), np.minimum))
        places = corners, rest[:, :, : dofs.bs]
        here, there = (_normals(hats, x, hats.points.mean(axis=0)[None])[0] for x in places)
        normal = unit(there * np.sign(np.sum(here * normal, axis=1, keepdims=True)))
    at_vertices = np.broadcast_to(normal[:, None], corners.shape)
    return normal, unit(facets.on_groups(dofs, at_vertices))


def edges_at_rest(
    facets: Facets, rest: tuple[Array, Array], dofs: TornDofs, across: Array | None
) -> Array:
    """Return where facets turn as at an edge, as they were meshed: flags of groups. Collective.

    On planes of symmetry it is edges that cross them.
    """
    own, averaged = rest[0][:, None], facets.at_vertices(dofs, rest[1])
    if across is not None:
        at = facets.at_vertices(dofs, across)
        own, averaged = (unit(np.where(at, 0.0, normal)) for normal in (own, averaged))
    cosine = np.sum(own * averaged, axis=2)
    return facets.on_groups(dofs, cosine, np.minimum, 1.0) < SEARCH.edge


def apart_at_edges(facets: Facets, dofs: TornDofs, edges: Array) -> Facets:
    """Return facets with their own normals at edges, flags of owned groups. Collective.

    A mean is of no side there.
    """
    at = facets.at_vertices(dofs, edges)[:, :, None]
    return replace(
        facets, vertex_normals=np.where(at, facets.normal[:, None], facets.vertex_normals)
    )


def shares_at_edges(
    facets: Facets, dofs: TornDofs, towards: Array, across: Array | None
) -> tuple[Array, Array]:
    """Return how much facets beside edges count, by how they face a shape, and edges. Collective.

    A side that stands on a plane bears nothing. ``towards`` has normals into the shape at the
    vertices, shape ``(n v, gdim)``.
    """
    if dofs.bs == 1:
        return np.ones(len(facets)), np.zeros(dofs.num_groups, dtype=bool)
    edges = edges_at_rest(facets, normals_at_rest(facets, dofs), dofs, across)
    vertices = facets.vertices.reshape(-1, 1)
    cosine = np.einsum("ng,nvg->nv", facets.normal, towards.reshape(facets.corners.shape)).ravel()
    cosine, at = np.maximum(cosine, SEARCH.turned), np.arange(len(vertices))
    seen = facing_shares(dofs, vertices, at, cosine, edges, SEARCH.turned)
    return seen.reshape(facets.vertices.shape).min(axis=1), edges


def facing_shares(
    dofs: TornDofs, vertices: Array, facet: Array, cosine: Array, edges: Array, aslant: float
) -> Array:
    """Return how much points of facets count, by how they face what they meet. Collective.

    That is over what those at the same ``vertices``, shape ``(n, v)``, do most: all of it where one
    is at ``edges``, else ``aslant`` of it. Points have a facet and a cosine, shape ``(m,)``.
    """
    of_points = np.repeat(cosine, vertices.shape[1])
    most = dofs.reduce_on_owners(vertices[facet].ravel(), of_points, np.maximum)
    most, sharp = (x.reshape(vertices.shape) for x in dofs.lookup(vertices.ravel(), most, edges))
    enough = np.where(sharp.any(axis=1), 1.0, aslant) * most.max(axis=1, initial=0.0)
    return np.minimum(quotient(cosine, enough[facet]), 1.0) ** SEARCH.aside


def with_images(facets: Facets, dofs: TornDofs, across: Array | None) -> Facets:
    """Return facets with mirror images of those at planes of symmetry. Collective.

    Images have the nodes of what they mirror: beside the plane u_k is hardly another than on it.
    """
    if across is None:
        return facets
    at = facets.at_vertices(dofs, across)
    for k in range(dofs.bs):
        of = np.flatnonzero(at[:, :, k].any(axis=1) & ~at[:, :, k].all(axis=1))
        if not len(of):
            continue
        sign = np.where(np.arange(dofs.bs) == k, -1.0, 1.0)
        offset = 2.0 * facets.x[of, np.argmax(at[of, :, k], axis=1), k]
        image, x = facets[of], sign * facets.x[of]
        x[:, :, k] += offset[:, None]
        image = replace(
            image,
            x=x,
            normal=sign * image.normal,
            vertex_normals=sign * image.vertex_normals,
            curvature=sign * image.curvature * sign[:, None],
        )
        both = ((getattr(facets, f.name), getattr(image, f.name)) for f in fields(facets))
        facets, at = Facets(*map(np.concatenate, both)), np.concatenate((at, at[of]))
    return facets


def _normals(element: FacetElement, x: Array, xi: Array) -> Array:
    """Normals at reference points, as long as area per area there, shape ``(points, n, gdim)``."""
    # from the first node on: rounding turns no facet that is far from 0
    tangents = np.einsum("tvg,ngd->tvnd", element.slopes(xi), x - x[:, :1])
    if len(tangents) == 1:
        return np.stack((tangents[0, :, :, 1], -tangents[0, :, :, 0]), axis=2)
    return np.cross(*tangents)


def unit(vectors: Array) -> Array:
    """Return vectors over their lengths, along the last axis; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


# --- Maps of reference facets -----------------------------------------------------------------


def points(element: FacetElement, x: Array, xi: Array) -> Array:
    """Points at reference coordinates of facets with nodes x: ``(m, nodes, d)`` to ``(m, d)``."""
    return np.einsum("mv,mvd->md", element.values(xi), x[:, : element.size])


def radii(kind: FacetKind, facets: Facets, facet: Array, xi: Array) -> Array | float:
    """Radius x[0] at reference coordinates of facets in axisymmetric models, ``(m,)``, else 1."""
    return points(kind.geometry, facets.x[facet], xi)[:, 0] if kind.axisymmetric else 1.0


def densities(element: FacetElement, x: Array, xi: Array) -> Array:
    """Area per area of the reference facet, shape ``(m,)``; arguments as of ``points``."""
    nodes = x[:, : element.size]
    return _areas(np.einsum("tmv,mvd->mtd", element.slopes(xi), nodes - nodes[:, :1]))


def reference_points(element: FacetElement, nodes: Array, y: Array) -> Array:
    """Reference coordinates, ``(m, tdim)``, of points in facets that lie in a line or a plane.

    Each point, ``(m, tdim)``, has the nodes of its facet, ``(m, nodes, tdim)``. At once where the
    map is affine, else by Newton's method; where that does not converge, as facets are folded,
    raise an InputError.
    """
    origin = nodes[:, 0]
    xi = _solve((nodes[:, 1 : 1 + y.shape[1]] - origin[:, None]).transpose(0, 2, 1), y - origin)
    affine = element.degree == 1 and element.facet != "quadrilateral"
    if affine or len(xi) == 0:
        return xi
    size = np.ptp(nodes, axis=1).max(axis=1)
    for _ in range(SEARCH.newton_steps):
        slopes = np.einsum("tmv,mvd->mdt", element.slopes(xi), nodes[:, : element.size])
        away = y - points(element, nodes, xi)
        if np.all(np.abs(away).max(axis=1) <= SEARCH.close * size):
            return xi
        xi = xi + _solve(slopes, away)
    left = np.abs(y - points(element, nodes, xi)).max(axis=1)
    if np.any(~(left <= SEARCH.far * size)):
        raise InputError("a facet of a contact surface is folded, or too far from a plane one")
    return xi


def whole_facets(kind: FacetKind, facets: Facets, degree: int) -> tuple[Array, Array, Array]:
    """Return facet, reference coordinates, ``(m, tdim)``, and weight of quadrature points.

    That of axisymmetric models has the radius, too.
    """
    xi, w = basix.make_quadrature(getattr(basix.CellType, kind.hats.facet), degree)
    n, q = len(facets), len(w)
    nodes = facets.x - facets.x[:, :1]
    slopes = np.einsum("tqv,nvd->nqtd", kind.geometry.slopes(xi), nodes)
    weight = _areas(slopes.reshape(n * q, *slopes.shape[2:])) * np.tile(w, n)
    facet, xi = np.repeat(np.arange(n), q), np.tile(xi, (n, 1))
    return facet, xi, weight * radii(kind, facets, facet, xi)


def hat_areas(kind: FacetKind, facets: Facets) -> Array:
    """∫φ_i over whole facets, shape ``(n, v)``."""
    facet, xi, weight = whole_facets(kind, facets, 2 * kind.geometry.degree + kind.axisymmetric)
    return sum_rows(facet, weight[:, None] * kind.hats.values(xi), len(facets))


def _areas(slopes: Array) -> Array:
    """Return the length or area that tangents span, shape ``(m, tdim, d)`` to ``(m,)``."""
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


# --- Surfaces by name -------------------------------------------------------------------------


def surface_facets(decomposition: Decomposition, name: str | int) -> Array:
    """Local facets of a contact surface, which is a part of the boundary, ascending. Collective."""
    facets = decomposition.facets(name)
    comm = decomposition.comm
    if count_over(comm, len(facets)) == 0:
        raise InputError(f"surface {name!r} has no facets; expected a part of the boundary")
    inside = np.setdiff1d(facets, decomposition.boundary, assume_unique=True)
    if count := count_over(comm, len(inside)):
        raise InputError(
            f"surface {name!r}: {count} of its facets lie inside a body; "
            "expected facets on the boundary only"
        )
    return facets


def hat_integrals(
    dofs: TornDofs, names: Sequence[str | int], thickness: Any = 1.0, u: fem.Function | None = None
) -> Array:
    """Return ∫φ_i of the hats of degree 1 over the union of surfaces, by names or tags. Collective.

    They are weighted by the thickness, a number or a scalar in UFL. One integral per owned group,
    zero off the surfaces and off the vertices, shape ``(g,)``. With a displacement the surfaces
    are where it brings the points of the mesh.
    """
    if not names:
        return np.zeros(dofs.num_groups)
    (W, node), decomposition = dofs.hats, dofs.decomposition
    tags = tuple(sorted({decomposition.surface(name) for name in names}))
    ds = ufl.Measure("ds", domain=W.mesh, subdomain_data=decomposition.facet_tags)
    weight = fem.Constant(W.mesh, thickness) if isinstance(thickness, float) else thickness
    if u is not None:
        element = W.mesh.ufl_domain().ufl_coordinate_element()
        moved = fem.Function(fem.functionspace(W.mesh, element))
        moved.interpolate(u)
        F = ufl.Identity(len(u)) + ufl.grad(moved)
        normal = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(W.mesh)
        weight *= ufl.sqrt(ufl.inner(normal, normal))
        if dofs.axisymmetric:
            r = ufl.SpatialCoordinate(W.mesh)[0]  # 0 on facets on the axis
            weight *= 1.0 + ufl.conditional(ufl.gt(r, 0.0), moved[0] / r, 0.0)
    form = fem.form(weight * ufl.TestFunction(W) * ds(tags))
    per_node = np.zeros(dofs.num_nodes)
    per_node[node] = fem.assemble_vector(form).array
    return dofs.reduce(per_node, np.add)


def group_points(dofs: TornDofs) -> Array:
    """Return coordinates of the owned groups, shape ``(g, 3)``. Collective."""
    return dofs.reduce(dofs.points(), np.minimum)


def diameter(decomposition: Decomposition, facets: Array | None = None) -> float:
    """Return the diagonal of the box of local facets, or of the mesh, a length. Collective."""
    mesh, x = decomposition.mesh, decomposition.mesh.geometry.x
    if facets is not None:
        x = x[np.unique(facet_points(mesh, facets))]
    low, high = box_over_ranks(decomposition.comm, x)
    return float(np.linalg.norm(high - low))
