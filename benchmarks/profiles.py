"""Contact pressures as functions, linear between the points where they are known, and their errors.

It needs numpy and scipy only, so that other programs' pressures are judged by the same code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import LinearNDInterpolator

Array = Any
INSIDE, MIDDLE, OUTSIDE = 0.9, 0.2, 1.5  # of the half width a
FINE = 300  # samples along a


@dataclass(frozen=True)
class Samples:
    """Where pressures are compared.

    Attributes:
        points: Along the contact, shape ``(n, 1)`` or ``(n, 2)``.
        weights: What each of them counts, an area.
        half_width: a; None where contact is everywhere.
    """

    points: Array
    weights: Array
    half_width: float | None

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

    def exact(self, pressure: Callable[[Array], Array]) -> Array:
        """A closed form, a function of the distance from the middle, at the samples."""
        return pressure(self.distance)


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
