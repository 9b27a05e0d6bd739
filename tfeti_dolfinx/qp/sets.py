"""Feasible sets: bounds, ellipses, their products and faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import TINY, Array, Entries, beside, quotient, transposed
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

    Its directions are coordinates and, on other rows, tangents of boundaries. Each of them lives on
    this rank.

    Attributes:
        free: Flags of the rows that move on their own, shape ``(m,)``.
        status: Status of each row, shape ``(m,)``.
        tangent_rows: The rows of each tangent, shape ``(t, w)``.
        tangents: Its components there, orthonormal, 0 where it has fewer; shape ``(t, w)``.
        curvature: What the set's boundary adds to the Hessian along each tangent: where the
            gradient pushes against it, moving along the set by Zt changes gᵀx by
            gᵀZt + ½ Σ κ_j t_j². 0 where it is flat or not pushed against. Shape ``(t,)``.
        beta: Chopped gradient β, 0 where rows are free; the free one φ is the gradient there, and
            φ + β the projected gradient. Shape ``(m,)``.
    """

    free: Array
    status: Array
    tangent_rows: Array = field(default_factory=np.zeros((0, 2), dtype=np.int64).copy)
    tangents: Array = field(default_factory=np.zeros((0, 2)).copy)
    curvature: Array = field(default_factory=np.zeros(0).copy)
    beta: Array = field(default_factory=np.zeros(0).copy)

    @cached_property
    def carrying(self) -> Array:
        """Rows that are not on their bound, all but the open ones; flags, shape ``(m,)``."""
        return np.asarray(self.status != Status.OPEN)

    @cached_property
    def holding(self) -> Array:
        """Rows that hold what they multiply, Bu = c, neither open nor slipping; flags."""
        return self.carrying & (self.status != Status.SLIP)

    @cached_property
    def held(self) -> Array:
        """Rows that no direction moves; flags."""
        held = ~self.free
        held[self.tangent_rows[self.tangents != 0.0]] = False
        return held

    @cached_property
    def Z(self) -> csr_array:
        """All directions as columns, coordinates first, scipy CSR, shape ``(m, k)``."""
        rows, m = np.flatnonzero(self.free), len(self.free)
        own = np.cumsum(np.append(0, self.free))
        coordinates = Entries(np.ones(len(rows)), np.arange(len(rows)), own, (m, len(rows)))
        count, width = self.tangents.shape
        table = np.arange(0, count * width + 1, width or 1)[: count + 1]
        values = self.tangents.ravel(), self.tangent_rows.ravel(), table
        return beside(coordinates, transposed(Entries(*values, (count, m)))).csr()

    @property
    def bends(self) -> Array:
        """The curvature along all directions of Z, shape ``(k,)``."""
        return np.concatenate((np.zeros(int(np.sum(self.free))), self.curvature))

    def damped(self) -> Face:
        """Z diag(1 + κ)^{-1/2}: ZZᵀ is the derivative of P_Ω at x, P_Ω(x) − x its gradient."""
        if not np.any(self.curvature):
            return self
        return replace(self, tangents=(self.tangents.T / np.sqrt(1.0 + self.curvature)).T)

    def restricted(self, x: Array) -> Array:
        """Z Zᵀ x: the part of vectors, shapes ``(m,)`` or ``(m, q)``, that lies in the face."""
        own = np.asarray((x.T * self.free).T)
        if len(self.tangents):
            own += self.along_tangents(x, np.ones(len(self.tangents)))
        return own

    def bend(self, x: Array) -> Array:
        """Z diag(κ) Zᵀ x, shapes ``(m,)`` or ``(m, q)``."""
        return self.along_tangents(x, self.curvature)

    def along_tangents(self, x: Array, weights: Array) -> Array:
        """T diag(weights) Tᵀ x, T the tangents as columns, shapes ``(m,)`` or ``(m, q)``."""
        y = np.zeros(x.shape)
        if len(self.tangents):
            along = np.einsum("tw,tw...,t->t...", self.tangents, x[self.tangent_rows], weights)
            np.add.at(y, self.tangent_rows, np.einsum("tw,t...->tw...", self.tangents, along))
        return y

    def is_like(self, other: Face) -> bool:
        """Return whether both are flat, with the same statuses and directions."""
        if len(self.tangents) or len(other.tangents):
            return False
        same = np.array_equal(self.status, other.status)
        return same and np.array_equal(self.free, other.free)


