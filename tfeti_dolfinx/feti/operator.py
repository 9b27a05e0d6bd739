"""The dual operators F = B K⁺ Bᵀ and its preconditioners."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from petsc4py import PETSc
from scipy.sparse import block_diag, csr_array

from tfeti_dolfinx.common.arrays import Array, joined, node_means, parts_of
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.errors import raised_on_all_ranks, require
from tfeti_dolfinx.subdomains.local_operators import LocalOperator
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- K on the trace and next to it ------------------------------------------------------------

# equal subdomains from which on they share a matrix: products with several are slow for few
SHARED = 16


class NearStiffness:
    """K between the trace unknowns of each subdomain and those that share a cell with them.

    Its vectors are the t trace unknowns of a rank, as ``Subdomains`` has them, and after them the
    t_n ones next to them. Many equal subdomains with equal traces share a matrix, all others have
    one together.

    Args:
        blocks: This rank's Blocks.

    Attributes:
        diagonal: Next to the trace, the mean of the diagonal of K at each node, shape ``(t_n,)``.
    """

    def __init__(self, blocks: Sequence[SparseBlock]) -> None:
        seen = [block for block in blocks if len(block.trace_dofs)]
        members: dict[int, list[int]] = {}
        for i, block in enumerate(seen):
            members.setdefault(id(block.traced), []).append(i)
        next_to = {of: _next_to(seen[first]) for of, (first, *_) in members.items()}
        own = [next_to[id(block.traced)] for block in seen]
        pairs = zip(seen, own, strict=True)
        means = [node_means(b.stiffness.diagonal, b.bs)[dofs] for b, dofs in pairs]
        self.diagonal = joined(means)
        traces = parts_of([len(block.trace_dofs) for block in seen])
        parts = parts_of([*([traces[-1].stop] if seen else []), *map(len, own)])[1:]
        places = [
            np.concatenate((trace.start + np.argsort(b.trace_place), np.arange(p.start, p.stop)))
            for b, trace, p in zip(seen, traces, parts, strict=True)
        ]
        self._products: list[tuple[csr_array, Array]] = []
        alone: list[tuple[csr_array, Array]] = []
        for of, equal in members.items():
            K = _restricted_to_rows(seen[equal[0]], next_to[of])
            if len(equal) < SHARED:
                alone += [(K, places[i]) for i in equal]
            else:
                self._products.append((K, np.stack([places[i] for i in equal], axis=1)))
        if alone:
            K = csr_array(block_diag([K for K, _ in alone], format="csr"))
            self._products.append((K, np.concatenate([place for _, place in alone])))

    def mult(self, u: Array, out: Array) -> None:
        """out = K u, shapes ``(t + t_n,)``; all of out is set."""
        for K, place in self._products:
            out[place] = K @ u[place]


def _next_to(block: SparseBlock) -> Array:
    """Unknowns of the stiffness that are not in the trace, of nodes that share a cell with it."""
    trace, bs = block.traced.trace, block.bs
    rows = block.stiffness.K[trace]
    rows.eliminate_zeros()  # entries between fixing nodes
    nodes = np.unique(rows.indices // bs)
    reached = (bs * nodes[:, None] + np.arange(bs)).ravel()
    return np.setdiff1d(reached, trace, assume_unique=True)


def _restricted_to_rows(block: SparseBlock, next_to: Array) -> csr_array:
    """K on the trace, ascending, and on these unknowns."""
    kept = np.concatenate((block.traced.trace, next_to))
    return csr_array(block.stiffness.K[kept][:, kept])


# --- The dual operator F = B K⁺ Bᵀ and its preconditioners ------------------------------------

# (λ + 2μ)/μ: 20 of ν = 0.474; from here on what is inside has to follow where a trace moves
VOLUME = 20.0


class RowMatrix(Protocol):
    """B, or something that stands for it between dual and trace vectors."""

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = B x; x may be overwritten. Collective."""
        ...

    def multTranspose(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Bᵀ x. Collective."""
        ...

    def createVecRight(self) -> PETSc.Vec:
        """Return a trace vector. Collective."""
        ...


@dataclass(frozen=True)
class Metric:
    """Energy norm in which displacements with given jumps are smoothed, on faces.

    Attributes:
        trace: K_bb.
        near: Makes K on the trace and on what is next to it, where a subdomain of some rank hardly
            changes its volume; else None.
        hard: Whether such a one is in space, where many steps cost less than they save.
    """

    trace: LocalOperator
    near: Callable[[], NearStiffness] | None
    hard: bool


class DualOperator:
    """B diag(A_s) Bᵀ, diag(A_s) local to the ranks, with a count of multiplications.

    Args:
        B: Dual rows × trace unknowns, MPIAIJ (or scaled).
        local: diag(A_s) on this rank; what its ``prepare`` raises is raised on all ranks.
        metric: What displacements with given jumps are made smooth in before they come to
            diag(A_s); None: they stay as they are.

    Attributes:
        count: Multiplications so far, by who they are charged to (``"solver"`` by default).
    """

    def __init__(self, B: RowMatrix, local: LocalOperator, metric: Metric | None = None) -> None:
        self.B, self.local, self.metric = B, local, metric
        self.count: Counter[str] = Counter()
        self._payer, self._seconds, self._times = "solver", 0.0, 0
        self._w, self._v = B.createVecRight(), B.createVecRight()
        with raised_on_all_ranks(self._w.getComm().tompi4py()):
            local.prepare()
            if metric is not None:
                metric.trace.prepare()

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
        self.B.multTranspose(x, self._w)
        self.multiply(self._w.array_r, self._v.array)
        self.B.mult(self._v, y)

    def multiply(self, w: Array, out: Array) -> None:
        """out = diag(A_s) w on this rank's trace, which counts as a multiplication."""
        self.count[self._payer] += 1
        start = perf_counter()
        self.local.mult(w, out)
        self._seconds, self._times = self._seconds + perf_counter() - start, self._times + 1

    @property
    def local_seconds(self) -> float:
        """Seconds that diag(A_s) has taken on this rank, on average of all multiplications."""
        return self._seconds / max(self._times, 1)

    def destroy(self) -> None:
        """Destroy the work vectors and the local operator, not B. Collective."""
        self.local.destroy()
        if self.metric is not None:
            self.metric.trace.destroy()
        self._w.destroy()
        self._v.destroy()


def dual_operator(B: PETSc.Mat, subdomains: Subdomains) -> DualOperator:
    """F = B K⁺ Bᵀ. Collective."""
    return DualOperator(B, subdomains.local_operator("pinv"))


class ScaledRows:
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
        """Return a trace vector. Collective."""
        return self.B.createVecRight()

    def destroy(self) -> None:
        """Destroy D, not B. Collective."""
        self._inverse.destroy()


def lumped_preconditioner(B: RowMatrix, subdomains: Subdomains) -> DualOperator:
    """B K_bb Bᵀ (Farhat, Roux 1991), B or rather B_D. Collective."""
    return DualOperator(B, subdomains.local_operator("stiffness"))


def dirichlet_preconditioner(B: RowMatrix, subdomains: Subdomains) -> DualOperator:
    """B S Bᵀ (Farhat, Mandel, Roux 1994), B or rather B_D; with a metric if sparse. Collective."""
    sparse = [block for block in subdomains.blocks if isinstance(block, SparseBlock)]
    metric, comm = None, subdomains.comm
    if not any_rank(comm, len(sparse) < len(subdomains.blocks)):
        stiff = [block.bs for block in sparse if block.stiffness.stretch_over_shear > VOLUME]
        near = partial(NearStiffness, sparse) if any_rank(comm, bool(stiff)) else None
        hard = any_rank(comm, 3 in stiff)
        metric = Metric(subdomains.local_operator("stiffness"), near, hard)
    return DualOperator(B, subdomains.local_operator("schur"), metric)


MakePreconditioner = Callable[[RowMatrix, Subdomains], DualOperator]
PRECONDITIONERS: dict[str, MakePreconditioner] = {
    "lumped": lumped_preconditioner,
    "dirichlet": dirichlet_preconditioner,
}


def linear_term(B: PETSc.Mat, c: PETSc.Vec, subdomains: Subdomains) -> PETSc.Vec:
    """d = B K⁺ f − c. Collective."""
    v, d = B.createVecRight(), c.duplicate()
    v.array[:] = subdomains.pinv_load[subdomains.trace]
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
