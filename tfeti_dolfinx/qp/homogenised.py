"""Homogenisation: λ = x + λ̄ with Gλ̄ = e, so that Gx = 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, norm_over
from tfeti_dolfinx.qp.problem import QP, Operator, QPResult, Start

# of the terms that a residual is the difference of: what rounding leaves of it at least, and
# below how many times that rounding may be the reason of anything strange
ROUNDING, STRANGE = 1e-14, 1e8
# of open gaps: what drives the others is less, and would be lost in what P spreads of the gaps
FAR_OPEN = 1e-6


@dataclass(frozen=True)
class OperatorProduct:
    """Vector x with the product Fx, this rank's parts.

    Attributes:
        x: The vector.
        Fx: F x.
    """

    x: Array
    Fx: Array


def operator_product(F: Operator, comm: MPI.Intracomm, x: Array) -> OperatorProduct:
    """x and F x; multiplies once if x ≠ 0. Collective."""
    moves = any_rank(comm, bool(np.any(x)))
    return OperatorProduct(x, F(x) if moves else np.zeros(len(x)))


class LastProduct:
    """Last solution x of a program, with the product Fx.

    Attributes:
        looked: A point of the program with Fx − d, as an assessment computes it.
    """

    def __init__(self) -> None:
        nothing: Array = np.zeros(0)
        self._x, self._Fx, self._d, self._e = nothing, nothing, nothing, nothing
        self.looked, self._within = (nothing, nothing), 0.0

    def keep(self, result: QPResult, qp: QP) -> None:
        """Store a solution with its gradient Fx − d − Gᵀμ, or that of an assessment. Collective.

        So what steps leave out of the gradient does not grow from solve to solve.
        """
        (x, g), self._x, self._within = self.looked, result.lam, 0.0
        other = any_rank(qp.comm, not np.array_equal(x, self._x))
        self._Fx = (result.gradient + qp.coarse.combined(result.mu) if other else g) + qp.d
        self._d, self._e = qp.d, np.array(qp.coarse.e)

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

    def is_of(self, comm: MPI.Intracomm, d: Array, e: Array) -> bool:
        """Return whether it was kept from a program with this d and e. Collective."""
        return not any_rank(comm, not (np.array_equal(self._d, d) and np.array_equal(self._e, e)))

    def image(self, F: Operator, comm: MPI.Intracomm, x: Array) -> OperatorProduct:
        """Return x with Fx; multiply by F only if x is not the last solution. Collective."""
        known = self.known(comm, x)
        if self._within > 0.0 and not any_rank(comm, x.shape != self._x.shape):
            known = self._Fx if norm_over(comm, x - self._x) <= self._within else known
        found = any_rank(comm, known.size > 0)
        return OperatorProduct(x, known) if found else operator_product(F, comm, x)


def restored(qp: QP, start: Start) -> Array:
    """Return the nearest solution of Gλ̄ = e to a start: λ + Gᵀ(GGᵀ)⁻¹(e − Gλ). Collective."""
    return qp.coarse.project(start.lam) + qp.coarse.particular()


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
    size = norm_over(qp.comm, qp.coarse.project(start.Fx - qp.d))
    return Scale(size, _rounding(qp, start))


def scale_near(qp: QP, at: OperatorProduct) -> Scale:
    """Return a scale from another solution of Gλ̄ = e, if F λ̄₀ is not known. Collective.

    ‖P d‖ and ‖P F λ‖ are equal at the solution, and b₀ is ‖P d‖ where e = 0; the larger one.
    """
    sizes = [norm_over(qp.comm, qp.coarse.project(x)) for x in (qp.d, at.Fx)]
    return Scale(max(sizes), _rounding(qp, at))


def _rounding(qp: QP, at: OperatorProduct) -> float:
    """Estimate the rounding error of ‖g^P‖, to which open gaps, however wide, do not count."""
    phi, beta = qp.feasible.split(qp.feasible.project(at.x), qp.coarse.project(at.Fx - qp.d))
    # P makes of gaps a gradient of rows that nothing closes yet: d is negative there
    counts = (phi != 0.0) | ((beta != 0.0) & (qp.d > 0.0))
    return ROUNDING * sum(norm_over(qp.comm, np.where(counts, x, 0.0)) for x in (qp.d, at.Fx))


@dataclass(frozen=True)
class Homogenised:
    """min ½xᵀPFPx − bᵀx subject to Gx = 0, x + λ̄ ∈ Ω.

    Attributes:
        lam_bar: λ̄.
        gradient: F λ̄ − d.
        b: P(d − F λ̄).
        scale: Size of the residual at λ̄₀, whatever λ̄ is.
    """

    lam_bar: Array
    gradient: Array
    b: Array
    scale: Scale

    def is_rounding(self, residual: float) -> bool:
        """Return whether a residual is so small that its behaviour may be due to rounding."""
        return residual <= STRANGE * self.scale.rounding


def homogenise(
    qp: QP, at: OperatorProduct | None = None, scale: Scale | None = None
) -> Homogenised:
    """Homogenise a quadratic program. Collective.

    Args:
        qp: The program.
        at: A solution of Gλ̄ = e with its image; default λ̄₀, which costs one multiplication by F if
            e ≠ 0.
        scale: The scale of residuals; default that at λ̄.
    """
    at = at or operator_product(qp.F, qp.comm, qp.coarse.particular())
    gradient = at.Fx - qp.d
    # d on rows that are open without forces: P would spread it over all others
    phi, beta = qp.feasible.split(qp.feasible.project(np.zeros(len(qp.d))), -qp.d)
    gaps = np.where((phi == 0.0) & (beta == 0.0), qp.d, 0.0)
    b = qp.coarse.project(-gradient - gaps)
    if norm_over(qp.comm, b) <= FAR_OPEN * norm_over(qp.comm, gaps):
        b = b + gaps
    else:
        b = qp.coarse.project(-gradient)
    return Homogenised(at.x, gradient, b, scale or scale_at(qp, at))
