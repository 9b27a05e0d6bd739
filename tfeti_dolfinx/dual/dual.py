"""The dual problem of a scene: Blocks and rows in, a quadratic program out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.operator import (
    PRECONDITIONERS,
    BlockOperator,
    ScaledGluing,
    dual_operator,
    linear_term,
)
from tfeti_dolfinx.dual.recovery import recover
from tfeti_dolfinx.dual.solvability import check_solvable
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.qp.feasible_sets import Bounds, FeasibleSet, Unbounded
from tfeti_dolfinx.qp.problem import QP, Coarse, NoCoarse
from tfeti_dolfinx.subdomains.block import Block


class Dual:
    """F, G, d and e of a scene. Creation and all methods are collective.

    Args:
        constraints: B and c.
        blocks: This rank's Blocks.
        body_of_block: Body of each of them.
        body_names: Names of all bodies.
        mode_names: Names of their candidate modes.
        pc_type: Preconditioner: none, lumped or dirichlet.

    Attributes:
        F: B K⁺ Bᵀ.
        num_bodies: Number of bodies on all ranks.
        preconditioner: The preconditioner, or None.
        coarse: The coarse space.
        num_inequalities: Inequality rows of all ranks.

    Raises:
        NoSolutionError: The load moves a body that nothing holds.
    """

    def __init__(
        self,
        constraints: Constraints,
        blocks: Sequence[Block],
        body_of_block: Array,
        body_names: Sequence[str],
        mode_names: Sequence[str],
        pc_type: str,
    ) -> None:
        self.constraints, self.blocks = constraints, blocks
        self.body_of_block, self.num_bodies = body_of_block, len(body_names)
        B, comm = constraints.B, constraints.B.getComm().tompi4py()
        self.F = dual_operator(B, blocks)
        self.preconditioner: BlockOperator | None = None
        self._scaled: ScaledGluing | None = None
        if pc_type != "none":
            self._scaled = ScaledGluing(B, constraints.weights)
            self.preconditioner = PRECONDITIONERS[pc_type](self._scaled, blocks)
        self.coarse = CoarseSpace(B, blocks, body_of_block, len(body_names), comm)
        bounded = constraints.inequalities
        self.num_inequalities = comm.allreduce(bounded.stop - bounded.start)
        load_norm = np.sqrt(comm.allreduce(sum(block.load_norm**2 for block in blocks)))
        check_solvable(self.coarse, bounded, float(load_norm), body_names, mode_names)
        self.d = linear_term(B, constraints.c, blocks)

    def qp(self) -> QP:
        """The quadratic program; without kernel it has no coarse problem."""
        coarse: Coarse = self.coarse if self.coarse.dimension else NoCoarse()
        bounds = Bounds(self.constraints.inequalities)
        feasible: FeasibleSet = bounds if self.num_inequalities else Unbounded()
        return QP(self.F, self.d, coarse, feasible, self.preconditioner)

    def recover(self, lam: PETSc.Vec, gradient: PETSc.Vec) -> list[Array]:
        """Displacements that belong to multipliers.

        Args:
            lam: The multipliers λ.
            gradient: Fλ − d up to the range of Gᵀ; on bound components the multiplier ν.
        """
        constraints, bounded = self.constraints, self.constraints.inequalities
        nu = np.zeros(constraints.num_rows)
        closed = lam.array_r[bounded] <= 0.0
        nu[bounded] = np.where(closed, gradient.array_r[bounded], 0.0)
        return recover(constraints.B, constraints.c, self.blocks, self.coarse, lam, bounded, nu)

    def destroy(self) -> None:
        """Destroy the PETSc objects."""
        for item in (self.F, self.preconditioner, self._scaled, self.coarse, self.d):
            if item is not None:
                item.destroy()
