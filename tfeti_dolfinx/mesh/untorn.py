"""The untorn mesh as it comes in: cells that lie on any rank, with original node ids."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from dolfinx import mesh as dmesh

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.entities import cell_entities, equal_pairs, facet_keys


@dataclass(frozen=True)
class PhysicalNames:
    """Names of the physical groups: ``surfaces[name]`` and ``volumes[name]`` are tags."""

    surfaces: dict[str, int] = field(default_factory=dict)
    volumes: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class UntornMesh:
    """This rank's share of the untorn mesh.

    Attributes:
        cell_type: Type of all cells.
        element: Coordinate element (basix.ufl), the same on all ranks.
        cells: Original node ids in DOLFINx's order, shape ``(n, nodes_per_cell)``.
        cell_ids: Original ids of the cells, shape ``(n,)``.
        cell_tags: Material tags, shape ``(n,)``, NO_TAG where there is none.
        facet_tags: Tags of the cells' facets, shape ``(n, facets_per_cell)``, NO_TAG likewise.
        node_ids: Original ids of the nodes of these cells, ascending, shape ``(p,)``.
        x: Coordinates of these nodes, shape ``(p, gdim)``.
        names: Names of the physical groups, the same on all ranks.
    """

    cell_type: dmesh.CellType
    element: Any
    cells: Array
    cell_ids: Array
    cell_tags: Array
    facet_tags: Array
    node_ids: Array
    x: Array
    names: PhysicalNames

    @property
    def gdim(self) -> int:
        """Geometric dimension."""
        return self.x.shape[1]

    @property
    def degree(self) -> int:
        """Polynomial degree of the geometry."""
        return int(self.element.degree)

    @property
    def num_vertices(self) -> int:
        """Vertices of a cell."""
        return len(cell_entities(self.cell_type, 0))

    def midpoints(self) -> Array:
        """Mean of each cell's vertices, shape ``(n, gdim)``."""
        return self._corners().mean(axis=1)

    def extents(self) -> Array:
        """Sides of the box around each cell's vertices, shape ``(n, gdim)``."""
        return np.ptp(self._corners(), axis=1)

    def _corners(self) -> Array:
        vertices = np.searchsorted(self.node_ids, self.cells[:, : self.num_vertices])
        return self.x[vertices]

    def neighbours(self, colours: Array | None = None) -> tuple[Array, Array]:
        """Pairs of local cells that share a facet, and a colour if colours are given."""
        keys = facet_keys(self.cells, self.cell_type)
        first, second = equal_pairs(keys.ravel())
        first, second = first // keys.shape[1], second // keys.shape[1]
        if colours is None:
            return first, second
        same = colours[first] == colours[second]
        return first[same], second[same]

    def with_cells(self, **changes: Array) -> UntornMesh:
        """The same mesh with other arrays."""
        return replace(self, **changes)  # type: ignore[arg-type]
