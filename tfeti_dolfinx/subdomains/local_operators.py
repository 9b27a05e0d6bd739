"""K⁺, K_bb and S of all subdomains of a rank, in the form that costs least."""

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Protocol

import numpy as np
from scipy.linalg.blas import dsymm, dsymv

from tfeti_dolfinx.common.arrays import Array, Entries, LocalMatrix, parts_of
from tfeti_dolfinx.subdomains.block import Block, OperatorKind
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock, Stiffness

LOCAL_TYPES = ("auto", "implicit", "explicit", "shared")


@dataclass(frozen=True)
class LocalChoice:
    """Choice of the form of local operators."""

    type: str = "auto"  # one of `LOCAL_TYPES`
    multiplications: int = 50  # how many to expect


# right sides that go through a factor at once: enough that it is not read for each, and few enough
# that they fit beside it into the cache; more of a short trace, so many numbers
TOGETHER, NUMBERS = 32, 2**14

# --- Groups of Blocks with one matrix ---------------------------------------------------------


@dataclass
class Group:
    """Blocks that apply one symmetric matrix A on a trace: equal ones, or one alone."""

    count: int  # number of Blocks
    size: int  # rows of A
    columns: int  # vectors that A is applied to at once
    place: Array  # where the trace unknowns go in these columns, the first column first
    where: Array | slice  # their places among the rank's; a slice: one column, as it stands
    apply: Callable[[Array], Array]  # a W, shapes (size,) or (size, q)
    work: float  # operations of `apply` for a vector, 0 if they are not known
    can_be_dense: bool = True  # whether there is use in a dense A
    dense: Array | None = None  # a, where that is cheaper
    stiffness: Stiffness | None = None  # of a K⁺: on what trace this is known makes S dense, too
    trace: Array | None = None  # this trace, ascending
    rough: Callable[[Array], Array] | None = None  # as `apply`, to single precision for less

    def prefers_dense(self, choice: LocalChoice) -> bool:
        """Return whether the group takes a dense matrix: by its type, or for fewer operations.

        It costs as many solves as it has columns. A single right side reads the factor for itself,
        as long as three of many take; with a dense K⁺ comes S, as often multiplied by.
        """
        if choice.type in ("implicit", "explicit") or not self.can_be_dense:
            return self.can_be_dense and choice.type == "explicit"
        if choice.type == "shared" and self.columns == 1:
            return False
        once = self.work * (3.0 if self.columns == 1 else self.columns)
        dense = 2.0 * self.size**2 * self.columns
        times = choice.multiplications * (2 if self.stiffness else 1)
        return times * (once - dense) > self.work * self.size

    def take_dense(self, A: Array) -> None:
        """Apply a dense A, which is exact."""
        self.dense, self.rough = A, None
        self.apply = partial(dsymv if self.columns == 1 else dsymm, 1.0, A)

    def mult(self, w: Array, out: Array, roughly: bool = False) -> None:
        """Set this group's part of out = diag(A_s) w, shapes ``(t,)``."""
        apply = self.rough if roughly and self.rough is not None else self.apply
        if isinstance(self.where, slice):
            out[self.where] = apply(w[self.where])
            return
        flat = np.zeros(self.size * self.columns)
        flat[self.place] = w[self.where]
        shape = (self.size, self.columns) if self.columns > 1 else self.size
        out[self.where] = apply(flat.reshape(shape, order="F")).ravel(order="F")[self.place]


def groups_of(blocks: Sequence[Block], kind: OperatorKind) -> list[Group]:
    """Return groups that are as large as possible; Blocks without a trace have nothing to apply."""
    parts = parts_of([len(block.trace_dofs) for block in blocks])
    groups = []
    members: dict[int, list[tuple[SparseBlock, slice]]] = defaultdict(list)
    for block, part in zip(blocks, parts, strict=True):
        if isinstance(block, SparseBlock) and len(block.trace_dofs):
            members[id(block.stiffness if kind == "pinv" else block.traced)].append((block, part))
        elif len(block.trace_dofs):
            groups.append(_own_group(block, kind, part))
    if kind == "stiffness":
        return [*groups, _stiffness_group(list(chain(*members.values())))] if members else groups
    return [*groups, *map(_pinv_group if kind == "pinv" else _schur_group, members.values())]


def _pinv_group(equal: Sequence[tuple[SparseBlock, slice]]) -> Group:
    """K⁺ on a trace that has those of all: a part of it is K⁺ on a part."""
    stiffness = equal[0][0].stiffness
    traces = [block.place[block.trace_dofs] for block, _ in equal]
    trace = np.unique(np.concatenate(traces))

    def solved(solve: Callable[[Array], Array], W: Array) -> Array:
        B = np.zeros((stiffness.size, *W.shape[1:]), order="F")
        B[trace] = W
        return solve(B)[trace]

    def chunks(solve: Callable[[Array], Array]) -> Callable[[Array], Array]:
        apply = partial(solved, solve)
        return apply if len(equal) <= TOGETHER else partial(_in_chunks, apply)

    rows = [np.searchsorted(trace, own) for own in traces]
    work = 4.0 * stiffness.entries
    group = _group(equal, rows, len(trace), chunks(stiffness.solve), work)
    rough = chunks(stiffness.roughly) if stiffness.mixed else None
    return replace(group, stiffness=stiffness, trace=trace, rough=rough)