# --- Feasible sets ----------------------------------------------------------------------------
# A set knows its own rows of this rank as numpy arrays, nothing of ranks and other rows: solvers
# add up over ranks, ``Product`` puts sets on rows. Nothing here is collective.


class FeasibleSet(Protocol):
    """A set Ω of vectors of n entries, and its faces.

    All arrays have the shape ``(n,)``; none that is passed may be written to.
    ``check_feasible_set`` tests any implementation.
    """

    def project(self, x: Array) -> Array:
        """P_Ω(x), the nearest point of Ω."""

    def max_step(self, x: Array, p: Array) -> float:
        """Return the largest α with x − α p ∈ Ω, maybe infinite."""

    def face(self, x: Array, g: Array) -> Face:
        """Return the face of x ∈ Ω, and β of the gradient there."""

    def onto(self, x: Array, status: Array) -> Array:
        """P_Ω(x), but on their bounds where rows are open, and on the boundary where they slip."""


def face_at(feasible: FeasibleSet, x: Array, g: Array) -> Face:
    """Return a set's face with its β; where that has none, the β of its ``split(x, g) = φ, β``."""
    face = feasible.face(x, g)
    if face.beta.shape == x.shape:
        return face
    if (split := getattr(feasible, "split", None)) is None:
        raise InputError(
            f"extensions: feasible_set: beta of {type(feasible).__name__} has shape "
            f"{face.beta.shape}; expected {x.shape}"
        )
    return replace(face, beta=split(x, g)[1])


@dataclass(frozen=True)
class Bounds:
    """x_i ≥ l_i."""

    lower: Array | float = 0.0  # the bounds l, shape (n,), or one for all entries

    def project(self, x: Array) -> Array:
        """max(x, l)."""
        return np.maximum(x, self.lower)

    def max_step(self, x: Array, p: Array) -> float:
        """min over p_i > 0 of (x_i − l_i)/p_i."""
        down = p > 0.0
        return float(np.min((x - self.lower)[down] / p[down], initial=np.inf))

    def face(self, x: Array, g: Array) -> Face:
        """Return the face of x: off their bounds rows are free, they touch; else β = min(g, 0)."""
        off = np.asarray(x > self.lower)
        beta = np.where(off, 0.0, np.minimum(g, 0.0))
        return Face(off, np.where(off, Status.TOUCHING, Status.OPEN), beta=beta)

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
        self.factors = [
            (np.r_[rows] if isinstance(rows, slice) else rows, factor) for rows, factor in factors
        ]
        rows = [np.empty(0, dtype=np.int64), *(rows for rows, _ in self.factors)]
        if np.any(twice := np.bincount(np.concatenate(rows)) > 1):
            raise InputError(
                f"Product: constraint {np.argmax(twice)} stands in two sets; expected one at most"
            )

    def project(self, x: Array) -> Array:
        """P of each set on its rows."""
        y = np.array(x)
        for rows, factor in self.factors:
            y[rows] = factor.project(x[rows])
        return y

    def max_step(self, x: Array, p: Array) -> float:
        """Return the least of all sets."""
        steps = [factor.max_step(x[rows], p[rows]) for rows, factor in self.factors]
        return min([float(np.inf), *steps])

    def face(self, x: Array, g: Array) -> Face:
        """Free rows, then the directions of each set."""
        status, beta, found = np.zeros(len(x), dtype=np.int64), np.zeros(len(x)), []
        free = status == Status.FREE
        for rows, factor in self.factors:
            face = face_at(factor, x[rows], g[rows])
            status[rows], free[rows], beta[rows] = face.status, face.free, face.beta
            if len(face.tangents):
                found.append((rows[face.tangent_rows], face.tangents, face.curvature))
        if not found:
            return Face(free, status, beta=beta)
        width = max(tangents.shape[1] for _, tangents, _ in found)
        tables = []
        for at, tangents, kappa in found:
            none = np.zeros((len(at), width - at.shape[1]), dtype=at.dtype)
            tables.append((np.hstack((at, none)), np.hstack((tangents, none)), kappa))
        at, tangents, kappa = map(np.concatenate, zip(*tables, strict=True))
        return Face(free, status, at, tangents, kappa, beta)

    def onto(self, x: Array, status: Array) -> Array:
        """Each set's, x itself on free rows."""
        values = np.array(x)
        for rows, factor in self.factors:
            values[rows] = factor.onto(x[rows], status[rows])
        return values


