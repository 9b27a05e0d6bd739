"""Quadrature for pairs of triangles: Sauter and Schwab's rules where they meet, and tensor ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import basix
import numpy as np

from tfeti_dolfinx.arrays import Array

# Gauss points that integrate polynomials of degree 5: what the products of two hats and the
# Jacobian are in each variable
POLYNOMIAL = 3


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
    rules = [np.polynomial.legendre.leggauss(POLYNOMIAL if k < shared else n) for k in range(4)]
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
    """Of the points (s, t), 0 ≤ t ≤ s ≤ 1."""
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
    return [
        ((xi, xi * a), (xi * b, xi * b * c), j),
        ((xi * b, xi * b * c), (xi, xi * a), j),
    ]
