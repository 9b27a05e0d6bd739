"""Homogenisation: λ = x + λ̄ with Gλ̄ = e, so that Gx = 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, norm_over
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.problem import QP, Operator, QPResult, Start

# of the terms that a residual is the difference of: what rounding leaves of it at least, and
# below how many times that rounding may be the reason of anything strange
ROUNDING, STRANGE = 1e-14, 1e8
# of open gaps: what drives the others is less, and would be lost in what P spreads of the gaps
FAR_OPEN = 1e-6


@dataclass(frozen=True)
class OperatorProduct:
    """Vector x with the product Fx.

    Attributes:
        x: The vector.
        Fx: F x.
    """

    x: PETSc.Vec
    Fx: PETSc.Vec

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        self.x.destroy()
        self.Fx.destroy()


def operator_product(F: Operator, x: PETSc.Vec) -> OperatorProduct:
    """x and F x; takes x over, and multiplies once if x ≠ 0. Collective."""
    Fx = x.duplicate()
    Fx.set(0.0)
    if x.norm() > 0.0:
        F.mult(x, Fx)
    return OperatorProduct(x, Fx)


class LastProduct:
    """Last solution x of a program, with the product Fx."""

    def __init__(self) -> None:
        nothing: Array = np.zeros(0)
        self._x, self._Fx, self._d, self._e = nothing, nothing, nothing, nothing
        self._looked, self._within = (nothing, nothing), 0.0

    def look(self, x: Array, g: Array) -> None:
        """Store a point of the program with Fx − d, as an assessment computes it."""
        self._looked = (x, g)

    def keep(self, result: QPResult, qp: QP) -> None:
        """Store a solution with its gradient Fx − d − Gᵀμ, or that of an assessment. Collective.

        So what steps leave out of the gradient does not grow from solve to solve.
        """
        (x, g), by_mu = self._looked, qp.d.duplicate()
        qp.coarse.combine(result.mu, by_mu)
        self._x, self._within = np.array(result.lam.array_r), 0.0
        other = any_rank(qp.d.getComm().tompi4py(), not np.array_equal(x, self._x))
        self._Fx = (result.gradient.array_r + by_mu.array_r if other else g) + qp.d.array_r
        self._d, self._e = np.array(qp.d.array_r), np.array(qp.coarse.e)
        by_mu.destroy()

    def pass_on(self, x: Array, Fx: Array, within: float) -> None:
        """Store another solver's x and Fx, to stand for all vectors within this distance."""
        self._x, self._Fx, self._within = x, Fx, within

    def known(self, comm: MPI.Intracomm, x: Array) -> Array:
        """Return this rank's Fx, or an empty array if x is not the last solution. Collective."""
        found = not any_rank(comm, not np.array_equal(self._x, x))
        return np.array(self._Fx) if found else np.zeros(0)

    def take(self, comm: MPI.Intracomm, x: Array, Fx: Array) -> None:
        """Restore what ``known`` has returned in another run. Collective."""
        if any_rank(comm, Fx.size > 0):
            self._x, self._Fx = x, Fx

    def is_of(self, d: PETSc.Vec, e: Array) -> bool:
        """Return whether it was kept from a program with this d and e. Collective."""
        same = np.array_equal(self._d, d.array_r) and np.array_equal(self._e, e)
        return not any_rank(d.getComm().tompi4py(), not same)

    def image(self, F: Operator, x: PETSc.Vec) -> OperatorProduct:
        """Return x with Fx; multiply by F only if x is not the last solution. Collective."""
        comm = x.getComm().tompi4py()
        known = self.known(comm, x.array_r)
        if self._within > 0.0 and not any_rank(comm, x.array_r.shape != self._x.shape):
            known = self._Fx if norm_over(comm, x.array_r - self._x) <= self._within else known
        if not any_rank(comm, known.size > 0):
            return operator_product(F, x)
        Fx = x.duplicate()
        Fx.array[:] = known
        return OperatorProduct(x, Fx)


def natural(coarse: Coarse, like: PETSc.Vec) -> PETSc.Vec:
    """λ̄₀ = Gᵀ(GGᵀ)⁻¹e. Collective."""
    x = like.duplicate()
    coarse.particular(x)
    return x


def restored(qp: QP, start: Start) -> PETSc.Vec:
    """Return the nearest solution of Gλ̄ = e to a start: λ + Gᵀ(GGᵀ)⁻¹(e − Gλ). Collective."""
    x, fixed = start.lam.copy(), natural(qp.coarse, start.lam)
    qp.coarse.project(x)
    x.axpy(1.0, fixed)
    fixed.destroy()
    return x


