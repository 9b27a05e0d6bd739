"""Recycling of search directions, with their products with F, from earlier solves."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.linalg import svd

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, dot_over, summed

# from a vector, and directions or images as rows, to a step and its coefficients
Along = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True)
class RecyclingParameters:
    """Tolerances of directions that are kept."""

    # of the energy of a direction: what stands out from those that are kept; where less does,
    # rounding of their images would grow from one to the next
    new: float = 0.1
    # of wᵀFp, for w and p of energy 1: where Fw says otherwise than Fp it is no longer F of w
    wrong: float = 1e-9
    held: float = 1e-10  # of the longest direction: less on rows that a face holds is rounding


class DirectionStore:
    """Directions p of energy pᵀFp = 1 and their images; this rank's part.

    Of more than ``capacity`` directions the oldest goes; ``count`` is their number, and ``changes``
    says how often they have changed. They are in no order the rows of ``directions``, of shape
    ``(count, m)``, and those of ``images`` their images.
    """

    def __init__(self, capacity: int, size: int) -> None:
        self.capacity, self.changes = capacity, 0
        self._hold(np.zeros((2, 0, size)))

    def _hold(self, rows: Array, count: int = 0, following: int = 0) -> None:
        """Take directions and images, ``(2, room, m)``, the first ``count`` of which are filled."""
        self._rows, self.count, self._next, self.changes = rows, count, following, self.changes + 1
        self.directions, self.images = rows[:, :count]

    def put(self, p: Array, image: Array) -> None:
        """Store another direction."""
        rows, at = self._rows, self._next
        if at == rows.shape[1]:
            more = min(max(at, 8), self.capacity - at)
            rows = np.empty((2, at + more, rows.shape[2]))  # memory comes as rows are filled
            rows[:, :at] = self._rows
        rows[0, at], rows[1, at] = p, image
        self._hold(rows, max(self.count, at + 1), (at + 1) % self.capacity)

    def clear(self) -> None:
        """Drop all directions."""
        self._hold(self._rows)


class Recycled(DirectionStore):
    """F-orthonormal search directions W of earlier solves, and their images FW.

    Farhat, Crivelli, Roux, Comput. Methods Appl. Mech. Engrg. 117 (1994) 195–209: solves with
    other right sides begin with the best of what is known, and go F-orthogonally to it. Each takes
    two vectors, and two more while it is new.
    """

    def __init__(
        self,
        capacity: int,
        comm: MPI.Intracomm,
        parameters: RecyclingParameters = RecyclingParameters(),
    ) -> None:
        super().__init__(capacity, 0)
        self.comm, self.parameters = comm, parameters
        self._on_face: tuple[int, Array, Array] = (-1, np.zeros(0), np.zeros(0))

    def add(self, x: Array, Fx: Array, energy: float) -> None:
        """Store x with Fx and xᵀFx > 0, made F-orthonormal to those stored. Collective.

        Where images are no longer right, all that was kept is forgotten. Three reductions.
        """
        x, Fx = x / np.sqrt(energy), Fx / np.sqrt(energy)
        if not self.count:
            self._hold(np.zeros((2, 0, len(x))))
        for passed in range(2):
            W, FW = self.directions, self.images
            a, same = summed(self.comm, np.array([FW @ x, W @ Fx]))
            if passed == 0 and bcast_from_root(
                self.comm, bool(np.any(np.abs(a - same) > self.parameters.wrong))
            ):
                self.clear()
                continue
            if self.count == self.capacity:
                a[self._next] = 0.0  # it goes
            x, Fx = x - a @ W, Fx - a @ FW
        energy = dot_over(self.comm, (x, Fx))[0]
        if energy >= self.parameters.new:
            self.put(x / np.sqrt(energy), Fx / np.sqrt(energy))

    def keep(self, x: Array, Fx: Array) -> None:
        """Store a direction with Fx, if its energy is positive. Collective."""
        energy = dot_over(self.comm, (x, Fx))[0]
        if energy > 0.0:
            self.add(x, Fx, energy)

    def in_order(self) -> Array:
        """Return this rank's part of W and FW, shape ``(m, 2, count)``, the oldest direction first.

        So they lie from then on: who takes them adds what it adds in the same order.
        """
        if self.count == self.capacity:
            self._hold(np.roll(self._rows, -self._next, axis=1), self.count)
        return np.array(self._rows[:, : self.count].transpose(2, 0, 1))

    def take(self, kept: Array) -> None:
        """Restore another run's directions, the newest ones if they are too many."""
        newest = kept[:, :, max(kept.shape[2] - self.capacity, 0) :]
        self._hold(np.zeros((2, 0, len(newest))))
        for w, Fw in newest.transpose(2, 1, 0):
            self.put(w, Fw)

    def without(self, values: Array) -> Array:
        """Orthonormal N so that values N = 0, for values linear in the columns of W. Collective.

        ``values`` is this rank's part, shape ``(l, count)``; N has the shape ``(count, k)``.
        """
        sizes, Vt = right_singular(self.comm, values)
        squares = summed(self.comm, np.sum(self.directions**2, axis=1))
        longest = float(np.sqrt(bcast_from_root(self.comm, float(squares.max(initial=0.0)))))
        return np.asarray(Vt[int(np.sum(sizes > self.parameters.held * longest)) :].T)

    def on_face(self, held: Array | None) -> Along | None:
        """Return steps along directions that are 0 on flagged rows; None without any. Collective.

        Of x and rows it gives W b and b = N Nᵀ rows x, by one reduction. For r = −P(Fλ − d) and the
        directions W as rows that is the step to where q is least; p less that for p and the images
        FW is F-orthogonal to W. They must stay as they are meanwhile.
        """
        N: Array | None = None
        if held is not None and self.count:
            changes, known, N = self._on_face
            same = changes == self.changes and np.array_equal(known, held)
            if any_rank(self.comm, not same):
                N = self.without(self.directions.T[held])
                self._on_face = self.changes, held, N

        def along(x: Array, rows: Array) -> tuple[Array, Array]:
            b = summed(self.comm, rows @ x)
            b = b if N is None else N @ (N.T @ b)
            step = self.directions.T @ b
            if held is not None:
                step[held] = 0.0
            return step, b

        return along if (self.count if N is None else N.shape[1]) else None


