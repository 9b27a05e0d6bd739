"""Monitors: called once per step with what a solver knows anyway."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from petsc4py import PETSc

from tfeti_dolfinx.qp.problem import Steps


class Monitor(Protocol):
    """Called on all ranks after each step; a monitor may communicate."""

    def __call__(
        self, steps: Steps, step: str, x: PETSc.Vec, projected_gradient: float, equality: float
    ) -> None:
        """See a step.

        Args:
            steps: Steps so far.
            step: Kind of this one: start, cg, expansion, proportioning, outer.
            x: The iterate.
            projected_gradient: ‖g^P‖ there.
            equality: ‖Q x‖ there, how far Gλ = e is from being met.
        """
        ...


def no_monitor(
    steps: Steps, step: str, x: PETSc.Vec, projected_gradient: float, equality: float
) -> None:
    """Say nothing."""


@dataclass(frozen=True)
class PrintMonitor:
    """Prints a line per step on rank 0.

    Attributes:
        touching: Number of free components among the bounded ones of an iterate (collective).
        multiplications: Multiplications by F so far.
    """

    touching: Callable[[PETSc.Vec], int]
    multiplications: Callable[[], int]

    def __call__(
        self, steps: Steps, step: str, x: PETSc.Vec, projected_gradient: float, equality: float
    ) -> None:
        """Print outer iteration, step, ‖g^P‖, ‖Qx‖ if known, touching rows, multiplications."""
        touching = self.touching(x)
        if x.getComm().getRank() == 0:
            print(
                f"{steps.outer:4d} {step:<13s} |gP| {projected_gradient:.4e}  "
                f"|Qx| {_known(equality)}  touching {touching:6d}  "
                f"multiplications {self.multiplications():5d}",
                flush=True,
            )


def _known(value: float) -> str:
    """A norm, blank where it was not computed."""
    return f"{value:.4e}" if value >= 0.0 else " " * 10
