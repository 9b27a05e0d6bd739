"""The least displacement that closes what rows miss."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.gluing.constraints import Constraints

# Conjugate gradients for least squares: with the usual eigenvalues of B_f D⁻¹ B_fᵀ, 0.6 to 2, about
# 15 steps to this part of the first gradient; what is left of w then has at most 1e-2 of its energy
# where one is 1e-8.
EXACT, MOST_STEPS = 1e-10, 100


def closing(constraints: Constraints, w: PETSc.Vec, closed: Array) -> Array:
    """The least displacement v in D for which B_f v comes nearest to w. Collective.

    Gluing and Dirichlet rows are orthonormal in D⁻¹, and orthogonal to contact rows: D⁻¹B_fᵀw
    closes them. Contact rows are not so to each other: where a stiff and fine side is the secondary
    one, several of them act on the same soft nodes of the primary one, nearly alike; and where
    walls meet, rows of a node depend on each other, so that no v has B_f v = w.

    Args:
        constraints: B and D.
        w: What rows miss, zero on rows that are not asked about.
        closed: Flags of the local contact rows that are, in the order of ``sets.contact``.

    Returns:
        On this rank's trace unknowns, shape ``(Σ t_s,)``.
    """
    rows, z = _Rows(constraints, closed), w.duplicate()
    own, contact = np.array(w.array_r), constraints.sets.contact
    missed = np.where(closed, own[contact], 0.0)
    own[contact] = 0.0
    z.array[:] = own
    v = rows.spread(z) + rows.nearest(missed)
    z.destroy()
    rows.destroy()
    return v


class _Rows:
    """B_f and D on the contact rows flagged."""

    def __init__(self, constraints: Constraints, rows: Array) -> None:
        self._constraints, self._rows = constraints, rows
        self._contact = constraints.sets.contact
        self._comm = constraints.B.getComm().tompi4py()
        self._x, self._y = constraints.c.duplicate(), constraints.c.duplicate()
        self._v = constraints.B.createVecRight()
        self._x.set(0.0)

    def spread(self, z: PETSc.Vec) -> Array:
        """D⁻¹Bᵀz."""
        self._constraints.B.multTranspose(z, self._v)
        return np.asarray(self._v.array_r / self._constraints.weights)

    def nearest(self, w: Array) -> Array:
        """The least v with B_f v nearest to w, zero off the rows, by conjugate gradients."""
        D, r = self._constraints.weights, w.copy()
        s = self._upwards(r)
        v, p, left = np.zeros_like(s), s.copy(), self._dot(s, D * s)
        first = left
        for _ in range(MOST_STEPS):
            if left <= EXACT**2 * first:
                break
            q = self._downwards(p)
            curvature = self._dot(q, q)
            if curvature == 0.0:
                break
            length = left / curvature
            v += length * p
            r -= length * q
            s = self._upwards(r)
            left, before = self._dot(s, D * s), left
            p = s + left / before * p
        return v

    def _upwards(self, r: Array) -> Array:
        """D⁻¹B_fᵀr."""
        self._x.array[self._contact] = r
        return self.spread(self._x)

    def _downwards(self, v: Array) -> Array:
        """B_f v."""
        self._v.array[:] = v
        self._constraints.B.mult(self._v, self._y)
        return np.where(self._rows, self._y.array_r[self._contact], 0.0)

    def _dot(self, a: Array, b: Array) -> float:
        return float(self._comm.allreduce(a @ b))

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self._x, self._y, self._v):
            vec.destroy()
