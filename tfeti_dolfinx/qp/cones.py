"""Coulomb's cone: tangential entries in an ellipse whose semi-axes grow with the normal entry."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.qp.discs import reduced_by
from tfeti_dolfinx.qp.faces import Face, Status

# halvings of an interval of length 1: down to rounding
HALVINGS = 60
# of the distance from the axis: what is so near to the boundary is on it
ON = 1e-12


class Cones:
    """‖τ/μ‖ ≤ n for points (n, τ) − apex of one normal and one or two tangential entries each.

    >>> cone = Cones(np.array([[1.0]]))
    >>> cone.project(np.array([0.0, 2.0])).round(12).tolist()
    [1.0, 1.0]
    >>> cone.project(np.array([-2.0, 1.0])).tolist()
    [0.0, 0.0]

    Args:
        mu: Coefficients of friction, not all 0 at a point, shape ``(n, k)``, k = 1 or 2; along an
            axis with 0 the point has no entry but the apex's.
        apex: The apices, shape ``(n, k + 1)``, or 0.
    """

    def __init__(self, mu: Array, apex: Array | float = 0.0) -> None:
        self.mu = np.asarray(mu, dtype=float)
        self.apex = np.broadcast_to(apex, (len(self.mu), self.mu.shape[1] + 1))
        self._moves = self.mu > 0.0
        self._own = np.column_stack((np.ones(len(self.mu), dtype=bool), self._moves))
        self._inverse = np.divide(1.0, self.mu, out=np.zeros_like(self.mu), where=self._moves)

    def project(self, x: Array) -> Array:
        """The nearest points of the cones."""
        values, nearest = self._points(x), self._nearest(self._from_apex(x))
        stays = values - self.apex == nearest  # what stays where it was is not rounded
        return np.where(stays, values, self.apex + nearest).ravel()

    def split(self, x: Array, g: Array) -> tuple[Array, Array]:
        """φ = g inside; on the boundary and at the apex β, what of g a way in the cone goes down.

        On the boundary it is g − min(νᵀg, 0)ν, ν the outward normal; at the apex −P(−g).
        """
        point, g = self._from_apex(x), np.where(self._own, self._points(g), 0.0)
        closed, inside = self._places(point)
        normal = self._normals(point)
        pushing = np.minimum(np.sum(normal * g, axis=1, keepdims=True), 0.0)
        beta = np.where(closed[:, None], g - pushing * normal, -self._nearest(-g))
        within = inside[:, None]
        return np.where(within, g, 0.0).ravel(), np.where(within, 0.0, beta).ravel()

    def reduced(self, x: Array, phi: Array, alpha: float) -> Array:
        """φ̃ = (x − P(x − αφ))/α, φ itself where the step stays inside."""
        return reduced_by(self.project, x, phi, alpha)

    def max_step(self, x: Array, p: Array) -> float:
        """Largest α with x − αp inside: the smallest root of a quadratic equation for each."""
        p = self._points(p)
        if np.any(p[~self._own]):
            return 0.0
        moves = np.any(p != 0.0, axis=1)
        point, p = self._from_apex(x)[moves], p[moves]
        inverse = self._inverse[moves]
        n, t, down, along = point[:, 0], point[:, 1:] * inverse, p[:, 0], p[:, 1:] * inverse
        a = np.sum(along**2, axis=1) - down**2  # aα² − 2bα = room
        b = np.sum(along * t, axis=1) - down * n
        room = np.maximum(n**2 - np.sum(t**2, axis=1), 0.0)
        root = np.sqrt(np.maximum(b * b + a * room, 0.0))
        rises, endless = (a > 0.0) & (b > 0.0), (a <= 0.0) & ((b >= 0.0) | (b * b + a * room < 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            # of the two forms of the root the one that cancels nothing
            steps = np.where(rises, (b + root) / a, room / np.maximum(root - b, TINY))
            to_apex = np.where(down > 0.0, n / down, np.inf)
        return float(np.min(np.minimum(np.where(endless, np.inf, steps), to_apex), initial=np.inf))

    def shifted(self, shift: Array) -> Cones:
        """Cones with the apices moved by −shift."""
        return Cones(self.mu, self.apex - self._points(shift))

    def face(self, x: Array, g: Array) -> Face:
        """Inside all directions; on the boundary the ray, and the tangent of the ellipse."""
        point = self._from_apex(x)
        closed, inside = self._places(point)
        on = np.flatnonzero(closed & ~inside)
        free = np.flatnonzero((self._own & inside[:, None]).ravel())
        rows = self._own.shape[1] * on[:, None] + np.arange(self._own.shape[1])
        ray = _unit(point[on])
        columns, kappa = [(free[:, None], np.ones((len(free), 1))), (rows, ray)], []
        if self.mu.shape[1] == 2:
            kept = self._moves[on].all(axis=1)
            curved = on[kept]
            around, bent = _tangents(point[curved], self.mu[curved], ray[kept])
            pushing = -np.sum(self._points(g)[curved] * self._normals(point)[curved], axis=1)
            columns.append((rows[kept], around))
            kappa.append(np.maximum(pushing, 0.0) * bent)
        status = np.where(inside[:, None], Status.STICK, Status.SLIP)
        status = np.where(self._own & closed[:, None], status, Status.OPEN).ravel()
        Z = _columns(columns, status.size)
        flat = np.zeros(len(free) + len(on))
        return Face(Z, np.concatenate([flat, *kappa]), status)

    def onto(self, x: Array, status: Array) -> Array:
        """The nearest points of the cones; of their boundary, from inside too, for slip."""
        values, status = self._points(self.project(x)).copy(), self._points(status)[:, 0]
        point = self._from_apex(x)
        within = self._places(point)[1] & np.any(point[:, 1:] != 0.0, axis=1)
        inward = within & (status == Status.SLIP)
        values[inward] = self.apex[inward] + self._outwards(point[inward], inward)
        is_open = status == Status.OPEN
        values[is_open] = self.apex[is_open]
        return np.asarray(values.ravel())

    def _points(self, x: Array) -> Array:
        return np.asarray(x).reshape(self.apex.shape)

    def _from_apex(self, x: Array) -> Array:
        return np.where(self._own, self._points(x) - self.apex, 0.0)

    def _places(self, point: Array) -> tuple[Array, Array]:
        """Flags of points off the apex, and of those inside."""
        level = np.linalg.norm(point[:, 1:] * self._inverse, axis=1)
        closed = point[:, 0] > 0.0
        return closed, closed & (level < (1.0 - ON) * point[:, 0])

    def _normals(self, point: Array) -> Array:
        """Outward normals (−1, t/μ²‖t/μ‖) of the boundary, of unit length."""
        level = np.linalg.norm(point[:, 1:] * self._inverse, axis=1, keepdims=True)
        steep = point[:, 1:] * self._inverse**2 / np.maximum(level, TINY)
        return _unit(np.column_stack((-np.ones(len(point)), steep)))

    def _nearest(self, point: Array) -> Array:
        """The nearest points, from the apex.

        With m the multiplier of the constraint, τ = μ²t/(μ² + m) and n = n₀/(1 − m): m is below 1
        where n₀ > 0, above it where n₀ < 0. Where nothing but 0 is near, ‖μt‖ ≤ −n₀.
        """
        n, t = point[:, 0], point[:, 1:]
        inside = np.linalg.norm(t * self._inverse, axis=1) <= n
        nothing = np.linalg.norm(t * self.mu, axis=1) <= -n
        tau = self.mu**2 * t / (self.mu**2 + self._multiplier(n, t)[:, None] + TINY)
        normal = np.linalg.norm(tau * self._inverse, axis=1)
        normal = np.where(inside, n, np.where(nothing, 0.0, normal))
        tau = np.where(inside[:, None], t, np.where(nothing[:, None], 0.0, tau))
        return np.column_stack((normal, tau))

    def _outwards(self, point: Array, which: Array) -> Array:
        """The nearest points of the boundary to points inside: the same with m below 0."""
        mu, (n, t) = self.mu[which], (point[:, 0], point[:, 1:])
        low = -(np.min(np.where(mu > 0.0, mu, np.inf), axis=1) ** 2)
        high: Array = np.zeros(len(n))
        for _ in range(HALVINGS):
            m = 0.5 * (low + high)
            level = np.linalg.norm(mu * t / (mu**2 + m[:, None] + TINY), axis=1)
            far = level * (1.0 - m) > n  # falls in m
            low, high = np.where(far, m, low), np.where(far, high, m)
        m = 0.5 * (low + high)
        tau, normal = mu**2 * t / (mu**2 + m[:, None] + TINY), n / (1.0 - m)
        level = np.linalg.norm(tau * self._inverse[which], axis=1)
        return np.column_stack((normal, tau * (normal / np.maximum(level, TINY))[:, None]))

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


def _tangents(point: Array, mu: Array, ray: Array) -> tuple[Array, Array]:
    """Tangents of the boundary orthogonal to rays, of unit length; how a unit push bends them."""
    inverse = mu**-2.0
    steep = point[:, 1:] * inverse
    slope = np.linalg.norm(steep, axis=1, keepdims=True)
    radial = steep / np.maximum(slope, TINY)
    around = np.column_stack((np.zeros(len(point)), -radial[:, 1], radial[:, 0]))
    along = np.sum(around * ray, axis=1, keepdims=True)  # 0 on a circle
    level = np.linalg.norm(point[:, 1:] / mu, axis=1)
    tilted = slope[:, 0] / np.maximum(np.hypot(slope[:, 0], level), TINY)  # of ν, in its plane
    bent = tilted * np.sum(inverse * radial[:, ::-1] ** 2, axis=1) / np.maximum(slope[:, 0], TINY)
    return _unit(around - along * ray), bent / np.maximum(1.0 - along[:, 0] ** 2, TINY)


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