# --- Ellipses ---------------------------------------------------------------------------------

# of the boundary's distance from the centre: what is so near to the boundary is on it
ON = 1e-13
# of the longer semi-axis: how far a point may be, and how short the other may be
FAR, THIN = 1e100, 1e-150
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
        # so that ‖t/a‖ is 1 on the boundary; entries that are fixed do not count
        self._inverse = quotient(np.ones(self.semi_axes.shape), self.semi_axes)

    def project(self, x: Array) -> Array:
        """Return the nearest points of the ellipses."""
        t = x.reshape(self.semi_axes.shape)
        with np.errstate(over="ignore"):  # farther than numbers go is outside
            outside = _lengths(t * self._inverse) > 1.0
        nearest = np.where(self._moves, t, 0.0)
        if np.any(outside):
            nearest[outside] = self._nearest(t[outside], outside)
        return np.asarray(nearest.ravel())

    def max_step(self, x: Array, p: Array) -> float:
        """Largest α with x − αp inside: the smallest root of a quadratic equation for each."""
        p = p.reshape(self.semi_axes.shape)
        if np.any(p[~self._moves]):
            return 0.0
        t, p = x.reshape(self.semi_axes.shape) * self._inverse, p * self._inverse
        a, b = np.sum(p * p, axis=1), np.sum(p * t, axis=1)
        moves = a > 0.0
        a, b = a[moves], b[moves]
        room = np.maximum(1.0 - np.sum(t[moves] ** 2, axis=1), 0.0)
        root = np.sqrt(b * b + a * room)
        # of the two forms of the larger root of aα² − 2bα = room the one that cancels nothing
        steps = np.where(b > 0.0, (b + root) / a, room / np.maximum(root - b, TINY))
        return float(np.min(steps, initial=np.inf))

    def face(self, x: Array, g: Array) -> Face:
        """Inside all directions are free: it sticks. On the boundary the tangent: it slips.

        β = g + (−nᵀg)⁺n there, n the outward normal.
        """
        t = x.reshape(self.semi_axes.shape)
        on, normal = self._boundary(t)
        status = np.where(on[:, None], Status.SLIP, Status.STICK)
        status = np.where(self._moves, status, Status.OPEN)
        g = np.where(self._moves, g.reshape(self.semi_axes.shape), 0.0)
        pushing = np.maximum(-np.sum(g * normal, axis=1), 0.0)
        beta = np.where(on[:, None], g + pushing[:, None] * normal, 0.0)
        face = Face((self._moves & ~on[:, None]).ravel(), status.ravel(), beta=beta.ravel())
        along = np.flatnonzero(on & self._moves.all(axis=1))
        if self.semi_axes.shape[1] != 2 or not len(along):
            return face
        # κ = (−nᵀg)⁺ τᵀHτ/‖Ht‖ with H = diag(a)⁻² and τ the tangent
        n, H = normal[along], self._inverse[along] ** 2
        slope = np.linalg.norm(H * t[along], axis=1)
        bent = np.sum(H * n[:, ::-1] ** 2, axis=1)
        kappa = pushing[along] * quotient(bent, slope)
        rows, tangents = 2 * along[:, None] + (0, 1), np.stack((-n[:, 1], n[:, 0]), axis=1)
        return replace(face, tangent_rows=rows, tangents=tangents, curvature=kappa)

    def onto(self, x: Array, status: Array) -> Array:
        """The nearest points of the ellipses; of their boundary, from inside too, for slip."""
        values = self.project(x).reshape(self.semi_axes.shape).copy()
        t = np.where(self._moves, x.reshape(self.semi_axes.shape), 0.0)
        slips = np.any(status.reshape(self.semi_axes.shape) == Status.SLIP, axis=1)
        inward = slips & (_lengths(t * self._inverse) < 1.0) & np.any(t != 0.0, axis=1)
        if np.any(inward):
            values[inward] = self._nearest(t[inward], inward)
        return np.asarray(values.ravel())

    def _boundary(self, t: Array) -> tuple[Array, Array]:
        """Flags of what is on the boundary, and its outward normals; 0 where nothing moves."""
        on = _lengths(t * self._inverse) >= 1.0 - ON
        steep = t * self._inverse**2
        return on | ~self._moves.any(axis=1), quotient(steep, _lengths(steep)[:, None])

    def _nearest(self, z: Array, which: Array) -> Array:
        """Return the nearest points of the boundary: a_j²z_j/(a_j² + μ)."""
        a = self.semi_axes[which]
        if np.all(a == a[:, :1]):  # discs and intervals
            return np.asarray(a * (z / _lengths(z)[:, None]))
        # from so far only the direction counts; squares stay in the range of floating point
        z, scale = np.where(a > 0.0, z, 0.0), np.maximum(a.max(axis=1), TINY)[:, None]
        given, z = a / scale, z / np.maximum(scale, np.abs(z).max(axis=1)[:, None] / FAR)
        a = np.where(given > 0.0, np.maximum(given, THIN), 0.0)
        y = a * a * z / np.maximum(a * a + _secular(a, z)[:, None], TINY)
        # the last rounding of μ must not leave y off the boundary
        level = np.linalg.norm(quotient(y, a), axis=1)
        return np.asarray(scale * y * quotient(given, a) / np.maximum(level, TINY)[:, None])


