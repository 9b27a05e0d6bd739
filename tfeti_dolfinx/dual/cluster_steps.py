"""Chebyshev's steps between the blocks of clusters, for what subdomains do within them."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.linalg import eigvalsh_tridiagonal
from scipy.sparse import coo_array, csr_array, diags_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.projectors import Factor
from tfeti_dolfinx.dual.smoothing import chebyshev
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.parallel import agreed, chunk_offsets, summed
from tfeti_dolfinx.subdomains.clusters import InnerMotions
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

# what Chebyshev's steps leave of an interval, and how far it reaches at most: 13 steps
LEFT, WIDEST = 0.05, 50.0
# steps of Lanczos' method for the spectrum, how far it may reach beyond what they see, and when
# nothing is left to be seen
SEEN, BELOW, ABOVE, NOTHING = 10, 0.8, 1.1, 1e-12
# relative, added to the diagonal of D_A: motions of clusters that no row of a face holds
SHIFT = 1e-8


class ClusterSteps:
    """X ≈ A⁺, A = Ĝ_fĜ_fᵀ + D/σ: Chebyshev's steps with the clusters' blocks of A.

    Between them what moves whole clusters is solved for: with N their motions among those of the
    subdomains, E = N(NᵀAN)⁺Nᵀ and Π = I − EA, X = E + Π q(D_A⁻¹ΠᵀA) D_A⁻¹ Πᵀ, which is symmetric
    and positive definite (Nicolaides, SIAM J. Numer. Anal. 24, 1987, 355–365; Saad, section 12.3).

    Args:
        comm: Communicator.
        own: This rank's motions.
        whole: (NᵀAN)⁻¹; taken over.
        A: A; taken over. The constructor and ``solve`` are collective.
        prefix: Prefix of the factor's PETSc options.
    """

    def __init__(
        self, comm: MPI.Intracomm, own: InnerMotions, whole: Factor, A: PETSc.Mat, prefix: str
    ) -> None:
        self._comm, self._own, self._whole, self._A = comm, own, whole, A
        offsets = chunk_offsets(comm, own.whole.shape[1])
        self._part = slice(int(offsets[comm.rank]), int(offsets[comm.rank + 1]))
        self._x, self._y = A.createVecs()
        self._blocks: CholeskyFactor | None = None
        with raised_on_all_ranks(comm):
            if len(own.cluster):
                self._blocks = CholeskyFactor(_blocks(A, own.cluster), prefix)
        low, top = self._spectrum()
        self._steps = chebyshev(_count(low, top), low, top)

    def solve(self, b: Array) -> Array:
        """X b, this rank's entries."""
        u = self._of_clusters(b)
        rest, change = b - self._times(u), np.zeros_like(b)
        for k, (a, c) in enumerate(self._steps):
            if k:
                rest -= self._times(change)
            s = self._solved(rest)
            change = a * change + c * (s - self._of_clusters(self._times(s)))
            u += change
        return u

    def _of_clusters(self, b: Array) -> Array:
        """E b."""
        e = np.concatenate(self._comm.allgather(self._own.whole.T @ b))
        return np.asarray(self._own.whole @ self._whole.solve(e)[self._part])

    def _solved(self, b: Array) -> Array:
        """D_A⁻¹ b."""
        return b if self._blocks is None else self._blocks.solve(b)

    def _times(self, u: Array) -> Array:
        """A u."""
        self._x.array[:] = u
        self._A.mult(self._x, self._y)
        return np.array(self._y.array_r)

    def _spectrum(self) -> tuple[float, float]:
        """An interval for the eigenvalues of D_A⁻¹ΠᵀA, as conjugate gradients show them."""
        comm = self._comm
        b = self._times(np.random.default_rng(comm.rank).standard_normal(len(self._own.cluster)))
        (least,) = NOTHING * summed(comm, np.array([b @ self._solved(b)]))
        r, p = b - self._times(self._of_clusters(b)), np.zeros_like(b)
        sizes, steps = list[float](), list[float]()
        for _ in range(SEEN):
            s = self._solved(r)
            s -= self._of_clusters(self._times(s))
            (size,) = summed(comm, np.array([r @ s]))
            p = s + (size / sizes[-1] if sizes else 0.0) * p
            Ap = self._times(p)
            (curvature,) = summed(comm, np.array([p @ Ap]))
            if agreed(comm, not (size > least and curvature > 0.0)):
                break
            sizes.append(float(size))
            steps.append(float(size / curvature))
            r -= steps[-1] * Ap
        values = agreed(comm, _ritz_values(np.array(sizes), np.array(steps)))
        low, top = float(BELOW * values[0]), float(ABOVE * values[-1])
        return min(max(low, top / WIDEST), 0.5 * top), top

    def destroy(self) -> None:
        """Free A and the factors. Collective."""
        self._whole.destroy()
        if self._blocks is not None:
            self._blocks.destroy()
        for item in (self._A, self._x, self._y):
            item.destroy()


def _ritz_values(sizes: Array, steps: Array) -> Array:
    """Those of conjugate gradients, ascending, from rᵀz and the lengths of steps; 1 without any."""
    if len(sizes) == 0:
        return np.ones(1)
    beta, inverse = sizes[1:] / sizes[:-1], 1.0 / steps
    diagonal = inverse + np.append(0.0, beta * inverse[:-1])
    beside = np.sqrt(beta) * inverse[:-1]
    return np.asarray(eigvalsh_tridiagonal(diagonal, beside))


def _count(low: float, high: float) -> int:
    """How many of Chebyshev's steps leave so little of an interval."""
    root = np.sqrt(high / low)
    return int(np.ceil(np.arccosh(1.0 / LEFT) / np.log((root + 1.0) / (root - 1.0))))


def _blocks(A: PETSc.Mat, cluster: Array) -> csr_array:
    """The blocks of A between motions of one cluster each, with a shift."""
    indptr, columns, values = A.getDiagonalBlock().getValuesCSR()
    own = csr_array((values, columns, indptr), shape=(len(cluster),) * 2).tocoo()
    within = cluster[own.coords[0]] == cluster[own.coords[1]]
    places = tuple(i[within] for i in own.coords)
    blocks = csr_array(coo_array((own.data[within], places), shape=own.shape))
    diagonal = blocks.diagonal()
    shift = SHIFT * np.maximum(diagonal, SHIFT * diagonal.max(initial=0.0))
    return csr_array(blocks + diags_array(np.where(shift > 0.0, shift, 1.0)))
