"""Homogenisation: λ = x + λ̄ with Gλ̄ = e, so that Gx = 0."""

from __future__ import annotations

from dataclasses import dataclass

from petsc4py import PETSc

from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.problem import QP, project

# of the terms that a residual is the difference of: what rounding leaves of it at least, and
# below how many times that rounding may be the reason of anything strange
ROUNDING, STRANGE = 1e-14, 1e8


@dataclass(frozen=True)
class Homogenised:
    """min ½xᵀPFPx − bᵀx subject to Gx = 0, x ∈ Ω − λ̄.

    Attributes:
        lam_bar: λ̄.
        b: P(d − F λ̄).
        feasible: Ω − λ̄.
        reference: b₀ = ‖P(d − F λ̄₀)‖ with λ̄₀ = Gᵀ(GGᵀ)⁻¹e, whatever λ̄ is.
        rounding: What rounding leaves of b₀ where it should be 0.
    """

    lam_bar: PETSc.Vec
    b: PETSc.Vec
    feasible: FeasibleSet
    reference: float
    rounding: float

    def is_rounding(self, residual: float) -> bool:
        """Whether a residual is so small that rounding explains what is strange about it."""
        return residual <= STRANGE * self.rounding

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        self.lam_bar.destroy()
        self.b.destroy()


def homogenise(qp: QP, lam_bar: PETSc.Vec | None = None) -> Homogenised:
    """Homogenise a quadratic program; multiplies by F once if e ≠ 0. Collective.

    Args:
        qp: The program.
        lam_bar: A solution of Gλ̄ = e; default λ̄₀. Another one costs a second multiplication.
    """
    natural = qp.d.duplicate()
    qp.coarse.particular(natural)
    b, size = _right_side(qp, natural)
    reference, rounding = b.norm(), ROUNDING * size
    if lam_bar is None:
        return Homogenised(natural, b, qp.feasible.shifted(natural), reference, rounding)
    natural.destroy()
    b.destroy()
    b, _ = _right_side(qp, lam_bar)
    return Homogenised(lam_bar.copy(), b, qp.feasible.shifted(lam_bar), reference, rounding)


def _right_side(qp: QP, lam_bar: PETSc.Vec) -> tuple[PETSc.Vec, float]:
    """P(d − F λ̄), and the size of what it is the difference of."""
    b, work, size = qp.d.copy(), qp.d.duplicate(), qp.d.norm()
    if lam_bar.norm() > 0.0:
        qp.F.mult(lam_bar, work)
        size += work.norm()
        b.axpy(-1.0, work)
    project(qp.coarse, b, work)
    work.destroy()
    return b, size
