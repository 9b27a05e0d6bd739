"""Rows of arrays that travel between ranks."""

from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array, Entries

T = TypeVar("T")


def bcast_from_root(comm: MPI.Intracomm, value: T) -> T:
    """Return rank 0's value on every rank. Collective.

    For what steers collective calls: processors of different kinds may round differently, and
    ranks that decide by their own floats may part ways. Numbers and flags travel as a buffer; all
    ranks pass the same type.
    """
    if comm.size == 1:
        return value
    if isinstance(value, bool | float | np.bool_ | np.floating):
        number = np.array([float(value)])
        comm.Bcast(number, root=0)
        return type(value)(number[0])  # type: ignore[return-value]
    return comm.bcast(value, root=0)


def steering(comm: MPI.Intracomm, *values: float) -> Array:
    """Return rank 0's numbers on every rank: ``bcast_from_root`` by a buffer. Collective."""
    found = np.array(values, dtype=float)
    comm.Bcast(found, root=0)
    return found


def any_rank(comm: MPI.Intracomm, flag: bool | Array) -> bool:
    """Return whether a flag, or an entry other than 0, is set on some rank. Collective."""
    own = flag.any() if isinstance(flag, np.ndarray) else flag
    if comm.size == 1:
        return bool(own)
    found = np.array([own], dtype=int)
    comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
    return bool(found[0])


def summed(comm: MPI.Intracomm, values: Array) -> Array:
    """Return the sums of all ranks' values, entry by entry: one reduction. Collective."""
    sums = np.array(values)
    comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    return sums


def count_over(comm: MPI.Intracomm, flags: Array | int) -> int:
    """Return how many flags are set on all ranks, or the sum of their counts. Collective."""
    return int(summed(comm, np.array([np.sum(flags)]))[0])


def dot_over(comm: MPI.Intracomm, *pairs: tuple[Array, Array]) -> list[float]:
    """xᵀy of pairs of vectors that are spread over ranks, rank 0's on each. Collective."""
    products = np.array([x @ y for x, y in pairs])
    comm.Allreduce(MPI.IN_PLACE, products, op=MPI.SUM)
    comm.Bcast(products, root=0)
    return [float(value) for value in products]


def norm_over(comm: MPI.Intracomm, x: Array) -> float:
    """‖x‖ of a vector that is spread over ranks, the same on each. Collective."""
    return float(np.sqrt(dot_over(comm, (x, x))[0]))


def maxima(comm: MPI.Intracomm, values: Array) -> Array:
    """Return the largest of all ranks' values, entry by entry: one reduction. Collective."""
    found = np.array(values)
    comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
    return found


def largest(comm: MPI.Intracomm, x: Array) -> float:
    """Largest modulus of a vector that is spread over ranks, 0 if it is empty. Collective."""
    found = np.array([np.abs(x).max(initial=0.0)], dtype=float)
    comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
    return float(found[0])


def least(comm: MPI.Intracomm, value: float) -> float:
    """Return the least of all ranks' values. Collective."""
    found = np.array([value], dtype=float)
    comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MIN)
    return float(found[0])


def joined_over(comm: MPI.Intracomm, own: Array) -> Array:
    """Return the arrays of all ranks, one after the other. Collective."""
    if comm.size == 1:
        return own
    sizes = np.empty(comm.size, dtype=np.int64)
    comm.Allgather(np.array([len(own)]), sizes)
    whole = np.empty(int(sizes.sum()), dtype=own.dtype)
    comm.Allgatherv(np.ascontiguousarray(own), [whole, sizes.tolist()])
    return whole


def rows_over(comm: MPI.Intracomm, own: Any) -> Entries:
    """Return the rows of all ranks' CSR matrices, one after the other. Collective."""
    # ranks may have indices of 32 or 64 bits
    integers = (part.astype(np.int64) for part in (np.diff(own.indptr), own.indices))
    counts, indices = (joined_over(comm, part) for part in integers)
    table = np.concatenate(([0], np.cumsum(counts)))
    return Entries(joined_over(comm, own.data), indices, table, (len(table) - 1, own.shape[1]))


class Exchange:
    """Rows that travel to other ranks, and answers that travel back.

    The communication pattern is found once; any number of arrays may follow it. Creation, with the
    rank that each row goes to, and both methods are collective. ``source`` is the rank that each
    received row comes from, shape ``(m,)``, ascending.
    """

    def __init__(self, comm: MPI.Intracomm, destination: Array) -> None:
        self._comm = comm
        if comm.size == 1:
            self.source = np.zeros(len(destination), dtype=np.int64)
            return
        self._order = np.argsort(destination, kind="stable")
        self._sent = np.bincount(destination, minlength=comm.size).astype(np.int64)
        self._received = np.empty_like(self._sent)
        comm.Alltoall(self._sent, self._received)
        self.source = np.repeat(np.arange(comm.size), self._received)

    def send(self, rows: Array) -> Array:
        """Send ``rows`` (first axis of length n) and return the rows received (m of them)."""
        if self._comm.size == 1:
            return np.array(rows)
        return self._travel(np.take(rows, self._order, axis=0), self._sent, self._received)

    def answer(self, rows: Array) -> Array:
        """Send one row back for each received row; returns them in the order first sent."""
        if self._comm.size == 1:
            return np.array(rows)
        back = self._travel(np.asarray(rows), self._received, self._sent)
        answers = np.empty_like(back)
        answers[self._order] = back
        return answers

    def _travel(self, rows: Array, sent: Array, received: Array) -> Array:
        rows = np.ascontiguousarray(rows)
        out = np.empty((int(received.sum()), *rows.shape[1:]), dtype=rows.dtype)
        width = int(np.prod(rows.shape[1:], dtype=np.int64)) * rows.dtype.itemsize
        row_type = MPI.BYTE.Create_contiguous(width).Commit()
        self._comm.Alltoallv([rows, sent, row_type], [out, received, row_type])
        row_type.Free()
        return out


def offset_of(comm: MPI.Intracomm, size: int) -> int:
    """First global index of this rank's chunk of ``size`` (exclusive prefix sum). Collective."""
    return int(comm.scan(size)) - size


def owner_of(offsets: Array, index: Array) -> Array:
    """Return rank whose chunk holds each global index; ``offsets`` has comm.size + 1 entries."""
    return np.searchsorted(offsets, index, side="right") - 1


def chunk_offsets(comm: MPI.Intracomm, size: int) -> Array:
    """Offsets of all ranks' chunks, shape ``(comm.size + 1,)``. Collective."""
    sizes = np.empty(comm.size, dtype=np.int64)
    comm.Allgather(np.array([size]), sizes)
    return np.concatenate(([0], np.cumsum(sizes)))


def box_over_ranks(comm: MPI.Intracomm, x: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates of all ranks' points, shapes ``(gdim,)``. Collective."""
    ends = [(-column.min(initial=np.inf), column.max(initial=-np.inf)) for column in x.T]
    low, high = maxima(comm, np.array(ends)).T
    return -low, high
