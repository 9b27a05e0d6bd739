"""Layer integrals on triangles: Sauter and Schwab's quadrature where they meet."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.layers import Layers, in_chunks
from tfeti_dolfinx.boundary.panels import Panels
from tfeti_dolfinx.boundary.rules import PairRule, apart_rule, touching_rule

# Gauss points along each variable for pairs that share 1, 2 or 3 corners, up to a distortion of
# the worse of both (2 is half a square): tractions of constant stresses are right to 1e-4 up to 5.
TOUCHING = (
    (2.1, {1: 6, 2: 10, 3: 8}),
    (3.0, {1: 8, 2: 12, 3: 12}),
    (4.0, {1: 10, 2: 14, 3: 18}),
    (6.0, {1: 14, 2: 18, 3: 24}),
    (np.inf, {1: 20, 2: 24, 3: 40}),
)
# Distance of two midpoints over the longer of their longest edges, and the degree on each triangle
# from which on it is taken
APART = ((8.0, 2), (4.0, 4), (2.0, 6), (1.2, 10), (0.6, 16), (0.0, 30))


def layers_3d(panels: Panels) -> Layers:
    """V_Δ, R and K_Δ of three dimensions."""
    layers = Layers.empty(panels)
    first, second = np.triu_indices(len(panels.nodes))
    shared, order_i, order_j = _shared_corners(panels.nodes, first, second)
    pairs = (first, second, order_i, order_j)
    distortion = np.maximum(panels.distortion[first], panels.distortion[second])
    above = 0.0
    for most, counts in TOUCHING:
        fits = (distortion > above) & (distortion <= most)
        for count, n in counts.items():
            some = np.flatnonzero(fits & (shared == count))
            if len(some):
                _integrate(layers, pairs, some, touching_rule(count, n))
        above = most
    apart = np.linalg.norm(panels.midpoints[first] - panels.midpoints[second], axis=1)
    ratio = apart / np.maximum(panels.size[first], panels.size[second])
    below = np.inf
    for least, degree in APART:
        some = np.flatnonzero((shared == 0) & (ratio >= least) & (ratio < below))
        _integrate(layers, pairs, some, apart_rule(degree))
        below = least
    return layers


def _shared_corners(nodes: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Number of shared corners of pairs, and orders of the corners that put these first."""
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
