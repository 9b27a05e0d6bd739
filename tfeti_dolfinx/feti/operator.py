"""The dual operators F = B K⁺ Bᵀ and its preconditioners."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array, entries_of_rows, joined, node_means
from tfeti_dolfinx.common.parallel import any_rank, summed
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.qp.problem import Operator
from tfeti_dolfinx.subdomains.local_operators import GroupedOperator, LocalOperator
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.subdomains.subdomains import Subdomains


def near_stiffness(blocks: Sequence[SparseBlock], rigid: int = 0) -> tuple[csr_array, Array]:
    """K between the trace unknowns of each subdomain and those that share a cell with them.

    Of ``rigid`` trace unknowns of rigid bodies, which come behind, it is 0. Return it on the trace
    unknowns of this rank, as ``Subdomains`` has them, and after them on the t_n ones next to them;
    and the mean of the diagonal of K at each node of these, shape ``(t_n,)``.
    """
    means, values = list[Array](), list[Array]()
    none: Array = np.empty(0, dtype=np.int64)
    rows, columns = [none], [none]
    start, end = 0, rigid + sum(len(block.trace_dofs) for block in blocks)
    for block in (block for block in blocks if len(block.trace_dofs)):
        trace, bs, K = block.traced.trace, block.bs, block.stiffness.K
        entries, _ = entries_of_rows(K, trace)
        entries = entries[K.data[entries] != 0.0]  # those between fixing nodes may be 0
        nodes = np.unique(K.indices[entries] // bs)
        reached = (bs * nodes[:, None] + np.arange(bs)).ravel()
        next_to = np.setdiff1d(reached, trace, assume_unique=True)
        kept = np.concatenate((trace, next_to))
        place = np.append(
            start + np.argsort(block.place[block.trace_dofs]), end + np.arange(len(next_to))
        )
        table, column, data = block.stiffness.product.part(kept, kept).getValuesCSR()
        rows.append(np.repeat(place, np.diff(table)))
        columns.append(place[column])
        values.append(data)
        means.append(node_means(block.stiffness.diagonal, bs)[next_to])
        start, end = start + len(trace), end + len(next_to)
    where = np.concatenate(rows), np.concatenate(columns)
    return csr_array((joined(values), where), shape=(end, end)), joined(means)


# --- The dual operator F = B K⁺ Bᵀ and its preconditioners ------------------------------------


@dataclass(frozen=True)
class Metric:
    """Energy norm in which displacements with given jumps are smoothed, on faces."""

    trace: LocalOperator  # K_bb
    # makes `near_stiffness`, where a subdomain of some rank hardly changes its volume; else None
    near: Callable[[], tuple[csr_array, Array]] | None
    hard: bool  # whether such a one is in space, where many steps cost less than they save


@dataclass(frozen=True)
class PreconditionerChoice:
    """Choice of the preconditioner."""

    # mean entries of a column of a subdomain's factor, from which on S is dear: to make it takes as
    # long as a twentieth of so many multiplications by F
    dear: float = 200.0
    # multiplications by the lumped one, beyond which S pays: friendly scenes have taken 26 to 40 to
    # 1e-6
    steps: int = 60
    # (λ + 2μ)/μ, 20 of ν = 0.474, from which on what is inside has to follow a trace
    volume: float = 20.0


CHOICE = PreconditionerChoice()


class DualOperator:
    """B diag(A_s) Bᵀ, diag(A_s) local to the ranks, with a count of multiplications.

    Args:
        B: Dual rows × trace unknowns, MPIAIJ (or scaled).
        local: diag(A_s) on this rank; what its ``prepare`` raises is raised on all ranks.
        metric: What displacements with given jumps are made smooth in before they come to
            diag(A_s); None: they stay as they are.

    Attributes:
        count: Multiplications since somebody has set it to 0.
        seconds: Seconds that diag(A_s) has taken on this rank, in ``times`` multiplications.
    """

    def __init__(self, B: PETSc.Mat, local: LocalOperator, metric: Metric | None = None) -> None:
        self.B, self.local, self.metric = B, local, metric
        self.count, self.seconds, self.times = 0, 0.0, 0
        self.added: Array | float = 0.0  # of rows of springs
        self._w, self._x = B.createVecs()
        self._v = self._w.duplicate()
        with raised_on_all_ranks(self._w.getComm().tompi4py()):
            local.prepare()
            if metric is not None:
                metric.trace.prepare()

    @property
    def rough(self) -> Operator | None:
        """The operator to single precision, if it costs less; else None. Collective."""
        mixed = isinstance(self.local, GroupedOperator) and self.local.mixed
        known = any_rank(self._w.getComm().tompi4py(), mixed)
        return partial(self, roughly=True) if known else None

    def __call__(self, x: Array, roughly: bool = False) -> Array:
        """B diag(A_s) Bᵀ x, from this rank's part of x to that of the product. Collective."""
        self._x.setArray(x)
        self.B.multTranspose(self._x, self._w)
        self.multiply(self._w.array_r, self._v.array, roughly)
        self.B.mult(self._v, self._x)
        return np.asarray(self._x.array_r + self.added * x)

    def multiply(self, w: Array, out: Array, roughly: bool = False) -> None:
        """out = diag(A_s) w on this rank's trace, which counts as a multiplication."""
        self.count += 1
        start = perf_counter()
        if roughly and isinstance(self.local, GroupedOperator):
            self.local.mult(w, out, roughly)
        else:
            self.local.mult(w, out)
        self.seconds, self.times = self.seconds + perf_counter() - start, self.times + 1

    def destroy(self) -> None:
        """Destroy the work vectors, not B. Collective."""
        for vec in (self._w, self._v, self._x):
            vec.destroy()


