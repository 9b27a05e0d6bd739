"""When a solver may stop: a cheap test in every step, and an examination where that holds."""

from __future__ import annotations

from typing import Protocol

from petsc4py import PETSc

from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.problem import ConvergedReason


class StoppingRule(Protocol):
    """What the residuals of an iterate must come down to.

    A solver compares max(‖g^P‖, ‖F‖‖Qx‖) with ``tolerance`` in every step. Where it is small
    enough, the iterate is examined; an examination that is not content lowers the tolerance.

    Attributes:
        tolerance: Norm of the residuals from which on an examination is worth its price.
        aim: What solves on faces come down to at most: the tolerance, or 0 where an examination
            is to wait until one of them is done.
        drifted: Set where an examination finds that the solver's gradient is no longer true;
            the solver makes it anew and takes the flag back.
        norm: ‖F‖, or an estimate: residuals over it are errors of multipliers. A solver that
            learns it on its way says so here.
    """

    tolerance: float
    drifted: bool
    norm: float

    @property
    def aim(self) -> float:
        """What solves on faces come down to at most."""
        ...

    def examine(
        self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, residual: float
    ) -> ConvergedReason:
        """Examine an iterate whose residuals are small. Collective.

        Args:
            lam: The multipliers λ.
            gradient: Fλ − d up to the range of Gᵀ.
            face: The face of λ: which rows carry a force.
            residual: max(‖g^P‖, ‖F‖‖Qx‖).

        Returns:
            Why to stop, or ITERATING; then ``tolerance`` is below ``residual``.
        """
        ...


class ResidualRule:
    """Small residuals are good enough: for a program that stands for itself.

    Args:
        tolerance: What residuals must come down to.
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance, self.drifted, self.norm = tolerance, False, 1.0

    @property
    def aim(self) -> float:
        """The tolerance."""
        return self.tolerance

    def examine(
        self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, residual: float
    ) -> ConvergedReason:
        """Content."""
        return ConvergedReason.CONVERGED_RTOL


class TargetRule(ResidualRule):
    """Content where the residual is what was asked for, and not before: for a part of a solve."""

    def examine(
        self, lam: PETSc.Vec, gradient: PETSc.Vec, face: Face, residual: float
    ) -> ConvergedReason:
        """Content, if the residual has come down to the tolerance."""
        small = residual <= self.tolerance
        return ConvergedReason.CONVERGED_RTOL if small else ConvergedReason.ITERATING
