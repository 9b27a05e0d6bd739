"""Somigliana's identity: displacement and stress inside, from what is on the surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import basix
import numpy as np
from scipy.spatial import cKDTree

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.layers import in_chunks
from tfeti_dolfinx.boundary.panels import Panels
from tfeti_dolfinx.boundary.steklov import Steklov, gunter

# A panel is cut in parts until their middles are as far as so many of their sizes; then a rule of
# this degree is exact to 1e-9. What is nearer to the surface than a panel's size over 2 to the
# power of HALVINGS loses that.
FAR, DEGREE, HALVINGS = 2.0, 14, 12
# Steps of differences over the distance to the nearest node or midpoint: of fourth order, so that
# they err by 1e-11, and rounding by 1e-13
STEP = 1e-3


class Inside:
    """The solution inside a body with boundary elements.

    u(x) = V(t − 2μ𝓜û) + V_Δ𝓜û − K_Δû + u_p at x, û = u − u_p on the surface, t = V⁻¹(½M + K)û, u_p
    a particular solution for the force per volume.

    Args:
        steklov: The body.
        u: Displacement of the nodes, shape ``(np, d)``.
        b: Force per volume, shape ``(d,)``.
        shift: From the panels of ``steklov`` to where the body is, shape ``(d,)``.
    """

    def __init__(self, steklov: Steklov, u: Array, b: Array, shift: Array | float = 0.0) -> None:
        panels, law = steklov.panels, steklov.law
        self._shift = shift
        self._panels, self._law, self._b = panels, law, b
        self._middle = panels.x.mean(axis=0)
        rest = u - self._particular(panels.x)
        t = (steklov.tractions @ rest.ravel()).reshape(-1, panels.dim)
        turned = (gunter(panels) @ rest.T.ravel()).reshape(panels.dim, -1).T
        self._field = _Field(t - 2.0 * law.mu * turned, turned, rest[panels.nodes])

    def displacement(self, points: Array) -> Array:
        """Shape ``(k, d)``, at points inside, shape ``(k, d)``."""
        return self._at(points - self._shift, np.zeros((1, self._panels.dim)))[:, 0]

    def contains(self, points: Array) -> Array:
        """Flags of points inside, shape ``(k,)``, for points of shape ``(k, d)``."""
        return contains(self._panels, points - self._shift)

    def stress(self, points: Array) -> Array:
        """Shape ``(k, d, d)``, without σ_zz, at points inside, shape ``(k, d)``."""
        d, points = self._panels.dim, points - self._shift
        size = STEP * _distance(self._panels, points)
        ways = np.array([-2.0, -1.0, 1.0, 2.0])
        steps = np.concatenate([way * np.eye(d) for way in ways])
        values = self._at(points, steps, size).reshape(len(points), 4, d, d)
        weights = np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
        gradient = np.einsum("w,kwji->kij", weights, values) / size[:, None, None]
        return self._law.stress(gradient)

    def _particular(self, x: Array) -> Array:
        stiff = self._law.lmbda + 2.0 * self._law.mu
        return np.asarray(-self._b * (x - self._middle) ** 2 / (2.0 * stiff))

    def _at(self, points: Array, steps: Array, size: Array | None = None) -> Array:
        """Displacements at points and steps from there, shape ``(k, q, d)``, by the same rules."""
        size = np.ones(len(points)) if size is None else size
        moved = points[:, None] + size[:, None, None] * steps
        u = self._particular(moved)
        for cut in _cuts(self._panels, points, self._field.on_corners):
            r = moved[cut.point][:, :, None] - cut.y[:, None]
            np.add.at(u, cut.point, self._layers(r, cut))
        return u

    def _layers(self, r: Array, cut: _Cut) -> Array:
        """What some panels contribute, shape ``(p, q, d)``; r = x − y, shape ``(p, q, y, d)``."""
        panels, law, d = self._panels, self._law, self._panels.dim
        square = np.einsum("pqyi,pqyi->pqy", r, r)
        over = cut.weight / ((4 if d == 3 else 2) * np.pi * square ** (d / 2.0))
        logs = 1.0 if d == 3 else -0.5 * np.log(square / panels.rho**2)
        potential = np.sum(over * square * logs, axis=2)[:, :, None]
        density, turned = self._field.density[cut.panel], self._field.turned[cut.panel]
        along = over * np.einsum("pqyi,pi->pqy", r, density)
        value = potential * (law.single * (3.0 - 4.0 * law.nu) * density + turned)[:, None]
        value += law.single * np.einsum("pqy,pqyi->pqi", along, r)
        through = over * np.einsum("pqyi,pi->pqy", r, panels.normal[cut.panel])
        return np.asarray(value - np.einsum("pqy,pyi->pqi", through, cut.values))


def contains(panels: Panels, points: Array) -> Array:
    """Flags of points inside a closed surface, shape ``(k,)``, by the double layer of 1."""
    d = panels.dim
    found = np.zeros(len(points))
    ones = np.ones((len(panels.nodes), d, 1))
    low, high = panels.x.min(axis=0), panels.x.max(axis=0)
    near = np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))
    for cut in _cuts(panels, points[near], ones):
        r = points[near][cut.point][:, None] - cut.y
        scale = (4 if d == 3 else 2) * np.pi * np.linalg.norm(r, axis=2) ** d
        through = np.einsum("pyi,pi->py", r, panels.normal[cut.panel]) / scale
        np.subtract.at(found, near[cut.point], np.sum(through * cut.weight[:, 0], axis=1))
    return found > 0.5


@dataclass(frozen=True)
class _Field:
    """What is on the panels: t − 2μ𝓜û and 𝓜û, shape ``(ne, d)``, û at corners ``(ne, d, d)``."""

    density: Array
    turned: Array
    on_corners: Array


@dataclass(frozen=True)
class _Cut:
    """Parts of panels that are far enough from points, and points of a rule on them.

    Attributes:
        point: Shape ``(p,)``.
        panel: Shape ``(p,)``.
        y: Points of the rule, shape ``(p, y, d)``.
        weight: Weights, shape ``(p, 1, y)``.
        values: What is linear on the panels, shape ``(p, y, ...)``.
    """

    point: Array
    panel: Array
    y: Array
    weight: Array
    values: Array


def _cuts(panels: Panels, points: Array, values: Array) -> Iterator[_Cut]:
    """Panels, cut as the distances to points ask for; values at their corners go along."""
    hats, weights = _rule(panels.dim)
    for some in in_chunks(np.arange(len(points)), 4 * len(panels.nodes)):
        point, panel = np.repeat(some, len(panels.nodes)), np.tile(_all(panels), len(some))
        corners, carried, measure = panels.corners[panel], values[panel], panels.measure[panel]
        for level in range(HALVINGS + 1):
            apart = np.linalg.norm(points[point] - corners.mean(axis=1), axis=1)
            far = apart >= FAR * panels.size[panel] / 2.0**level
            far |= level == HALVINGS
            for part in in_chunks(np.flatnonzero(far), 4 * len(weights)):
                yield _Cut(
                    point[part],
                    panel[part],
                    hats @ corners[part],
                    (measure[part, None] * weights)[:, None],
                    hats @ carried[part],
                )
            point, panel, corners, carried, measure = (
                item[~far] for item in (point, panel, corners, carried, measure)
            )
            parts = _parts(panels.dim)
            corners, carried = (
                np.concatenate([part @ item for part in parts]) for item in (corners, carried)
            )
            point, panel, measure = (
                np.tile(item, len(parts)) for item in (point, panel, measure / len(parts))
            )


def _all(panels: Panels) -> Array:
    return np.arange(len(panels.nodes))


@cache
def _rule(d: int) -> tuple[Array, Array]:
    """Barycentric points, shape ``(y, d)``, and weights with the sum 1."""
    cell = basix.CellType.triangle if d == 3 else basix.CellType.interval
    points, weights = basix.make_quadrature(cell, DEGREE)
    hats = np.column_stack((1.0 - points.sum(axis=1), points))
    return hats, weights / weights.sum()


@cache
def _parts(d: int) -> list[Array]:
    """Corners of the parts of a panel in its barycentric coordinates."""
    half = 0.5 * (np.eye(d) + np.roll(np.eye(d), 1, axis=1))  # row i: the middle after corner i
    if d == 2:
        return [np.array([[1.0, 0.0], [0.5, 0.5]]), np.array([[0.5, 0.5], [0.0, 1.0]])]
    one = np.eye(3)
    inner = [np.stack((one[i], half[i], half[i - 1])) for i in range(3)]
    return [*inner, half]


def _distance(panels: Panels, points: Array) -> Array:
    """To the nearest node or middle of a panel, shape ``(k,)``."""
    known = np.concatenate((panels.x, panels.midpoints))
    return np.asarray(cKDTree(known).query(points)[0])
