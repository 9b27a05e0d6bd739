"""Linear programs with rows on many ranks, of which few matter: cutting planes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, vstack

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.parallel import agreed

# Random directions in which the outermost rows are taken at first: enough for the corners of
# patches; what they miss comes by and by.
DIRECTIONS = 12


class Rows:
    """This rank's inequalities A y ≤ b, each between few bodies.

    Args:
        A: Shape ``(m, n)``.
        b: Shape ``(m,)``.
        body: Body of each column, shape ``(n,)``.

    Attributes:
        ends: First and last body of each row, shape ``(m,)``; of an empty row beyond all bodies,
            and −1.
        sent: Which of them the rank that solves knows, shape ``(m,)``.
    """

    def __init__(self, A: csr_array, b: Array, body: Array) -> None:
        self.A, self.b, self._body = A, b, body
        entries = A.tocoo()
        row, column = entries.coords
        first, last = np.full(A.shape[0], len(body)), np.full(A.shape[0], -1)
        np.minimum.at(first, row, body[column])
        np.maximum.at(last, row, body[column])
        # rows between the same bodies form a patch
        self.ends = first, last
        _, self.patch = np.unique(np.stack((first, last), axis=1), axis=0, return_inverse=True)
        self.patch = self.patch.ravel()
        self._entry = row, column
        self.sent = np.zeros(A.shape[0], dtype=bool)

    def links(self, bodies: int) -> csr_array:
        """Which bodies meet in a row, shape ``(bodies, bodies)``."""
        row, column = self._entry
        meets = (np.ones(len(row)), (row, self._body[column]))
        incidence = csr_array(meets, shape=(self.A.shape[0], bodies))
        return csr_array(incidence.T @ incidence)

    def extremes(self) -> Array:
        """Of each patch the rows that are outermost in some directions.

        Of a flat patch they are most of its corners, which imply all other rows.
        """
        found = [np.empty(0, dtype=np.int64)]
        for direction in np.random.default_rng(0).standard_normal((DIRECTIONS, self.A.shape[1])):
            order = np.lexsort((self.A @ direction, self.patch))
            change = np.flatnonzero(np.diff(self.patch[order]))
            ends = np.concatenate(([0], change, change + 1, [-1])) if len(order) else order
            found.append(order[ends])
        return np.unique(np.concatenate(found))

    def violated(self, y: Array, tolerance: float, most: int) -> Array:
        """Of each patch the rows, at most so many, that y violates most."""
        excess = self.A @ y - self.b
        row = np.flatnonzero((excess > tolerance) & ~self.sent)
        row = row[np.lexsort((-excess[row], self.patch[row]))]
        starts = np.flatnonzero(np.diff(self.patch[row], prepend=-1))
        place = np.arange(len(row)) - np.repeat(starts, np.diff(starts, append=len(row)))
        return row[place < most]

    def allowed(self, y: Array, tolerance: float, comm: MPI.Intracomm) -> float:
        """Largest share of y, up to 1, that meets all rows; 0 does. Collective."""
        value = self.A @ y
        beyond = value > self.b + tolerance
        shares = np.maximum(self.b[beyond], 0.0) / value[beyond]
        return float(comm.allreduce(float(shares.min(initial=1.0)), op=MPI.MIN))


def minimise(
    rows: Rows,
    solve: Callable[[csr_array, Array], Array | None],
    tolerance: float,
    comm: MPI.Intracomm,
    first: Array,
) -> Array | None:
    """Solve a program whose rows are spread over the ranks. Collective.

    One rank solves it with some of the rows and is sent what the others find violated: each time
    up to twice as many of a patch, so that it ends.

    Args:
        rows: This rank's rows.
        solve: Minimises over A y ≤ b, some of the rows, on rank 0; None ends the search.
        tolerance: Excess of a row that is let be.
        comm: Communicator.
        first: Rows of this rank to begin with.

    Returns:
        The minimiser, or None where ``solve`` returned it.
    """
    A, b = csr_array((0, rows.A.shape[1])), np.zeros(0)
    chosen, most = first, 1
    rows.sent[:] = False
    while True:
        rows.sent[chosen] = True
        parts = comm.gather((rows.A[chosen], rows.b[chosen]), root=0)
        y: Array | None = None
        with raised_on_all_ranks(comm):
            if parts is not None:
                A = csr_array(vstack([A, *(part for part, _ in parts)]))
                b = np.concatenate([b, *(part for _, part in parts)])
                y = solve(A, b)
        y = agreed(comm, y)
        if y is None:
            return None
        chosen, most = rows.violated(y, tolerance, most), 2 * most
        if comm.allreduce(len(chosen)) == 0:
            return y
