"""The natural coarse space: G = Rᵀ Bᵀ, its projectors, and motions that no row of B resists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.bodies import Bodies, joined
from tfeti_dolfinx.dual.kernel_basis import kernel_basis
from tfeti_dolfinx.dual.motions import NULL, Motions, unresisted, unsprung
from tfeti_dolfinx.dual.null_basis import null_basis
from tfeti_dolfinx.dual.operator import trace_slices
from tfeti_dolfinx.dual.projectors import (
    FaceFactors,
    FaceProjectors,
    Projectors,
    replicated_gram,
)
from tfeti_dolfinx.dual.semidefinite import SemidefiniteFactor
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.parallel import agreed, chunk_offsets
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.subdomains.block import Block

# Of the size of a row: what of it acts on motions of bodies and is only rounding; and how it acts
# as a whole if it only glues. Rounding of points far from the origin is more than that of motions,
# but all other rows act on translations with about their size.
NO_GRIP, GLUING = 1e-12, 1e-6


class CoarseSpace(Projectors):
    """G, GGᵀ and what follows from them; the r-vectors are replicated on all ranks.

    G = (R T)ᵀ Bᵀ, with T a basis of the kernel that has the bodies' motions as coordinates.

    Args:
        B: Dual rows × trace unknowns.
        blocks: This rank's Blocks.
        body_of_block: Body of each of them.
        num_bodies: Number of bodies on all ranks.
        bounded: Local rows with λ ≥ 0.
        comm: Communicator. The constructor and all methods are collective.
        prefix: Prefix of the factor's PETSc options.

    Attributes:
        dimension: r, the dimension of the kernel of K.
        e: (R T)ᵀ f, shape ``(r,)``.
        modes: The bodies' motions in the basis T, scipy CSR, shape ``(r, bodies * k)``.
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        bounded: Local rows with λ ≥ 0.
        row_size: Sum of the moduli of each local row of B, the same however the mesh is torn. A
            row over it gives lengths. Shape ``(m_local,)``.
        bodies: Motions of the bodies.
        J: This rank's rows of B R over their size, on motions of bodies, scipy CSR, shape
            ``(m_local, bodies * k)``; empty for gluing rows.
        unheld: Motions that neither springs nor equality rows resist; each of these rows acts
            on one body.
        free_motions: Motions that no row resists at all.
        null: Orthonormal basis of null(Gᵀ).
        factors: Makes the factors of faces, and counts them apart from that of GGᵀ.
    """

    def __init__(
        self,
        B: PETSc.Mat,
        blocks: Sequence[Block],
        body_of_block: Array,
        num_bodies: int,
        bounded: Array,
        comm: MPI.Intracomm,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self.comm, self.bounded = comm, bounded
        sizes = np.array([block.kernel.shape[1] for block in blocks], dtype=np.int64)
        offsets = chunk_offsets(comm, int(sizes.sum()))
        self.dimension = int(offsets[-1])
        starts = offsets[comm.rank] + np.concatenate(([0], np.cumsum(sizes)))
        self._starts, self._sizes = starts, sizes
        Gt, self.row_size = _transposed_G(B, blocks, starts, self.dimension), _sizes(B)
        self.bodies = Bodies(blocks, starts, self.dimension, body_of_block, num_bodies, comm)
        self.J = _without_rounding(diags_array(1.0 / self.row_size) @ Gt @ self.bodies.modes)
        equalities = np.ones(len(self.row_size), dtype=bool)
        equalities[bounded] = False
        self.unheld = self._unresisted(equalities, unsprung(self.bodies.springs), NULL)
        self.free_motions = self.unresisted(~equalities)
        # made on one rank: processors that round differently might choose differently
        self._basis = agreed(comm, kernel_basis(self.bodies, self.unheld, self.free_motions))
        self.modes = self._basis.coordinates(self.bodies.modes)
        self.Gt = self._basis.rows(Gt, diags_array(self.row_size) @ self.J, equalities)
        self._read_load(blocks)
        joint = self.modes @ self.free_motions.joint
        self.null = agreed(comm, null_basis(np.flatnonzero(self._basis.free), joint))
        self._gram = replicated_gram(self.Gt, comm)
        self.factors = FaceFactors(comm, self.null, prefix)
        self._factor = self.factors.factor(self._gram, "whole")

    def update_load(self, blocks: Sequence[Block]) -> None:
        """Replace e = Rᵀ f by that of the Blocks' present loads."""
        self._read_load(blocks)
        self.bodies.update_load(blocks)

    def _read_load(self, blocks: Sequence[Block]) -> None:
        local = [block.kernel_load for block in blocks]
        e = np.concatenate(self.comm.allgather(np.concatenate([np.empty(0), *local])))
        self.e = self._basis.products(e)

    @property
    def free_modes(self) -> int:
        """Number of motions that no row resists."""
        return self.free_motions.count

    def alpha_of(self, alpha: Array) -> list[Array]:
        """Kernel coordinates of this rank's Blocks that belong to an r-vector."""
        alpha = self._basis.kernel(alpha)
        return [alpha[a : a + n] for a, n in zip(self._starts, self._sizes, strict=False)]

    def gram(self, rows: Array | None = None) -> csr_array:
        """GGᵀ, or G_f G_fᵀ of the local rows flagged, shape ``(r, r)``; replicated."""
        return self._gram if rows is None else replicated_gram(csr_array(self.Gt[rows]), self.comm)

    def damped_factor(self, rows: Array, damping: float) -> SemidefiniteFactor:
        """A factor of G_f G_fᵀ + damping·GGᵀ of the local rows flagged."""
        return self.factors.factor(csr_array(self.gram(rows) + damping * self.gram()))

    def on_face(self, face: Face) -> FaceProjectors:
        """The projectors on a face of the rows."""
        return FaceProjectors(self, face, self.factors)

    def unresisted(self, rows: Array, below: float = NULL) -> Motions:
        """Motions that neither springs, nor equality rows, nor contact rows flagged resist.

        The null space of Gᵀ lives on the bodies' motions: one that no gluing row resists is the
        same in all subdomains of a body.

        Args:
            rows: Flags of local rows, those of equalities without effect.
            below: Motions of a single body that are held by less than this share of what the
                same rows hold at most are taken in, too.
        """
        flags = np.zeros(len(self.row_size), dtype=bool)
        flags[self.bounded] = rows[self.bounded]
        return self._unresisted(flags, self.unheld, below)

    def _unresisted(self, rows: Array, within: Motions, below: float) -> Motions:
        """Found on one rank: processors that round differently might count differently."""
        grams = self.comm.gather(self.J[rows].T @ self.J[rows], root=0)
        found: Any = None
        with raised_on_all_ranks(self.comm):
            if grams is not None:
                found = unresisted(csr_array(sum(grams)), within, below)
        return cast(Motions, agreed(self.comm, found))


