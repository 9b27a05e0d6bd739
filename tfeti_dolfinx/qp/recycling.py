"""Recycling of search directions, with their products with F, from earlier solves."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, summed
from tfeti_dolfinx.qp.sets import Face

# of the energy of a direction: what stands out from those that are kept; where less does, rounding
# of their images would grow from one to the next
NEW = 0.1
# of wᵀFp, for w and p of energy 1: where Fw says otherwise than Fp it is no longer F of w
WRONG = 1e-9
# of the longest direction: less on rows that a face holds is rounding
HELD = 1e-10


class DirectionStore:
    """Directions p of energy pᵀFp = 1 and their images, as rows; this rank's part.

    Args:
        capacity: Most directions; where they are more the oldest goes.
        size: Rows of this rank.

    Attributes:
        count: Number of directions.
    """

    def __init__(self, capacity: int, size: int) -> None:
        self.capacity, self.count, self._next = capacity, 0, 0
        self._rows: Array = np.zeros((2, 0, size))

    @property
    def directions(self) -> Array:
        """Directions, in no order, shape ``(count, m)``."""
        return np.asarray(self._rows[0, : self.count])

    @property
    def images(self) -> Array:
        """Their images, likewise."""
        return np.asarray(self._rows[1, : self.count])

    def put(self, p: Array, image: Array) -> None:
        """Store another direction."""
        room = self._rows.shape[1]
        if self._next == room:
            more = min(max(room, 8), self.capacity - room)
            more_rows = np.zeros((2, more, self._rows.shape[2]))
            self._rows = np.concatenate((self._rows, more_rows), axis=1)
        self._rows[0, self._next], self._rows[1, self._next] = p, image
        self.count = max(self.count, self._next + 1)
        self._next = (self._next + 1) % self.capacity

    def clear(self) -> None:
        """Drop all directions."""
        self.count = self._next = 0


class Recycled(DirectionStore):
    """F-orthonormal search directions W of earlier solves, and their images FW.

    Farhat, Crivelli, Roux, Comput. Methods Appl. Mech. Engrg. 117 (1994) 195–209: solves with
    other right sides begin with the best of what is known, and go F-orthogonally to it.

    Args:
        capacity: Most directions; each takes two vectors, and two more while it is new.
        comm: Communicator.
    """

    def __init__(self, capacity: int, comm: MPI.Intracomm) -> None:
        super().__init__(capacity, 0)
        self.comm = comm

    @property
    def columns(self) -> tuple[Array, Array]:
        """This rank's part of W and FW, in no order, shapes ``(m, count)``."""
        return self.directions.T, self.images.T

    def add(self, x: Array, Fx: Array, energy: float) -> None:
        """Store a direction, made F-orthonormal to those stored. Collective, three reductions.

        Where images are no longer right, all that was kept is forgotten.

        Args:
            x: The direction, this rank's part.
            Fx: What F makes of it.
            energy: xᵀFx > 0, over all ranks.
        """
        x, Fx = x / np.sqrt(energy), Fx / np.sqrt(energy)
        self._set_size(len(x))
        for passed in range(2):
            W, FW = self.directions, self.images
            a, same = summed(self.comm, np.array([FW @ x, W @ Fx]))
            if passed == 0 and bcast_from_root(self.comm, bool(np.any(np.abs(a - same) > WRONG))):
                self.clear()
                continue
            if self.count == self.capacity:
                a[self._next] = 0.0  # it goes
            x, Fx = x - a @ W, Fx - a @ FW
        energy = float(summed(self.comm, np.array([x @ Fx]))[0])
        if bcast_from_root(self.comm, energy >= NEW):
            self.put(x / np.sqrt(energy), Fx / np.sqrt(energy))

    def _set_size(self, size: int) -> None:
        """Make room for vectors of so many rows, if there is none."""
        if not self.count and self._rows.shape[2] != size:
            self._rows = np.zeros((2, 0, size))

    def in_order(self) -> Array:
        """Return this rank's part of W and FW, shape ``(2, m, count)``, the oldest direction first.

        So they lie from then on: who takes them adds what it adds in the same order.
        """
        if self.count == self.capacity:
            self._rows, self._next = np.roll(self._rows, -self._next, axis=1), 0
        return np.array(self._rows[:, : self.count].transpose(0, 2, 1))

    def take(self, kept: Array) -> None:
        """Restore another run's directions, the newest ones if they are too many."""
        newest = kept[:, :, max(kept.shape[2] - self.capacity, 0) :]
        self.clear()
        self._set_size(newest.shape[1])
        for w, Fw in zip(newest[0].T, newest[1].T, strict=True):
            self.put(w, Fw)

    def within(self, held: Array | None) -> Array | None:
        """Return orthonormal N so that W N is 0 on rows, shape ``(count, k)``. Collective.

        Args:
            held: Flags of the local rows; None: no rows, and then N is None, too.
        """
        return None if held is None else self.without(self.columns[0][held])

    def without(self, values: Array) -> Array:
        """Orthonormal N so that values N = 0, for values of W's columns, shape ``(count, k)``.

        Collective.

        Args:
            values: Linear in the columns of W, this rank's part, shape ``(l, count)``.
        """
        _, sizes, Vt = np.linalg.svd(triangle(self.comm, values))
        squares = summed(self.comm, np.sum(self.directions**2, axis=1))
        longest = float(np.sqrt(bcast_from_root(self.comm, float(squares.max(initial=0.0)))))
        return np.asarray(Vt[int(np.sum(sizes > HELD * longest)) :].T)


