"""Conditions of a scene on the untorn mesh, written anew: N u ≤ gap, slips T u, friction's bounds.

Nothing is shared with the package but the definition (docs/theory.md): on what is covered of a
secondary facet ψ = D M⁻¹φ, but φ near what is held where no vertices match, points at vertices that
both sides hold, and n·(Σ_k ∫ψ_i φ_k u_k − Σ_j ∫ψ_i φ_j u_j) / ∫φ_i ≤ the distance of the planes.
At walls conditions are nodal, but of degree 2 Σ_k ∫ψ_i N_k u_k / ∫φ_i takes the place of u_i.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import basix
import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack

from benchmarks.stress.scene import Scene, Side, wall_distance

HARDLY_COVERED = 1e-6  # of a node's ∫φ_i: no condition, docs/theory.md
SLIVER = 1e-13  # of a facet's area: nothing is shared
ROUNDING = 1e-6  # of shape functions

# weights of nodes (c × n), normals (c × gdim), gaps, ∫φ over what is covered, law of friction
Block = tuple[csr_array, np.ndarray, np.ndarray, np.ndarray, tuple[str, float] | None]
# vertices and all nodes of each facet of a side
FacetsOf = Callable[[Side], tuple[np.ndarray, np.ndarray]]


@dataclass
class Conditions:
    """All conditions of a scene."""

    N: csr_array  # shape ``(c, n)``
    T: csr_array  # slips T u + slip, gdim − 1 rows of each condition, one after the other
    gap: np.ndarray  # shape ``(c,)``
    given: np.ndarray  # largest tangential forces, by Tresca's law
    coefficient: np.ndarray  # of Coulomb's law
    slip: np.ndarray | None = None  # of prescribed values, where u are the free unknowns alone

    @property
    def has_friction(self) -> bool:
        """Whether a condition has friction."""
        return bool(self.given.any() or self.coefficient.any())


def conditions(scene: Scene, x: np.ndarray, facets_of: FacetsOf, fixed: np.ndarray) -> Conditions:
    """The conditions: at vertices of walls, and of pairs by mortar.

    Args:
        scene: The scene.
        x: Nodes, shape ``(n, 3)``.
        facets_of: Vertices and nodes of a side's facets.
        fixed: Whether a displacement is prescribed, shape ``(n * gdim,)``.
    """
    fixed = fixed.reshape(-1, scene.gdim)
    found = [*_at_walls(scene, x, facets_of, fixed), *_of_pairs(scene, x, facets_of, fixed)]
    if not found:
        none, rows = np.zeros(0), csr_array((0, len(x) * scene.gdim))
        return Conditions(rows, rows, none, none, none)
    weights, normals, gaps, areas, laws = zip(*found, strict=True)
    W = vstack(weights, format="csr")
    # the normal, and tangents that are orthonormal to it
    frames = np.linalg.svd(np.concatenate(normals)[:, None])[2]
    frames[:, 0] = np.concatenate(normals)
    given, coefficient = (
        np.repeat([law[1] if law and law[0] == kind else 0.0 for law in laws], list(map(len, gaps)))
        for kind in ("tresca", "coulomb")
    )
    N, T = _rows(W, frames[:, :1]), _rows(W, frames[:, 1:])
    return Conditions(N, T, np.concatenate(gaps), given * np.concatenate(areas), coefficient)


def _at_walls(
    scene: Scene, x: np.ndarray, facets_of: FacetsOf, fixed: np.ndarray
) -> Iterator[Block]:
    for wall in scene.walls:
        vertices, nodes = facets_of(wall.side)
        area, M = np.zeros(len(x)), csr_array((len(x), len(x)))
        normals = -wall_distance(wall, x.T)[1].T[:, : scene.gdim]
        held = np.all(fixed | (abs(normals) <= ROUNDING), axis=1) & (scene.order == 2)
        for own in zip(vertices, nodes, strict=True):  # each in its own plane
            first = x[own[0][0]]
            basis = np.linalg.qr((x[own[0][1 : scene.gdim]] - first).T)[0]
            facet, every = (Facet(of, (x[of] - first) @ basis, len(own[0])) for of in own)
            parts = mortar([facet], [every], held)
            area, M = area + parts[0], M + parts[2]
        at = np.flatnonzero(area)
        W = eye_array(len(x), format="csr")[at]
        if scene.order == 2:
            W = csr_array(diags_array(1.0 / area[at]) @ M[at])
        distance, gradient = wall_distance(wall, x[at].T)
        length = np.linalg.norm(gradient, axis=0)
        normals = -(gradient / length).T[:, : scene.gdim]
        yield W, normals, distance / length, area[at], wall.friction


def _of_pairs(
    scene: Scene, x: np.ndarray, facets_of: FacetsOf, fixed: np.ndarray
) -> Iterator[Block]:
    for pair in scene.pairs:
        _, axis, end = pair.secondary
        sign = 1.0 if end else -1.0
        across = [c for c in range(scene.gdim) if c != axis]
        facets, at = [], []
        for side in (pair.secondary, pair.primary):
            facets.append([Facet(n, x[n][:, across], len(n)) for n in facets_of(side)[0]])
            box = scene.bodies[side[0]]
            at.append((box.low, box.high)[side[2]][axis])
        area, D, M = mortar(*facets, fixed[:, axis])
        met = np.flatnonzero(area)
        W = diags_array(1.0 / area[met]) @ (D - M)[met]
        normals = np.tile(sign * np.eye(scene.gdim)[axis], (len(met), 1))
        gap = np.full(len(met), sign * (at[1] - at[0]))
        yield csr_array(W), normals, gap, area[met], pair.friction


def _rows(W: csr_array, axes: np.ndarray) -> csr_array:
    """Rows Σ_j w_ij a·u_j along the axes a of each condition, shape ``(c, k, gdim)``."""
    weights = kron(W, np.ones(axes.shape[1:]), format="csr")
    along = np.tile(axes.reshape(-1, axes.shape[2]), W.shape[1])
    found = csr_array(weights.multiply(along))
    found.eliminate_zeros()
    return found


def mortar(
    secondary: list[Facet], primary: list[Facet], held: np.ndarray
) -> tuple[np.ndarray, csr_array, csr_array]:
    """∫φ_i over the covered part, and integrals of multipliers and shape functions.

    Args:
        secondary: Facets of the side that carries the multipliers.
        primary: Facets of the other side.
        held: Whether nodes are held along the normal, shape ``(n,)``.

    Returns:
        ∫φ_i of each node, 0 of those without a condition, ∫ψ_i φ_k of nodes i, k of the secondary
        side, ∫ψ_i φ_j of nodes i, j of both sides.
    """
    covered, whole = np.zeros((2, len(held)))
    entries: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for s in secondary:
        y, w = s.rule(s.polygon)
        whole[s.nodes] += w @ s.hats(y)
        shared = [(p, *s.rule(s.clip(p))) for p in primary if s.near(p)]
        shared = [(p, y, w) for p, y, w in shared if w.sum() > SLIVER * s.area]
        if not shared:
            continue
        y, w = (np.concatenate([part[k] for part in shared]) for k in (1, 2))
        phi = s.hats(y)
        d = w @ phi
        covered[s.nodes] += d
        psi_of_phi = d[:, None] * np.linalg.inv((phi * w[:, None]).T @ phi)
        near = [f for f in (s, *(p for p, *_ in shared)) if held[f.nodes].any()]
        if near and not (len(shared) == 1 and s.matches(shared[0][0])):
            psi_of_phi = np.eye(len(d))
        spots, moved = _points(s, [p for p, *_ in shared], held)
        at_points = np.eye(len(d)) - moved
        for p, y, w in shared:
            psi = moved @ psi_of_phi @ (s.hats(y) * w[:, None]).T
            own, other = psi @ s.hats(y), psi @ p.hats(y)
            for k, here in spots.items():
                if p in here:
                    share, at = at_points[:, [k]] * d[k] / len(here), s.x[k : k + 1]
                    own, other = own + share @ s.hats(at), other + share @ p.hats(at)
            for f, m, into in zip((s, p), (own, other), entries, strict=True):
                i, j = np.meshgrid(s.nodes, f.nodes, indexing="ij")
                into.append(np.stack((m, i, j)).reshape(3, -1))
    covered[covered <= HARDLY_COVERED * whole] = 0.0
    tables = (np.concatenate(of, axis=1) if of else np.zeros((3, 0)) for of in entries)
    D, M = (csr_array((m, (i.astype(int), j.astype(int))), (len(held),) * 2) for m, i, j in tables)
    return covered, D, M


def _points(
    s: Facet, shared: list[Facet], held: np.ndarray
) -> tuple[dict[int, list[Facet]], np.ndarray]:
    """Vertices of a facet that both sides hold with facets there, and who takes their multipliers.

    Multipliers are moved by a matrix of ones and shares: to vertices along edges, if not all of
    these are held, too; where all are, to the first.
    """
    spots = {}
    for k in np.flatnonzero(held[s.nodes]):
        values = {p: p.hats(s.x[k : k + 1])[0] for p in shared}
        here = [p for p in shared if values[p].min() >= -ROUNDING]
        if here and all(abs(values[p]) @ ~held[p.nodes] <= ROUNDING for p in here):
            spots[int(k)] = here
    if len(spots) == len(s.nodes):
        del spots[0]
    moved, rest = np.eye(len(s.nodes)), [k for k in range(len(s.nodes)) if k not in spots]
    for k in spots:
        # of a rectangle corners along an edge, of a triangle all
        near = abs(s.x - s.x[k]).min(axis=1) <= ROUNDING * (s.high - s.low).max()
        along = [j for j in rest if len(s.x) < 4 or near[j]]
        moved[k, k], moved[along or rest, k] = 0.0, 1.0 / len(along or rest)
    return spots, moved


class Facet:
    """An edge of a line, or a triangle or an upright rectangle of a plane.

    Args:
        nodes: Numbers of its nodes, the vertices first.
        x: Their places, shape ``(v, 1)`` or ``(v, 2)``.
        corners: Number of vertices.
    """

    def __init__(self, nodes: np.ndarray, x: np.ndarray, corners: int) -> None:
        self.nodes, self.x, vertices = nodes, x, x[:corners]
        self.low, self.high = vertices.min(axis=0), vertices.max(axis=0)
        self._origin, dim = x[0], x.shape[1]
        self._inverse = np.linalg.inv((x[1 : dim + 1] - x[0]).T)
        order = range(corners)
        if dim == 2:
            away = (vertices - vertices.mean(axis=0)) / (self.high - self.low)
            order = np.argsort(np.arctan2(*away.T[::-1]))
        self.polygon = vertices[list(order)]
        cell = {2: "interval", 3: "triangle", 4: "quadrilateral"}[corners]
        variant = basix.LagrangeVariant.equispaced
        family, kind = basix.ElementFamily.P, basix.CellType[cell]
        self._element = basix.create_element(family, kind, 1 if len(x) == corners else 2, variant)
        self._to_nodes = np.linalg.inv(self._shapes(x))
        self.area = self.rule(self.polygon)[1].sum()

    def _shapes(self, y: np.ndarray) -> np.ndarray:
        return self._element.tabulate(0, (y - self._origin) @ self._inverse.T)[0, :, :, 0]

    def hats(self, y: np.ndarray) -> np.ndarray:
        """Shape functions of the nodes at points, shape ``(q, v)``."""
        return self._shapes(y) @ self._to_nodes

    def matches(self, other: Facet) -> bool:
        """Whether the facets have the same vertices."""
        away = abs(self.x[:, None] - other.x).max(axis=2).min(axis=1).max()
        return len(self.x) == len(other.x) and away <= ROUNDING * (self.high - self.low).max()

    def near(self, other: Facet) -> bool:
        """Whether the boxes of the facets overlap."""
        return bool(np.all((self.low < other.high) & (other.low < self.high)))

    def clip(self, other: Facet) -> np.ndarray:
        """What both facets have in common, a convex polygon or an interval."""
        if len(self.low) == 1:
            return np.array([np.maximum(self.low, other.low), np.minimum(self.high, other.high)])
        polygon = self.polygon
        for a, b in zip(other.polygon, np.roll(other.polygon, -1, axis=0), strict=True):
            polygon = _cut(polygon, a, b - a)
        return polygon

    def rule(self, polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and weights that integrate polynomials of degree 6 over a convex polygon."""
        if len(self.low) == 1:
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
