"""Facets of contact surfaces, as they travel between ranks."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import geometry_dofmap
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.entities import cell_facets
from tfeti_dolfinx.mortar.facet_element import FACET_OF, FacetElement, facet_dofs, from_first
from tfeti_dolfinx.parallel import Exchange


@dataclass(frozen=True)
class FacetKind:
    """What all contact facets of a problem have in common.

    Attributes:
        facet: interval, triangle or quadrilateral.
        hats: P1 (Q1) element of the multipliers.
        displacement: Element of the displacement's trace.
        geometry: Element of the geometry.
    """

    facet: str
    hats: FacetElement
    displacement: FacetElement
    geometry: FacetElement

    @property
    def num_vertices(self) -> int:
        """Vertices of a facet."""
        return self.hats.size


@dataclass(frozen=True)
class Facets:
    """Some facets, one row each.

    Attributes:
        x: Geometry nodes, vertices first, shape ``(n, g, gdim)``.
        groups: Global groups of the displacement's nodes, vertices first, shape ``(n, t)``.
        normal: Outward unit normal at the centre, shape ``(n, gdim)``.
        vertex_normals: Unit normals at the vertices, at first the facet's own, then averaged ones,
            shape ``(n, v, gdim)``.
        area: Area (length in 2D), shape ``(n,)``.
        curvature: Second derivatives of the height of a smooth surface over the facet's tangent
            plane (``curvature.py``), negative where the body is convex; at first 0, shape
            ``(n, gdim, gdim)``.
    """

    x: Array
    groups: Array
    normal: Array
    vertex_normals: Array
    area: Array
    curvature: Array

    def __len__(self) -> int:
        return len(self.x)

    def sent(self, exchange: Exchange, rows: Array | None = None) -> Facets:
        """The facets (or some rows of them) that an exchange brings here. Collective."""
        chosen = slice(None) if rows is None else rows
        return Facets(*(exchange.send(getattr(self, f.name)[chosen]) for f in fields(self)))

    def corners(self, num_vertices: int) -> Array:
        """Vertices, shape ``(n, v, gdim)``."""
        return self.x[:, :num_vertices]

    def box(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates of each facet, shapes ``(n, gdim)``."""
        return self.x.min(axis=1), self.x.max(axis=1)

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
        facet=facet,
        hats=FacetElement(facet, 1, element.lagrange_variant),
        displacement=FacetElement(facet, element.degree, element.lagrange_variant),
        geometry=FacetElement(facet, geometry.degree, geometry.lagrange_variant),
    )


def local_facets(dofs: TornDofs, decomposition: Decomposition, facets: Array) -> Facets:
    """Data of local boundary facets, without averaged normals.

    Args:
        dofs: Dof maps.
        decomposition: The torn mesh.
        facets: Local facets of the true boundary.
    """
    mesh = decomposition.mesh
    cell_type, gdim = mesh.topology.cell_type, mesh.geometry.dim
    cell, place = _cells_of(decomposition, facets)
    element = dofs.V.element.basix_element
    coordinate = mesh.ufl_domain().ufl_coordinate_element()
    on_facet = facet_dofs(cell_type.name, coordinate.degree, coordinate.lagrange_variant)[place]
    nodes = geometry_dofmap(mesh)[cell]
    x = mesh.geometry.x[np.take_along_axis(nodes, on_facet, axis=1)][:, :, :gdim]
    trace = facet_dofs(cell_type.name, element.degree, element.lagrange_variant)[place]
    displacement = np.take_along_axis(np.asarray(dofs.V.dofmap.list)[cell], trace, axis=1)
    kind = facet_kind(dofs)
    num_vertices = kind.num_vertices
    inside = mesh.geometry.x[nodes[:, : coordinate.dim // gdim]].mean(axis=1)[:, :gdim]
    normal, area = _normals(x[:, :num_vertices], inside)
    return Facets(
        x=np.ascontiguousarray(x),
        groups=dofs.group[dofs.primal_nodes(displacement)],
        normal=normal,
        vertex_normals=_vertex_normals(kind, x, normal),
        area=area,
        curvature=np.zeros((len(x), gdim, gdim)),
    )


def with_averaged_normals(
    facets: Facets, dofs: TornDofs, num_vertices: int
) -> tuple[Facets, Array]:
    """The same facets with normals averaged at the vertices, weighted by area. Collective.

    Returns:
        The facets, and the averaged normal of each owned group, 0 off them, shape ``(g, gdim)``.
    """
    groups = facets.groups[:, :num_vertices]
    weighted = facets.vertex_normals * facets.area[:, None, None]
    total = dofs.add_on_owners(groups.ravel(), weighted.reshape(-1, weighted.shape[2]))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    averaged = total / np.where(length > 0.0, length, 1.0)
    (at_vertices,) = dofs.lookup(groups.ravel(), averaged)
    return replace(facets, vertex_normals=at_vertices.reshape(weighted.shape)), averaged


def _cells_of(decomposition: Decomposition, facets: Array) -> tuple[Array, Array]:
    """Cell of each boundary facet, and its place among the cell's facets."""
    topology = decomposition.mesh.topology
    topology.create_connectivity(topology.dim - 1, topology.dim)
    cells = topology.connectivity(topology.dim - 1, topology.dim)
    cell = cells.array[cells.offsets[facets]]
    place = np.argmax(cell_facets(decomposition.mesh)[cell] == facets[:, None], axis=1)
    return cell, place


def _vertex_normals(kind: FacetKind, x: Array, normal: Array) -> Array:
    """Unit normals of curved facets at their vertices, on the side of plane facets' normals."""
    slopes = kind.geometry.slopes(kind.hats.points)
    tangents = np.einsum("tvg,ngd->tnvd", slopes, from_first(x))
    if len(tangents) == 1:
        found = np.stack((tangents[0, :, :, 1], -tangents[0, :, :, 0]), axis=2)
    else:
        found = np.cross(*tangents)
    length = np.linalg.norm(found, axis=2) * np.sign(np.einsum("nvd,nd->nv", found, normal))
    return found / np.where(length != 0.0, length, np.inf)[:, :, None]


def _normals(corners: Array, inside: Array) -> tuple[Array, Array]:
    """Unit normals at the centres, away from points inside, and areas."""
    if corners.shape[2] == 2:
        edge = corners[:, 1] - corners[:, 0]
        normal = np.stack((edge[:, 1], -edge[:, 0]), axis=1)
        area = np.linalg.norm(normal, axis=1)
    elif corners.shape[1] == 3:
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(normal, axis=1)
    else:  # the diagonals of a quadrilateral
        normal = np.cross(corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])
        area = 0.5 * np.linalg.norm(normal, axis=1)
    outward = np.sum(normal * (corners.mean(axis=1) - inside), axis=1)
    length = np.linalg.norm(normal, axis=1)
    sign = np.where(outward < 0.0, -1.0, 1.0)
    return sign[:, None] * normal / np.where(length > 0.0, length, 1.0)[:, None], area
