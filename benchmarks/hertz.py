"""Closed forms of Hertz, and what is compared with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI


@dataclass(frozen=True)
class LineContact:
    """Parallel cylinders: a = √(4P'R/(πE*)), p₀ = 2P'/(πa).

    Attributes:
        half_width: a.
        load: P', a force per length.
        peak: p₀.
    """

    half_width: float
    load: float
    peak: float

    @classmethod
    def from_half_width(cls, a, radius, modulus):
        """The contact of half width a; ``modulus`` is E*."""
        load = np.pi * modulus * a**2 / (4 * radius)
        return cls(a, load, 2 * load / (np.pi * a))

    @classmethod
    def from_load(cls, load, radius, modulus):
        """The contact under a force per length; ``modulus`` is E*."""
        a = np.sqrt(4 * load * radius / (np.pi * modulus))
        return cls(a, load, 2 * load / (np.pi * a))

    def pressure(self, x):
        """p₀√(1 − x²/a²), 0 outside."""
        return self.peak * np.sqrt(np.maximum(1 - (x / self.half_width) ** 2, 0.0))


@dataclass(frozen=True)
class PointContact:
    """Spheres: a³ = 3FR/(4E*), p₀ = 3F/(2πa²).

    Attributes:
        half_width: Radius a of the contact circle.
        load: F.
        peak: p₀.
    """

    half_width: float
    load: float
    peak: float

    @classmethod
    def from_half_width(cls, a, radius, modulus):
        """The contact of radius a; ``modulus`` is E*."""
        load = 4 * modulus * a**3 / (3 * radius)
        return cls(a, load, 3 * load / (2 * np.pi * a**2))

    def pressure(self, r):
        """p₀√(1 − r²/a²), 0 outside."""
        return self.peak * np.sqrt(np.maximum(1 - (r / self.half_width) ** 2, 0.0))


def fit(comm, r, p, peak):
    """Half width and peak pressure from a line through p² over r², where p > 0.3 p₀.

    Collective. The pressures at the nodes are on the line p² = p₀² − (p₀/a)² r², while the
    outermost touching node gives a only up to the element size.
    """
    used = p > 0.3 * peak
    X, y = np.column_stack((np.ones(used.sum()), r[used] ** 2)), p[used] ** 2
    normal = comm.allreduce(X.T @ X, op=MPI.SUM)
    right = comm.allreduce(X.T @ y, op=MPI.SUM)
    constant, slope = np.linalg.solve(normal, right)
    return np.sqrt(-constant / slope), np.sqrt(constant)


def pressure_error(comm, contact, r, hertz, radius):
    """Relative L² error of the pressure where |r| < radius. Collective."""
    inside = np.abs(r) < radius
    exact = hertz.pressure(r)
    error = np.sum((contact.area * (contact.pressure - exact) ** 2)[inside])
    size = np.sum((contact.area * exact**2)[inside])
    return float(np.sqrt(comm.allreduce(error) / comm.allreduce(size)))


def compare(comm, contact, r, hertz, part=1.0):
    """Relative errors of half width, peak, force (of a part of the load), pressure. Collective."""
    half_width, peak = fit(comm, r, contact.pressure, hertz.peak)
    force = comm.allreduce(contact.force @ contact.normal)[-1]  # normals of arcs are not vertical
    return {
        "half_width": half_width / hertz.half_width - 1,
        "peak_pressure": peak / hertz.peak - 1,
        "force": abs(force) / (part * hertz.load) - 1,
        "pressure_l2": pressure_error(comm, contact, r, hertz, 0.9 * hertz.half_width),
    }
