"""Local operators: K⁺, K_bb or S of all subdomains of a rank at once, on its trace."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.block import Block, OperatorKind


class LocalOperator(Protocol):
    """diag(A_s) over the subdomains of a rank, on its t trace unknowns. Nothing is collective.

    One object for the whole rank, so that an implementation may treat subdomains together: solve
    with several right sides, or share one matrix among equal subdomains.
    """

    def prepare(self) -> None:
        """Make what ``mult`` needs; called where ranks can raise together.

        Raises:
            FactorError: A factor could not be made.
        """
        ...

    def mult(self, w: Array, out: Array) -> None:
        """out = diag(A_s) w, shapes ``(t,)``; w stays as it is, all of out is set."""
        ...

    def destroy(self) -> None:
        """Free what ``prepare`` has made, but not the Blocks."""
        ...


class BlockwiseOperator:
    """Each Block applies its own, one after the other: with sparse factors the implicit form.

    Args:
        blocks: This rank's Blocks.
        kind: ``"pinv"``, ``"stiffness"`` or ``"schur"``.
    """

    def __init__(self, blocks: Sequence[Block], kind: OperatorKind) -> None:
        self._blocks, self._kind = blocks, kind
        parts = parts_of([len(block.trace_dofs) for block in blocks])
        apply = [getattr(block, f"apply_{kind}") for block in blocks]
        self._work = list(zip(apply, parts, strict=True))

    def prepare(self) -> None:
        """Let each Block make what it needs."""
        for block in self._blocks:
            block.prepare(self._kind)

    def mult(self, w: Array, out: Array) -> None:
        """out = diag(A_s) w, shapes ``(t,)``."""
        for apply, part in self._work:
            out[part] = apply(w[part])

    def destroy(self) -> None:
        """The factors are the Blocks'."""


def local_operator(blocks: Sequence[Block], kind: OperatorKind) -> LocalOperator:
    """The local operator of a rank: the one place that chooses its form."""
    return BlockwiseOperator(blocks, kind)


def parts_of(sizes: Sequence[int]) -> list[slice]:
    """Where arrays of these lengths lie, one after the other."""
    ends = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def joined(parts: Sequence[Array]) -> Array:
    """One float array of several, maybe none."""
    return np.concatenate([np.empty(0), *parts])
