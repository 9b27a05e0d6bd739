"""Whether friction can hold the load: Gλ = e with all contact forces in their sets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import block_array, csr_array, diags_array, eye_array, hstack, vstack

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.cuts import Rows
from tfeti_dolfinx.dual.naming import free_to_move
from tfeti_dolfinx.dual.solvability import SLOPE, load_sizes, minimiser, parts_of
from tfeti_dolfinx.errors import NoSolutionError, raised_on_all_ranks
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.parallel import agreed

# Cutting planes: far more programs than it takes; and what is left of the friction's work, as a
# share of the load's, where a plane more says nothing new
MOST_PROGRAMS, EXACT = 300, 1e-7
# of the largest work: less than this friction lets pass, so that a load at the capacity is tried
LEAST = 1e-7
# of the same: price of moving, so that what does no work rests and is not named
REST = 1e-8
# the factor on the coefficients of friction that would do is sought up to this, to this share
MOST, SHARE = 1e3, 1e-4


class Resistance:
    """What normals and friction do against motions of bodies: no overlap, and work of friction.

    A motion y escapes if the load does more work on it than forces in their sets can take:
    N y ≤ 0 for normals, N_i y + ‖μ_i T_i y‖ ≤ 0 under Coulomb's law, and Σψ_i‖T_i y‖ less than the
    work of the load for what has a bound. Creation and all methods are collective.

    Args:
        coarse: The coarse space.
        constraints: Rows, limits and coefficients.
        cones: Whether Coulomb's law bounds friction by the forces of normals; else by the present
            limits.
    """

    def __init__(self, coarse: CoarseSpace, constraints: Constraints, cones: bool) -> None:
        self._coarse, self.Z = coarse, coarse.unheld.alone
        body = np.repeat(np.arange(coarse.bodies.count), coarse.unheld.free.sum(axis=1))
        self._body, sets = body, constraints.sets
        J, size = csr_array(coarse.J @ self.Z), coarse.row_size
        pressed = constraints.pressed if cones else np.empty(0, dtype=np.int64)
        given = np.setdiff1d(np.arange(len(sets.tangents)), pressed)
        above = constraints.pressed_by[pressed]
        flat = np.setdiff1d(sets.normals, above)
        everything = Rows(J[sets.contact], np.zeros(sets.contact.size), body)
        self._load(everything)
        self._flat = Rows(csr_array(J[flat]), np.zeros(len(flat)), body)
        self._pressing = csr_array(J[above])
        over = size[sets.tangents]
        mu = constraints.coefficients * (over / size[constraints.pressed_by][:, None])
        self._cone = _weighted(J, sets.tangents[pressed], mu[pressed])
        work = constraints.limits * over
        self._given = _weighted(J, sets.tangents[given], work[given])
        self._patches(Rows(csr_array(sum(abs(T) for T in self._given)), np.zeros(len(given)), body))

    @property
    def is_idle(self) -> bool:
        """Whether nothing is left for contact to hold."""
        return bool(np.all(np.abs(self._loads) <= self._noise))

    def _load(self, rows: Rows) -> None:
        """The load over the size of that on the same part of the scene."""
        coarse, body = self._coarse, self._body
        load = self.Z.T @ (coarse.motions.T @ coarse.e)
        noise = coarse.bodies.negligible[body]
        part = parts_of(coarse, rows, body) if len(body) else body
        largest = load_sizes(load, noise, part) if len(body) else np.ones(0)
        self._scale = largest[part]
        self._loads, self._noise = load / self._scale, noise / self._scale

    def _patches(self, rows: Rows) -> None:
        """Which of the patches of all ranks each row with a bound belongs to, and its load."""
        count = self._coarse.bodies.count
        first, last = np.minimum(rows.ends[0], count), rows.ends[1]  # empty rows are of nobody
        own = first * (count + 1) + last
        self._keys = np.unique(np.concatenate(self._coarse.comm.allgather(np.unique(own))))
        place = np.searchsorted(self._keys, own)
        shape = (len(self._keys), len(own))
        scale = np.ones(count + 1)
        scale[self._body] = self._scale
        entries = (1.0 / scale[first], (place, np.arange(len(own))))
        self._sums = csr_array(entries, shape=shape)

    def friction(self, y: Array) -> tuple[Array, csr_array]:
        """Work of friction on each patch, and its gradient, on all ranks."""
        size, direction = _directions(self._given, y)
        rows = sum(
            (diags_array(d) @ T for d, T in zip(direction.T, self._given, strict=True)),
            start=csr_array(self._given[0].shape),
        )
        own = (self._sums @ size, csr_array(self._sums @ rows))
        found = self._coarse.comm.allgather(own)
        work = np.sum([work for work, _ in found], axis=0)
        return np.asarray(work), csr_array(sum(gradient for _, gradient in found))

    def violated(self, y: Array, factor: float) -> csr_array:
        """Rows that y violates, at most one of each patch and kind of this rank."""
        chosen = self._flat.violated(y, SLOPE, 1)
        self._flat.sent[chosen] = True
        size, direction = _directions(self._cone, y)
        excess = self._pressing @ y + factor * size
        cut = np.flatnonzero(excess > SLOPE)
        cut = cut[np.argsort(-excess[cut])][: 2 * len(y)]
        rows = self._pressing[cut]
        for d, T in zip(direction.T, self._cone, strict=True):
            rows = rows + diags_array(factor * d[cut]) @ T[cut]
        return csr_array(vstack([self._flat.A[chosen], rows]))

    def escape(self, on_friction: float = 1.0, on_coefficients: float = 1.0) -> Escape | None:
        """A motion on which the load does more work than friction, if there is one.

        Args:
            on_friction: Factor on the limits.
            on_coefficients: Factor on the coefficients.
        """
        comm, load = self._coarse.comm, self._loads
        self._flat.sent[:] = False
        first = self._flat.extremes()
        self._flat.sent[first] = True
        new, planes = csr_array(self._flat.A[first]), csr_array((0, len(load) + len(self._keys)))
        rows = csr_array((0, len(load)))
        for _ in range(MOST_PROGRAMS):
            parts, y = comm.gather(new, root=0), None
            with raised_on_all_ranks(comm):
                if parts is not None:
                    rows = csr_array(vstack([rows, *parts]))
                    y = _best(load, on_friction * np.ones(len(self._keys)), rows, planes)
            y, t = np.split(np.asarray(agreed(comm, y)), [len(load)])
            work, gradient = self.friction(y)
            most = float(load @ y) - on_friction * float(t.sum())
            if most <= max(LEAST, float(self._noise @ np.abs(y))):
                return None
            new = self.violated(y, on_coefficients)
            kept = comm.allreduce(new.shape[0]) == 0
            gain = float(load @ y) - on_friction * float(work.sum())
            if kept and gain >= most - EXACT:
                return Escape(np.asarray(self.Z @ y), float(load @ y), float(work.sum()))
            planes = csr_array(
                vstack([planes, block_array([[gradient, -eye_array(len(self._keys))]])])
            )
        return None  # undecided: the solver will see

    @cached_property
    def has_cones(self) -> bool:
        """Whether some rank has Coulomb's law."""
        return bool(self._coarse.comm.allreduce(self._pressing.shape[0]))


