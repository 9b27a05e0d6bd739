"""Directions of conjugate gradients that are kept, so that rounding does not undo what they did."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array

# of the largest curvature of a direction, and of what the preconditioner makes of a residual: less
# is rounding, as where rows depend on each other
FLAT = 1e-13
# numbers that a rank keeps at most: 192 MB
NUMBERS = 24_000_000


class Conjugates:
    """Directions p_i with PFp_i and p_iᵀFp_i, the last ones where memory lasts not for all.

    In exact arithmetic a new direction is conjugate to all if it is to the last one. Where F is ill
    conditioned on a face rounding undoes that, and what was solved for has to be solved for again
    (Farhat, Crivelli, Roux, Comput. Methods Appl. Mech. Engrg. 117, 1994, for FETI).

    Args:
        like: A vector of the right layout. The constructor is collective.
        numbers: How many a rank keeps at most.
    """

    def __init__(self, like: PETSc.Vec, numbers: int = NUMBERS) -> None:
        self.comm = like.getComm().tompi4py()
        rows = self.comm.allreduce(like.getLocalSize(), op=MPI.MAX)
        self._most = max(numbers // (2 * max(rows, 1)), 1)
        self._p, self._PFp = (np.zeros((0, like.getLocalSize())) for _ in range(2))
        self._pFp: Array = np.zeros(0)
        self._count = 0

    def clear(self) -> None:
        """Forget them."""
        self._count = 0

    @property
    def number(self) -> int:
        """How many there are."""
        return min(self._count, self._most)

    def products(self, z: Array) -> Array:
        """This rank's part of PFp_i·z, shape ``(k,)``."""
        return np.asarray(self._PFp[: self.number] @ z)

    def take_away(self, z: Array, products: Array) -> None:
        """Make z conjugate to them, in place; given the sums of products over all ranks."""
        z -= (products / self._pFp[: self.number]) @ self._p[: self.number]

    def keep(self, p: Array, PFp: Array, pFp: float) -> None:
        """Keep another one, in the place of the oldest if there are too many."""
        at = self._count % self._most
        if at == len(self._pFp):
            more = min(max(len(self._pFp), 8), self._most - len(self._pFp))
            self._p, self._PFp = (
                np.concatenate((known, np.zeros((more, known.shape[1]))))
                for known in (self._p, self._PFp)
            )
            self._pFp = np.append(self._pFp, np.zeros(more))
        self._p[at], self._PFp[at], self._pFp[at] = p, PFp, pFp
        self._count += 1


class Directions:
    """What PCPG remembers, so that it can go on where it has stopped.

    Args:
        like: A vector of the right layout.

    Attributes:
        r: Residual −P g.
        p: The last direction.
        fresh: Whether the next direction is the first.
        kept: Directions that the next one is made conjugate to.
        norm: Largest Rayleigh quotient of F that a direction has shown; at most ‖PFP‖.
        helped: Largest rᵀz/rᵀr so far.
    """

    def __init__(self, like: PETSc.Vec) -> None:
        self.r, self.p, self.Fp, self.z = (like.duplicate() for _ in range(4))
        self.fresh, self.norm, self.helped = True, 0.0, 0.0
        self.kept = Conjugates(like)

    def seen(self, pFp: float, pp: float, short: bool = False) -> bool:
        """Whether a direction has a curvature that stands out from rounding.

        Of a short step, which may be rounding of Gλ = e, F makes far too much to learn ‖F‖ from.
        """
        if not short:
            self.norm = max(self.norm, pFp / pp if pp > 0.0 else 0.0)
        return pFp > FLAT * self.norm * pp

    def stands_out(self, rz: float, rr: float) -> bool:
        """Whether the preconditioner leaves something of a residual."""
        self.helped = max(self.helped, rz / rr if rr > 0.0 else 0.0)
        return rz > FLAT * self.helped * rr

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self.r, self.p, self.Fp, self.z):
            vec.destroy()
