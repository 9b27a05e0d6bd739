"""The least displacement that closes what rows miss."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.gluing.constraints import Constraints

# Conjugate gradients for B_f D⁻¹ B_fᵀ: with its usual eigenvalues, 0.6 to 2, about 10 steps to this
# residual; what is left of w then has at most 1e-2 of its energy where one is 1e-8.
EXACT, MOST_STEPS = 1e-6, 100
# curvature of a direction, usually about 1: rows that are dependent but for rounding, whose
# differences nothing can close
DEPENDENT = 1e-10


def closing(constraints: Constraints, w: PETSc.Vec, closed: Array) -> Array:
    """v = D⁻¹B_fᵀ(B_f D⁻¹ B_fᵀ)⁻¹w, the least displacement in D with B_f v = w. Collective.

    Gluing and Dirichlet rows are orthonormal in D⁻¹, and orthogonal to contact rows. Contact rows
    are not so to each other: where a stiff and fine side is the secondary one, several of them act
    on the same soft nodes of the primary one, nearly alike.

    Args:
        constraints: B and D.
        w: What rows miss, zero on rows that are not asked about.
        closed: Flags of the local contact rows that are, in the order of ``sets.contact``.

    Returns:
        On this rank's trace unknowns, shape ``(Σ t_s,)``.
    """
    gram = _Gram(constraints, closed)
    z, found = w.duplicate(), np.array(w.array_r)
    contact = constraints.sets.contact
    found[contact] = gram.solve(found[contact])
    z.array[:] = found
    v = gram.spread(z)
    z.destroy()
    gram.destroy()
    return v


class _Gram:
    """B_f D⁻¹ B_fᵀ on the contact rows flagged."""

    def __init__(self, constraints: Constraints, rows: Array) -> None:
        self._constraints, self._rows = constraints, rows
        self._contact = constraints.sets.contact
        self._comm = constraints.B.getComm().tompi4py()
        self._x, self._y = constraints.c.duplicate(), constraints.c.duplicate()
        self._v = constraints.B.createVecRight()

    def spread(self, z: PETSc.Vec) -> Array:
        """D⁻¹Bᵀz."""
        self._constraints.B.multTranspose(z, self._v)
        self._v.array[:] /= self._constraints.weights
        return np.array(self._v.array_r)

    def solve(self, w: Array) -> Array:
        """Conjugate gradients; w is zero off the rows."""
        x, r, p = np.zeros_like(w), w.copy(), w.copy()
        size = left = self._dot(r, r)
        for _ in range(MOST_STEPS):
            if left <= EXACT**2 * size:
                break
            q = self._mult(p)
            curvature = self._dot(p, q)
            if curvature <= DEPENDENT * self._dot(p, p):
                break
            x += left / curvature * p
            r -= left / curvature * q
            left, before = self._dot(r, r), left
            p = r + left / before * p
        return x

    def _mult(self, p: Array) -> Array:
        self._x.array[self._contact] = p
        self.spread(self._x)
        self._constraints.B.mult(self._v, self._y)
        return np.where(self._rows, self._y.array_r[self._contact], 0.0)

    def _dot(self, a: Array, b: Array) -> float:
        return float(self._comm.allreduce(a @ b))

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self._x, self._y, self._v):
            vec.destroy()
