"""Layer integrals on segments: closed forms where segments are near, Gauss' rule elsewhere.

With points as complex numbers and z = x − y all of them are integrals of log z, z̄/z and s/z. Far
from each other the closed forms are small differences of large numbers, and Gauss' rule is exact to
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.layers import Layers, in_chunks
from tfeti_dolfinx.boundary.panels import Panels

# Distance of two midpoints over the sum of the lengths from which on Gauss' rule of so many points
# is exact to rounding: the nearest singularity lies at δ of a half length, outside an ellipse with
# half axes that sum up to ρ = δ + √(δ² − 1), and the error is ρ^−2n: 6e-18 for δ = 6 and 8 points,
# 7e-16 for δ = 40 and 4.
FAR = ((20.0, 4), (3.0, 8))


def layers_2d(panels: Panels) -> Layers:
    """V_Δ, R and K_Δ of plane strain; ρ as ``Panels`` has it."""
    layers, lengths = Layers.empty(panels), panels.measure
    first, second = np.indices((len(lengths),) * 2).reshape(2, -1)
    apart = np.linalg.norm(panels.midpoints[first] - panels.midpoints[second], axis=1)
    ratio, below = apart / (lengths[first] + lengths[second]), np.inf
    for least, points in (*FAR, (-1.0, 0)):
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
    """The integrals by Gauss' rule in both variables."""
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
    """The integrals in closed form; F₁, F₂ are antiderivatives of log z."""
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