class RecycledOnFace:
    """Directions of earlier solves that lie in a face, by default that of all rows.

    Args:
        known: All directions; kept as an attribute.
        held: Flags of the local rows that are 0 on the face; None: no rows.
    """

    def __init__(self, known: Recycled, held: Array | None = None) -> None:
        self.known, self._held = known, held
        self._N: Array | None = None
        self._active = False
        self._new = deque[tuple[Array, Array, float]](maxlen=known.capacity)

    def on(self, face: Face) -> RecycledOnFace:
        """Those within another face."""
        return RecycledOnFace(self.known, face.held)

    def go(
        self,
        lam: PETSc.Vec,
        g: PETSc.Vec,
        r: PETSc.Vec,
        project: Callable[[PETSc.Vec], None],
    ) -> bool:
        """Go where q is least along W. Collective.

        Args:
            lam: A point; updated.
            g: Fλ − d; updated.
            r: −P g.
            project: P, in place: takes away what rounding of many directions leaves of Gλ = e.

        Returns:
            Whether there is any direction.
        """
        self.keep()
        known = self.known
        self._active = known.count > 0
        if self._active:
            self._N = known.within(self._held)
            self._active = self._N is None or self._N.shape[1] > 0
        if self._active:
            W, FW = known.columns
            b = self._part(summed(known.comm, W.T @ r.array_r))
            way = lam.duplicate()
            way.array[:] = self._combined(b)
            project(way)
            lam.axpy(1.0, way)
            g.array[:] += FW @ b
            way.destroy()
        return self._active

    def conjugate(self, p: PETSc.Vec) -> None:
        """Make a direction F-orthogonal to W. Collective, one reduction, or none without W."""
        if self._active:
            known = self.known
            a = summed(known.comm, known.columns[1].T @ p.array_r)
            p.array[:] -= self._combined(self._part(a))

    def remember(self, p: PETSc.Vec, Fp: PETSc.Vec, energy: float) -> None:
        """Record a search direction, to be stored after the solve, as W stays during it."""
        self._new.append((np.array(p.array_r), np.array(Fp.array_r), energy))

    def keep(self) -> None:
        """Store the recorded directions. Collective."""
        while self._new:
            self.known.add(*self._new.popleft())
        self._active = False

    def _part(self, a: Array) -> Array:
        """N Nᵀ a."""
        return a if self._N is None else self._N @ (self._N.T @ a)

    def _combined(self, b: Array) -> Array:
        """W b, 0 where the face holds rows."""
        x = self.known.columns[0] @ b
        if self._held is not None:
            x[self._held] = 0.0
        return np.asarray(x)


def triangle(comm: MPI.Intracomm, A: Array) -> Array:
    """R of A = QR, the rows of A spread over ranks; the same on all of them. Collective."""

    def of(rows: Array) -> Array:
        return np.asarray(np.linalg.qr(rows, mode="r"))

    return bcast_from_root(
        comm, comm.allreduce(of(A), op=lambda one, other: of(np.vstack((one, other))))
    )
