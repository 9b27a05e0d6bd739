"""Groups of Blocks that apply one matrix, each to its own part of it."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Protocol

import numpy as np
from scipy.sparse import block_diag, csr_array

from tfeti_dolfinx.arrays import Array, parts_of
from tfeti_dolfinx.subdomains.block import Block, OperatorKind
from tfeti_dolfinx.subdomains.cost import TOGETHER, Cost, dense_product, dense_traffic
from tfeti_dolfinx.subdomains.matrices import (
    OwnMatrix,
    PinvMatrix,
    SchurMatrix,
    StiffnessMatrix,
    TraceMatrix,
)
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock


class Group:
    """Blocks of equal subdomains, one alone, or some whose sparse matrices are one.

    Args:
        matrix: The matrix that all apply.
        rows: Its row for each trace unknown, for each column.
        parts: Where the trace unknowns of each Block lie among those of the rank.

    Attributes:
        matrix: The matrix.
        count: Number of Blocks.
        columns: Of what the matrix is applied to: one for each Block, or one for all.
    """

    def __init__(self, matrix: TraceMatrix, rows: Sequence[Array], parts: Sequence[slice]) -> None:
        self.matrix, self.count, self.columns = matrix, len(parts), len(rows)
        # of an array of columns, the first one first
        self._place = np.concatenate([k * matrix.size + row for k, row in enumerate(rows)])
        self._where = np.concatenate([np.arange(part.start, part.stop) for part in parts])

    def mult(self, apply: Callable[[Array], Array], w: Array, out: Array) -> None:
        """out = A w on the parts of all Blocks, A W being ``apply``."""
        columns = np.zeros(self.columns * self.matrix.size)
        columns[self._place] = w[self._where]
        product = apply(columns.reshape((self.matrix.size, self.columns), order="F"))
        out[self._where] = product.ravel(order="F")[self._place]


class Form(Protocol):
    """How a group applies its matrix.

    Attributes:
        name: Name in reports.
        group: The group.
        cost: What it costs by the model.
    """

    name: str
    group: Group
    cost: Cost

    def prepare(self) -> None:
        """Make what ``mult`` needs."""
        ...

    def mult(self, w: Array, out: Array) -> None:
        """out = A w on the group's parts of trace vectors of the rank."""
        ...


class Implicit:
    """Through factors, with several right sides where there are several Blocks."""

    def __init__(self, group: Group) -> None:
        self.group, self.name = group, "implicit" if group.columns == 1 else "shared_implicit"
        matrix, count = group.matrix, group.columns
        self.cost = Cost(0.0, matrix.seconds(count), matrix.traffic(count))

    def prepare(self) -> None:
        """The factors are there."""

    def mult(self, w: Array, out: Array) -> None:
        """out = A w on the group's parts of trace vectors of the rank."""
        self.group.mult(self.group.matrix.apply, w, out)


class Explicit:
    """By a dense matrix: one product for all Blocks."""

    def __init__(self, group: Group) -> None:
        self.group, self.name = group, "explicit" if group.columns == 1 else "shared_explicit"
        t, count = group.matrix.size, group.columns
        self.cost = Cost(group.matrix.seconds(t), dense_product(t, count), dense_traffic(t, count))

    def prepare(self) -> None:
        """Make the matrix."""
        self._matrix = self.group.matrix.dense(packed=self.group.columns == 1)

    def mult(self, w: Array, out: Array) -> None:
        """out = A w on the group's parts of trace vectors of the rank."""
        self.group.mult(self._matrix.apply, w, out)


def chosen(group: Group, local_type: str, multiplications: int) -> Form:
    """The form of a group, one of a type or what the model says is cheapest."""
    implicit, explicit = Implicit(group), Explicit(group)
    if local_type == "implicit" or not group.matrix.has_dense:
        return implicit
    if local_type == "explicit":
        return explicit
    if local_type == "shared" and group.columns == 1:
        return implicit
    if implicit.cost.of(multiplications) <= explicit.cost.of(multiplications):
        return implicit
    return explicit if group.matrix.is_sound else implicit


