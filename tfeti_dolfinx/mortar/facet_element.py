"""Lagrange elements on facets, and which unknowns of a cell are those of its facets."""

from __future__ import annotations

from functools import cache
from typing import Any

import basix
import numpy as np

from tfeti_dolfinx.arrays import Array

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

    Args:
        facet: interval, triangle or quadrilateral.
        degree: Polynomial degree.
        variant: basix' Lagrange variant.
    """

    def __init__(self, facet: str, degree: int, variant: Any) -> None:
        self.facet, self.degree = facet, degree
        self._cell = getattr(basix.CellType, facet)
        self._element = basix.create_element(basix.ElementFamily.P, self._cell, degree, variant)
        self.points = self._element.points
        self.size = self._element.dim

    @property
    def is_affine(self) -> bool:
        """Whether all maps with these basis functions are affine."""
        return self.degree == 1 and self.facet != "quadrilateral"

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


def from_first(x: Array) -> Array:
    """Nodes of facets from the first one on, shape ``(n, nodes, d)``.

    Tangents are sums of these times slopes: slopes add up to 0 but for rounding, which would turn
    a facet that is far from the origin.
    """
    return np.asarray(x - x[:, :1])


@cache
def facet_dofs(cell: str, degree: int, variant: Any) -> Array:
    """Cell unknowns of each facet, in the order of the facet's own element.

    Args:
        cell: Name of the cell type.
        degree: Degree of the Lagrange element.
        variant: Its variant.

    Returns:
        Shape ``(facets, unknowns per facet)``.
    """
    cell_type = getattr(basix.CellType, cell)
    points = basix.create_element(basix.ElementFamily.P, cell_type, degree, variant).points
    corners, topology = basix.geometry(cell_type), basix.topology(cell_type)
    element = FacetElement(FACET_OF[cell], degree, variant)
    hats = FacetElement(FACET_OF[cell], 1, variant)
    table = []
    for vertices in topology[points.shape[1] - 1]:
        on_facet = hats.values(element.points) @ corners[vertices]
        distance = np.linalg.norm(on_facet[:, None] - points[None], axis=2)
        table.append(np.argmin(distance, axis=1))
    return np.array(table)