@dataclass(frozen=True)
class Scale:
    """Norm of the residual at the start, and its rounding error.

    Attributes:
        reference: b₀ = ‖P(d − F λ̄₀)‖ with λ̄₀ = Gᵀ(GGᵀ)⁻¹e.
        rounding: What rounding leaves of b₀ where it should be 0.
    """

    reference: float
    rounding: float


def scale_at(qp: QP, start: OperatorProduct) -> Scale:
    """Return the scale of a program whose λ̄₀ is known with its image. Collective."""
    return Scale(_projected(qp, start.Fx, qp.d), _rounding(qp, start))


def scale_near(qp: QP, at: OperatorProduct) -> Scale:
    """Return a scale from another solution of Gλ̄ = e, if F λ̄₀ is not known. Collective.

    ‖P d‖ and ‖P F λ‖ are equal at the solution, and b₀ is ‖P d‖ where e = 0; the larger one.
    """
    sizes = (_projected(qp, qp.d), _projected(qp, at.Fx))
    return Scale(max(sizes), _rounding(qp, at))


def _rounding(qp: QP, at: OperatorProduct) -> float:
    """Estimate the rounding error of ‖g^P‖, to which open gaps, however wide, do not count."""
    s = at.Fx.copy()
    s.axpy(-1.0, qp.d)
    qp.coarse.project(s)
    phi, beta = qp.feasible.split(qp.feasible.project(np.array(at.x.array_r)), s.array_r)
    s.destroy()
    # P makes of gaps a gradient of rows that nothing closes yet: d is negative there
    counts = (phi != 0.0) | ((beta != 0.0) & (qp.d.array_r > 0.0))
    Fx, d = at.Fx.array_r, qp.d.array_r
    parts = (np.where(counts, x, 0.0) for x in (d, Fx))
    return ROUNDING * sum(norm_over(qp.d.getComm().tompi4py(), part) for part in parts)


@dataclass(frozen=True)
class Homogenised:
    """min ½xᵀPFPx − bᵀx subject to Gx = 0, x + λ̄ ∈ Ω.

    Attributes:
        lam_bar: λ̄.
        gradient: F λ̄ − d.
        b: P(d − F λ̄).
        scale: Size of the residual at λ̄₀, whatever λ̄ is.
    """

    lam_bar: PETSc.Vec
    gradient: PETSc.Vec
    b: PETSc.Vec
    scale: Scale

    def is_rounding(self, residual: float) -> bool:
        """Return whether a residual is so small that its behaviour may be due to rounding."""
        return residual <= STRANGE * self.scale.rounding

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self.lam_bar, self.gradient, self.b):
            vec.destroy()


def homogenise(
    qp: QP, at: OperatorProduct | None = None, scale: Scale | None = None
) -> Homogenised:
    """Homogenise a quadratic program. Collective.

    Args:
        qp: The program.
        at: A solution of Gλ̄ = e with its image, which is copied; default λ̄₀, which costs one
            multiplication by F if e ≠ 0.
        scale: The scale of residuals; default that at λ̄.
    """
    if at is None:
        at = operator_product(qp.F, natural(qp.coarse, qp.d))
        homogenised = homogenise(qp, at, scale)
        at.destroy()
        return homogenised
    gradient = at.Fx.copy()
    gradient.axpy(-1.0, qp.d)
    b = gradient.copy()
    b.scale(-1.0)
    gaps, comm = open_gaps(qp), qp.d.getComm().tompi4py()
    without = b.copy()
    without.array[:] -= gaps
    qp.coarse.project(without)
    if bcast_from_root(comm, without.norm() <= FAR_OPEN * norm_over(comm, gaps)):
        b.array[:] = without.array_r + gaps
    else:
        qp.coarse.project(b)
    without.destroy()
    return Homogenised(at.x.copy(), gradient, b, scale or scale_at(qp, at))


def open_gaps(qp: QP) -> Array:
    """The part of d on rows that are open without forces: P would spread it over all others."""
    d = qp.d.array_r
    phi, beta = qp.feasible.split(qp.feasible.project(np.zeros(len(d))), -d)
    return np.where((phi == 0.0) & (beta == 0.0), d, 0.0)


def _projected(qp: QP, x: PETSc.Vec, less: PETSc.Vec | None = None) -> float:
    """‖P x‖, or ‖P(x − y)‖."""
    part = x.copy()
    if less is not None:
        part.axpy(-1.0, less)
    qp.coarse.project(part)
    size: float = part.norm()
    part.destroy()
    return size
