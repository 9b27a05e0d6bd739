"""Flat panels: the closed surface of a body, and its traces of displacements and tractions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.arrays import Array


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
        """Of a ball around them, whatever way they are turned."""
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
        """A sparse matrix, ne × np, from values for the corners, shape ``(ne, d)``."""
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
