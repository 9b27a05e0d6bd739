"""Local operators: K⁺, K_bb or S of all subdomains of a rank at once, on its trace."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from tfeti_dolfinx.arrays import Array, parts_of
from tfeti_dolfinx.subdomains.block import Block, OperatorKind
from tfeti_dolfinx.subdomains.groups import Form, chosen, groups_of

LOCAL_TYPES = ("auto", "implicit", "explicit", "shared")


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


@runtime_checkable
class ModelledOperator(LocalOperator, Protocol):
    """A local operator that knows what it costs.

    Attributes:
        predicted: After ``prepare``: seconds of one multiplication by the model.
        traffic: Bytes that it moves by the model.
        forms: Number of subdomains in each form.
    """

    predicted: float
    traffic: float
    forms: Counter[str]


@dataclass(frozen=True)
class LocalChoice:
    """Which form local operators take.

    Attributes:
        type: One of ``LOCAL_TYPES``.
        multiplications: How many to expect.
    """

    type: str = "auto"
    multiplications: int = 50

    @property
    def shares(self) -> bool:
        """Whether equal subdomains share their stiffness."""
        return self.type in ("auto", "shared")


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


class GroupedOperator:
    """Equal subdomains apply theirs at once, each group in the form that suits it.

    Args:
        blocks: This rank's Blocks.
        kind: ``"pinv"``, ``"stiffness"`` or ``"schur"``.
        choice: Which form groups take.
    """

    def __init__(self, blocks: Sequence[Block], kind: OperatorKind, choice: LocalChoice) -> None:
        self._blocks, self._kind, self._choice = blocks, kind, choice
        self._forms: list[Form] = []
        self.predicted, self.traffic = 0.0, 0.0
        self.forms: Counter[str] = Counter()

    def prepare(self) -> None:
        """Let Blocks make what they need, and make dense matrices where they are chosen."""
        for block in self._blocks:
            block.prepare(self._kind)
        for group in groups_of(self._blocks, self._kind):
            form = chosen(group, self._choice.type, self._choice.multiplications)
            form.prepare()
            self._forms.append(form)
            self.predicted += form.cost.multiplication
            self.traffic += form.cost.traffic
            self.forms[form.name] += group.count

    def mult(self, w: Array, out: Array) -> None:
        """out = diag(A_s) w, shapes ``(t,)``."""
        for form in self._forms:
            form.mult(w, out)

    def destroy(self) -> None:
        """Let dense matrices go; the factors are the Blocks'."""
        self._forms.clear()


def local_operator(
    blocks: Sequence[Block], kind: OperatorKind, choice: LocalChoice
) -> ModelledOperator:
    """The local operator of a rank: the one place that chooses its form."""
    return GroupedOperator(blocks, kind, choice)
