"""F = B K⁺ Bᵀ, and its preconditioners: B does all the communication, the rest is local."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import raised_on_all_ranks, require
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.subdomains.local import LocalOperator
from tfeti_dolfinx.subdomains.near import NearStiffness
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.subdomains.subdomains import Subdomains

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
        """A trace vector. Collective."""
        ...


@dataclass(frozen=True)
class Metric:
    """What displacements with given jumps are made smooth in, on faces.

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
        """A trace vector. Collective."""
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
