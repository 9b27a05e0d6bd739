"""K⁺, K_bb and S of all subdomains of a rank, in the form that costs least."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.linalg.blas import dsymm, dsymv
from scipy.sparse import block_diag, csr_array

from tfeti_dolfinx.common.arrays import Array, parts_of
from tfeti_dolfinx.subdomains.block import Block, OperatorKind
from tfeti_dolfinx.subdomains.factor import FactorSize
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.subdomains.stiffness import Stiffness, Traced

# --- Cost model of local operators ------------------------------------------------------------


@dataclass(frozen=True)
class Cost:
    """Cost of a product, by the model.

    Attributes:
        seconds: Seconds.
        traffic: Bytes that go through memory.
    """

    seconds: float = 0.0
    traffic: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.seconds + other.seconds, self.traffic + other.traffic)


@dataclass(frozen=True)
class CostModel:
    """Speed of one core of a few years ago; of a faster one only ratios of times choose.

    Attributes:
        bandwidth: Bytes read from memory per second.
        sweeps: Operations per second of sweeps over a factor.
        products: Operations per second of dense products of matrices.
        call: Seconds of a call that comes through Python and PETSc.
        sparse_entry: Seconds of an entry of a sparse matrix times one number.
        together: Right sides that go through a factor at once: enough that it is not read for
            each, and few enough that they fit beside it into the cache.
        real: Bytes of a number.
        index: Bytes of a column of a sparse matrix.
    """

    bandwidth: float = 1.2e10
    sweeps: float = 9e9
    products: float = 1.6e10
    call: float = 2e-5
    sparse_entry: float = 1.2e-9
    together: int = 32
    real: int = 8
    index: int = 4

    def solve(self, factor: FactorSize, n: int, count: int) -> Cost:
        """Return the cost of a solve with a factor of n unknowns and as many right sides."""
        passes = -(-count // self.together)
        traffic = 2.0 * passes * factor.memory + 4.0 * self.real * n * count
        work = 4.0 * factor.entries * count / self.sweeps
        return Cost(max(traffic / self.bandwidth, work) + self.call * passes, traffic)

    def sparse(self, entries: int, count: int) -> Cost:
        """Return the cost of products of a sparse matrix with as many vectors."""
        seconds = self.sparse_entry * entries * count + self.call
        return Cost(seconds, float((self.real + self.index) * entries * count))

    def dense(self, t: int, count: int) -> Cost:
        """Return the cost of a dense symmetric t × t matrix times as many vectors."""
        if count == 1:  # half of it is read
            traffic, work = self.real * t * t / 2.0, 0.0
        else:
            traffic = self.real * (t * t + 4.0 * t * count)
            work = 2.0 * t * t * count / self.products
        return Cost(max(traffic / self.bandwidth, work) + self.call, traffic)


MODEL = CostModel()

# --- Matrices on a trace ----------------------------------------------------------------------


@dataclass(frozen=True)
class TraceMatrix:
    """A symmetric matrix on a trace, which all Blocks of a group apply.

    Attributes:
        size: Number of its rows, t.
        apply: A W, shapes ``(t, q)``.
        cost: Cost of ``apply`` to so many vectors.
        can_be_dense: Whether there is use in a dense one.
    """

    size: int
    apply: Callable[[Array], Array]
    cost: Callable[[int], Cost]
    can_be_dense: bool = True

    def dense(self) -> Array:
        """Return the matrix, symmetric to the last bit, by columns."""
        A = np.empty((self.size, self.size), order="F")
        for first in range(0, self.size, MODEL.together):
            last = min(first + MODEL.together, self.size)
            unit = np.zeros((self.size, last - first), order="F")
            unit[np.arange(first, last), np.arange(last - first)] = 1.0
            A[:, first:last] = self.apply(unit)
        A += A.T
        A *= 0.5
        return A


def pinv_matrix(stiffness: Stiffness, trace: Array) -> TraceMatrix:
    """K⁺ on a trace, through the factor, with as many right sides as are good for the cache."""

    def apply(W: Array) -> Array:
        out = np.empty(W.shape, order="F")
        for first in range(0, W.shape[1], MODEL.together):
            some = slice(first, first + MODEL.together)
            B = np.zeros((stiffness.size, W[:, some].shape[1]), order="F")
            B[trace] = W[:, some]
            out[:, some] = stiffness.solve(B)[trace]
        return out

    cost = partial(MODEL.solve, stiffness.factor_size, stiffness.size)
    return TraceMatrix(len(trace), apply, cost)


def schur_matrix(traced: Traced) -> TraceMatrix:
    """S on a trace, through the factor of K_ii."""

    def cost(count: int) -> Cost:
        products = MODEL.sparse(traced.K_bb.nnz, count)
        if traced.inner is None:
            return products
        across = MODEL.sparse(traced.K_ib.nnz, count)
        return (
            products + across + across + MODEL.solve(traced.inner.size, len(traced.inside), count)
        )

    return TraceMatrix(len(traced.trace), traced.apply_schur, cost)


def stiffness_matrix(K_bb: Any) -> TraceMatrix:
    """K_bb on a trace: sparse as it is."""
    cost = partial(MODEL.sparse, K_bb.nnz)
    return TraceMatrix(K_bb.shape[0], lambda W: np.asarray(K_bb @ W), cost, can_be_dense=False)


def own_matrix(block: Block, kind: OperatorKind) -> TraceMatrix:
    """Matrix of a Block of another class, one vector after the other; it costs nothing known."""
    apply = getattr(block, f"apply_{kind}")

    def columns(W: Array) -> Array:
        return np.stack([apply(np.ascontiguousarray(w)) for w in W.T], axis=1)

    return TraceMatrix(len(block.trace_dofs), columns, lambda count: Cost())


# --- Groups of Blocks with one matrix ---------------------------------------------------------


@dataclass
class Group:
    """Blocks of equal subdomains, one alone, or some whose sparse matrices are one.

    Attributes:
        matrix: The matrix that all apply.
        count: Number of Blocks.
        columns: Of what the matrix is applied to: one for each Block, or one for all.
        place: Where the trace unknowns go in an array of columns, the first column first.
        where: Where they lie among those of the rank.
        dense: The matrix, dense, where that is cheaper.
    """

    matrix: TraceMatrix
    count: int
    columns: int
    place: Array
    where: Array
    dense: Array | None = None

    @classmethod
    def of(cls, matrix: TraceMatrix, rows: Sequence[Array], parts: Sequence[slice]) -> Group:
        """Return the group of Blocks whose trace unknowns are these rows of the matrix.

        Args:
            matrix: The matrix.
            rows: Rows for each column.
            parts: Where the trace unknowns of each Block lie among those of the rank.
        """
        place = np.concatenate([k * matrix.size + row for k, row in enumerate(rows)])
        where = np.concatenate([np.arange(part.start, part.stop) for part in parts])
        return cls(matrix, len(parts), len(rows), place, where)

    def prefers_dense(self, local_type: str, multiplications: int) -> bool:
        """Return whether the group takes a dense matrix: by its type, or as the model says."""
        matrix, columns = self.matrix, self.columns
        if local_type == "implicit" or not matrix.can_be_dense:
            return False
        if local_type == "explicit":
            return True
        if local_type == "shared" and columns == 1:
            return False
        setup, once = matrix.cost(matrix.size).seconds, matrix.cost(columns).seconds
        dense = setup + multiplications * MODEL.dense(matrix.size, columns).seconds
        return multiplications * once > dense


def groups_of(blocks: Sequence[Block], kind: OperatorKind) -> list[Group]:
    """Return groups that are as large as possible; Blocks without a trace have nothing to apply.

    K_bb of subdomains that have none equal to them are one sparse matrix.
    """
    parts = parts_of([len(block.trace_dofs) for block in blocks])
    members: dict[int, list[tuple[SparseBlock, slice]]] = {}
    groups = []
    for block, part in zip(blocks, parts, strict=True):
        if len(block.trace_dofs) == 0:
            continue
        if isinstance(block, SparseBlock):
            shared = block.stiffness if kind == "pinv" else block.traced
            members.setdefault(id(shared), []).append((block, part))
        else:
            own = own_matrix(block, kind)
            groups.append(Group.of(own, [np.arange(own.size)], [part]))
    alone = [equal[0] for equal in members.values() if len(equal) == 1 and kind == "stiffness"]
    for equal in members.values():
        if kind == "stiffness" and len(equal) == 1:
            continue
        own_parts, first = [part for _, part in equal], equal[0][0]
        if kind == "pinv":
            # K⁺ on a part of a trace is a part of K⁺ on the trace, so that all may be joined
            trace = np.unique(np.concatenate([block.trace_place for block, _ in equal]))
            matrix = pinv_matrix(first.stiffness, trace)
            rows = [np.searchsorted(trace, block.trace_place) for block, _ in equal]
        else:
            schur, traced = kind == "schur", first.traced
            matrix = schur_matrix(traced) if schur else stiffness_matrix(traced.K_bb)
            rows = [block.trace_rows for block, _ in equal]
        groups.append(Group.of(matrix, rows, own_parts))
    if alone:
        K_bb = [block.traced.K_bb for block, _ in alone]
        begins = np.cumsum([0, *(K.shape[0] for K in K_bb)])
        rows = [a + block.trace_rows for a, (block, _) in zip(begins[:-1], alone, strict=True)]
        matrix = stiffness_matrix(csr_array(block_diag(K_bb, format="csr")))
        groups.append(Group.of(matrix, [np.concatenate(rows)], [part for _, part in alone]))
    return groups


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
        stiffness = equal[0][0].stiffness
        for first in range(0, len(equal), MODEL.together):
            some = equal[first : first + MODEL.together]
            columns = np.empty((stiffness.size, len(some)), order="F")
            for j, (block, part) in enumerate(some):
                columns[block.place, j] = b[part]
            columns = stiffness.solve(columns)
            for j, (block, part) in enumerate(some):
                x[part] = columns[block.place, j]
    return x


# --- Local operators of all subdomains of a rank ----------------------------------------------

LOCAL_TYPES = ("auto", "implicit", "explicit", "shared")


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


class GroupedOperator:
    """Equal subdomains apply theirs at once, each group in the form that suits it.

    Args:
        blocks: This rank's Blocks.
        kind: ``"pinv"``, ``"stiffness"`` or ``"schur"``.
        choice: Which form groups take.

    Attributes:
        predicted, traffic, forms: As of ``ModelledOperator``.
    """

    def __init__(
        self, blocks: Sequence[Block], kind: OperatorKind, choice: LocalChoice | None = None
    ) -> None:
        self._blocks, self._kind, self._choice = blocks, kind, choice or LocalChoice()
        self._groups: list[Group] = []
        self.predicted, self.traffic = 0.0, 0.0
        self.forms: Counter[str] = Counter()

    def prepare(self) -> None:
        """Let Blocks make what they need, and make dense matrices where they are chosen."""
        for block in self._blocks:
            block.prepare(self._kind)
        self._groups = groups_of(self._blocks, self._kind)
        for group in self._groups:
            cost, form = group.matrix.cost(group.columns), "implicit"
            if group.prefers_dense(self._choice.type, self._choice.multiplications):
                group.dense = group.matrix.dense()
                cost, form = MODEL.dense(group.matrix.size, group.columns), "explicit"
            self.predicted += cost.seconds
            self.traffic += cost.traffic
            self.forms["shared_" * (group.columns > 1) + form] += group.count

    def mult(self, w: Array, out: Array) -> None:
        """out = diag(A_s) w, shapes ``(t,)``."""
        for group in self._groups:
            size, q, A = group.matrix.size, group.columns, group.dense
            columns = np.zeros(q * size)
            columns[group.place] = w[group.where]
            if A is None:
                product = group.matrix.apply(columns.reshape((size, q), order="F"))
            elif q == 1:
                product = dsymv(1.0, A, columns)
            else:
                product = dsymm(1.0, A, columns.reshape((size, q), order="F"))
            out[group.where] = product.ravel(order="F")[group.place]

    def destroy(self) -> None:
        """Let dense matrices go; the factors are the Blocks'."""
        self._groups = []
