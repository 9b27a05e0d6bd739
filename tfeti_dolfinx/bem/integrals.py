"""Layer potentials: kernels and their integrals over panels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import basix
import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.bem.panels import Panels
from tfeti_dolfinx.common.arrays import Array

# --- Integrals of the layer operators ---------------------------------------------------------


@dataclass(frozen=True)
class QuadratureRules:
    """Rules of the layer integrals.

    Attributes:
        together: Points, or pairs of them, that are looked at together: what they need stays in
            the cache.
        polynomial: Gauss points that integrate polynomials of degree 5: what the products of two
            hats and the Jacobian are in each variable.
        segments: Distance of two midpoints over the sum of the lengths from which on Gauss' rule of
            so many points is exact to rounding: the nearest singularity lies at δ of a half
            length, outside an ellipse with half axes that sum up to ρ = δ + √(δ² − 1), and the
            error is ρ^−2n: 6e-18 for δ = 6 and 8 points, 7e-16 for δ = 40 and 4.
        touching: Gauss points along each variable for pairs of triangles that share 1, 2 or 3
            corners, up to a distortion of the worse of both (2 is half a square): tractions of
            constant stresses are right to 1e-4 up to 5.
        apart: Distance of two midpoints over the longer of their longest edges, and the degree on
            each triangle from which on it is taken.
    """

    together: int = 2**15
    polynomial: int = 3
    segments: tuple[tuple[float, int], ...] = ((20.0, 4), (3.0, 8))
    touching: tuple[tuple[float, tuple[int, int, int]], ...] = (
        (2.1, (6, 10, 8)),
        (3.0, (8, 12, 12)),
        (4.0, (10, 14, 18)),
        (6.0, (14, 18, 24)),
        (np.inf, (20, 24, 40)),
    )
    apart: tuple[tuple[float, int], ...] = (
        *((8.0, 2), (4.0, 4), (2.0, 6)),
        *((1.2, 10), (0.6, 16), (0.0, 30)),
    )


RULES = QuadratureRules()


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
    step = max(RULES.together // max(points, 1), 1)
    for start in range(0, len(items), step):
        yield items[start : start + step]


# --- Quadrature for pairs of triangles --------------------------------------------------------


@dataclass(frozen=True)
class PairRule:
    """Points on two triangles by their barycentric coordinates; weights for areas of 1.

    Corners that two triangles share are the first of both, in the same order.

    Attributes:
        x: Shape ``(q, 3)``.
        y: Shape ``(q, 3)``.
        weights: Shape ``(q,)``.
    """

    x: Array
    y: Array
    weights: Array


@cache
def touching_rule(shared: int, n: int) -> PairRule:
    """For triangles that share 1, 2 or 3 corners: Gauss points along each of four variables.

    Sauter, Schwab, Boundary Element Methods (2011), section 5.2. As many of the variables as there
    are shared corners are factors of r = x − y, the first one ξ always. The kernels are homogeneous
    in r, so that what is left of these factors is a polynomial; n points are for the others.
    """
    rules = [
        np.polynomial.legendre.leggauss(RULES.polynomial if k < shared else n) for k in range(4)
    ]
    grid = np.meshgrid(*[0.5 * (points + 1.0) for points, _ in rules], indexing="ij")
    xi, a, b, c = (g.ravel() for g in grid)
    tensor = np.einsum("i,j,k,l->ijkl", *[0.5 * weights for _, weights in rules]).ravel()
    maps = {1: _vertex, 2: _edge, 3: _identical}[shared](xi, a, b, c)
    first = [_barycentric(*x) for x, _, _ in maps]
    second = [_barycentric(*y) for _, y, _ in maps]
    scaled = [4.0 * tensor * jacobian for _, _, jacobian in maps]
    return PairRule(np.concatenate(first), np.concatenate(second), np.concatenate(scaled))


@cache
def apart_rule(degree: int) -> PairRule:
    """For triangles that do not touch: one rule, exact to this degree, on each of them."""
    points, weights = basix.make_quadrature(basix.CellType.triangle, degree)
    own = np.column_stack((1.0 - points.sum(axis=1), points))
    i, j = np.indices((len(weights),) * 2).reshape(2, -1)
    return PairRule(own[i], own[j], 4.0 * weights[i] * weights[j])


def _barycentric(s: Array, t: Array) -> Array:
    """Return the barycentric coordinates of the points (s, t), 0 ≤ t ≤ s ≤ 1."""
    return np.stack((1.0 - s, s - t, t), axis=1)


Map = tuple[tuple[Array, Array], tuple[Array, Array], Array]


def _identical(xi: Array, a: Array, b: Array, c: Array) -> list[Map]:
    jacobian = xi**3 * a**2 * b
    pairs = [
        ((xi, xi * (1 - a + a * b)), (xi * (1 - a * b * c), xi * (1 - a))),
        ((xi, xi * a * (1 - b + b * c)), (xi * (1 - a * b), xi * a * (1 - b))),
        ((xi * (1 - a * b * c), xi * a * (1 - b * c)), (xi, xi * a * (1 - b))),
    ]
    return [(x, y, jacobian) for x, y in pairs] + [(y, x, jacobian) for x, y in pairs]


def _edge(xi: Array, a: Array, b: Array, c: Array) -> list[Map]:
    j, abc = xi**3 * a**2, a * b * c
    return [
        ((xi, xi * a * c), (xi * (1 - a * b), xi * a * (1 - b)), j),
        ((xi, xi * a), (xi * (1 - abc), xi * a * b * (1 - c)), j * b),
        ((xi * (1 - a * b), xi * a * (1 - b)), (xi, xi * abc), j * b),
        ((xi * (1 - abc), xi * a * b * (1 - c)), (xi, xi * a), j * b),
        ((xi * (1 - abc), xi * a * (1 - b * c)), (xi, xi * a * b), j * b),
    ]


def _vertex(xi: Array, a: Array, b: Array, c: Array) -> list[Map]:
    j = xi**3 * b
    return [((xi, xi * a), (xi * b, xi * b * c), j), ((xi * b, xi * b * c), (xi, xi * a), j)]


# --- Layer integrals on segments --------------------------------------------------------------
# With points as complex numbers and z = x − y all of them are integrals of log z, z̄/z and s/z.
# Far from each other the closed forms are small differences of large numbers, and Gauss' rule is
# exact to rounding.


def layers_2d(panels: Panels) -> Layers:
    """V_Δ, R and K_Δ of plane strain; ρ as ``Panels`` has it."""
    layers, lengths = Layers.empty(panels), panels.measure
    first, second = np.indices((len(lengths),) * 2).reshape(2, -1)
    apart = np.linalg.norm(panels.midpoints[first] - panels.midpoints[second], axis=1)
    ratio, below = apart / (lengths[first] + lengths[second]), np.inf
    for least, points in (*RULES.segments, (-1.0, 0)):
        for some in in_chunks(np.flatnonzero((ratio >= least) & (ratio < below)), points**2):
            i, j = first[some], second[some]
            _put(layers, i, j, _by_rule(panels, i, j, points) if points else _exact(panels, i, j))
        below = least
    layers.single[:] += np.log(panels.rho) / (2 * np.pi) * np.outer(lengths, lengths)
    return layers


def _put(layers: Layers, i: Array, j: Array, values: tuple[Array, ...]) -> None:
    """∫∫log r, ∫∫z/z̄ and the double layer on the two hats into the layers."""
    logs, turned, start, end = values
    lengths = layers.panels.measure[i] * layers.panels.measure[j]
    layers.single[i, j] = -logs / (2 * np.pi)
    layers.tensor[0, 0][i, j] = (lengths + turned.real) / (4 * np.pi)
    layers.tensor[1, 1][i, j] = (lengths - turned.real) / (4 * np.pi)
    layers.tensor[0, 1][i, j] = layers.tensor[1, 0][i, j] = turned.imag / (4 * np.pi)
    layers.on_corners[0][i, j], layers.on_corners[1][i, j] = start / (2 * np.pi), end / (2 * np.pi)


def _by_rule(panels: Panels, i: Array, j: Array, points: int) -> tuple[Array, ...]:
    """Return the integrals by Gauss' rule in both variables."""
    rule: Array = np.array(np.polynomial.legendre.leggauss(points))
    s, weights = 0.5 * (rule[0] + 1.0), 0.5 * rule[1]
    z, tau = panels.corners @ np.array([1.0, 1j]), panels.directed @ np.array([1j, -1.0])
    at = z[:, :1] + s * tau[:, None]
    r = at[i][:, :, None] - at[j][:, None, :]
    scale = np.abs(tau[i]) * np.abs(tau[j])

    def over_both(values: Array) -> Array:
        return np.asarray(scale * ((values @ weights) @ weights))

    # Re(n_y / z) = r·n_y / r²
    normal = (-1j * tau / np.abs(tau))[j]
    kernel = np.real(normal[:, None, None] / r)
    end = over_both(kernel * s)
    return over_both(np.log(np.abs(r))), over_both(r / np.conj(r)), over_both(kernel) - end, end


