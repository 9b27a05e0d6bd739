"""The dual problem of a scene: Blocks and rows in, a quadratic program out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.naming import listed
from tfeti_dolfinx.dual.operator import (
    PRECONDITIONERS,
    DualOperator,
    ScaledRows,
    dual_operator,
    linear_term,
)
from tfeti_dolfinx.dual.recovery import moved, recover
from tfeti_dolfinx.dual.smallest import nearly_free, smallest_motion
from tfeti_dolfinx.dual.solvability import check_solvable
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.feasible_sets import Bounds, FeasibleSet, Unbounded
from tfeti_dolfinx.qp.problem import QP, Coarse, NoCoarse
from tfeti_dolfinx.subdomains.subdomains import Subdomains


class Dual:
    """F, G, d and e of a scene. Creation and all methods are collective.

    Args:
        constraints: B and c.
        subdomains: This rank's Blocks.
        body_names: Names of all bodies.
        mode_names: Names of their candidate modes.
        pc_type: Preconditioner: none, lumped or dirichlet.
        options_prefix: Prefix of all PETSc options.

    Attributes:
        F: B K⁺ Bᵀ.
        preconditioner: The preconditioner, or None.
        coarse: The coarse space.
        num_inequalities: Inequality rows of all ranks.
        carrying: After ``recover``: contact rows whose force is more than the solver's error.
        nearly_free: After ``recover``: motions that contacts with a force hold hardly or not.

    Raises:
        NoSolutionError: The load moves a body that nothing holds.
        FactorError: A matrix could not be factored.
    """

    def __init__(
        self,
        constraints: Constraints,
        subdomains: Subdomains,
        body_names: Sequence[str],
        mode_names: Sequence[str],
        pc_type: str,
        options_prefix: str = "tfeti_",
    ) -> None:
        self.constraints, self.subdomains = constraints, subdomains
        self.carrying = np.zeros(constraints.num_rows, dtype=bool)
        self._names, self.nearly_free = (body_names, mode_names), list[dict[str, object]]()
        B, comm = constraints.B, constraints.B.getComm().tompi4py()
        self.F = dual_operator(B, subdomains.blocks)
        self.preconditioner: DualOperator | None = None
        self._scaled: ScaledRows | None = None
        if pc_type != "none":
            self._scaled = ScaledRows(B, constraints.weights)
            self.preconditioner = PRECONDITIONERS[pc_type](self._scaled, subdomains.blocks)
        bounded = constraints.sets.normals
        self.coarse = CoarseSpace(B, subdomains, bounded, f"{options_prefix}coarse_")
        self.num_inequalities = comm.allreduce(len(bounded))
        check_solvable(self.coarse, body_names, mode_names)
        self.d = linear_term(B, constraints.c, subdomains)

    def update_load(self) -> None:
        """Take the Blocks' present loads and the present right sides.

        Raises:
            NoSolutionError: The load moves a body that nothing holds.
        """
        self.coarse.update_load()
        check_solvable(self.coarse, *self._names)
        self.d.destroy()
        self.d = linear_term(self.constraints.B, self.constraints.c, self.subdomains)

    def forget_counts(self) -> None:
        """Count multiplications from 0 on."""
        for operator in (self.F, self.preconditioner):
            if operator is not None:
                operator.count.clear()

    def qp(self) -> QP:
        """The quadratic program; without kernel it has no coarse problem."""
        coarse: Coarse = self.coarse if self.coarse.dimension else NoCoarse()
        bounds = Bounds(self.constraints.sets.normals)
        feasible: FeasibleSet = bounds if self.num_inequalities else Unbounded()
        return QP(self.F, self.d, coarse, feasible, self.preconditioner)

    def recover(self, lam: PETSc.Vec, gradient: PETSc.Vec, error: float) -> Array:
        """Displacements that belong to multipliers: of equal ones the smallest.

        Args:
            lam: The multipliers λ.
            gradient: Fλ − d up to the range of Gᵀ; on bound components the multiplier ν.
            error: How large multipliers may be by the solver's error alone.

        Returns:
            This rank's part of u, shape ``(n,)``.
        """
        constraints, bounded = self.constraints, self.constraints.sets.normals
        nu = np.zeros(constraints.num_rows)
        closed = lam.array_r[bounded] <= 0.0
        nu[bounded] = np.where(closed, gradient.array_r[bounded], 0.0)
        u, gap = recover(constraints.B, constraints.c, self.coarse, lam, nu)
        motions, force = nearly_free(self.coarse, lam.array_r, error)
        self.carrying = force
        words = listed(motions, self.coarse.bodies, *self._names)
        self.nearly_free = agreed(self.coarse.comm, words)
        if motions.count == 0:
            return u
        alpha = smallest_motion(self.coarse, u, gap, motions, force)
        return moved(u, self.coarse, alpha)

    def destroy(self) -> None:
        """Destroy the PETSc objects."""
        for item in (self.F, self.preconditioner, self._scaled, self.coarse, self.d):
            if item is not None:
                item.destroy()