@dataclass(frozen=True)
class Escape:
    """A motion of bodies.

    Attributes:
        motion: Coordinates of the bodies' motions.
        load: Work of the load on it, over the size of the load.
        friction: Work that friction takes at most, over the same.
    """

    motion: Array
    load: float
    friction: float


def holds(coarse: CoarseSpace, constraints: Constraints) -> bool:
    """Whether forces within the present limits can balance the load. Collective."""
    if not coarse.unheld.free.any():
        return True
    resistance = Resistance(coarse, constraints, cones=False)
    return agreed(coarse.comm, resistance.is_idle) or resistance.escape() is None


def check_capacity(
    coarse: CoarseSpace,
    constraints: Constraints,
    body_names: Sequence[str],
    mode_names: Sequence[str],
) -> None:
    """Raise if the load moves a body that friction would have to hold. Collective.

    Raises:
        NoSolutionError: Names the body, the motion, the load and what friction can hold.
    """
    has_friction = coarse.comm.allreduce(coarse.rubbing.size) > 0
    if not has_friction or not coarse.unheld.free.any():
        return
    resistance = Resistance(coarse, constraints, cones=True)
    if agreed(coarse.comm, resistance.is_idle) or (found := resistance.escape()) is None:
        return
    if resistance.escape(on_friction=MOST, on_coefficients=MOST) is not None:
        reason = (
            "only contact could resist that, and the load drives out of it, or along it where "
            "there is no friction"
        )
    elif resistance.has_cones:
        factor = _factor(resistance)
        reason = (
            "friction does not hold the load: the coefficients of friction would have to be "
            f"{factor:.4g} times as large"
        )
    else:
        found = _critical(resistance, found)
        load, capacity = _in_units(coarse, constraints, found)
        reason = (
            f"the load does the work {load:.4g} on a motion of size 1, and friction takes "
            f"{capacity:.4g} at most"
        )
    words = free_to_move(coarse.bodies.amounts(found.motion), body_names, mode_names)
    raise NoSolutionError(f"{words}: {reason}")


