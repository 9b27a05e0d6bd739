"""The natural coarse space: G = Rᵀ Bᵀ, its projectors, and motions that no row of B resists."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.operator import trace_slices
from tfeti_dolfinx.errors import FactorError, raised_on_all_ranks
from tfeti_dolfinx.parallel import chunk_offsets
from tfeti_dolfinx.subdomains.block import Block
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

NULL = 1e-14


class CoarseSpace:
    """G, GGᵀ and what follows from them; the r-vectors are replicated on all ranks.

    Args:
        B: Dual rows × trace unknowns.
        blocks: This rank's Blocks.
        body_of_block: Body of each of them.
        num_bodies: Number of bodies on all ranks.
        comm: Communicator. The constructor and all methods are collective.
        prefix: Prefix of the factor's PETSc options.

    Attributes:
        dimension: r, the dimension of the kernel of K.
        e: Rᵀ f, shape ``(r,)``.
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        body_modes: Kernel coordinates of the bodies' candidate modes, scipy CSR, shape
            ``(r, bodies * k)``.
        free_motions: Motions of the bodies that no row resists, as ``null_motions`` gives them.
        free_modes: Orthonormal basis of null(Gᵀ), shape ``(r, number of free modes)``.
    """

    def __init__(
        self,
        B: PETSc.Mat,
        blocks: Sequence[Block],
        body_of_block: Array,
        num_bodies: int,
        comm: MPI.Intracomm,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self.comm = comm
        sizes = np.array([block.kernel.shape[1] for block in blocks], dtype=np.int64)
        offsets = chunk_offsets(comm, int(sizes.sum()))
        self.dimension = int(offsets[-1])
        starts = offsets[comm.rank] + np.concatenate(([0], np.cumsum(sizes)))
        self._starts, self._sizes = starts, sizes
        self.Gt = _transposed_G(B, blocks, starts, self.dimension)
        self.update_load(blocks)
        self.body_modes, self._defect = _body_modes(
            blocks, starts, self.dimension, body_of_block, num_bodies, comm
        )
        self.free_motions = self.null_motions()
        self.free_modes = self.modes_of(self.free_motions)
        gram = self.gram()
        with raised_on_all_ranks(comm):
            try:
                self._factor = SemidefiniteFactor(gram, self.free_modes, prefix)
            except FactorError as error:
                raise type(error)(f"GGᵀ of the coarse problem: {error}") from error

    def update_load(self, blocks: Sequence[Block]) -> None:
        """Replace e = Rᵀ f by that of the Blocks' present loads."""
        local = [block.kernel_load for block in blocks]
        self.e = np.concatenate(self.comm.allgather(np.concatenate([np.empty(0), *local])))

    def alpha_of(self, alpha: Array) -> list[Array]:
        """The parts of an r-vector that belong to this rank's Blocks."""
        return [alpha[a : a + n] for a, n in zip(self._starts, self._sizes, strict=False)]

    def G(self, x: Array) -> Array:
        """G x, shape ``(r,)``, from this rank's part of x."""
        y = self.Gt.T @ x
        self.comm.Allreduce(MPI.IN_PLACE, y, op=MPI.SUM)
        return np.asarray(y)

    def solve(self, y: Array) -> Array:
        """(GGᵀ)⁺ y for y in the range of G, orthogonal to the free modes."""
        return self._factor.solve(y)

    def apply_Q(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = Gᵀ(GGᵀ)⁻¹G x."""
        self.combine(self.coordinates(x), y)

    def norm_Q(self, x: PETSc.Vec) -> float:
        """‖Q x‖."""
        Gx = self.G(x.array_r)
        return float(np.sqrt(max(float(Gx @ self.solve(Gx)), 0.0)))

    def particular(self, x: PETSc.Vec) -> None:
        """x = Gᵀ(GGᵀ)⁻¹e."""
        self.combine(self.solve(self.e), x)

    def coordinates(self, x: PETSc.Vec) -> Array:
        """(GGᵀ)⁻¹G x, shape ``(r,)``."""
        return self.solve(self.G(x.array_r))

    def combine(self, mu: Array, x: PETSc.Vec) -> None:
        """x = Gᵀ μ. Not collective."""
        x.array[:] = self.Gt @ mu

    def gram(self, rows: Array | None = None) -> csr_array:
        """GGᵀ, or G_f G_fᵀ of the local rows flagged, shape ``(r, r)``; replicated."""
        Gt = self.Gt if rows is None else self.Gt[rows]
        local = (Gt.T @ Gt).tocoo()
        row, column = (np.concatenate(self.comm.allgather(index)) for index in local.coords)
        value = np.concatenate(self.comm.allgather(local.data))
        return coo_array((value, (row, column)), shape=(self.dimension,) * 2).tocsr()

    def body_gram(self, rows: Array | None = None) -> Array:
        """How rows and springs resist the bodies' modes, shape ``(bodies * k,) * 2``; replicated.

        Gram matrix of B R Z on the rows flagged, Z the modes, plus what of Z no kernel holds.
        """
        J = (self.Gt if rows is None else self.Gt[rows]) @ self.body_modes
        gram = (J.T @ J).toarray()
        self.comm.Allreduce(MPI.IN_PLACE, gram, op=MPI.SUM)
        return gram + self._defect

    @cached_property
    def motion_basis(self) -> Array:
        """Basis of the bodies' motions, of unit size each, shape ``(bodies * k, count)``."""
        size = (self.body_modes.T @ self.body_modes).toarray() + self._defect
        return _metric_basis(size)

    def null_motions(self, rows: Array | None = None) -> Array:
        """Motions of the bodies that Gᵀ (or the rows flagged of it) does not resist.

        The null space of Gᵀ lives on the bodies' modes: a motion that no gluing row resists is
        the same in all subdomains of a body.

        Returns:
            Coefficients of the bodies' modes as columns, shape ``(bodies * k, count)``.
        """
        basis = self.motion_basis
        values, vectors = np.linalg.eigh(basis.T @ self.body_gram(rows) @ basis)
        free = values <= NULL * max(values.max(initial=0.0), 1.0)
        return basis @ vectors[:, free]

    def modes_of(self, motions: Array) -> Array:
        """Orthonormal basis of motions in kernel coordinates, shape ``(r, count)``."""
        modes = self.body_modes @ motions
        return np.linalg.qr(modes)[0] if modes.shape[1] else modes

    def destroy(self) -> None:
        """Free the factor."""
        self._factor.destroy()


class SemidefiniteFactor:
    """A⁺ of a sparse positive semidefinite A with a known null space, on each rank.

    A + σ E Eᵀ, E unit vectors of entries that determine the null modes: an exact generalised
    inverse for right sides orthogonal to them.

    Args:
        A: scipy CSR, shape ``(r, r)``.
        null: Orthonormal basis of its null space, shape ``(r, k)``.
        prefix: Prefix of the factor's PETSc options.
    """

    def __init__(self, A: csr_array, null: Array, prefix: str = "tfeti_coarse_") -> None:
        self._null = null
        pinned = np.zeros(A.shape[0])
        pinned[_independent_rows(null)] = A.diagonal().max(initial=1.0)
        regular = csr_array(A + diags_array(pinned))
        self._factor = CholeskyFactor(regular, prefix) if A.shape[0] else None

    def solve(self, y: Array) -> Array:
        """A⁺ y up to null modes that are removed, y orthogonal to them."""
        if self._factor is None:
            return y
        if self._null.shape[1] == 0:
            return self._factor.solve(y)
        x = self._factor.solve(y - self._null @ (self._null.T @ y))
        return np.asarray(x - self._null @ (self._null.T @ x))

    def destroy(self) -> None:
        """Free the factor."""
        if self._factor is not None:
            self._factor.destroy()


def _independent_rows(null: Array) -> Array:
    """As many rows as columns, chosen by pivoting, on which the columns are independent."""
    from scipy.linalg import qr

    if null.shape[1] == 0:
        return np.empty(0, dtype=np.int64)
    return np.asarray(qr(null.T, pivoting=True, mode="r")[1][: null.shape[1]])


def _metric_basis(size: Array) -> Array:
    """Basis that is orthonormal in a positive semidefinite metric, null directions left out."""
    values, vectors = np.linalg.eigh(size)
    kept = values > 1e-12 * max(values.max(initial=0.0), 1e-300)
    return vectors[:, kept] / np.sqrt(values[kept])


def _transposed_G(
    B: PETSc.Mat, blocks: Sequence[Block], starts: Array, dimension: int
) -> csr_array:
    """This rank's rows of Gᵀ = B R, with global columns."""
    num_trace = B.getLocalSize()[1]
    kernels = [block.kernel for block in blocks]
    rows, columns, values = [], [], []
    for kernel, part, start in zip(kernels, trace_slices(blocks), starts, strict=False):
        i, j = np.indices(kernel.shape)
        rows.append((part.start + i).ravel())
        columns.append((start + j).ravel())
        values.append(kernel.ravel())
    coordinates = (_join(rows, np.int64), _join(columns, np.int64))
    local = coo_array((_join(values, np.float64), coordinates), shape=(num_trace, dimension))
    local = local.tocsr()
    index = PETSc.IntType
    R = PETSc.Mat().createAIJ(
        size=((num_trace, None), (int(sum(k.shape[1] for k in kernels)), None)),
        csr=(local.indptr.astype(index), local.indices.astype(index), local.data),
        comm=B.getComm(),
    )
    BR = B.matMult(R)
    indptr, indices, data = BR.getValuesCSR()
    Gt = csr_array((data, indices, indptr), shape=(B.getLocalSize()[0], dimension))
    R.destroy()
    BR.destroy()
    return Gt


def _body_modes(
    blocks: Sequence[Block],
    starts: Array,
    dimension: int,
    body_of_block: Array,
    num_bodies: int,
    comm: MPI.Intracomm,
) -> tuple[csr_array, Array]:
    """Kernel coordinates of the bodies' modes, and the Gram matrix of what no kernel holds."""
    parts = [block.body_modes for block in blocks]
    k = comm.allreduce(max((inside.shape[1] for inside, _ in parts), default=0), op=MPI.MAX)
    defect = np.zeros((num_bodies * k, num_bodies * k))
    rows, columns, values = [], [], []
    for (inside, rest), start, body in zip(parts, starts, body_of_block, strict=False):
        i, j = np.indices(inside.shape)
        rows.append((start + i).ravel())
        columns.append((body * k + j).ravel())
        values.append(inside.ravel())
        own = slice(body * k, body * k + k)
        defect[own, own] += rest
    comm.Allreduce(MPI.IN_PLACE, defect, op=MPI.SUM)
    row, column, value = (
        np.concatenate(comm.allgather(_join(parts_, kind)))
        for parts_, kind in ((rows, np.int64), (columns, np.int64), (values, np.float64))
    )
    return coo_array((value, (row, column)), shape=(dimension, num_bodies * k)).tocsr(), defect


def _join(parts: list[Array], dtype: Any) -> Array:
    return np.concatenate([np.empty(0, dtype=dtype), *parts])