def right_singular(comm: MPI.Intracomm, A: Array) -> tuple[Array, Array]:
    """Return singular values and right singular vectors of A, spread over ranks. Collective.

    LAPACK's gesdd gives up on some graded triangles; its gesvd, which is slower, does not.
    """
    R = triangle(comm, A)
    try:
        return np.linalg.svd(R)[1:]
    except np.linalg.LinAlgError:
        return svd(R, lapack_driver="gesvd")[1:]


def triangle(comm: MPI.Intracomm, A: Array) -> Array:
    """R of A = QR, the rows of A spread over ranks; the same on all of them. Collective.

    Triangles of two ranks are made one after the other, in one reduction. Shape ``(k, k)`` for k
    columns.
    """
    k = A.shape[1]
    own, R = np.zeros((k, k)), np.linalg.qr(A, mode="r")
    own[: len(R)] = R
    if k == 0 or comm.size == 1:
        return own

    def of_both(given: Any, found: Any, _: MPI.Datatype) -> None:
        one, other = (np.frombuffer(part, dtype=float).reshape(-1, k, k) for part in (given, found))
        other[:] = np.linalg.qr(np.concatenate((one, other), axis=1), mode="r")

    whole, op = MPI.DOUBLE.Create_contiguous(k * k).Commit(), MPI.Op.Create(of_both)
    comm.Allreduce(MPI.IN_PLACE, [own, 1, whole], op=op)
    comm.Bcast(own, root=0)
    op.Free()
    whole.Free()
    return own
