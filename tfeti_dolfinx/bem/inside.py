"""Displacement and stress inside of boundary elements."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache

import basix
import numpy as np
from dolfinx import fem

from tfeti_dolfinx.bem.integrals import in_chunks
from tfeti_dolfinx.bem.panels import Panels
from tfeti_dolfinx.bem.steklov import Steklov, gunter, rigid_motions
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.forms.fields import value_row

# --- Somigliana's identity: displacement and stress inside ------------------------------------


@dataclass(frozen=True)
class EvaluationParameters:
    """Parameters of the solution inside and on the surface.

    Attributes:
        far, halvings: A panel is cut in parts until their middles are as far as ``far`` of their
            sizes, at most so many times; nearer to the surface digits are lost.
        degrees: From so many sizes on a rule of this degree is exact to 1e-9.
        on: Of the size of the body: so far from its box a point may be and on its surface.
        sure: Share of directions hidden by a body that is neither 0 nor 1 to this: points on its
            surface.
        beside: Their stress is taken so far on the way to the middles of their cells.
    """

    far: float = 2.0
    halvings: int = 12
    degrees: tuple[tuple[float, int], ...] = ((32, 4), (12, 5), (6, 6), (3, 10), (0, 14))
    on: float = 1e-10
    sure: float = 1e-3
    beside: float = 0.1


PARAMETERS = EvaluationParameters()


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
        # a rigid motion is taken out: it has no tractions, but quadrature makes some of it
        R = rigid_motions(panels.x)
        self._moved, self._turn = _rigid(panels.x, (R @ (R.T @ u.ravel())).reshape(u.shape))
        rest = u - self._known(panels.x)
        t = (steklov.tractions @ rest.ravel()).reshape(-1, panels.dim)
        turned = (gunter(panels) @ rest.T.ravel()).reshape(panels.dim, -1).T
        self._field = _Field(t - 2.0 * law.mu * turned, turned, rest[panels.nodes])

    def displacement(self, points: Array) -> Array:
        """Return an array of shape ``(k, d)``, at points inside, shape ``(k, d)``."""
        points = points - self._shift
        u = self._known(points)
        for cut in _cuts(self._panels, points, self._field.on_corners):
            np.add.at(u, cut.point, self._layers(_Seen(cut, points, self._panels), cut))
        return u

    def share(self, points: Array) -> Array:
        """Return the shares of the points as ``share`` does, shape ``(k,)``."""
        return share(self._panels, points - self._shift)

    def stress(self, points: Array) -> Array:
        """Return σ, shape ``(k, d, d)``, without σ_zz, at points inside, shape ``(k, d)``."""
        return self._law.stress(self.gradient(points))

    def gradient(self, points: Array) -> Array:
        """∂_j u_i, shape ``(k, d, d)``, at points inside, shape ``(k, d)``."""
        points, each = points - self._shift, np.arange(self._panels.dim)
        gradient = np.tile(self._turn, (len(points), 1, 1))
        gradient[:, each, each] -= self._b * (points - self._middle) / self._stiff
        for cut in _cuts(self._panels, points, self._field.on_corners):
            np.add.at(gradient, cut.point, self._slopes(_Seen(cut, points, self._panels), cut))
        return gradient

    @property
    def _stiff(self) -> float:
        return self._law.lmbda + 2.0 * self._law.mu

    def _known(self, x: Array) -> Array:
        """Return the rigid motion and u_p."""
        y = x - self._middle
        return np.asarray(self._moved + y @ self._turn.T - self._b * y**2 / (2.0 * self._stiff))

    def _densities(self, cut: _Cut) -> tuple[Array, Array]:
        """Factors of δ_ij/(4πr) and of r_i r_j/(4πr³), in 2D of −log(r/ρ)/2π and r_i r_j/(2πr²)."""
        density, k = self._field.density[cut.panel], self._law.single
        both = k * (3.0 - 4.0 * self._law.nu) * density + self._field.turned[cut.panel]
        return both, k * density

    def _layers(self, seen: _Seen, cut: _Cut) -> Array:
        """Return the contributions of some panels to u, shape ``(p, d)``."""
        panels, (single, tensor) = self._panels, self._densities(cut)
        logs = 1.0 if panels.dim == 3 else -0.5 * np.log(seen.square / panels.rho**2)
        potential = np.sum(seen.over * seen.square * logs, axis=1)
        value = potential[:, None] * single
        value += np.einsum("py,pyi->pi", seen.over * seen.along(tensor), seen.r)
        double = seen.over * seen.through[:, None]
        return np.asarray(value - np.einsum("py,pyi->pi", double, cut.values))

    def _slopes(self, seen: _Seen, cut: _Cut) -> Array:
        """Return the contributions of some panels to ∂_j u_i, shape ``(p, d, d)``."""
        d, (single, tensor) = self._panels.dim, self._densities(cut)
        r, over, along = seen.r, seen.over, seen.along(tensor)
        falling = d * over / seen.square
        mean = np.einsum("py,pyi->pi", over, r)
        values = np.einsum("py,pyi->pi", over, cut.values)
        gradient = mean[:, :, None] * tensor[:, None] - single[:, :, None] * mean[:, None]
        gradient += np.sum(over * along, axis=1)[:, None, None] * np.eye(d)
        gradient -= values[:, :, None] * self._panels.normal[cut.panel][:, None]
        # of 1/r^d: −d r_j/r^(d+2), of both kernels that have it
        rest = seen.through[:, None, None] * cut.values - along[:, :, None] * r
        gradient += np.swapaxes(rest, 1, 2) @ (falling[:, :, None] * r)
        return np.asarray(gradient)


def _rigid(x: Array, u: Array) -> tuple[Array, Array]:
    """Mean and gradient of a rigid motion of points."""
    moved, y = u.mean(axis=0), x - x.mean(axis=0)
    turn = np.linalg.lstsq(y, u - moved, rcond=None)[0].T
    return moved, 0.5 * (turn - turn.T)


def share(panels: Panels, points: Array) -> Array:
    """Share of all directions that a closed surface hides, by the double layer of 1.

    1 inside, 0 outside, between them on the surface: there it is the angle of the body.

    Args:
        panels: The surface.
        points: Shape ``(k, d)``.

    Returns:
        Shape ``(k,)``.
    """
    found = np.zeros(len(points))
    ones = np.ones((len(panels.nodes), panels.dim, 1))
    margin = PARAMETERS.on * panels.diameter
    low, high = panels.x.min(axis=0) - margin, panels.x.max(axis=0) + margin
    near = np.flatnonzero(np.all((points >= low) & (points <= high), axis=1))
    for cut in _cuts(panels, points[near], ones):
        seen = _Seen(cut, points[near], panels)
        np.subtract.at(found, near[cut.point], seen.over.sum(axis=1) * seen.through)
    return found


@dataclass(frozen=True)
class _Field:
    """Densities on panels: t − 2μ𝓜û and 𝓜û, shape ``(ne, d)``, û at corners ``(ne, d, d)``."""

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
        weight: Weights, shape ``(p, y)``.
        values: What is linear on the panels, shape ``(p, y, ...)``.
    """

    point: Array
    panel: Array
    y: Array
    weight: Array
    values: Array