def scaled_rows(B: PETSc.Mat, weights: Array) -> PETSc.Mat:
    """B_D = B D⁻¹, (B D⁻¹ Bᵀ)⁻¹ B D⁻¹ for rows that are orthonormal in D⁻¹. Collective.

    With D the stiffness, the weights on this rank's trace unknowns, preconditioners built on B_D
    bear jumps of stiffness between subdomains (Klawonn, Widlund, Comm. Pure Appl. Math. 54, 2001,
    section 4).
    """
    scaled, inverse = B.copy(), B.createVecRight()
    inverse.array[:] = 1.0 / weights
    scaled.diagonalScale(None, inverse)
    inverse.destroy()
    return scaled


def dirichlet_preconditioner(B: PETSc.Mat, subdomains: Subdomains) -> DualOperator:
    """B S Bᵀ (Farhat, Mandel, Roux 1994), B or rather B_D; with a metric if sparse. Collective.

    From (λ + 2μ)/μ of ``CHOICE.volume`` on what is inside has to follow a trace, and in space in
    tangents, some of whose cells yield and keep their volumes.
    """
    sparse = [block for block in subdomains.elastic if isinstance(block, SparseBlock)]
    metric, comm = None, subdomains.comm
    if not any_rank(comm, len(sparse) < len(subdomains.elastic)):
        stiff = [
            block.bs
            for block in sparse
            if (subdomains.is_tangent and block.bs == 3)
            or block.stiffness.stretch_over_shear > CHOICE.volume
        ]
        rigid = sum(len(block.trace_dofs) for block in subdomains.blocks[len(sparse) :])
        near = partial(near_stiffness, sparse, rigid) if any_rank(comm, bool(stiff)) else None
        hard = any_rank(comm, 3 in stiff)
        metric = Metric(subdomains.local_operator("stiffness"), near, hard)
    return DualOperator(B, subdomains.local_operator("schur"), metric)


class LateDirichlet(DualOperator):
    """The lumped preconditioner for ``lumped_for`` multiplications; then that of Dirichlet.

    Directions of PCPG and of conjugate residuals are kept, so they go on through the change. At 0
    S is made as soon as it is needed, as where more solves come.
    """

    def __init__(self, B: PETSc.Mat, subdomains: Subdomains, lumped_for: int) -> None:
        super().__init__(B, subdomains.local_operator("stiffness"))
        self.lumped_for, self._subdomains = lumped_for, subdomains

    def make_if_due(self) -> None:
        """Make S where it is time. Collective.

        Raise a FactorError where the stiffness inside of a subdomain could not be factored.
        """
        if self.metric is None and self.times >= self.lumped_for:
            made = dirichlet_preconditioner(self.B, self._subdomains)
            self.local, self.metric = made.local, made.metric
            made.destroy()


def chosen_preconditioner(
    B: PETSc.Mat, subdomains: Subdomains, choice: PreconditionerChoice = CHOICE
) -> DualOperator:
    """Dirichlet's, or a late one where S is dear. Collective.

    Where a subdomain keeps its volume, or springs hold one, the lumped one takes many times as many
    steps; there, in tangents, in clusters, and beside other Blocks it is Dirichlet's.
    """
    if subdomains.is_tangent:
        return dirichlet_preconditioner(B, subdomains)
    sparse = [block for block in subdomains.elastic if isinstance(block, SparseBlock)]
    other = subdomains.num_clusters > 0 or len(sparse) < len(subdomains.elastic)
    dear = any(block.stiffness.entries > choice.dear * block.stiffness.size for block in sparse)
    held = any(block.kernel.shape[1] < block.modes.shape[1] for block in sparse)
    stiff = any(block.stiffness.stretch_over_shear > choice.volume for block in sparse)
    if any_rank(subdomains.comm, dear) and not any_rank(subdomains.comm, other or held or stiff):
        return LateDirichlet(B, subdomains, choice.steps)
    return dirichlet_preconditioner(B, subdomains)


def mean_stiffness(subdomains: Subdomains, weights: Array) -> float:
    """σ, the mean stiffness of a row scaled with D, the weights. Collective."""
    terms = np.array([np.sum(subdomains.diagonal / weights), len(weights)])
    stiffness, unknowns = summed(subdomains.comm, terms)
    return float(stiffness / max(unknowns, 1.0))


MakePreconditioner = Callable[[PETSc.Mat, Subdomains], DualOperator]
PRECONDITIONERS: dict[str, MakePreconditioner] = {
    # B K_bb Bᵀ (Farhat, Roux 1991), B or rather B_D
    "lumped": lambda B, subdomains: DualOperator(B, subdomains.local_operator("stiffness")),
    "dirichlet": dirichlet_preconditioner,
    "auto": chosen_preconditioner,
}
