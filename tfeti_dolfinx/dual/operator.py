"""F = B K⁺ Bᵀ, and its preconditioners: B does all the communication, Blocks are local."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import raised_on_all_ranks, require
from tfeti_dolfinx.subdomains.block import Block


class Gluing(Protocol):
    """B, or something that stands for it between dual and trace vectors."""

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = B x; x may be overwritten. Collective."""
        ...

    def multTranspose(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Bᵀ x. Collective."""
        ...

    def createVecRight(self) -> PETSc.Vec:
        """A trace vector. Collective."""
        ...


class BlockOperator:
    """B diag(A_s) Bᵀ, A_s a local operator of each Block, with a count of multiplications.

    Args:
        B: Dual rows × trace unknowns, MPIAIJ (or scaled).
        blocks: This rank's Blocks, in the order of B's local columns.
        apply: The local operator: from a Block and a trace vector to a trace vector.
        name: Its name for ``Block.prepare``; all ranks raise what it raises.

    Attributes:
        count: Multiplications so far, by who they are charged to (``"solver"`` by default).
    """

    def __init__(
        self,
        B: Gluing,
        blocks: Sequence[Block],
        apply: Callable[[Block, Array], Array],
        name: str,
    ) -> None:
        self.B, self.blocks, self.apply = B, blocks, apply
        self.slices = trace_slices(blocks)
        self.count: Counter[str] = Counter()
        self._payer = "solver"
        self._w, self._v = B.createVecRight(), B.createVecRight()
        with raised_on_all_ranks(self._w.getComm().tompi4py()):
            for block in blocks:
                block.prepare(name)

    @contextmanager
    def charged_to(self, payer: str) -> Iterator[None]:
        """Charge multiplications inside the block to someone else."""
        self._payer, previous = payer, self._payer
        try:
            yield
        finally:
            self._payer = previous

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = B diag(A_s) Bᵀ x. Collective."""
        self.count[self._payer] += 1
        self.B.multTranspose(x, self._w)
        w, v = self._w.array_r, self._v.array
        for block, part in zip(self.blocks, self.slices, strict=True):
            v[part] = self.apply(block, w[part])
        self.B.mult(self._v, y)

    def destroy(self) -> None:
        """Destroy the work vectors. Collective."""
        self._w.destroy()
        self._v.destroy()


def trace_slices(blocks: Sequence[Block]) -> list[slice]:
    """Local trace unknowns of each Block."""
    ends = np.cumsum([0, *(len(block.trace_dofs) for block in blocks)])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def dual_operator(B: PETSc.Mat, blocks: Sequence[Block]) -> BlockOperator:
    """F = B K⁺ Bᵀ."""
    return BlockOperator(B, blocks, lambda block, w: block.apply_pinv(w), "pinv")


class ScaledGluing:
    """B_D = B D⁻¹, which is (B D⁻¹ Bᵀ)⁻¹ B D⁻¹ for rows that are orthonormal in D⁻¹.

    With D the stiffness, preconditioners built on B_D bear jumps of stiffness between subdomains
    (Klawonn, Widlund, Comm. Pure Appl. Math. 54, 2001, section 4).

    Args:
        B: Dual rows × trace unknowns.
        weights: D on this rank's trace unknowns.
    """

    def __init__(self, B: PETSc.Mat, weights: Array) -> None:
        self.B = B
        self._inverse = B.createVecRight()
        self._inverse.array[:] = 1.0 / weights

    def multTranspose(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = B_Dᵀ x. Collective."""
        self.B.multTranspose(x, y)
        y.pointwiseMult(y, self._inverse)

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = B_D x; x is overwritten. Collective."""
        x.pointwiseMult(x, self._inverse)
        self.B.mult(x, y)

    def createVecRight(self) -> PETSc.Vec:
        """A trace vector. Collective."""
        return self.B.createVecRight()

    def destroy(self) -> None:
        """Destroy D, not B. Collective."""
        self._inverse.destroy()


def lumped_preconditioner(B: Gluing, blocks: Sequence[Block]) -> BlockOperator:
    """B K_bb Bᵀ (Farhat, Roux 1991), B or rather B_D."""
    return BlockOperator(B, blocks, lambda block, w: block.apply_stiffness(w), "stiffness")


def dirichlet_preconditioner(B: Gluing, blocks: Sequence[Block]) -> BlockOperator:
    """B S Bᵀ (Farhat, Mandel, Roux 1994), B or rather B_D."""
    return BlockOperator(B, blocks, lambda block, w: block.apply_schur(w), "schur")


PRECONDITIONERS = {"lumped": lumped_preconditioner, "dirichlet": dirichlet_preconditioner}


def linear_term(B: PETSc.Mat, c: PETSc.Vec, blocks: Sequence[Block]) -> PETSc.Vec:
    """d = B K⁺ f − c. Collective."""
    v, d = B.createVecRight(), c.duplicate()
    for block, part in zip(blocks, trace_slices(blocks), strict=True):
        v.array[part] = block.condensed_load
    B.mult(v, d)
    d.axpy(-1.0, c)
    v.destroy()
    return d


def check_operator(F: Any, like: PETSc.Vec, tol: float = 1e-10) -> None:
    """Check that an operator is symmetric and positive semidefinite on random vectors. Collective.

    Raises:
        ConformanceError: It is not; the message says which.
    """
    rng = np.random.default_rng(like.getComm().getRank())
    x, y, Fx, Fy = (like.duplicate() for _ in range(4))
    for _ in range(3):
        for vec in (x, y):
            vec.array[:] = rng.standard_normal(vec.getLocalSize())
        F.mult(x, Fx)
        F.mult(y, Fy)
        require(x.dot(Fx) >= 0.0, "xᵀFx ≥ 0")
        require(abs(y.dot(Fx) - x.dot(Fy)) <= tol * Fx.norm() * y.norm(), "yᵀFx = xᵀFy")
    for vec in (x, y, Fx, Fy):
        vec.destroy()
