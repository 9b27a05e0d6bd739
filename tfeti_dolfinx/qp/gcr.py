"""Generalised conjugate residuals: for operators that are not symmetric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed, summed

# of Az: what earlier directions leave of it, less is rounding; and of the residual: what a
# direction takes from it, or there is nothing to gain
NEW, GAIN = 1e-7, 1e-8


@dataclass(frozen=True)
class Gone:
    """Where the directions have led from 0.

    Attributes:
        u: The solution.
        image: What was given with each Az, combined as u is.
        residual: ‖b − Au‖.
        steps: Directions gone, each for one multiplication.
    """

    u: Array
    image: Array
    residual: float
    steps: int


def gcr(
    apply: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    b: Array,
    target: float,
    most: int,
    comm: MPI.Intracomm,
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
    """
    u, image, r = np.zeros_like(b), np.zeros_like(b), np.array(b)
    Q, Z, images = [np.zeros((0, len(b))) for _ in range(3)]
    size, steps = agreed(comm, float(np.sqrt(summed(comm, np.array([b @ b]))[0]))), 0
    while size > target and steps < most:
        z = precondition(r)
        q, w = apply(z)
        sums = summed(comm, np.concatenate((Q @ q, (q @ q, q @ r, r @ r))))
        c, (square, along, left) = sums[:-3], sums[-3:]
        length = float(np.sqrt(max(square - c @ c, 0.0)))
        steps += 1
        if agreed(comm, length <= NEW * np.sqrt(square) or abs(along) <= GAIN * length * size):
            break
        q, z, w = ((x - c @ X) / length for x, X in ((q, Q), (z, Z), (w, images)))
        step = along / length
        u, image, r = u + step * z, image + step * w, r - step * q
        Q, Z, images = (np.vstack((X, x)) for X, x in ((Q, q), (Z, z), (images, w)))
        size = agreed(comm, float(np.sqrt(max(left - step**2, 0.0))))
    return Gone(u, image, size, steps)