def groups_of(blocks: Sequence[Block], kind: OperatorKind) -> Iterator[Group]:
    """Groups that are as large as possible; Blocks without a trace have nothing to apply.

    K_bb of subdomains that have none equal to them are one sparse matrix.
    """
    members: dict[Hashable, list[int]] = {}
    for i, block in enumerate(blocks):
        if len(block.trace_dofs):
            members.setdefault(_key(block, kind), []).append(i)
    parts = parts_of([len(block.trace_dofs) for block in blocks])
    alone = [i for (i, *more) in members.values() if not more and kind == "stiffness"]
    alone = [i for i in alone if isinstance(blocks[i], SparseBlock)]
    for chosen_blocks in members.values():
        if chosen_blocks[0] not in alone:
            own = [blocks[i] for i in chosen_blocks]
            yield _group(own, kind, [parts[i] for i in chosen_blocks])
    if alone:
        yield _joined([blocks[i] for i in alone], [parts[i] for i in alone])


def solved_together(blocks: Sequence[Block], parts: Sequence[slice], b: Array) -> Array:
    """K⁺ b of all Blocks, shape ``(n,)``; of equal ones with several right sides at once.

    Args:
        blocks: The Blocks.
        parts: Where the unknowns of each lie among the n.
        b: Right sides.
    """
    x = np.empty(len(b))
    members: dict[int, list[tuple[SparseBlock, slice]]] = {}
    for block, part in zip(blocks, parts, strict=True):
        if isinstance(block, SparseBlock):
            members.setdefault(id(block.stiffness), []).append((block, part))
        else:
            x[part] = block.solve(b[part])
    for equal in members.values():
        for first in range(0, len(equal), TOGETHER):
            _solve_some(equal[first : first + TOGETHER], b, x)
    return x


def _solve_some(equal: Sequence[tuple[SparseBlock, slice]], b: Array, x: Array) -> None:
    """x = K⁺ b on the parts of some Blocks with one stiffness."""
    stiffness = equal[0][0].stiffness
    columns = np.empty((stiffness.size, len(equal)), order="F")
    for j, (block, part) in enumerate(equal):
        columns[block.place, j] = b[part]
    solved = stiffness.solve(columns)
    for j, (block, part) in enumerate(equal):
        x[part] = solved[block.place, j]


def _key(block: Block, kind: OperatorKind) -> Hashable:
    """Equal for Blocks that apply the same matrix."""
    if not isinstance(block, SparseBlock):
        return id(block)
    return id(block.stiffness) if kind == "pinv" else id(block.traced)


def _joined(blocks: Sequence[Block], parts: Sequence[slice]) -> Group:
    """K_bb of some Blocks as one sparse matrix."""
    sparse = [block for block in blocks if isinstance(block, SparseBlock)]
    K_bb = [block.traced.K_bb for block in sparse]
    begins = np.cumsum([0, *(K.shape[0] for K in K_bb)])
    rows = [
        begin + np.searchsorted(block.traced.trace, block.trace_place)
        for begin, block in zip(begins[:-1], sparse, strict=True)
    ]
    matrix = StiffnessMatrix(csr_array(block_diag(K_bb, format="csr")))
    return Group(matrix, [np.concatenate(rows)], parts)


def _group(blocks: Sequence[Block], kind: OperatorKind, parts: Sequence[slice]) -> Group:
    sparse = [block for block in blocks if isinstance(block, SparseBlock)]
    if not sparse:
        own = OwnMatrix(getattr(blocks[0], f"apply_{kind}"), len(blocks[0].trace_dofs))
        return Group(own, [np.arange(own.size)], parts)
    places, first = [block.trace_place for block in sparse], sparse[0]
    if kind == "pinv":
        # K⁺ on a part of a trace is a part of K⁺ on the trace, so that all traces may be joined
        trace = np.unique(np.concatenate(places))
        matrix: TraceMatrix = PinvMatrix(first.stiffness, trace)
    else:
        trace = first.traced.trace
        schur = kind == "schur"
        matrix = SchurMatrix(first.traced) if schur else StiffnessMatrix(first.traced.K_bb)
    return Group(matrix, [np.searchsorted(trace, place) for place in places], parts)
