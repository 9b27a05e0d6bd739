"""Closed convex sets that are products of small ones: bounds now, discs and ellipses later."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import require


class FeasibleSet(Protocol):
    """A set Ω of vectors, and the parts of a gradient that belong to it."""

    def project(self, x: PETSc.Vec) -> None:
        """x ← P_Ω(x), the nearest point of Ω."""
        ...

    def split(self, x: PETSc.Vec, g: PETSc.Vec, phi: PETSc.Vec, beta: PETSc.Vec) -> None:
        """Free gradient φ and chopped gradient β at x ∈ Ω; φ + β is the projected gradient."""
        ...

    def reduced(self, x: PETSc.Vec, phi: PETSc.Vec, alpha: float) -> float:
        """φ̃ᵀφ, φ̃ = (x − P_Ω(x − α φ))/α on free components, φ elsewhere. Collective."""
        ...

    def max_step(self, x: PETSc.Vec, p: PETSc.Vec) -> float:
        """Largest α with x − α p ∈ Ω, maybe infinite. Collective."""
        ...

    def shifted(self, shift: PETSc.Vec) -> FeasibleSet:
        """The set Ω − shift."""
        ...

    def num_off(self, x: PETSc.Vec) -> int:
        """Local constrained components that are off their bound."""
        ...


class Bounds:
    """x_i ≥ l_i on some of the local components, the others free.

    Args:
        where: Local components that are bounded.
        lower: Their bounds, shape as ``where`` gives; default 0.
    """

    def __init__(self, where: slice | Array, lower: Array | float = 0.0) -> None:
        self.where = where
        self.lower = lower

    def project(self, x: PETSc.Vec) -> None:
        """x ← max(x, l)."""
        x.array[self.where] = np.maximum(x.array_r[self.where], self.lower)

    def split(self, x: PETSc.Vec, g: PETSc.Vec, phi: PETSc.Vec, beta: PETSc.Vec) -> None:
        """φ = g off the bounds; β = min(g, 0) on them."""
        g.copy(phi)
        beta.set(0.0)
        bounded = x.array_r[self.where] <= self.lower
        part = g.array_r[self.where]
        phi.array[self.where] = np.where(bounded, 0.0, part)
        beta.array[self.where] = np.where(bounded, np.minimum(part, 0.0), 0.0)

    def reduced(self, x: PETSc.Vec, phi: PETSc.Vec, alpha: float) -> float:
        """φ̃ᵀφ with φ̃_i = min((x_i − l_i)/α, φ_i) on bounded components."""
        part = phi.array_r[self.where]
        room = (x.array_r[self.where] - self.lower) / alpha
        excess = np.sum((part - np.minimum(room, part)) * part)
        total = phi.dot(phi)
        return float(total - phi.getComm().tompi4py().allreduce(excess))

    def max_step(self, x: PETSc.Vec, p: PETSc.Vec) -> float:
        """min over p_i > 0 of (x_i − l_i)/p_i."""
        part = p.array_r[self.where]
        room = x.array_r[self.where] - self.lower
        down = part > 0.0
        step = np.min(room[down] / part[down], initial=np.inf)
        return float(p.getComm().tompi4py().allreduce(float(step), op=MPI.MIN))

    def shifted(self, shift: PETSc.Vec) -> Bounds:
        """Bounds l − shift."""
        return Bounds(self.where, self.lower - shift.array_r[self.where])

    def num_off(self, x: PETSc.Vec) -> int:
        """Local components with x_i > l_i."""
        return int(np.sum(x.array_r[self.where] > self.lower))


class Unbounded:
    """The whole space: a scene without inequalities."""

    def project(self, x: PETSc.Vec) -> None:
        """Nothing to do."""

    def split(self, x: PETSc.Vec, g: PETSc.Vec, phi: PETSc.Vec, beta: PETSc.Vec) -> None:
        """φ = g, β = 0."""
        g.copy(phi)
        beta.set(0.0)

    def reduced(self, x: PETSc.Vec, phi: PETSc.Vec, alpha: float) -> float:
        """φᵀφ."""
        return float(phi.dot(phi))

    def max_step(self, x: PETSc.Vec, p: PETSc.Vec) -> float:
        """Infinite."""
        return float(np.inf)

    def shifted(self, shift: PETSc.Vec) -> Unbounded:
        """The same set."""
        return self

    def num_off(self, x: PETSc.Vec) -> int:
        """None."""
        return 0


def check_feasible_set(feasible: FeasibleSet, like: PETSc.Vec, seed: int = 0) -> None:
    """Check what MPRGP relies on, at random points of any feasible set. Collective.

    The projection is idempotent and the nearest point; a maximal step stays in the set; the
    projected gradient vanishes exactly where a projected step does not move; the reduced free
    gradient is not longer than the free one.

    Raises:
        ConformanceError: Something of that does not hold; the message says what.
    """
    rng = np.random.default_rng(seed + like.getComm().getRank())
    x, y, g, phi, beta, z = (like.duplicate() for _ in range(6))
    for scale in (0.1, 1.0, 10.0):
        for vec in (x, y, g):
            vec.array[:] = scale * rng.standard_normal(vec.getLocalSize())
        x.copy(z)
        feasible.project(x)
        feasible.project(y)
        z.axpy(-1.0, x)  # z = x₀ − P(x₀) makes an obtuse angle with every y − P(x₀)
        y.axpy(-1.0, x)
        require(z.dot(y) <= 1e-12 * (1.0 + z.norm() * y.norm()), "P(x) is the nearest point of Ω")
        x.copy(z)
        feasible.project(z)
        z.axpy(-1.0, x)
        require(z.norm() <= 1e-14 * (1.0 + x.norm()), "P(P(x)) = P(x)")

        feasible.split(x, g, phi, beta)
        reduced = feasible.reduced(x, phi, 0.5)
        require(-1e-12 <= reduced <= phi.dot(phi) * (1.0 + 1e-12), "0 ≤ φ̃ᵀφ ≤ φᵀφ")
        step = feasible.max_step(x, phi)
        x.copy(z)
        z.axpy(-min(step, 1e3), phi)
        z.copy(y)
        feasible.project(y)
        y.axpy(-1.0, z)
        require(y.norm() <= 1e-10 * (1.0 + z.norm()), "x − αφ ∈ Ω for the largest step α")
        x.copy(z)
        z.axpy(-1e-6, g)
        feasible.project(z)
        z.axpy(-1.0, x)
        phi.axpy(1.0, beta)
        apart = abs(z.norm() - 1e-6 * phi.norm())
        require(apart <= 1e-4 * 1e-6 * (1.0 + phi.norm()), "φ + β is the projected gradient")
    for vec in (x, y, g, phi, beta, z):
        vec.destroy()
