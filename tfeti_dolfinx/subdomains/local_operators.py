"""K⁺, K_bb and S of all subdomains of a rank, in the form that costs least."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.sparse import block_diag, csr_array

from tfeti_dolfinx.common.arrays import Array, parts_of
from tfeti_dolfinx.subdomains.block import Block, OperatorKind
from tfeti_dolfinx.subdomains.factor import REAL, FactorSize
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.subdomains.stiffness import (
    Packed,
    Stiffness,
    SymmetricMatrix,
    Traced,
    made_dense,
)

# --- Cost model of local operators ------------------------------------------------------------

# What one core of a few years ago does; of a faster one all times are shorter alike, and only their
# ratios choose. Bytes read from memory, and operations of sweeps over a factor and of dense
# products of matrices, each per second; seconds of a call that comes through Python and PETSc.
BANDWIDTH, SWEEPS, PRODUCTS, CALL = 1.2e10, 9e9, 1.6e10, 2e-5
# Seconds of one entry of a sparse matrix times one number, and bytes of its column.
SPARSE_ENTRY, INDEX = 1.2e-9, 4
# Right sides that go through a factor at once: enough that it is not read for each, and few enough
# that they fit beside it into the cache.
TOGETHER = 32


@dataclass(frozen=True)
class Cost:
    """Seconds, by the model.

    Attributes:
        setup: Of making it, but for factors.
        multiplication: Of one multiplication.
        traffic: Bytes that one multiplication reads and writes.
    """

    setup: float
    multiplication: float
    traffic: float = 0.0

    def of(self, multiplications: int) -> float:
        """All of so many multiplications."""
        return self.setup + multiplications * self.multiplication


def sweeps(factor: FactorSize, n: int, count: int) -> float:
    """Return seconds of a solve with a factor of n unknowns and as many right sides."""
    reading = sweeps_traffic(factor, n, count) / BANDWIDTH
    return max(reading, 4.0 * factor.entries * count / SWEEPS) + CALL * -(-count // TOGETHER)


def sweeps_traffic(factor: FactorSize, n: int, count: int) -> float:
    """Return bytes that go through memory for it: the factor twice, and the right sides."""
    return 2.0 * -(-count // TOGETHER) * factor.memory + 4.0 * REAL * n * count


def sparse_traffic(entries: int, count: int) -> float:
    """Return bytes that go through memory for products of a sparse matrix with as many vectors."""
    return (REAL + INDEX) * entries * count


def sparse_products(entries: int, count: int) -> float:
    """Return seconds of products of a sparse matrix with as many vectors."""
    return SPARSE_ENTRY * entries * count + CALL


def dense_product(t: int, count: int) -> float:
    """Return seconds of a product of a dense symmetric t × t matrix with as many vectors."""
    reading = dense_traffic(t, count) / BANDWIDTH
    if count == 1:
        return reading + CALL
    return max(reading, 2.0 * t * t * count / PRODUCTS) + CALL


def dense_traffic(t: int, count: int) -> float:
    """Return bytes that go through memory for it; of a matrix that is used alone half is stored."""
    if count == 1:
        return REAL * t * t / 2.0
    return REAL * (t * t + 4.0 * t * count)


# --- K⁺, K_bb and S on a trace, applied through factors ---------------------------------------

# Of the stiffness of a node: what K⁺ makes of forces of size 1 on a sound subdomain stays far below
# it. Above it, where springs or soft parts hardly hold a subdomain, the parts of K⁺ w that cancel
# are so large that a dense product loses two or three times as much to rounding as a factor does.
HARDLY_HELD = 1e5


class TraceMatrix(Protocol):
    """A symmetric matrix on a trace, applied as cheaply as factors allow.

    Attributes:
        size: Number of its rows, t.
        has_dense: Whether there is use in a dense one.
    """

    size: int
    has_dense: bool

    @property
    def is_sound(self) -> bool:
        """True if the dense matrix rounds no worse than the factors; may cost a solve."""
        ...

    def apply(self, W: Array) -> Array:
        """A W, shapes ``(t, q)``."""
        ...

    def seconds(self, count: int) -> float:
        """Return the modelled seconds of ``apply`` to so many vectors."""
        ...

    def traffic(self, count: int) -> float:
        """Return bytes that ``apply`` to so many vectors moves, by the model."""
        ...

    def dense(self, packed: bool) -> Packed | SymmetricMatrix:
        """Return the same, dense."""
        ...


class PinvMatrix:
    """K⁺ on a trace.

    Args:
        stiffness: The stiffness.
        trace: Trace unknowns of it, ascending.
    """

    has_dense = True

    def __init__(self, stiffness: Stiffness, trace: Array) -> None:
        self._stiffness, self._trace, self.size = stiffness, trace, len(trace)

    @property
    def is_sound(self) -> bool:
        """True if random unit forces move the trace no more than in a well-held subdomain."""
        if self.size == 0:
            return True
        forces = np.random.default_rng(0).standard_normal((self.size, 1))
        largest = self._stiffness.diagonal[self._trace].max()
        return bool(np.abs(self.apply(forces)).max() * largest <= HARDLY_HELD)

    def apply(self, W: Array) -> Array:
        """K⁺ W, through the factor, as many right sides at once as are good for the cache."""
        out = np.empty(W.shape, order="F")
        for first in range(0, W.shape[1], TOGETHER):
            some = slice(first, first + TOGETHER)
            B = np.zeros((self._stiffness.size, W[:, some].shape[1]), order="F")
            B[self._trace] = W[:, some]
            out[:, some] = self._stiffness.solve(B)[self._trace]
        return out

    def seconds(self, count: int) -> float:
        """Return the modelled seconds of ``apply`` to so many vectors."""
        return sweeps(self._stiffness.factor_size, self._stiffness.size, count)

    def traffic(self, count: int) -> float:
        """Return bytes that ``apply`` to so many vectors moves, by the model."""
        return sweeps_traffic(self._stiffness.factor_size, self._stiffness.size, count)

    def dense(self, packed: bool) -> Packed | SymmetricMatrix:
        """Return the same, dense; kept for the next operator on this trace."""
        key = packed, self._trace.tobytes()
        kept = self._stiffness.dense_pinv
        if kept is None or kept[0] != key:
            self._stiffness.dense_pinv = None  # two of them might be too large
            kept = self._stiffness.dense_pinv = (key, _made(self, packed))
        return kept[1]


class SchurMatrix:
    """S on a trace.

    Args:
        traced: The stiffness on the trace.
    """

    has_dense = True

    def __init__(self, traced: Traced) -> None:
        self._traced, self.size = traced, len(traced.trace)

    @property
    def is_sound(self) -> bool:
        """Yes: S is of the size of K."""
        return True

    def apply(self, W: Array) -> Array:
        """S W, through the factor of K_ii."""
        return self._traced.apply_schur(W)

    def seconds(self, count: int) -> float:
        """Return the modelled seconds of ``apply`` to so many vectors."""
        inner = self._traced.inner
        products = sparse_products(self._traced.K_bb.nnz, count)
        if inner is None:
            return products
        products += 2.0 * sparse_products(self._traced.K_ib.nnz, count)
        return products + sweeps(inner.size, self._traced.K_ib.shape[0], count)

    def traffic(self, count: int) -> float:
        """Return bytes that ``apply`` to so many vectors moves, by the model."""
        inner, K_ib = self._traced.inner, self._traced.K_ib
        products = sparse_traffic(self._traced.K_bb.nnz, count)
        if inner is None:
            return products
        products += 2.0 * sparse_traffic(K_ib.nnz, count)
        return products + sweeps_traffic(inner.size, K_ib.shape[0], count)

    def dense(self, packed: bool) -> Packed | SymmetricMatrix:
        """Return the same, dense."""
        return _made(self, packed)


class StiffnessMatrix:
    """K_bb on a trace: sparse as it is.

    Args:
        K_bb: scipy CSR, shape ``(t, t)``.
    """

    has_dense = False

    def __init__(self, K_bb: Any) -> None:
        self._K_bb, self.size = K_bb, K_bb.shape[0]

    @property
    def is_sound(self) -> bool:
        """There is no dense one."""
        return True

    def apply(self, W: Array) -> Array:
        """K_bb W."""
        return np.asarray(self._K_bb @ W)

    def seconds(self, count: int) -> float:
        """Return the modelled seconds of ``apply`` to so many vectors."""
        return sparse_products(self._K_bb.nnz, count)

    def traffic(self, count: int) -> float:
        """Return bytes that ``apply`` to so many vectors moves, by the model."""
        return sparse_traffic(self._K_bb.nnz, count)

    def dense(self, packed: bool) -> Packed | SymmetricMatrix:
        """Return the same, dense."""
        return _made(self, packed)


class OwnMatrix:
    """Matrix of a Block of another class, applied to one vector after the other.

    Args:
        apply: A w, shapes ``(t,)``.
        size: t.
    """

    has_dense = True

    def __init__(self, apply: Callable[[Array], Array], size: int) -> None:
        self._apply, self.size = apply, size

    @property
    def is_sound(self) -> bool:
        """Nothing is known against it."""
        return True

    def apply(self, W: Array) -> Array:
        """A W."""
        return np.stack([self._apply(np.ascontiguousarray(w)) for w in W.T], axis=1)

    def seconds(self, count: int) -> float:
        """Nothing is known of it: 0, so that it stays as it is."""
        return 0.0

    def traffic(self, count: int) -> float:
        """Return bytes that ``apply`` to so many vectors moves, by the model."""
        return 0.0

    def dense(self, packed: bool) -> Packed | SymmetricMatrix:
        """Return the same, dense."""
        return _made(self, packed)


def _made(matrix: TraceMatrix, packed: bool) -> Packed | SymmetricMatrix:
    A = made_dense(matrix.apply, matrix.size, TOGETHER)
    return Packed(A) if packed else SymmetricMatrix(A)


# --- Groups of Blocks with one matrix ---------------------------------------------------------


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
    """Form in which a group applies its matrix.

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
    """Return the form of a group, one of a type or what the model says is cheapest."""
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


# --- Local operators of all subdomains of a rank ----------------------------------------------

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
    """Choice of the form of local operators.

    Attributes:
        type: One of ``LOCAL_TYPES``.
        multiplications: How many to expect.
    """

    type: str = "auto"
    multiplications: int = 50

    @property
    def shares(self) -> bool:
        """True if equal subdomains share their stiffness."""
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
    """Return the local operator of a rank: the one place that chooses its form."""
    return GroupedOperator(blocks, kind, choice)
