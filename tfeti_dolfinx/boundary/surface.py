"""Panels of subdomains: the facets of a torn mesh on its outside, tears included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.panels import Panels
from tfeti_dolfinx.compat import geometry_degree
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.entities import cell_facets, facet_vertices

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
        """The same with nodes, and therefore panels, in another order."""
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
        corners = dofs.primal_nodes(np.asarray(dofs.V.dofmap.list)[cell])
        local_corners = facet_vertices(mesh.topology.cell_type)[local]
        nodes = np.take_along_axis(corners, local_corners, axis=1)
        middle, where = x[corners].mean(axis=1), position[cell]
        normals = _sum_at(nodes, _hat_normals(x, nodes, middle), x.shape)
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


def _sum_at(nodes: Array, values: Array, shape: tuple[int, ...]) -> Array:
    total = np.zeros(shape)
    np.add.at(total, nodes, values)
    return total


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