@dataclass(frozen=True)
class _Corners:
    """z = x − y at the ends of two segments, and the logarithm on the parallelogram between."""

    z: Array
    turn: Array

    @classmethod
    def of(cls, ends: Array, other: Array) -> _Corners:
        z = ends[:, :, None] - other[:, None, :]
        middle = z.mean(axis=(1, 2))
        middle = np.where(middle == 0.0, 1.0, middle)  # a segment and itself, not needed
        return cls(z, (middle / np.abs(middle))[:, None, None])

    def log(self) -> Array:
        """Continuous: the cut is turned away from the parallelogram; 0 for z = 0, see F."""
        z = np.where(self.z == 0.0, self.turn, self.z)
        return np.asarray(np.log(z * np.conj(self.turn)) + 1j * np.angle(self.turn))


def _exact(panels: Panels, i: Array, j: Array) -> tuple[Array, ...]:
    """Return the integrals in closed form; F₁, F₂ are antiderivatives of log z."""
    lengths = panels.measure
    z = panels.corners @ np.array([1.0, 1j])
    tau = (panels.directed @ np.array([1j, -1.0])) / lengths
    t, tj, own, other = tau[i], tau[j], lengths[i], lengths[j]
    corners = _Corners.of(z[i], z[j])
    w, log = corners.z, corners.log()
    F1, F2 = w * log - w, 0.5 * w * w * log - 0.75 * w * w
    logs = -_second_difference(F2) / (t * tj)

    over_y = -_difference(np.conj(w) * F1) / tj[:, None]
    over_y = over_y + (np.conj(tj) / tj**2)[:, None] * _difference(F2)
    turned = np.conj((over_y[:, 1] - over_y[:, 0]) / t - np.conj(t) / t * logs)

    normal = -1j * tj
    whole = -_second_difference(F1) / (t * tj)
    end = (logs - other * (F1[:, 1, 1] - F1[:, 0, 1]) / t) / tj
    end = np.real(normal * end) / other
    start = np.real(normal * whole) - end
    same = i == j
    logs = np.where(same, own**2 * (np.log(own) - 1.5), logs.real)
    turned = np.where(same, own**2 * t**2, turned)
    return logs, turned, np.where(same, 0.0, start), np.where(same, 0.0, end)


