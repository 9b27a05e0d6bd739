"""Closed forms of contact pressures, and the errors of pressures as functions.

It needs numpy and scipy only, so that other programs' pressures are judged by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator

Array = Any
INSIDE, MIDDLE, OUTSIDE = 0.9, 0.2, 1.5  # of the half width a
FINE = 300  # samples along a

# --- Closed forms -------------------------------------------------------------------------------


@dataclass(frozen=True)
class LineContact:
    """Parallel cylinders (Hertz): a = √(4P'R/(πE*)), p₀ = 2P'/(πa)."""

    half_width: float  # a
    load: float  # P', a force per length
    peak: float  # p₀

    @classmethod
    def from_half_width(cls, a: float, radius: float, modulus: float) -> LineContact:
        """The contact of half width a; ``modulus`` is E*."""
        load = np.pi * modulus * a**2 / (4 * radius)
        return cls(a, load, 2 * load / (np.pi * a))

    @classmethod
    def from_load(cls, load: float, radius: float, modulus: float) -> LineContact:
        """The contact under a force per length; ``modulus`` is E*."""
        return cls.from_half_width(np.sqrt(4 * load * radius / (np.pi * modulus)), radius, modulus)

    def pressure(self, x: Array) -> Array:
        """p₀√(1 − x²/a²), 0 outside."""
        return self.peak * np.sqrt(np.maximum(1 - (x / self.half_width) ** 2, 0.0))


class PointContact(LineContact):
    """Spheres: a³ = 3FR/(4E*), p₀ = 3F/(2πa²); ``load`` is the force F."""

    @classmethod
    def from_half_width(cls, a: float, radius: float, modulus: float) -> PointContact:
        """The contact of radius a; ``modulus`` is E*."""
        load = 4 * modulus * a**3 / (3 * radius)
        return cls(a, load, 3 * load / (2 * np.pi * a**2))

    @classmethod
    def from_load(cls, load: float, radius: float, modulus: float) -> PointContact:
        """The contact under a force; ``modulus`` is E*."""
        return cls.from_half_width((3 * load * radius / (4 * modulus)) ** (1 / 3), radius, modulus)


@dataclass(frozen=True)
class RoundedPunch:
    """A flat of the half width s whose edges are rounded with the radius R, on a half plane.

    Ciavarella, Hills, Monno, Proc. Inst. Mech. Eng. C 212 (1998).
    """

    flat: float  # s
    half_width: float  # half width b > s of the contact
    radius: float  # R
    modulus: float  # E*

    @property
    def _angle(self) -> float:
        return float(np.arcsin(self.flat / self.half_width))

    @property
    def load(self) -> float:
        """The force per length."""
        f = self._angle
        share = (np.pi - 2 * f) / (2 * np.sin(f) ** 2) - 1 / np.tan(f)
        return float(self.modulus * self.flat**2 / (2 * self.radius) * share)

    def pressure(self, x: Array) -> Array:
        """p(x) where |x| < b, 0 outside."""
        g, t = self._angle, np.arcsin(np.clip(x / self.half_width, -1.0, 1.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.sin(t) * np.log(np.abs(np.sin(t + g) / np.sin(t - g)))
            logs += np.sin(g) * np.log(np.abs(np.tan((t + g) / 2) * np.tan((t - g) / 2)))
        value = (np.pi - 2 * g) * np.cos(t) + logs
        scale = 2 * self.load / (np.pi * self.half_width * (np.pi - 2 * g - np.sin(2 * g)))
        return np.where(np.abs(x) < self.half_width, scale * value, 0.0)


def fit(comm: Any, r: Array, p: Array, peak: float) -> tuple[float, float]:
    """Half width and peak pressure from a line through p² over r², where p > 0.3 p₀.

    Collective. The pressures at the nodes are on the line p² = p₀² − (p₀/a)² r², while the
    outermost touching node gives a only up to the element size.
    """
    used = p > 0.3 * peak
    X, y = np.column_stack((np.ones(used.sum()), r[used] ** 2)), p[used] ** 2
    constant, slope = np.linalg.solve(comm.allreduce(X.T @ X), comm.allreduce(X.T @ y))
    return float(np.sqrt(-constant / slope)), float(np.sqrt(constant))


# --- Pressures as functions ---------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """Where pressures are compared."""

    points: Array  # along the contact, shape ``(n, 1)`` or ``(n, 2)``
    weights: Array  # what each of them counts, an area
    half_width: float | None  # a; None where contact is everywhere

    @classmethod
    def line(cls, a: float) -> Samples:
        """|x| ≤ 1.5 a."""
        n = int(2 * OUTSIDE * FINE)
        x = OUTSIDE * a * (2 * np.arange(n) + 1 - n) / n
        return cls(x[:, None], np.full(n, 2 * OUTSIDE * a / n), a)

    @classmethod
    def circle(cls, radius: float) -> Samples:
        """A whole circle, by the length of the arc from −πR to πR."""
        n = 4 * FINE
        x = np.pi * radius * (2 * np.arange(n) + 1 - n) / n
        return cls(x[:, None], np.full(n, 2 * np.pi * radius / n), None)

    @classmethod
    def disc(cls, a: float) -> Samples:
        """A disc of the radius 1.5 a, Fibonacci's points: of equal areas."""
        n = 8000
        r = OUTSIDE * a * np.sqrt((np.arange(n) + 0.5) / n)
        angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
        points = np.stack((r * np.cos(angle), r * np.sin(angle)), axis=1)
        return cls(points, np.full(n, np.pi * (OUTSIDE * a) ** 2 / n), a)

    @property
    def distance(self) -> Array:
        """Distance from the middle of the contact."""
        return np.linalg.norm(self.points, axis=1)

    def at(self, points: Array, pressure: Array) -> Array:
        """A pressure at the samples, linear between points (any order), 0 where there are none."""
        if self.points.shape[1] == 2:
            return LinearNDInterpolator(points, pressure, fill_value=0.0)(self.points)
        x, order = points[:, 0], np.argsort(points[:, 0])
        if self.half_width is not None:
            return np.interp(self.points[:, 0], x[order], pressure[order], left=0.0, right=0.0)
        around = float(self.weights.sum())
        return np.interp(self.points[:, 0], x, pressure, period=around)


def errors(samples: Samples, found: Array, exact: Array) -> dict[str, float | None]:
    """Relative errors of a pressure against another one, both at the samples.

    ``pressure``: L² norm inside 0.9 a. ``a``: of √(∫p r²/∫p), which is a/2 for Hertz's line contact
    and √(2/5) a for the point contact. ``p0``: of the mean inside 0.2 a.
    """
    w, r, a = samples.weights, samples.distance, samples.half_width
    inside = r < (INSIDE * a if a else np.inf)
    middle = r < (MIDDLE * a if a else np.inf)

    def width(p: Array) -> float:
        return float(np.sqrt((w * p) @ r**2 / (w @ p)))

    difference = (w * (found - exact) ** 2)[inside].sum()
    return {
        "pressure": float(np.sqrt(difference / (w * exact**2)[inside].sum())),
        "a": width(found) / width(exact) - 1 if a else None,
        "p0": float((w * found)[middle].sum() / (w * exact)[middle].sum() - 1),
    }