def _without_rounding(J: Any) -> csr_array:
    """The same rows without entries that are only rounding."""
    J = csr_array(J)
    largest = abs(J).max(axis=1).toarray().ravel()
    noise = np.where(largest <= GLUING, GLUING, NO_GRIP)
    J.data[np.abs(J.data) <= np.repeat(noise, np.diff(J.indptr))] = 0.0
    J.eliminate_zeros()
    return J


def _sizes(B: PETSc.Mat) -> Array:
    """Sum of the moduli of each local row, 1 where that is 0."""
    indptr, _, data = B.getValuesCSR()
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    sizes = np.bincount(rows, np.abs(data), minlength=len(indptr) - 1).astype(float)
    return np.where(sizes > 0.0, sizes, 1.0)


def _transposed_G(
    B: PETSc.Mat, blocks: Sequence[Block], starts: Array, dimension: int
) -> csr_array:
    """This rank's rows of B R, with global columns."""
    num_trace = B.getLocalSize()[1]
    kernels = [block.kernel for block in blocks]
    rows, columns, values = [], [], []
    for kernel, part, start in zip(kernels, trace_slices(blocks), starts, strict=False):
        i, j = np.indices(kernel.shape)
        rows.append((part.start + i).ravel())
        columns.append((start + j).ravel())
        values.append(kernel.ravel())
    coordinates = (joined(rows, np.int64), joined(columns, np.int64))
    local = coo_array((joined(values, np.float64), coordinates), shape=(num_trace, dimension))
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