def _second_difference(F: Array) -> Array:
    return np.asarray(F[:, 0, 0] + F[:, 1, 1] - F[:, 0, 1] - F[:, 1, 0])


def _difference(F: Array) -> Array:
    """Along y, at both ends in x, shape ``(k, 2)``."""
    return np.asarray(F[:, :, 1] - F[:, :, 0])


# --- Layer integrals on triangles -------------------------------------------------------------


def layers_3d(panels: Panels) -> Layers:
    """V_Δ, R and K_Δ of three dimensions."""
    layers = Layers.empty(panels)
    first, second = np.triu_indices(len(panels.nodes))
    shared, order_i, order_j = _shared_corners(panels.nodes, first, second)
    pairs = (first, second, order_i, order_j)
    distortion = np.maximum(panels.distortion[first], panels.distortion[second])
    above = 0.0
    for most, counts in RULES.touching:
        fits = (distortion > above) & (distortion <= most)
        for count, n in enumerate(counts, start=1):
            some = np.flatnonzero(fits & (shared == count))
            if len(some):
                _integrate(layers, pairs, some, touching_rule(count, n))
        above = most
    apart = np.linalg.norm(panels.midpoints[first] - panels.midpoints[second], axis=1)
    ratio = apart / np.maximum(panels.size[first], panels.size[second])
    below = np.inf
    for least, degree in RULES.apart:
        some = np.flatnonzero((shared == 0) & (ratio >= least) & (ratio < below))
        _integrate(layers, pairs, some, apart_rule(degree))
        below = least
    return layers


