"""What the bodies' rigid motions are in kernel coordinates; the same on all ranks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.motions import block_diagonal, diagonal_blocks
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.subdomains.block import Block

# Share of a motion's square that lies outside a subdomain's kernel, and so moves a spring:
# kernels beside weak springs are inexact, and a share is the square of an angle.
SPRUNG = 1e-8
# Work of a body's load that counts as none, as a share of the largest that loads of this size
# could do (what users balance by hand is seldom exact), and of that of any body (rounding).
BALANCE, ROUNDING = 1e-9, 1e-14
DEPENDENT = 1e-12  # of the largest eigenvalue of the modes' Gram matrix: no motion of its own


class Bodies:
    """Motions of the bodies, in coordinates in which every motion has the mean square 1.

    Args:
        blocks: This rank's Blocks.
        starts: First kernel coordinate of each.
        dimension: Kernel coordinates of all ranks, r.
        body_of_block: Body of each Block.
        count: Number of bodies on all ranks.
        comm: Communicator. The constructor is collective.

    Attributes:
        count: Number of bodies.
        k: Candidate modes of each.
        frames: Modes' coefficients of each coordinate, shape ``(bodies, k, k)``.
        metric: Sums of the modes' products over a body's nodes, shape ``(bodies, k, k)``.
        nodes: Number of nodes of each body, copies counted once, shape ``(bodies,)``.
        modes: Kernel coordinates of the motions, scipy CSR, shape ``(r, bodies * k)``.
        size: Their Gram matrices, shape ``(bodies, k, k)``.
        springs: Projectors onto motions that springs resist, shape ``(bodies, k, k)``.
        loads: ‖f‖ of each body, shape ``(bodies,)``.
        negligible: Work of each body's load, on a motion of mean square 1, that counts as none,
            shape ``(bodies,)``.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        starts: Array,
        dimension: int,
        body_of_block: Array,
        count: int,
        comm: MPI.Intracomm,
    ) -> None:
        self.count, self._comm, self._body_of_block = count, comm, body_of_block
        parts = [block.body_modes for block in blocks]
        inside = [part for part, _ in parts]
        self.k = comm.allreduce(max((p.shape[1] for p in inside), default=0), op=MPI.MAX)
        self.metric = self._summed([block.body_metric for block in blocks])
        self.nodes = self.metric[:, :1, :1].max(axis=(1, 2), initial=1.0)
        self.frames = agreed(comm, _frames(self.metric / self.nodes[:, None, None]))
        shares = [rest / max(float(np.trace(p.T @ p + rest)), 1e-300) for p, rest in parts]
        self.springs = agreed(comm, self._springs(self._summed(shares)))
        self.modes = csr_array(
            _coordinates(inside, starts, body_of_block, (dimension, count * self.k), comm)
            @ block_diagonal(self.frames)
        )
        self.size = diagonal_blocks(csr_array(self.modes.T @ self.modes), self.k)
        self.update_load(blocks)

    def update_load(self, blocks: Sequence[Block]) -> None:
        """Measure the Blocks' present loads. Collective."""
        squares = np.zeros(self.count)
        for block, body in zip(blocks, self._body_of_block, strict=True):
            squares[body] += block.load_norm**2
        self._comm.Allreduce(MPI.IN_PLACE, squares, op=MPI.SUM)
        self.loads = np.sqrt(squares)
        largest = self.loads * np.sqrt(self.nodes)
        self.negligible = np.maximum(BALANCE * largest, ROUNDING * largest.max(initial=0.0))

    def part_of(self, u: Sequence[Array], blocks: Sequence[Block]) -> Array:
        """The bodies' motion in a displacement, by least squares over the nodes. Collective.

        Args:
            u: Displacement of each Block.
            blocks: This rank's Blocks.

        Returns:
            Coordinates, shape ``(bodies * k,)``.
        """
        moments = self._summed([b.body_moments(v) for b, v in zip(blocks, u, strict=True)])
        W = self.frames
        return np.asarray(np.einsum("bij,bi->bj", W, moments) / self.nodes[:, None]).ravel()

    def amounts(self, motion: Array) -> Array:
        """How much of each mode is in a motion, shape ``(bodies, k)``."""
        return np.einsum("bij,bj->bi", self.frames, motion.reshape(self.count, self.k))

    def _summed(self, parts: Sequence[Array]) -> Array:
        """Arrays of the Blocks with as many axes of length k, summed by bodies."""
        axes = self._comm.allreduce(max((p.ndim for p in parts), default=0), op=MPI.MAX)
        total = np.zeros((self.count, *(self.k,) * axes))
        for part, body in zip(parts, self._body_of_block, strict=True):
            total[body] += part
        self._comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
        return total

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


def _coordinates(
    inside: Sequence[Array],
    starts: Array,
    body_of_block: Array,
    shape: tuple[int, int],
    comm: MPI.Intracomm,
) -> csr_array:
    """Kernel coordinates of the candidate modes, replicated."""
    rows, columns, values = [], [], []
    for part, start, body in zip(inside, starts, body_of_block, strict=False):
        i, j = np.indices(part.shape)
        rows.append((start + i).ravel())
        columns.append((body * part.shape[1] + j).ravel())
        values.append(part.ravel())
    row, column, value = (
        np.concatenate(comm.allgather(joined(parts, kind)))
        for parts, kind in ((rows, np.int64), (columns, np.int64), (values, np.float64))
    )
    return coo_array((value, (row, column)), shape=shape).tocsr()


def joined(parts: list[Array], dtype: Any) -> Array:
    """One array of several, maybe none."""
    return np.concatenate([np.empty(0, dtype=dtype), *parts])
