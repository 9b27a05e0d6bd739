"""Coulomb's cone: tangential entries in an ellipse whose semi-axes grow with the normal entry."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.qp.faces import Face, Status

# halvings of an interval of length 1: down to rounding
HALVINGS = 60
# of the distance from the axis: what is so near to the boundary is on it
ON = 1e-12


class Cones:
    """‖τ/μ‖ ≤ n for points (n, τ) of one normal and one or two tangential entries each.

    For ``nearest``: it projects, and says in which directions a projection moves.

    >>> cone = Cones(np.array([[1.0]]))
    >>> cone.project(np.array([0.0, 2.0])).round(12).tolist()
    [1.0, 1.0]
    >>> cone.project(np.array([-2.0, 1.0])).tolist()
    [0.0, 0.0]

    Args:
        mu: Coefficients of friction, not all 0 at a point, shape ``(n, k)``, k = 1 or 2; along an
            axis with 0 the point has no entry.
    """

    def __init__(self, mu: Array) -> None:
        self.mu = np.asarray(mu, dtype=float)
        self._moves = self.mu > 0.0
        self._inverse = np.divide(1.0, self.mu, out=np.zeros_like(self.mu), where=self._moves)

    def project(self, x: Array) -> Array:
        """The nearest points of the cones.

        With m the multiplier of the constraint, τ = μ²t/(μ² + m) and n = n₀/(1 − m): m is below 1
        where n₀ > 0, above it where n₀ < 0. Where nothing but 0 is near, ‖μt‖ ≤ −n₀.
        """
        n, t = self._parts(x)
        inside = np.linalg.norm(t * self._inverse, axis=1) <= n
        nothing = np.linalg.norm(t * self.mu, axis=1) <= -n
        tau = self.mu**2 * t / (self.mu**2 + self._multiplier(n, t)[:, None] + TINY)
        normal = np.linalg.norm(tau * self._inverse, axis=1)
        normal = np.where(inside, n, np.where(nothing, 0.0, normal))
        tau = np.where(inside[:, None], t, np.where(nothing[:, None], 0.0, tau))
        return np.column_stack((normal, tau)).ravel()

    def face(self, x: Array, g: Array) -> Face:
        """Inside all directions; on the boundary the ray, and the tangent of the ellipse."""
        n, t = self._parts(x)
        closed = n > 0.0
        inside = closed & (np.linalg.norm(t * self._inverse, axis=1) < (1.0 - ON) * n)
        on = np.flatnonzero(closed & ~inside)
        own = np.column_stack((np.ones_like(self._moves[:, :1]), self._moves))
        free = np.flatnonzero((own & inside[:, None]).ravel())
        rows = own.shape[1] * on[:, None] + np.arange(own.shape[1])
        columns = [(free[:, None], np.ones((len(free), 1)))]
        ray = _unit(np.column_stack((n, t))[on])
        columns.append((rows, ray))
        if own.shape[1] == 3:
            curved = self._moves[on].all(axis=1)
            steep = (t * self._inverse**2)[on][curved]
            around = np.column_stack((0.0 * steep[:, 0], -steep[:, 1], steep[:, 0]))
            along = np.sum(around * ray[curved], axis=1, keepdims=True)  # 0 on a circle
            around = around - along * ray[curved]
            columns.append((rows[curved], _unit(around)))
        status = np.where(inside[:, None], Status.STICK, Status.SLIP)
        status = np.where(own & closed[:, None], status, Status.OPEN).ravel()
        Z = _columns(columns, x.size)
        return Face(Z, np.zeros(Z.shape[1]), status)

    def _parts(self, x: Array) -> tuple[Array, Array]:
        x = np.asarray(x).reshape(len(self.mu), -1)
        return x[:, 0], np.where(self._moves, x[:, 1:], 0.0)

    def _multiplier(self, n: Array, t: Array) -> Array:
        """m of ‖μt/(μ² + m)‖ = n/(1 − m) by halving, of r = 1/m where n < 0."""
        low: Array = np.zeros(len(n))
        high: Array = np.ones(len(n))
        below = n < 0.0
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            m = np.where(below, 1.0 / np.maximum(middle, TINY), middle)
            level = np.linalg.norm(self.mu * t / (self.mu**2 + m[:, None] + TINY), axis=1)
            far = level * np.abs(1.0 - m) > np.abs(n)  # falls in m below 1, in r where m is above
            low, high = np.where(far, middle, low), np.where(far, high, middle)
        middle = 0.5 * (low + high)
        return np.where(below, 1.0 / np.maximum(middle, TINY), middle)


def _unit(x: Array) -> Array:
    """Vectors of length 1; 0 stays."""
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), TINY))


def _columns(parts: list[tuple[Array, Array]], size: int) -> csr_array:
    """Columns from their rows and entries."""
    row, column, value, start = [], [], [], 0
    for rows, entries in parts:
        row.append(rows.ravel())
        column.append(start + np.repeat(np.arange(len(rows)), rows.shape[1]))
        value.append(entries.ravel())
        start += len(rows)
    places = (np.concatenate(row), np.concatenate(column))
    return csr_array((np.concatenate(value), places), shape=(size, start))