def _lengths(x: Array) -> Array:
    """Length of each row."""
    return np.sqrt(np.einsum("ij,ij->i", x, x))


def _secular(a: Array, z: Array) -> Array:
    """μ with Σ_j (a_j z_j/(a_j² + μ))² = 1, at least 0 for points outside, shape ``(n,)``.

    Newton's method for 1 − 1/√Σ, which is nearly linear in μ: from a start on the left of the root
    it comes nearer in each step (Moré, Sorensen, SIAM J. Sci. Stat. Comput. 4, 1983).
    """
    c = a * np.abs(z)
    mu = np.max(c - a * a, axis=1, initial=-np.inf)  # one term alone is 1 there
    outside = np.hypot.reduce(quotient(c, a * a), axis=1) >= 1.0
    mu = np.where(outside, np.maximum(mu, 0.0), mu)
    for _ in range(MOST_STEPS):
        below = a * a + mu[:, None]
        terms = quotient(c, below) ** 2
        total = terms.sum(axis=1)
        slope = quotient(terms, below).sum(axis=1)
        wanted = total > 1.0
        step = np.divide(total * (np.sqrt(total) - 1.0), slope, out=np.zeros_like(mu), where=wanted)
        mu = mu + step
        if not np.any(step > SOLVED * np.abs(mu)):
            break
    return mu
