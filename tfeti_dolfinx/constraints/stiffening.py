"""Stiffness on sides of flat cells that Dirichlet conditions hold at 0, beside their rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.constraints.gluing import Prescribed
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import cell_entities

# so many times as wide as the cell is thick there, a facet is the side of a flat cell
FLAT = 10.0


class Stiffening:
    """ρ K_ii for K_ii where a component is prescribed as 0 on a side of flat cells.

    An augmented Lagrangian: rows hold the component at 0, so that nothing of the solution changes,
    but a flat subdomain that conditions hold along a side no longer bends far more easily than the
    body can. Creation and all methods are collective.

    Args:
        penalty: ρ; 0: nothing is added.
        dofs: Dof maps.
    """

    def __init__(self, penalty: float, dofs: TornDofs) -> None:
        self._penalty, self._dofs = penalty, dofs
        self._held: Array = np.zeros((dofs.num_nodes, dofs.bs), dtype=bool)
        self._sides: Array = np.zeros_like(self._held)

    def look(self, prescribed: Prescribed) -> bool:
        """Take new conditions; whether another K comes of them."""
        if self._penalty == 0.0:
            return False
        held = self._dofs.spread(prescribed.flag & (prescribed.value == 0.0))
        held = (self._dofs.to_dolfinx(held.ravel()) > 0.0).reshape(self._held.shape)
        if np.array_equal(held, self._held):
            return any_rank(self._dofs.comm, False)
        old, self._held, self._sides = self._sides, held, held_flat_sides(self._dofs, held)
        return any_rank(self._dofs.comm, not np.array_equal(old, self._sides))

    def added(self, K: Any) -> Array | None:
        """Return the addition to this rank's diagonal of K, in DOLFINx's numbering, or None.

        Args:
            K: scipy CSR.
        """
        if not np.any(self._sides):
            return None
        return np.where(self._sides.ravel(), self._penalty * K.diagonal(), 0.0)


def held_flat_sides(dofs: TornDofs, held: Array) -> Array:
    """Components that are held on a whole facet of a cell that is flat there.

    Args:
        dofs: Dof maps.
        held: Flags in DOLFINx's numbering, shape ``(nodes, bs)``.

    Returns:
        Flags, shape ``(nodes, bs)``.
    """
    mesh, layout = dofs.V.mesh, dofs.V.dofmap.dof_layout
    facet_dim, cell_type = mesh.topology.dim - 1, mesh.topology.cell_type
    found, nodes = np.zeros_like(held), np.asarray(dofs.V.dofmap.list)
    corners = cell_entities(cell_type, facet_dim)
    vertices = geometry_dofmap(mesh)[:, : len(cell_entities(cell_type, 0))]
    x = mesh.geometry.x[vertices][:, :, : mesh.geometry.dim]
    for k, own in enumerate(corners):
        of_facet = nodes[:, layout.entity_closure_dofs(facet_dim, k)]
        at = np.flatnonzero(held[of_facet].all(axis=1).any(axis=1))
        at = at[_is_flat(x[at], own)]
        components = held[of_facet[at]].all(axis=1)
        for node in of_facet[at].T:
            np.logical_or.at(found, node, components)
    return found


def _is_flat(x: Array, facet: Array) -> Array:
    """Return whether cells are far less thick than a facet of theirs is wide, shape ``(n,)``.

    Args:
        x: Their vertices, shape ``(n, v, gdim)``.
        facet: The facet's vertices in a cell.
    """
    rays = x - x[:, facet[:1]]
    sides = rays[:, facet[1:]]
    normal = np.cross(sides[:, 0], sides[:, 1]) if x.shape[2] == 3 else sides[:, 0, ::-1] * (-1, 1)
    length = np.maximum(np.linalg.norm(normal, axis=1), TINY)
    thick = np.abs(np.einsum("nvi,ni->nv", rays, normal)).max(axis=1, initial=0.0) / length
    wide = np.linalg.norm(sides, axis=2).max(axis=1, initial=0.0)
    return np.asarray(wide > FLAT * thick)