class _Seen:
    """r = x − y from points to parts of panels, and factors of the kernels.

    Attributes:
        r: Shape ``(p, y, d)``.
        square: r², shape ``(p, y)``.
        over: Weights over 4πr³, in 2D 2πr², shape ``(p, y)``.
        through: r·n, the same at all points of a panel, shape ``(p,)``.
    """

    def __init__(self, cut: _Cut, points: Array, panels: Panels) -> None:
        d = panels.dim
        self.r = points[cut.point][:, None] - cut.y
        self.square = np.einsum("pyi,pyi->py", self.r, self.r)
        self.over = cut.weight / ((4 if d == 3 else 2) * np.pi * self.square ** (d / 2.0))
        self.through = np.einsum("pi,pi->p", self.r[:, 0], panels.normal[cut.panel])

    def along(self, density: Array) -> Array:
        """r·q, shape ``(p, y)``, for q of shape ``(p, d)``."""
        return np.einsum("pyi,pi->py", self.r, density)


def _cuts(panels: Panels, points: Array, values: Array) -> Iterator[_Cut]:
    """Cut panels as finely as the distances to points require, with their corner values."""
    for some in in_chunks(np.arange(len(points)), 4 * len(panels.nodes)):
        count = len(panels.nodes)
        point, panel = np.repeat(some, count), np.tile(np.arange(count), len(some))
        corners, carried, measure = panels.corners[panel], values[panel], panels.measure[panel]
        for level in range(PARAMETERS.halvings + 1):
            apart = np.linalg.norm(points[point] - corners.mean(axis=1), axis=1)
            apart /= panels.size[panel] / 2.0**level
            far, below = (apart >= PARAMETERS.far) | (level == PARAMETERS.halvings), np.inf
            for least, degree in PARAMETERS.degrees:
                hats, weights = _rule(panels.dim, degree)
                chosen = np.flatnonzero(far & (apart >= least) & (apart < below))
                below = least
                for part in in_chunks(chosen, len(weights)):
                    yield _Cut(
                        point[part],
                        panel[part],
                        hats @ corners[part],
                        measure[part, None] * weights,
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


@cache
def _rule(d: int, degree: int) -> tuple[Array, Array]:
    """Barycentric points, shape ``(y, d)``, and weights with the sum 1."""
    cell = basix.CellType.triangle if d == 3 else basix.CellType.interval
    points, weights = basix.make_quadrature(cell, degree)
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


# --- Solution of bodies with boundary elements ------------------------------------------------


@dataclass(frozen=True)
class SolvedBody:
    """A subdomain with boundary elements.

    Attributes:
        subdomain: Its number.
        inside: What is inside.
        nodes: Primal nodes that are not on its surface, shape ``(k,)``.
    """

    subdomain: int
    inside: Inside
    nodes: Array


@dataclass(frozen=True)
class BoundarySolution:
    """Solution on the surfaces of the subdomains with boundary elements.

    Attributes:
        bodies: Gives the subdomains of this rank that have them, one at a time.
        finite: Cells of this rank that have finite elements.
        cell_subdomain: Subdomain of each cell of this rank.
    """

    bodies: Callable[[], Iterable[SolvedBody]]
    finite: Array
    cell_subdomain: Array

    def values_at(
        self, points: Array, found: tuple[Array, Array], thickness: float, u: fem.Function
    ) -> Array:
        """Return rows of the bodies of this rank, added for each point (``value_row``)."""
        (k, d), mesh = points.shape, u.function_space.mesh
        total = np.zeros((k, 1 + d + d * d))
        (place, cells), owner = found, self.cell_subdomain
        for body in self.bodies():
            share = body.inside.share(points)
            own = np.flatnonzero(share > 1.0 - PARAMETERS.sure)
            sigma = body.inside.stress(points[own]) / thickness
            total[own] += value_row(body.inside.displacement(points[own]), sigma)
            on = (share > PARAMETERS.sure) & (share <= 1.0 - PARAMETERS.sure)
            there = on[place] & (owner[cells] == body.subdomain)
            if np.any(there):  # the mean of the cells that meet there, whatever their order
                own, cell = place[there], cells[there]
                at = points[own]
                middle = mesh.geometry.x[geometry_dofmap(mesh)[cell]].mean(axis=1)[:, :d]
                sigma = body.inside.stress(at + PARAMETERS.beside * (middle - at)) / thickness
                x = np.pad(at, ((0, 0), (0, 3 - d)))
                np.add.at(total, own, value_row(u.eval(x, cell).reshape(-1, d), sigma))
        return total