def _shared_corners(nodes: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Return number of shared corners of pairs, and orders of the corners that put these first."""
    same = nodes[first][:, :, None] == nodes[second][:, None, :]
    own = same.any(axis=2)
    shared = own.sum(axis=1)
    order_i = np.argsort(~own, axis=1, kind="stable")
    # the partner of each corner of the first triangle; what has none comes last
    partner = np.where(own, same.argmax(axis=2), 3)
    partner = np.take_along_axis(partner, order_i, axis=1)
    wanted = np.full((len(first), 3), 3)
    rank = np.broadcast_to(np.arange(3), wanted.shape)
    row, place = np.nonzero(partner < 3)
    wanted[row, partner[row, place]] = rank[row, place]
    return shared, order_i, np.argsort(wanted, axis=1, kind="stable")


def _integrate(layers: Layers, pairs: tuple[Array, ...], chosen: Array, rule: PairRule) -> None:
    """The integrals of some pairs, and of the same ones with x and y exchanged."""
    panels = layers.panels
    normal, area, corners = panels.normal, panels.measure, panels.corners
    for some in in_chunks(chosen, len(rule.weights)):
        i, j, order_i, order_j = (item[some] for item in pairs)
        first = np.take_along_axis(corners[i], order_i[:, :, None], axis=1)
        second = np.take_along_axis(corners[j], order_j[:, :, None], axis=1)
        r = [rule.x @ first[:, :, c].T - rule.y @ second[:, :, c].T for c in range(3)]
        inverse = 1.0 / np.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
        scale, w = area[i] * area[j] / (4 * np.pi), rule.weights
        _both(layers.single, i, j, scale * (w @ inverse))
        cube = inverse**3
        for a in range(3):
            for b in range(a, 3):
                value = scale * (w @ (cube * r[a] * r[b]))
                _both(layers.tensor[a, b], i, j, value)
                _both(layers.tensor[b, a], i, j, value)
        for row, column, order, hats, sign in (
            (i, j, order_j, rule.y, 1.0),
            (j, i, order_i, rule.x, -1.0),
        ):
            along = sum(r[c] * normal[column, c] for c in range(3)) * cube
            values = sign * scale * ((hats * w[:, None]).T @ along)
            for place, value in zip(order.T, values, strict=True):
                layers.on_corners[place, row, column] = np.where(row == column, 0.0, value)


def _both(matrix: Array, i: Array, j: Array, values: Array) -> None:
    matrix[i, j] = values
    matrix[j, i] = values
