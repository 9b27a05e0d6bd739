"""Closed convex sets that are products of small ones: bounds now, discs and ellipses later.

A set knows its own rows of this rank as numpy arrays, nothing of ranks and other rows: solvers
add up over ranks, ``Product`` puts sets on rows. Nothing here is collective.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.qp.faces import Face, Status, face_of


class FeasibleSet(Protocol):
    """A set Ω of vectors of n entries, and the parts of a gradient that belong to it.

    All arrays have the shape ``(n,)``; none that is passed may be written to.
    ``check_feasible_set`` tests any implementation.
    """

    def project(self, x: Array) -> Array:
        """P_Ω(x), the nearest point of Ω."""
        ...

    def split(self, x: Array, g: Array) -> tuple[Array, Array]:
        """Free gradient φ and chopped gradient β at x ∈ Ω; φ + β is the projected gradient."""
        ...

    def reduced(self, x: Array, phi: Array, alpha: float) -> Array:
        """Reduced free gradient φ̃ = (x − P_Ω(x − α φ))/α."""
        ...

    def max_step(self, x: Array, p: Array) -> float:
        """Largest α with x − α p ∈ Ω, maybe infinite."""
        ...

    def shifted(self, shift: Array) -> FeasibleSet:
        """The set Ω − shift."""
        ...

    def face(self, x: Array, g: Array) -> Face:
        """The face of x ∈ Ω, given the gradient there."""
        ...

    def onto(self, x: Array, status: Array) -> Array:
        """P_Ω(x), but on their bounds where rows are open, and on the boundary where they slip."""
        ...


class Bounds:
    """x_i ≥ l_i.

    Args:
        lower: The bounds l, shape ``(n,)``, or one for all entries.
    """

    def __init__(self, lower: Array | float = 0.0) -> None:
        self.lower = lower

    def project(self, x: Array) -> Array:
        """max(x, l)."""
        return np.maximum(x, self.lower)

    def split(self, x: Array, g: Array) -> tuple[Array, Array]:
        """φ = g off the bounds; β = min(g, 0) on them."""
        bound = x <= self.lower
        return np.where(bound, 0.0, g), np.where(bound, np.minimum(g, 0.0), 0.0)

    def reduced(self, x: Array, phi: Array, alpha: float) -> Array:
        """φ̃_i = min((x_i − l_i)/α, φ_i)."""
        return np.minimum((x - self.lower) / alpha, phi)

    def max_step(self, x: Array, p: Array) -> float:
        """min over p_i > 0 of (x_i − l_i)/p_i."""
        down = p > 0.0
        return float(np.min((x - self.lower)[down] / p[down], initial=np.inf))

    def shifted(self, shift: Array) -> Bounds:
        """Bounds l − shift."""
        return Bounds(self.lower - shift)

    def face(self, x: Array, g: Array) -> Face:
        """Rows off their bounds are free: they touch."""
        off = np.asarray(x > self.lower)
        return face_of(off, np.where(off, Status.TOUCHING, Status.OPEN))

    def onto(self, x: Array, status: Array) -> Array:
        """max(x, l); l where rows are open."""
        return np.where(status == Status.OPEN, self.lower, self.project(x))


class Product:
    """Sets on disjoint rows; rows of none are free. Without sets it is the whole space.

    >>> half_line = Product([(np.array([0]), Bounds())])
    >>> half_line.project(np.array([-1.0, -1.0])).tolist()
    [0.0, -1.0]
    >>> half_line.face(np.array([0.0, -1.0]), np.zeros(2)).carrying.tolist()
    [False, True]

    Args:
        factors: Pairs of rows, a slice or an array of indices, and the set of these rows.

    Raises:
        InputError: A row stands in two sets.
    """

    def __init__(self, factors: Sequence[tuple[slice | Array, FeasibleSet]] = ()) -> None:
        self.factors = [(_indices(rows), factor) for rows, factor in factors]
        rows, count = np.unique(
            np.concatenate([np.empty(0, dtype=np.int64), *(rows for rows, _ in self.factors)]),
            return_counts=True,
        )
        if np.any(count > 1):
            raise InputError(
                f"Product: row {rows[count > 1][0]} stands in two sets; expected one at most"
            )

    def project(self, x: Array) -> Array:
        """P of each set on its rows."""
        y = np.array(x)
        for rows, factor in self.factors:
            y[rows] = factor.project(x[rows])
        return y

    def split(self, x: Array, g: Array) -> tuple[Array, Array]:
        """φ and β of each set; φ = g on free rows."""
        phi, beta = np.array(g), np.zeros(len(g))
        for rows, factor in self.factors:
            phi[rows], beta[rows] = factor.split(x[rows], g[rows])
        return phi, beta

    def reduced(self, x: Array, phi: Array, alpha: float) -> Array:
        """φ̃ of each set; φ on free rows."""
        values = np.array(phi)
        for rows, factor in self.factors:
            values[rows] = factor.reduced(x[rows], phi[rows], alpha)
        return values

    def max_step(self, x: Array, p: Array) -> float:
        """The least of all sets."""
        steps = [factor.max_step(x[rows], p[rows]) for rows, factor in self.factors]
        return min([float(np.inf), *steps])

    def shifted(self, shift: Array) -> Product:
        """Each set, shifted."""
        return Product([(rows, factor.shifted(shift[rows])) for rows, factor in self.factors])

    def face(self, x: Array, g: Array) -> Face:
        """Free rows, then the directions of each set."""
        status, free = np.full(len(x), Status.FREE), np.ones(len(x), dtype=bool)
        faces = []
        for rows, factor in self.factors:
            face = factor.face(x[rows], g[rows])
            status[rows], free[rows] = face.status, False
            faces.append((rows, face))
        return _joined([(np.arange(len(x)), face_of(free, status)), *faces], status)

    def onto(self, x: Array, status: Array) -> Array:
        """Each set's, x itself on free rows."""
        values = np.array(x)
        for rows, factor in self.factors:
            values[rows] = factor.onto(x[rows], status[rows])
        return values


def _indices(rows: slice | Array) -> Array:
    """Rows as indices, in their order."""
    if isinstance(rows, slice):
        return np.arange(rows.start or 0, rows.stop, dtype=np.int64)
    return np.asarray(rows, dtype=np.int64)


def _joined(faces: Sequence[tuple[Array, Face]], status: Array) -> Face:
    """The directions of several faces on their rows, one after the other."""
    row, column, value, start = [], [], [], 0
    for rows, face in faces:
        Z = face.Z.tocoo()
        row.append(rows[Z.coords[0]])
        column.append(start + Z.coords[1])
        value.append(Z.data)
        start += Z.shape[1]
    coordinates = (np.concatenate(row), np.concatenate(column))
    Z = csr_array((np.concatenate(value), coordinates), shape=(len(status), start))
    return Face(Z, np.concatenate([face.curvature for _, face in faces]), status)
