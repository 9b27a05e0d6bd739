"""Conditions of a scene on the untorn mesh: N u ≤ gap, slips T u, and what friction bears."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from benchmarks.stress.mortar import Facet, mortar
from benchmarks.stress.scene import Scene, Side, wall_distance

# weights of nodes, normal, gap, ∫φ over what is covered, law of friction
Condition = tuple[dict[int, float], np.ndarray, float, float, tuple[str, float] | None]
# vertices and all nodes of each facet of a side
FacetsOf = Callable[[Side], tuple[np.ndarray, np.ndarray]]


@dataclass
class Conditions:
    """All conditions of a scene."""

    N: csr_array  # shape ``(c, n)``
    T: csr_array  # along tangents, gdim − 1 rows of each condition, one after the other
    gap: np.ndarray  # shape ``(c,)``
    given: np.ndarray  # largest tangential forces, by Tresca's law
    coefficient: np.ndarray  # of Coulomb's law

    @property
    def has_friction(self) -> bool:
        """Whether a condition has friction."""
        return bool(self.given.any() or self.coefficient.any())


def conditions(scene: Scene, x: np.ndarray, facets_of: FacetsOf) -> Conditions:
    """The conditions: at vertices of walls, for degree 2 with dual hats, and of pairs by mortar.

    Args:
        scene: The scene.
        x: Nodes, shape ``(n, 3)``.
        facets_of: Vertices and nodes of a side's facets.
    """
    found = list(_conditions(scene, x, facets_of))
    gdim, laws = scene.gdim, [condition[4] or ("", 0.0) for condition in found]
    area = np.array([condition[3] for condition in found])
    bounds = [
        np.array([value if law == kind else 0.0 for law, value in laws])
        for kind in ("tresca", "coulomb")
    ]
    frames = [_frame(normal[:gdim]) for _, normal, *_ in found]
    N = _rows([w for w, *_ in found], [frame[:1] for frame in frames], len(x) * gdim, gdim)
    T = _rows([w for w, *_ in found], [frame[1:] for frame in frames], len(x) * gdim, gdim)
    gap = np.array([condition[2] for condition in found])
    return Conditions(N, T, gap, bounds[0] * area, bounds[1])


def _conditions(scene: Scene, x: np.ndarray, facets_of: FacetsOf) -> Iterator[Condition]:
    for wall in scene.walls:
        vertices, nodes = facets_of(wall.side)
        weights = _weights(x, vertices, nodes, scene.gdim)
        at = sorted(weights)
        distance, gradient = wall_distance(wall, x[at].T)
        length = np.linalg.norm(gradient, axis=0)
        for k, i in enumerate(at):
            own, area = weights[i]
            own = own if scene.order == 2 else {i: 1.0}
            yield own, -gradient[:, k] / length[k], distance[k] / length[k], area, wall.friction
    for pair in scene.pairs:
        axis, end = pair.secondary[1:]
        across = [c for c in range(scene.gdim) if c != axis]
        sides = [facets_of(side)[0] for side in (pair.secondary, pair.primary)]
        D, M = mortar(*([Facet(n, x[n][:, across]) for n in nodes] for nodes in sides))
        sign = 1.0 if end else -1.0
        at = [
            (b.low, b.high)[side[2]][axis]
            for side in (pair.secondary, pair.primary)
            for b in [scene.bodies[side[0]]]
        ]
        normal, gap = sign * np.eye(3)[axis], sign * (at[1] - at[0])
        parts: dict[int, dict[int, float]] = {i: {i: 1.0} for i in D}
        for (i, j), m in M.items():
            if i in D:
                parts[i][j] = -m / D[i]
        for i, own in parts.items():
            yield own, normal, gap, D[i], pair.friction


def _weights(
    x: np.ndarray, vertices: np.ndarray, nodes: np.ndarray, gdim: int
) -> dict[int, tuple[dict[int, float], float]]:
    """∫ψ_i N_k / ∫φ_i of the nodes k, and ∫φ_i, ψ_i dual to the hats φ_i of the vertices."""
    sums: dict[int, dict[int, float]] = {}
    area: dict[int, float] = {}
    for own, every in zip(vertices, nodes, strict=True):
        basis = np.linalg.qr((x[own[1:gdim]] - x[own[0]]).T)[0].T
        facet = Facet(own, (x[own] - x[own[0]]) @ basis.T)
        y, w = facet.rule(facet.polygon)
        phi = facet.hats(y)
        d = w @ phi
        dual = d[:, None] * np.linalg.solve((phi * w[:, None]).T @ phi, phi.T)
        values = _quadratic((x[every] - x[own[0]]) @ basis.T, y, len(own))
        for i, row, part in zip(facet.nodes, (dual * w) @ values, d, strict=True):
            area[i] = area.get(i, 0.0) + part
            mine = sums.setdefault(i, {})
            for k, value in zip(every, row, strict=True):
                mine[int(k)] = mine.get(int(k), 0.0) + value
    return {i: ({k: v / area[i] for k, v in sums[i].items()}, area[i]) for i in sums}


def _quadratic(at: np.ndarray, y: np.ndarray, corners: int) -> np.ndarray:
    """Shape functions of a facet's nodes at points: as many as there are nodes."""
    degree = 1 if len(at) == corners else 2
    scale = np.ptp(at, axis=0)
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1)]
    if at.shape[1] == 1:
        powers = [(i, 0) for i in range(degree + 1)]
    elif corners == 3:
        powers = [(i, j) for i, j in powers if i + j <= degree]

    def monomials(z: np.ndarray) -> np.ndarray:
        z = np.pad(z / scale, ((0, 0), (0, 2 - z.shape[1])), constant_values=1.0)
        return np.stack([z[:, 0] ** i * z[:, 1] ** j for i, j in powers], axis=1)

    return monomials(y) @ np.linalg.inv(monomials(at))


def _frame(normal: np.ndarray) -> np.ndarray:
    """The normal, and tangents that are orthonormal to it."""
    _, _, Vt = np.linalg.svd(normal[None])
    return np.concatenate((normal[None], Vt[1:]))


def _rows(weights: list[dict[int, float]], axes: list[np.ndarray], n: int, gdim: int) -> csr_array:
    rows, columns, values, count = [], [], [], 0
    for own, directions in zip(weights, axes, strict=True):
        for direction in directions:
            for node, weight in own.items():
                rows += [count] * gdim
                columns += range(node * gdim, (node + 1) * gdim)
                values += list(weight * direction)
            count += 1
    found = csr_array((values, (rows, columns)), shape=(count, n))
    found.eliminate_zeros()
    return found
