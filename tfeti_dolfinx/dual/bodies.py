"""What the bodies' rigid motions are in kernel coordinates; the same on all ranks."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.motions import block_diagonal, diagonal_blocks
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# Share of a motion's square that lies outside a subdomain's kernel, and so moves a spring:
# kernels beside weak springs are inexact, and a share is the square of an angle.
SPRUNG = 1e-8
# Work of a body's load that counts as none, as a share of the largest that loads of this size
# could do (what users balance by hand is seldom exact), and of that of any body (rounding).
BALANCE, ROUNDING = 1e-9, 1e-14
# Eigenvalue of the modes' Gram matrix, as a share of the largest, that is none: on nodes of a line
# or a point some mode is no motion of its own, and only rounding is left of it.
DEPENDENT = 1e-12


class Bodies:
    """Motions of the bodies, in coordinates in which every motion has the mean square 1.

    Args:
        subdomains: This rank's Blocks. The constructor is collective.
        first: This rank's first kernel coordinate.
        dimension: Kernel coordinates of all ranks, r.

    Attributes:
        count: Number of bodies on all ranks.
        k: Candidate modes of each.
        frames: Modes' coefficients of each coordinate, shape ``(bodies, k, k)``.
        metric: Sums of the modes' products over a body's nodes, shape ``(bodies, k, k)``.
        nodes: Number of nodes of each body, copies counted once, shape ``(bodies,)``.
        motions: Kernel coordinates of the motions, scipy CSR, shape ``(r, bodies * k)``.
        size: Their Gram matrices, shape ``(bodies, k, k)``.
        springs: Projectors onto motions that springs resist, shape ``(bodies, k, k)``.
        loads: ‖f‖ of each body, shape ``(bodies,)``.
        negligible: Work of each body's load, on a motion of mean square 1, that counts as none,
            shape ``(bodies,)``.
    """

    def __init__(self, subdomains: Subdomains, first: int, dimension: int) -> None:
        self._subdomains, comm = subdomains, subdomains.comm
        self.count, self.k = subdomains.num_bodies, subdomains.num_modes
        self.metric = subdomains.modes_metric()
        self.nodes = self.metric[:, :1, :1].max(axis=(1, 2), initial=1.0)
        self.frames = agreed(comm, _frames(self.metric / self.nodes[:, None, None]))
        self.springs = agreed(comm, self._springs(subdomains.modes_outside()))
        inside = _replicated(subdomains.modes_in_kernel, first, dimension, comm)
        self.motions = csr_array(inside @ block_diagonal(self.frames))
        self.size = diagonal_blocks(csr_array(self.motions.T @ self.motions), self.k)
        self.update_load()

    def update_load(self) -> None:
        """Measure the Blocks' present loads. Collective."""
        self.loads = self._subdomains.load_norms()
        largest = self.loads * np.sqrt(self.nodes)
        self.negligible = np.maximum(BALANCE * largest, ROUNDING * largest.max(initial=0.0))

    def part_of(self, u: Array) -> Array:
        """The bodies' motion in a displacement, by least squares over the nodes. Collective.

        Args:
            u: This rank's part of the displacement, shape ``(n,)``.

        Returns:
            Coordinates, shape ``(bodies * k,)``.
        """
        W, moments = self.frames, self._subdomains.moments(u)
        return np.asarray(np.einsum("bij,bi->bj", W, moments) / self.nodes[:, None]).ravel()

    def amounts(self, motion: Array) -> Array:
        """How much of each mode is in a motion, shape ``(bodies, k)``."""
        return np.einsum("bij,bj->bi", self.frames, motion.reshape(self.count, self.k))

    def _springs(self, shares: Array) -> Array:
        W = self.frames
        values, vectors = np.linalg.eigh(np.swapaxes(W, 1, 2) @ shares @ W)
        sprung = values > SPRUNG
        return (vectors * sprung[:, None, :]) @ np.swapaxes(vectors, 1, 2)


def _frames(gram: Array) -> Array:
    """Symmetric inverse roots; a direction without extent is left as it is."""
    values, vectors = np.linalg.eigh(gram)
    extent = values > DEPENDENT * values.max(axis=1, initial=0.0, keepdims=True)
    roots = np.where(extent, values, 1.0) ** -0.5
    return np.asarray((vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2))


def _replicated(local: csr_array, first: int, dimension: int, comm: MPI.Intracomm) -> csr_array:
    """The rows of all ranks, on every rank; this rank's begin at first."""
    entries = local.tocoo()
    row, column = entries.coords
    every = ((first + row).astype(np.int64), column.astype(np.int64), entries.data)
    rows, columns, values = (np.concatenate(comm.allgather(part)) for part in every)
    return csr_array(coo_array((values, (rows, columns)), shape=(dimension, local.shape[1])))
