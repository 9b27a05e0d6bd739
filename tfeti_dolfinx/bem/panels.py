"""Panels of a boundary element surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_degree
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import cell_facets, facet_vertices

# --- Panels of a closed surface ---------------------------------------------------------------


@dataclass(frozen=True)
class Panels:
    """Segments in 2D, triangles in 3D. Displacements are linear on them, tractions constant.

    Attributes:
        x: Points of the nodes, shape ``(np, d)``.
        nodes: Nodes of each panel, shape ``(ne, d)``: in 2D the body is on the left, in 3D they
            are counter-clockwise as seen from outside.
    """

    x: Array
    nodes: Array

    @property
    def dim(self) -> int:
        """d."""
        return int(self.x.shape[1])

    @cached_property
    def corners(self) -> Array:
        """Shape ``(ne, d, d)``: panel, corner, component."""
        return self.x[self.nodes]

    @cached_property
    def directed(self) -> Array:
        """Outward normals times the measures of the panels, shape ``(ne, d)``."""
        edges = self.corners[:, 1:] - self.corners[:, :1]
        if self.dim == 2:
            return np.stack((edges[:, 0, 1], -edges[:, 0, 0]), axis=1)
        return np.asarray(0.5 * np.cross(edges[:, 0], edges[:, 1]))

    @cached_property
    def measure(self) -> Array:
        """Lengths or areas, shape ``(ne,)``."""
        return np.linalg.norm(self.directed, axis=1)

    @property
    def normal(self) -> Array:
        """Outward unit normals, shape ``(ne, d)``."""
        return self.directed / self.measure[:, None]

    @property
    def midpoints(self) -> Array:
        """Shape ``(ne, d)``."""
        return self.corners.mean(axis=1)

    @cached_property
    def size(self) -> Array:
        """Longest edge of each panel, shape ``(ne,)``."""
        edges = self.corners - np.roll(self.corners, 1, axis=1)
        return np.linalg.norm(edges, axis=2).max(axis=1)

    @property
    def distortion(self) -> Array:
        """Square of the longest edge over twice the area, of triangles: 1.2 if they are regular."""
        return np.asarray(0.5 * self.size**2 / self.measure)

    @property
    def diameter(self) -> float:
        """Diameter of a ball around the panels, the same for all rotations of them."""
        return 2.0 * float(np.linalg.norm(self.x - self.x.mean(axis=0), axis=1).max())

    @property
    def rho(self) -> float:
        """ρ of the logarithm in 2D: large enough for a single layer that is positive."""
        return 2.0 * self.diameter

    @property
    def volume(self) -> float:
        """∫x·n / d."""
        return float(np.sum(self.midpoints * self.directed) / self.dim)

    def by_corners(self, values: Array) -> csr_array:
        """Return a sparse matrix, ne × np, from values for the corners, shape ``(ne, d)``."""
        panel = np.repeat(np.arange(len(self.nodes)), self.dim)
        shape = (len(self.nodes), len(self.x))
        return csr_array(coo_array((values.ravel(), (panel, self.nodes.ravel())), shape=shape))

    @cached_property
    def mass(self) -> csr_array:
        """M, ∫ of the hats over the panels, shape ``(ne, np)``."""
        return self.by_corners(np.repeat(self.measure[:, None] / self.dim, self.dim, axis=1))

    @cached_property
    def curls(self) -> list[csr_array]:
        """Surface curls of the hats: d/ds alone in 2D, (n × ∇)_c in 3D."""
        if self.dim == 2:
            slopes = np.array([-1.0, 1.0]) / self.measure[:, None]
            return [self.by_corners(slopes)]
        opposite = np.roll(self.corners, 1, axis=1) - np.roll(self.corners, -1, axis=1)
        turned = -opposite / (2.0 * self.measure[:, None, None])
        return [self.by_corners(turned[:, :, c]) for c in range(3)]


# --- Panels of subdomains ---------------------------------------------------------------------

# Of the size of a facet: how far its corners may be from a plane
FLAT = 1e-8
# Which corner of a quadrilateral its diagonal starts from: the lowest along a direction in which
# no two corners of a grid are level, so that equal subdomains are cut alike
DIRECTION = np.array([1.0, np.sqrt(2.0), np.sqrt(5.0)])


@dataclass(frozen=True)
class Surface:
    """The surface of a subdomain.

    Attributes:
        cuts: Panels; their points are those of all nodes of the subdomain. Of quadrilaterals both
            ways to cut them: one alone loads the two corners on the diagonal more than the
            others.
        normals: Integrals of the hats of its facets times n, for each node, shape ``(n, d)``.
    """

    cuts: tuple[Panels, ...]
    normals: Array

    @property
    def panels(self) -> Panels:
        """The first of the cuts."""
        return self.cuts[0]

    def placed(self, order: Array) -> Surface:
        """Return the same with nodes, and therefore panels, in another order."""
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        x = self.panels.x[order]
        cuts = tuple(Panels(x, _in_order(rank[cut.nodes])) for cut in self.cuts)
        return Surface(cuts, self.normals[order])


def _in_order(nodes: Array) -> Array:
    """Panels sorted, triangles each from their lowest node on."""
    if nodes.shape[1] == 3:
        turn = (np.argmin(nodes, axis=1)[:, None] + np.arange(3)) % 3
        nodes = np.take_along_axis(nodes, turn, axis=1)
    return nodes[np.lexsort(nodes.T)]


def surfaces(dofs: TornDofs, decomposition: Decomposition, chosen: Array) -> dict[int, Surface]:
    """Surfaces of subdomains of this rank, by their positions in ``dofs.subdomains``. Collective.

    Nodes are in primal order.

    Args:
        dofs: Dof maps of displacements of degree 1.
        decomposition: The torn mesh.
        chosen: Flags of the subdomains of this rank, shape ``(S,)``.

    Raises:
        InputError: Cells are curved, displacements not of degree 1, or facets not flat.
    """
    mesh, gdim = decomposition.mesh, decomposition.mesh.geometry.dim
    facets = cell_facets(mesh)
    with raised_on_all_ranks(decomposition.comm):
        _check_degrees(dofs)
        x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, :gdim]
        outside = np.zeros(int(facets.max(initial=-1)) + 1, dtype=bool)
        outside[decomposition.tears] = outside[decomposition.boundary] = True
        position = np.searchsorted(dofs.subdomains, decomposition.cell_subdomain)
        cell, local = np.nonzero(outside[facets] & chosen[position][:, None])
        corners = dofs.primal_node[np.asarray(dofs.V.dofmap.list)[cell]]
        local_corners = facet_vertices(mesh.topology.cell_type)[local]
        nodes = np.take_along_axis(corners, local_corners, axis=1)
        middle, where = x[corners].mean(axis=1), position[cell]
        normals = np.zeros(x.shape)
        np.add.at(normals, nodes, _hat_normals(x, nodes, middle))
        cuts = [nodes]
        if nodes.shape[1] == 4:
            cuts = _triangles(x, nodes)
            middle, where = np.tile(middle, (2, 1)), np.tile(where, 2)
        cuts = [_turned_outward(x, cut, middle) for cut in cuts]
        found = {}
        for s in map(int, np.flatnonzero(chosen)):
            first, last = dofs.node_offsets[s], dofs.node_offsets[s + 1]
            own = tuple(Panels(x[first:last], cut[where == s] - first) for cut in cuts)
            found[s] = Surface(own, normals[first:last])
    return found


def _hat_normals(x: Array, nodes: Array, middle: Array) -> Array:
    """∫φ n of the corners of facets, outward, shape ``(k, corners, d)``."""
    if nodes.shape[1] < 4:
        panels = Panels(x, nodes)
        share = panels.directed / nodes.shape[1]
        whole = np.repeat(share[:, None], nodes.shape[1], axis=1)
    else:
        whole = _of_bilinear(x[nodes])
    outward = np.einsum("ki,ki->k", whole.sum(axis=1), x[nodes].mean(axis=1) - middle)
    return np.asarray(np.sign(outward)[:, None, None] * whole)


def _of_bilinear(corners: Array) -> Array:
    """∫φ n of quadrilaterals, by Gauss' rule of two points along each side, which is exact."""
    at = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12.0)
    total = np.zeros_like(corners)
    for s in at:
        for t in at:
            along = np.array([[t - 1.0, 1.0 - t, -t, t], [s - 1.0, -s, 1.0 - s, s]])
            tangents = np.einsum("ac,kci->aki", along, corners)
            hats = np.array([(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t])
            total += 0.25 * hats[None, :, None] * np.cross(*tangents)[:, None]
    return total


def _check_degrees(dofs: TornDofs) -> None:
    degree = dofs.V.element.basix_element.degree
    if geometry_degree(dofs.V.mesh) != 1:
        raise InputError("boundary elements on curved cells; expected a mesh of degree 1")
    if degree != 1 or dofs.bs != dofs.V.mesh.geometry.dim:
        raise InputError(
            f"boundary elements for {dofs.bs} components of degree {degree}; expected "
            "displacements of degree 1"
        )


def _triangles(x: Array, nodes: Array) -> list[Array]:
    """Quadrilaterals cut in two along each of their diagonals, shapes ``(2k, 3)``."""
    ring = nodes[:, [0, 1, 3, 2]]
    a, b, c, d = np.moveaxis(x[ring], 1, 0)
    size = np.linalg.norm(c - a, axis=1)
    height = np.abs(np.einsum("ki,ki->k", np.cross(b - a, c - a), d - a))
    if np.any(height > FLAT * size**3):
        raise InputError(
            f"boundary elements: {np.sum(height > FLAT * size**3)} facets are not flat; expected "
            "flat facets, say triangles"
        )
    first = np.argmin(x[ring] @ DIRECTION, axis=1)[:, None]
    ring = np.take_along_axis(ring, (first + np.arange(4)) % 4, axis=1)
    halves = [([0, 1, 2], [0, 2, 3]), ([1, 2, 3], [1, 3, 0])]
    return [np.concatenate([ring[:, half] for half in pair]) for pair in halves]


def _turned_outward(x: Array, nodes: Array, middle: Array) -> Array:
    """Panels with the last two nodes exchanged where their normal points to these points."""
    panels = Panels(x, nodes)
    inward = np.einsum("ki,ki->k", panels.directed, panels.midpoints - middle) < 0.0
    swapped = nodes.copy()
    swapped[:, [-2, -1]] = nodes[:, [-1, -2]]
    return np.where(inward[:, None], swapped, nodes)