def _critical(resistance: Resistance, found: Escape) -> Escape:
    """The motion where the load is the largest multiple of friction (Dinkelbach's method)."""
    while found.friction > LEAST * found.load:
        better = resistance.escape(on_friction=found.load / found.friction * (1.0 + SHARE))
        if better is None or better.friction <= 0.0:
            break
        found = better
    return found


def _factor(resistance: Resistance) -> float:
    """The factor on all friction that would hold the load."""
    low, high = 1.0, 2.0
    while high < MOST and resistance.escape(high, high) is not None:
        low, high = high, 2.0 * high
    while high - low > SHARE * low:
        middle = 0.5 * (low + high)
        held = resistance.escape(middle, middle) is None
        low, high = (low, middle) if held else (middle, high)
    return 0.5 * (low + high)


def _in_units(coarse: CoarseSpace, constraints: Constraints, found: Escape) -> tuple[float, float]:
    """Work of the load and of friction on a motion whose largest translation, or turn, is 1."""
    amounts = np.abs(coarse.bodies.amounts(found.motion))
    gdim = constraints.sets.tangents.shape[1] + 1
    size = amounts[:, :gdim].max(initial=0.0) or amounts.max(initial=0.0)
    work = float(found.motion @ (coarse.motions.T @ coarse.e)) / size
    return work, work * found.friction / found.load


def _weighted(J: csr_array, rows: Array, weight: Array) -> list[csr_array]:
    """Rows of each axis, weighted; shapes ``(t, k)``."""
    pairs = zip(rows.T, weight.T, strict=True)
    return [
        csr_array(diags_array(w) @ J[row]) if len(row) else csr_array(J[row]) for row, w in pairs
    ]


def _directions(rows: list[csr_array], y: Array) -> tuple[Array, Array]:
    """‖T_i y‖ and T_i y over it."""
    slip = np.stack([T @ y for T in rows], axis=1)
    size = np.linalg.norm(slip, axis=1)
    return size, slip / np.maximum(size, TINY)[:, None]


def _best(load: Array, price: Array, rows: csr_array, planes: csr_array) -> Array:
    """(y, t) of max loadᵀy − priceᵀt, −1 ≤ y ≤ 1, t ≥ 0, rows and planes at most 0."""
    wide = block_array([[rows, csr_array((rows.shape[0], len(price)))]])
    A = csr_array(vstack([wide, planes]))
    n = len(load)
    halves = csr_array(hstack([A[:, :n], -A[:, :n], A[:, n:]]))
    bounds = [(0.0, 1.0)] * (2 * n) + [(0.0, None)] * len(price)
    cost = np.concatenate((REST - load, REST + load, price))
    p, q, t = np.split(minimiser(cost, halves, bounds=bounds), [n, 2 * n])
    return np.concatenate((p - q, t))
