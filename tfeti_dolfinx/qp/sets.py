"""Feasible sets: bounds, ellipses, their products and faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.errors import InputError

# --- Faces ------------------------------------------------------------------------------------


class Status(IntEnum):
    """Status of a row at a point of a feasible set.

    FREE: no set constrains it. OPEN: it is on its bound, and what it multiplies may open.
    TOUCHING: it is off its bound, in contact. STICK: inside its disc. SLIP: on its circle, and
    pushed against it.
    """

    FREE = 0
    OPEN = 1
    TOUCHING = 2
    STICK = 3
    SLIP = 4


@dataclass(frozen=True)
class Face:
    """The face of a feasible set on which a point lies, on this rank's rows.

    Attributes:
        Z: Free directions as orthonormal columns, scipy CSR, shape ``(m, k)``; each of them
            lives on this rank.
        curvature: What the set's boundary adds to the Hessian along each direction: where the
            gradient pushes against it, moving along the set by Zt changes gᵀx by
            gᵀZt + ½ Σ κ_j t_j². 0 where it is flat or not pushed against. Shape ``(k,)``.
        status: Status of each row, shape ``(m,)``.
    """

    Z: csr_array
    curvature: Array
    status: Array

    @property
    def carrying(self) -> Array:
        """Rows that carry a force: all but the open ones; flags, shape ``(m,)``."""
        return np.asarray(self.status != Status.OPEN)

    @property
    def holding(self) -> Array:
        """Rows that hold what they multiply, Bu = c: neither open nor slipping; flags."""
        return self.carrying & (self.status != Status.SLIP)

    @property
    def constrained(self) -> Array:
        """Rows that some set constrains; flags, shape ``(m,)``."""
        return np.asarray(self.status != Status.FREE)

    @property
    def held(self) -> Array:
        """Rows that no direction moves; flags."""
        return np.asarray(np.diff(self.Z.indptr) == 0)

    @property
    def curved(self) -> bool:
        """True if some row of this rank slips along a boundary."""
        return bool(np.any(np.diff(self.Z.indptr)[self.status == Status.SLIP]))

    def damped(self) -> Face:
        """Z diag(1 + κ)^{-1/2}: ZZᵀ is the derivative of P_Ω at x, P_Ω(x) − x its gradient."""
        if not np.any(self.curvature):
            return self
        share = diags_array(1.0 / np.sqrt(1.0 + self.curvature))
        return Face(csr_array(self.Z @ share), self.curvature, self.status)

    def with_directions(self, kept: Array) -> Face:
        """Return the face with some of its directions only, the others held."""
        return Face(csr_array(self.Z[:, kept]), self.curvature[kept], self.status)

    def restricted(self, x: Array) -> Array:
        """Z Zᵀ x: the part of vectors, shapes ``(m,)`` or ``(m, q)``, that lies in the face."""
        if self._of_coordinates:
            return np.where(np.diff(self.Z.indptr) > 0, x.T, 0.0).T
        return np.asarray(self.Z @ (self.Z.T @ x))

    @cached_property
    def _of_coordinates(self) -> bool:
        """True if the directions are coordinates: unit columns with one entry each."""
        return bool(self.Z.nnz == self.Z.shape[1] and np.all(np.abs(self.Z.data) == 1.0))


def without_slip(face: Face, x: Array) -> Array:
    """x, 0 where rows slip: these follow their boundary, no bound stops them."""
    return np.where(face.status == Status.SLIP, 0.0, x)


def face_of(free: Array, status: Array) -> Face:
    """Return a flat face whose directions are coordinates.

    Args:
        free: Flags of the rows that may move, shape ``(m,)``.
        status: Status of each row.
    """
    rows = np.flatnonzero(free)
    k, m = len(rows), len(free)
    Z = csr_array((np.ones(k), (rows, np.arange(k))), shape=(m, k))
    return Face(Z, np.zeros(k), status)


# --- Feasible sets ----------------------------------------------------------------------------
# A set knows its own rows of this rank as numpy arrays, nothing of ranks and other rows: solvers
# add up over ranks, ``Product`` puts sets on rows. Nothing here is collective.


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

    def max_step(self, x: Array, p: Array) -> float:
        """Return the largest α with x − α p ∈ Ω, maybe infinite."""
        ...

    def face(self, x: Array, g: Array) -> Face:
        """Return the face of x ∈ Ω, given the gradient there."""
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

    def max_step(self, x: Array, p: Array) -> float:
        """min over p_i > 0 of (x_i − l_i)/p_i."""
        down = p > 0.0
        return float(np.min((x - self.lower)[down] / p[down], initial=np.inf))

    def face(self, x: Array, g: Array) -> Face:
        """Return the face of x: rows off their bounds are free, they touch."""
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

    def max_step(self, x: Array, p: Array) -> float:
        """Return the least of all sets."""
        steps = [factor.max_step(x[rows], p[rows]) for rows, factor in self.factors]
        return min([float(np.inf), *steps])

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
    """Return rows as indices, in their order."""
    if isinstance(rows, slice):
        return np.arange(rows.start or 0, rows.stop, dtype=np.int64)
    return np.asarray(rows, dtype=np.int64)


def _joined(faces: Sequence[tuple[Array, Face]], status: Array) -> Face:
    """Return the directions of several faces on their rows, one after the other."""
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


# --- Ellipses ---------------------------------------------------------------------------------

# of the boundary's distance from the centre: what is so near to the boundary is on it
ON = 1e-10
# Newton's method for the secular equation: far more steps than it takes, and where it ends
MOST_STEPS, SOLVED = 60, 9e-16


class Ellipses:
    """Σ_j (x_ij/a_ij)² ≤ 1: points x_i of one or two neighbouring entries each.

    A semi-axis of 0 fixes its entry; with both of them 0 the set is 0. Equal ones make a disc.

    >>> slab = Ellipses(np.array([[2.0, 1.0]]))
    >>> slab.project(np.array([0.0, 3.0])).tolist(), slab.project(np.array([0.5, 0.5])).tolist()
    ([0.0, 1.0], [0.5, 0.5])

    Args:
        semi_axes: The a_ij, 0 or more, shape ``(n, k)``, k = 1 or 2.
    """

    def __init__(self, semi_axes: Array) -> None:
        self.semi_axes = np.asarray(semi_axes, dtype=float)
        self._moves = self.semi_axes > 0.0
        self._inverse = np.divide(
            1.0, self.semi_axes, out=np.zeros(self.semi_axes.shape), where=self._moves
        )

    def project(self, x: Array) -> Array:
        """Return the nearest points of the ellipses."""
        t = self._points(x)
        outside = self._level(t) > 1.0
        nearest = np.where(self._moves, t, 0.0)
        nearest[outside] = self._nearest(t[outside], outside)
        return np.asarray(nearest.ravel())

    def split(self, x: Array, g: Array) -> tuple[Array, Array]:
        """φ = g inside; on the boundary β = g − min(nᵀg, 0)n, n its outward normal."""
        t = self._points(x)
        on, normal = self._boundary(t)
        g = np.where(self._moves, self._points(g), 0.0)
        pushing = np.minimum(np.sum(normal * g, axis=1), 0.0)
        phi = np.where(on[:, None], 0.0, g)
        beta = np.where(on[:, None], g - pushing[:, None] * normal, 0.0)
        return phi.ravel(), beta.ravel()

    def max_step(self, x: Array, p: Array) -> float:
        """Largest α with x − αp inside: the smallest root of a quadratic equation for each."""
        p = self._points(p)
        if np.any(p[~self._moves]):
            return 0.0
        t, p = self._points(x) * self._inverse, p * self._inverse
        a, b = np.sum(p * p, axis=1), np.sum(p * t, axis=1)
        moves = a > 0.0
        a, b = a[moves], b[moves]
        room = np.maximum(1.0 - np.sum(t[moves] ** 2, axis=1), 0.0)
        root = np.sqrt(b * b + a * room)
        # of the two forms of the larger root of aα² − 2bα = room the one that cancels nothing
        steps = np.where(b > 0.0, (b + root) / a, room / np.maximum(root - b, TINY))
        return float(np.min(steps, initial=np.inf))

    def face(self, x: Array, g: Array) -> Face:
        """Inside all directions are free: it sticks. On the boundary the tangent: it slips."""
        t = self._points(x)
        on, normal = self._boundary(t)
        status = np.where(on[:, None], Status.SLIP, Status.STICK)
        status = np.where(self._moves, status, Status.OPEN)
        inside = np.flatnonzero(self._moves & ~on[:, None])
        along = np.flatnonzero(on & self._moves.all(axis=1) & (self.semi_axes.shape[1] == 2))
        Z = _directions(inside, along, normal, x.size)
        curvature = self._curvature(t, np.where(self._moves, self._points(g), 0.0), normal)
        kappa = np.concatenate((np.zeros(len(inside)), curvature[along]))
        return Face(Z, kappa, status.ravel())

    def onto(self, x: Array, status: Array) -> Array:
        """The nearest points of the ellipses; of their boundary, from inside too, for slip."""
        values = self._points(self.project(x)).copy()
        t = np.where(self._moves, self._points(x), 0.0)
        slips = np.any(self._points(status) == Status.SLIP, axis=1)
        inward = slips & (self._level(t) < 1.0) & np.any(t != 0.0, axis=1)
        values[inward] = self._nearest(t[inward], inward)
        return np.asarray(values.ravel())

    def _points(self, x: Array) -> Array:
        return np.asarray(x).reshape(self.semi_axes.shape)

    def _level(self, t: Array) -> Array:
        """‖t/a‖, 1 on the boundary; entries that are fixed do not count."""
        return np.asarray(np.linalg.norm(t * self._inverse, axis=1))

    def _boundary(self, t: Array) -> tuple[Array, Array]:
        """Flags of what is on the boundary, and its outward normals; 0 where nothing moves."""
        on = self._level(t) >= 1.0 - ON
        steep = t * self._inverse**2
        size = np.linalg.norm(steep, axis=1, keepdims=True)
        normal = np.divide(steep, size, out=np.zeros_like(t), where=size > 0.0)
        return on | ~self._moves.any(axis=1), normal

    def _curvature(self, t: Array, g: Array, normal: Array) -> Array:
        """κ = (−nᵀg)⁺ τᵀHτ/‖Ht‖ with H = diag(a)⁻² and τ the tangent, shape ``(n,)``."""
        pushing = np.maximum(-np.sum(g * normal, axis=1), 0.0)
        inverse = self._inverse**2
        slope = np.linalg.norm(inverse * t, axis=1)
        bent = np.sum(inverse * normal[:, ::-1] ** 2, axis=1)
        return np.asarray(pushing * np.divide(bent, slope, out=0.0 * slope, where=slope > 0.0))

    def _nearest(self, z: Array, which: Array) -> Array:
        """Return the nearest points of the boundary: a_j²z_j/(a_j² + μ)."""
        a = self.semi_axes[which]
        scale = np.maximum(a.max(axis=1, initial=TINY), TINY)[:, None]
        a, z = a / scale, z / scale
        y = a * a * z / np.maximum(a * a + _secular(a, z)[:, None], TINY)
        # the last rounding of μ must not leave y off the boundary
        level = np.linalg.norm(np.divide(y, a, out=np.zeros_like(y), where=a > 0.0), axis=1)
        return np.asarray(scale * y / np.maximum(level, TINY)[:, None])


def _secular(a: Array, z: Array) -> Array:
    """μ with Σ_j (a_j z_j/(a_j² + μ))² = 1, at least 0 for points outside, shape ``(n,)``.

    Newton's method for 1 − 1/√Σ, which is nearly linear in μ: from a start on the left of the root
    it comes nearer in each step (Moré, Sorensen, SIAM J. Sci. Stat. Comput. 4, 1983).
    """
    c = a * np.abs(z)
    mu = np.max(c - a * a, axis=1, initial=-np.inf)  # one term alone is 1 there
    outside = np.sum(np.divide(c, a * a, out=np.zeros_like(c), where=a > 0.0) ** 2, axis=1) >= 1.0
    mu = np.where(outside, np.maximum(mu, 0.0), mu)
    for _ in range(MOST_STEPS):
        below = a * a + mu[:, None]
        terms = np.divide(c, below, out=np.zeros_like(c), where=below > 0.0) ** 2
        total = terms.sum(axis=1)
        slope = np.divide(terms, below, out=np.zeros_like(c), where=below > 0.0).sum(axis=1)
        wanted = total > 1.0
        step = np.divide(total * (np.sqrt(total) - 1.0), slope, out=np.zeros_like(mu), where=wanted)
        mu = mu + step
        if not np.any(step > SOLVED * np.abs(mu)):
            break
    return mu


def _directions(inside: Array, along: Array, normal: Array, size: int) -> csr_array:
    """Z: coordinates of what is inside, then the tangents of what is on the boundary."""
    n, k = len(inside), len(along)
    around = n + np.arange(k)
    rows = np.concatenate((inside, 2 * along, 2 * along + 1))
    columns = np.concatenate((np.arange(n), around, around))
    n_x, n_y = normal[along, 0], normal[along, -1]
    values = np.concatenate((np.ones(n), -n_y, n_x))
    return csr_array((values, (rows, columns)), shape=(size, n + k))
