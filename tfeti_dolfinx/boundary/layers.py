"""The three integrals that all layer operators of elasticity are made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.panels import Panels

# points, or pairs of them, that are looked at together: what they need stays in the cache
TOGETHER = 2**15


@dataclass(frozen=True)
class Layers:
    """Galerkin matrices of the kernels, r = x − y; x is on the panel of the row.

    Attributes:
        panels: The panels.
        single: V_Δ of 1/(4πr), in 2D −log(r/ρ)/2π, shape ``(ne, ne)``.
        tensor: R_ab of r_a r_b/(4πr³), in 2D r_a r_b/(2πr²), shape ``(d, d, ne, ne)``.
        on_corners: Of r·n_y/(4πr³), in 2D r·n_y/(2πr²), times the hat of each corner of the
            panel of y, shape ``(d, ne, ne)``.
    """

    panels: Panels
    single: Array
    tensor: Array
    on_corners: Array

    @classmethod
    def empty(cls, panels: Panels) -> Layers:
        """Zeros."""
        ne, d = len(panels.nodes), panels.dim
        matrices = np.zeros((d, d, ne, ne))
        return cls(panels, np.zeros((ne, ne)), matrices, np.zeros((d, ne, ne)))

    @property
    def double(self) -> Array:
        """K_Δ on the hats, shape ``(ne, np)``."""
        panels, ne = self.panels, len(self.single)
        K = np.zeros((ne, len(panels.x)))
        ones, each = np.ones(ne), np.arange(ne + 1)
        for corner, values in zip(panels.nodes.T, self.on_corners, strict=True):
            chosen = csr_array((ones, corner, each), shape=(ne, len(panels.x)))
            K += (chosen.T @ values.T).T
        return K


def in_chunks(items: Array, points: int) -> Iterator[Array]:
    """Parts of the items, each of which needs so many points."""
    step = max(TOGETHER // max(points, 1), 1)
    for start in range(0, len(items), step):
        yield items[start : start + step]
