"""Generalised conjugate residuals: for operators that are not symmetric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed, norm_over, summed

# of Az: what earlier directions leave of it, less is rounding; and of the residual: what a
# direction takes from it, or there is nothing to gain
NEW, GAIN = 1e-7, 1e-8


@dataclass(frozen=True)
class Known:
    """Directions of which A is known, as rows.

    Attributes:
        Q: Az of each, orthonormal over all ranks, this rank's part, shape ``(k, n)``.
        Z: The directions z.
        images: What is given with each Az.
    """

    Q: Array
    Z: Array
    images: Array

    @staticmethod
    def nothing(like: Array) -> Known:
        """None, of vectors like one."""
        return Known(*(np.zeros((0, len(like))) for _ in range(3)))

    def without(self, c: Array, q: Array, z: Array, w: Array) -> tuple[Array, Array, Array]:
        """A direction with its Az and image, less such parts of those that are known."""
        return q - c @ self.Q, z - c @ self.Z, w - c @ self.images


@dataclass(frozen=True)
class Gone:
    """Where the directions have led from 0.

    Attributes:
        u: The solution.
        image: What was given with each Az, combined as u is.
        new: The directions gone, each for one multiplication.
        length: The least step along one of them, over Mr less earlier directions; 0 without any.
    """

    u: Array
    image: Array
    new: Known
    length: float


def gcr(
    apply: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    b: Array,
    target: float,
    most: int,
    comm: MPI.Intracomm,
    known: Known | None = None,
) -> Gone:
    """Make ‖b − Au‖ least over more and more directions. Collective; one sum over ranks a step.

    Eisenstat, Elman, Schultz, SIAM J. Numer. Anal. 20 (1983) 345–357: each direction z = Mr with
    Az orthogonal to those before. All are kept.

    Args:
        apply: Gives Az, and what else is linear in z and wanted of u.
        precondition: M.
        b: Right side, this rank's part.
        target: Ends at ‖b − Au‖ ≤ target.
        most: Most directions.
        comm: Communicator.
        known: Directions to begin with.
    """
    old, new = known or Known.nothing(b), _Growing(len(b))
    c = summed(comm, old.Q @ b)
    u, image, r = c @ old.Z, c @ old.images, b - c @ old.Q
    size, lengths = norm_over(comm, r), list[float]()
    while size > target and new.count < most:
        z = precondition(r)
        q, w = apply(z)
        sums = summed(comm, np.concatenate((old.Q @ q, new.rows.Q @ q, (q @ q, q @ r, r @ r))))
        c, (square, along, left) = sums[:-3], sums[-3:]
        length = float(np.sqrt(max(square - c @ c, 0.0)))
        if agreed(comm, length <= NEW * np.sqrt(square) or abs(along) <= GAIN * length * size):
            break
        q, z, w = new.rows.without(c[len(old.Q) :], *old.without(c[: len(old.Q)], q, z, w))
        q, z, w, step = q / length, z / length, w / length, along / length
        u, image, r = u + step * z, image + step * w, r - step * q
        new.add(q, z, w)
        lengths.append(step / length)
        size = agreed(comm, float(np.sqrt(max(left - step**2, 0.0))))
    return Gone(u, image, new.rows, agreed(comm, max(min(lengths, default=0.0), 0.0)))


class _Growing:
    """Directions, with room for more.

    Args:
        size: Of this rank's part.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self._room: Array = np.zeros((3, 8, size))

    @property
    def rows(self) -> Known:
        """What there is."""
        return Known(*self._room[:, : self.count])

    def add(self, q: Array, z: Array, w: Array) -> None:
        """Take one more."""
        if self.count == self._room.shape[1]:
            self._room = np.concatenate((self._room, np.zeros_like(self._room)), axis=1)
        self._room[:, self.count] = q, z, w
        self.count += 1
