"""Conditions between parallel sides of boxes by dual mortar multipliers, written anew.

Nothing is shared with the package but the definition (docs/theory.md): on what is covered of a
secondary facet ψ = D M⁻¹φ, and n·(u_i − Σ_j ∫ψ_i φ_j u_j / ∫φ_i) ≤ the distance of the planes.
"""

from __future__ import annotations

import basix
import numpy as np

HARDLY_COVERED = 1e-6  # of a node's ∫φ_i: no condition, docs/theory.md
SLIVER = 1e-13  # of a facet's area: nothing is shared


def mortar(
    secondary: list[Facet], primary: list[Facet]
) -> tuple[dict[int, float], dict[tuple[int, int], float]]:
    """∫φ_i over the covered part, and ∫ψ_i φ_j.

    Args:
        secondary: Facets of the side that carries the multipliers.
        primary: Facets of the other side.

    Returns:
        ∫φ_i of each secondary vertex that has a condition, ∫ψ_i φ_j of vertices i, j.
    """
    D: dict[int, float] = {}
    whole: dict[int, float] = {}
    M: dict[tuple[int, int], float] = {}
    for s in secondary:
        y, w = s.rule(s.polygon)
        for i, value in zip(s.nodes, w @ s.hats(y), strict=True):
            whole[i] = whole.get(i, 0.0) + value
        shared = [(p, *s.rule(s.clip(p))) for p in primary if s.near(p)]
        shared = [(p, y, w) for p, y, w in shared if w.sum() > SLIVER * s.area]
        if not shared:
            continue
        y, w = (np.concatenate([part[k] for part in shared]) for k in (1, 2))
        phi = s.hats(y)
        d = w @ phi
        psi_of_phi = d[:, None] * np.linalg.inv((phi * w[:, None]).T @ phi)
        for i, value in zip(s.nodes, d, strict=True):
            D[i] = D.get(i, 0.0) + value
        for p, y, w in shared:
            m = psi_of_phi @ (s.hats(y) * w[:, None]).T @ p.hats(y)
            for a, i in enumerate(s.nodes):
                for b, j in enumerate(p.nodes):
                    M[i, j] = M.get((i, j), 0.0) + m[a, b]
    return {i: value for i, value in D.items() if value > HARDLY_COVERED * whole[i]}, M


class Facet:
    """An edge of a line, or a triangle or an upright rectangle of a plane.

    Args:
        nodes: Numbers of the vertices.
        x: Their places, shape ``(v, 1)`` or ``(v, 2)``.
    """

    def __init__(self, nodes: np.ndarray, x: np.ndarray) -> None:
        self.nodes, self.x = [int(n) for n in nodes], x
        self.low, self.high = x.min(axis=0), x.max(axis=0)
        middle = x.mean(axis=0)
        order = range(len(x))
        if x.shape[1] == 2:
            order = np.argsort(np.arctan2(*((x - middle) / (self.high - self.low)).T[::-1]))
        self.polygon = x[list(order)]
        self.area = self.rule(self.polygon)[1].sum()

    def near(self, other: Facet) -> bool:
        """Whether the boxes of the facets overlap."""
        return bool(np.all((self.low < other.high) & (other.low < self.high)))

    def hats(self, y: np.ndarray) -> np.ndarray:
        """Hats of the vertices at points, shape ``(q, v)``."""
        t = (y - self.low) / (self.high - self.low)
        corner = (self.x - self.low) / (self.high - self.low)
        if len(self.x) == 3:
            one = np.ones((1, 3))
            return np.linalg.solve(
                np.vstack((corner.T, one)), np.vstack((t.T, np.ones((1, len(y)))))
            ).T
        up = (corner > 0.5)[None]
        return np.where(up, t[:, None], 1.0 - t[:, None]).prod(axis=2)

    def clip(self, other: Facet) -> np.ndarray:
        """What both facets have in common, a convex polygon or an interval."""
        if self.x.shape[1] == 1:
            return np.array([np.maximum(self.low, other.low), np.minimum(self.high, other.high)])
        polygon = self.polygon
        for a, b in zip(other.polygon, np.roll(other.polygon, -1, axis=0), strict=True):
            polygon = _cut(polygon, a, b - a)
        return polygon

    def rule(self, polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and weights that integrate polynomials of degree 6 over a convex polygon."""
        if self.x.shape[1] == 1:
            xi, w = basix.make_quadrature(basix.CellType.interval, 6)
            return polygon[0] + xi * (polygon[1] - polygon[0]), w * abs(polygon[1] - polygon[0])
        if len(polygon) < 3:
            return np.empty((0, 2)), np.empty(0)
        xi, w = basix.make_quadrature(basix.CellType.triangle, 6)
        a, b, c = polygon[0], polygon[1:-1], polygon[2:]
        points = a + xi[:, :1, None] * (b - a)[:, None].swapaxes(0, 1)
        points = points + xi[:, 1:, None] * (c - a)[:, None].swapaxes(0, 1)
        area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        return points.reshape(-1, 2), (w[:, None] * area).ravel()


def _cut(polygon: np.ndarray, a: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The part of a polygon to the left of a line."""
    side = along[0] * (polygon - a)[:, 1] - along[1] * (polygon - a)[:, 0] if len(polygon) else []
    out = []
    for k in range(len(polygon)):
        p, q, s, t = polygon[k - 1], polygon[k], side[k - 1], side[k]
        if (s < 0.0) != (t < 0.0):
            out.append(p + (q - p) * (s / (s - t)))
        if t >= 0.0:
            out.append(q)
    return np.array(out).reshape(-1, 2)