def _schur_group(equal: Sequence[tuple[SparseBlock, slice]]) -> Group:
    """S from a dense K⁺, or through the factor of K_ii."""
    traced = equal[0][0].traced
    rows = [block.trace_rows for block, _ in equal]
    group = _group(equal, rows, len(traced.trace), traced.apply_schur, 0.0)
    if traced.schur is not None:
        group.take_dense(traced.schur)
        return group
    group.work = 2.0 * traced.stiffness.count
    if traced.inner is not None:
        group.work += 4.0 * (traced.coupling.count + traced.inner.entries)
    return group


def _stiffness_group(blocks: Sequence[tuple[SparseBlock, slice]]) -> Group:
    """K_bb of all subdomains as one sparse matrix, on one column."""
    traces = {id(block.traced): block.traced.stiffness.entries() for block, _ in blocks}
    matrices = [traces[id(block.traced)] for block, _ in blocks]
    begins = np.cumsum([0, *(K.shape[0] for K in matrices)])
    columns = [a + K.indices for a, K in zip(begins, matrices, strict=False)]
    table = np.cumsum(np.concatenate([[0], *(np.diff(K.indptr) for K in matrices)]))
    data, size = np.concatenate([K.data for K in matrices]), int(begins[-1])
    K_bb = LocalMatrix(Entries(data, np.concatenate(columns), table, (size, size)))
    rows = [a + block.trace_rows for a, (block, _) in zip(begins, blocks, strict=False)]
    group = _group(blocks, [np.concatenate(rows)], size, K_bb.__matmul__, 2.0 * K_bb.count)
    return replace(group, can_be_dense=False)


def _own_group(block: Block, kind: OperatorKind, part: slice) -> Group:
    """A Block of another class, one vector after the other."""
    apply, size = getattr(block, f"apply_{kind}"), len(block.trace_dofs)
    columns = partial(np.apply_along_axis, lambda w: apply(np.ascontiguousarray(w)), 0)
    return _group([(block, part)], [np.arange(size)], size, columns, 0.0)


def _group(
    blocks: Sequence[tuple[Block, slice]],
    rows: Sequence[Array],
    size: int,
    apply: Callable[[Array], Array],
    work: float,
) -> Group:
    """Return a group with these rows of its matrix in each column."""
    place = np.concatenate([k * size + row for k, row in enumerate(rows)])
    found = np.concatenate([np.arange(part.start, part.stop) for _, part in blocks])
    first, straight = int(found[0]), np.arange(size)
    as_it_stands = np.array_equal(place, straight) and np.array_equal(found, first + straight)
    where = slice(first, first + size) if as_it_stands else found
    return Group(len(blocks), size, len(rows), place, where, apply, work)


def _in_chunks(apply: Callable[[Array], Array], W: Array) -> Array:
    """A W, as many columns at a time as are good for the cache."""
    together = max(TOGETHER, NUMBERS // max(len(W), 1))
    if W.ndim == 1 or W.shape[1] <= together:
        return apply(W)
    out = np.empty(W.shape, order="F")
    for first in range(0, W.shape[1], together):
        some = slice(first, first + together)
        out[:, some] = apply(W[:, some])
    return out


# --- Local operators of all subdomains of a rank ----------------------------------------------


class LocalOperator(Protocol):
    """diag(A_s) over the subdomains of a rank, on its t trace unknowns. Nothing is collective.

    One object for the whole rank, so that an implementation may treat subdomains together: solve
    with several right sides, or share one matrix among equal subdomains. It may have ``forms``,
    the number of subdomains in each form, for the report.
    """

    def prepare(self) -> None:
        """Make what ``mult`` needs; errors are raised by ranks together."""

    def mult(self, w: Array, out: Array) -> None:
        """out = diag(A_s) w, shapes ``(t,)``; w stays as it is, all of out is set."""


class GroupedOperator:
    """Equal subdomains apply theirs at once, each group in the form that suits it."""

    def __init__(
        self, blocks: Sequence[Block], kind: OperatorKind, choice: LocalChoice | None = None
    ) -> None:
        self._blocks, self._kind, self._choice = blocks, kind, choice or LocalChoice()
        self._groups: list[Group] = []
        self.forms: Counter[str] = Counter()

    def prepare(self) -> None:
        """Let Blocks make what they need, and make dense matrices where they are chosen."""
        for block in self._blocks:
            block.prepare(self._kind)
        self._groups = groups_of(self._blocks, self._kind)
        for group in self._groups:
            if group.dense is None and group.prefers_dense(self._choice):
                A = _in_chunks(group.apply, np.eye(group.size, order="F"))
                A += A.T  # symmetric to the last bit
                group.take_dense(0.5 * A)
                if group.stiffness is not None:
                    group.stiffness.pinv_on = group.trace, group.dense
            form = "mixed" if group.rough else "implicit" if group.dense is None else "explicit"
            self.forms["shared_" * (group.columns > 1) + form] += group.count

    @property
    def mixed(self) -> bool:
        """Tell whether some subdomains apply theirs to single precision for less."""
        return self.forms["mixed"] > 0

    def mult(self, w: Array, out: Array, roughly: bool = False) -> None:
        """out = diag(A_s) w, shapes ``(t,)``; ``roughly``: to single precision where ``mixed``."""
        for group in self._groups:
            group.mult(w, out, roughly)
        self._groups.reverse()  # what a product has read last the next one finds in the cache
