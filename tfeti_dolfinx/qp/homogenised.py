"""Homogenisation: λ = x + λ̄ with Gλ̄ = e, so that Gx = 0."""

from __future__ import annotations

from dataclasses import dataclass

from petsc4py import PETSc

from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.problem import QP, project


@dataclass(frozen=True)
class Homogenised:
    """min ½xᵀPFPx − bᵀx subject to Gx = 0, x ∈ Ω − λ̄.

    Attributes:
        lam_bar: λ̄.
        b: P(d − F λ̄).
        feasible: Ω − λ̄.
        reference: b₀ = ‖P(d − F λ̄₀)‖ with λ̄₀ = Gᵀ(GGᵀ)⁻¹e, whatever λ̄ is.
    """

    lam_bar: PETSc.Vec
    b: PETSc.Vec
    feasible: FeasibleSet
    reference: float

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
    b = _right_side(qp, natural)
    reference = b.norm()
    if lam_bar is None:
        return Homogenised(natural, b, qp.feasible.shifted(natural), reference)
    natural.destroy()
    b.destroy()
    return Homogenised(
        lam_bar.copy(), _right_side(qp, lam_bar), qp.feasible.shifted(lam_bar), reference
    )


def _right_side(qp: QP, lam_bar: PETSc.Vec) -> PETSc.Vec:
    """P(d − F λ̄)."""
    b, work = qp.d.copy(), qp.d.duplicate()
    if lam_bar.norm() > 0.0:
        qp.F.mult(lam_bar, work)
        b.axpy(-1.0, work)
    project(qp.coarse, b, work)
    work.destroy()
    return b
