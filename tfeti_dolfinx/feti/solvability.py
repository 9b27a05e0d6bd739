"""Solvability: can contact and friction balance the load on bodies that nothing else holds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.optimize import linprog
from scipy.sparse import block_array, csr_array, diags_array, eye_array, hstack, vstack
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import NoSolutionError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.rigid_bodies import (
    BALANCE,
    Bodies,
    Motions,
    free_to_move,
    orthonormal_columns,
)

# --- Cutting planes for distributed linear programs -------------------------------------------

# Random directions in which the outermost rows are taken at first: enough for the corners of
# patches; what they miss comes by and by.
DIRECTIONS = 12


class CutRows:
    """This rank's inequalities A y ≤ b, each between few bodies.

    Args:
        A: Shape ``(m, n)``.
        b: Shape ``(m,)``.
        body: Body of each column, shape ``(n,)``.

    Attributes:
        ends: First and last body of each row, shape ``(m,)``; of an empty row beyond all bodies,
            and −1.
        sent: Which of them the rank that solves knows, shape ``(m,)``.
    """

    def __init__(self, A: csr_array, b: Array, body: Array) -> None:
        self.A, self.b, self._body = A, b, body
        entries = A.tocoo()
        row, column = entries.coords
        first, last = np.full(A.shape[0], len(body)), np.full(A.shape[0], -1)
        np.minimum.at(first, row, body[column])
        np.maximum.at(last, row, body[column])
        # rows between the same bodies form a patch
        self.ends = first, last
        _, self.patch = np.unique(np.stack((first, last), axis=1), axis=0, return_inverse=True)
        self.patch = self.patch.ravel()
        self._entry = row, column
        self.sent = np.zeros(A.shape[0], dtype=bool)

    def links(self, bodies: int) -> csr_array:
        """Return the matrix of bodies that share a row, shape ``(bodies, bodies)``."""
        row, column = self._entry
        meets = (np.ones(len(row)), (row, self._body[column]))
        incidence = csr_array(meets, shape=(self.A.shape[0], bodies))
        return csr_array(incidence.T @ incidence)

    def extremes(self) -> Array:
        """Return for each patch the rows that are outermost in some directions.

        Of a flat patch they are most of its corners, which imply all other rows.
        """
        found = [np.empty(0, dtype=np.int64)]
        for direction in np.random.default_rng(0).standard_normal((DIRECTIONS, self.A.shape[1])):
            order = np.lexsort((self.A @ direction, self.patch))
            change = np.flatnonzero(np.diff(self.patch[order]))
            ends = np.concatenate(([0], change, change + 1, [-1])) if len(order) else order
            found.append(order[ends])
        return np.unique(np.concatenate(found))

    def violated(self, y: Array, tolerance: float, most: int) -> Array:
        """Return for each patch the rows that y violates most, at most ``most`` of them."""
        excess = self.A @ y - self.b
        row = np.flatnonzero((excess > tolerance) & ~self.sent)
        row = row[np.lexsort((-excess[row], self.patch[row]))]
        starts = np.flatnonzero(np.diff(self.patch[row], prepend=-1))
        place = np.arange(len(row)) - np.repeat(starts, np.diff(starts, append=len(row)))
        return row[place < most]

    def allowed(self, y: Array, tolerance: float, comm: MPI.Intracomm) -> float:
        """Return the largest share of y, up to 1, that meets all rows; 0 does. Collective."""
        value = self.A @ y
        beyond = value > self.b + tolerance
        shares = np.maximum(self.b[beyond], 0.0) / value[beyond]
        return float(comm.allreduce(float(shares.min(initial=1.0)), op=MPI.MIN))


def minimise(
    rows: CutRows,
    solve: Callable[[csr_array, Array], Array | None],
    tolerance: float,
    comm: MPI.Intracomm,
    first: Array,
) -> Array | None:
    """Solve a program whose rows are spread over the ranks. Collective.

    One rank solves it with some of the rows and is sent what the others find violated: each time
    up to twice as many of a patch, so that it ends.

    Args:
        rows: This rank's rows.
        solve: Minimises over A y ≤ b, some of the rows, on rank 0; None ends the search.
        tolerance: Excess of a row that is let be.
        comm: Communicator.
        first: Rows of this rank to begin with.

    Returns:
        The minimiser, or None where ``solve`` returned it.
    """
    A, b = csr_array((0, rows.A.shape[1])), np.zeros(0)
    chosen, most = first, 1
    rows.sent[:] = False
    while True:
        rows.sent[chosen] = True
        parts = comm.gather((rows.A[chosen], rows.b[chosen]), root=0)
        y: Array | None = None
        with raised_on_all_ranks(comm):
            if parts is not None:
                A = csr_array(vstack([A, *(part for part, _ in parts)]))
                b = np.concatenate([b, *(part for _, part in parts)])
                y = solve(A, b)
        y = bcast_from_root(comm, y)
        if y is None:
            return None
        chosen, most = rows.violated(y, tolerance, most), 2 * most
        if comm.allreduce(len(chosen)) == 0:
            return y


# --- Balance of the load by contact -----------------------------------------------------------

# Least slope against a contact, of a motion of mean square 1, that counts as an overlap; the
# tolerances of the linear programs are finer.
SLOPE, LP_TOLERANCE = 1e-9, 1e-10
# Columns from which the interior point method with its crossover beats the simplex method.
LARGE = 2000
# Motions of a cone within −1 ≤ y ≤ 1: the largest entry is 1, or 0 but for rounding.
MOVES = 0.5


def check_solvable(
    coarse: CoarseSpace, body_names: Sequence[str], mode_names: Sequence[str]
) -> None:
    """Raise if the load moves a body that nothing holds. Collective.

    What friction holds is a question of its own, see ``feti/solvability.py``.

    Args:
        coarse: The coarse space.
        body_names: Names of the bodies.
        mode_names: Names of their modes.

    Raises:
        NoSolutionError: Names the body and the mode.
    """
    if coarse.dimension == 0:
        return
    load = coarse.motions.T @ coarse.e
    motion = bcast_from_root(coarse.comm, _driven(coarse.free_motions, load, coarse.bodies))
    reason = (
        "nothing resists that and the load drives it; add a Dirichlet condition, a contact or a "
        "spring, or balance the load"
    )
    if motion is None and not any_rank(coarse.comm, coarse.rubbing.size > 0):
        motion = escape(coarse)
        reason = "only contact could resist that, and the load drives out of contact"
    if motion is not None:
        words = free_to_move(coarse.bodies.amounts(motion), body_names, mode_names)
        raise NoSolutionError(f"{words}: {reason}")


def _driven(free: Motions, load: Array, bodies: Bodies) -> Array | None:
    """Return the part of the load on free motions, if it is more than rounding."""
    alone = (free.alone @ (free.alone.T @ load)).reshape(bodies.count, bodies.k)
    alone[np.linalg.norm(alone, axis=1) <= bodies.negligible] = 0.0
    if np.any(alone):
        return np.asarray(alone.ravel())
    Q = orthonormal_columns(free.joint)
    joint = np.asarray(Q @ (Q.T @ load))
    each = np.linalg.norm(joint.reshape(bodies.count, bodies.k), axis=1)
    return joint if joint @ load > bodies.negligible @ each else None


def escape(coarse: CoarseSpace) -> Array | None:
    """A motion of the bodies that opens contacts and on which the load does work. Collective.

    By Farkas' lemma Gλ = e has a solution with λ_N ≥ 0 just if there is none. With Z the motions
    that equality rows and springs leave, max zᵀe over J_N z ≤ 0, −1 ≤ z ≤ 1 is a linear program.

    Returns:
        Coordinates of the bodies' motion, or None.
    """
    bodies, Z = coarse.bodies, coarse.unheld.alone
    body = np.repeat(np.arange(bodies.count), coarse.unheld.free.sum(axis=1))
    J_N = csr_array(coarse.J[coarse.bounded] @ Z)
    rows = CutRows(J_N, np.zeros(J_N.shape[0]), body)
    load, noise = Z.T @ (coarse.motions.T @ coarse.e), bodies.negligible[body]
    if bcast_from_root(coarse.comm, bool(np.all(np.abs(load) <= noise))):
        return None
    # parts of the scene that do not meet may be loaded by very different forces
    part = parts_of(coarse, rows, body)
    largest = load_sizes(load, noise, part)
    load, noise = load / largest[part], noise / largest[part]
    comm, first = coarse.comm, rows.extremes()
    y = minimise(rows, lambda A, _: _most_work(A, load, noise), SLOPE, comm, first)
    if y is not None:
        y = minimise(rows, lambda A, _: _least_motion(A, load), SLOPE, comm, first)
    return None if y is None else np.asarray(Z @ y)


def load_sizes(load: Array, noise: Array, part: Array) -> Array:
    """Return the size of the load on each part of the scene, 1 where there is none.

    A load that is no more than rounding is not the size of anything: else its noise would hide
    what drives the other parts.
    """
    driving, possible = np.zeros((2, part.max() + 1))
    np.maximum.at(driving, part, np.where(np.abs(load) > noise, np.abs(load), 0.0))
    np.maximum.at(possible, part, noise / BALANCE)
    sizes = np.where(driving > 0.0, driving, possible)
    return np.where(sizes > 0.0, sizes, 1.0)


def parts_of(coarse: CoarseSpace, rows: CutRows, body: Array) -> Array:
    """For each column the part of the scene, connected through contact rows, that it is in."""
    links = coarse.comm.allgather(rows.links(coarse.bodies.count))
    return connected_components(csr_array(sum(links)), directed=False)[1][body]


def _most_work(A: csr_array, load: Array, noise: Array) -> Array | None:
    """Return a motion of much work, if that is more than rounding; A y ≤ 0, −1 ≤ y ≤ 1."""
    y = minimiser(-load, A, bounds=(-1.0, 1.0))
    if load @ y <= noise.max():
        return None
    # Motions that cost nothing are in y, too: of heavily loaded bodies they would hide that of a
    # light one. Work less what counts as none has no such motions.
    y = _halves(minimiser(np.concatenate((noise - load, noise + load)), _both(A), bounds=(0, 1)))
    # a cone: a motion that gains something gains more until a bound stops it
    return y if np.abs(y).max() > MOVES and load @ y > noise @ np.abs(y) else None


def _least_motion(A: csr_array, load: Array) -> Array:
    """Return the least motion (sum of moduli) of unit work, scaled to 1; A y ≤ 0."""
    work = np.concatenate((load, -load))[None, :]
    y = _halves(minimiser(np.ones(work.size), _both(A), A_eq=work, b_eq=np.ones(1)))
    return y / np.abs(y).max()


def _both(A: csr_array) -> csr_array:
    """A for y = p − q."""
    return csr_array(hstack([A, -A]))


def _halves(pq: Array) -> Array:
    """y = p − q."""
    p, q = np.split(pq, 2)
    return np.asarray(p - q)


def minimiser(cost: Array, A: csr_array, **rest: Any) -> Array:
    """Return the minimiser of a linear program over A y ≤ 0.

    Raises:
        TfetiError: Neither the simplex nor the interior point method found it.
    """
    methods = ("highs-ipm", "highs-ds") if len(cost) > LARGE else ("highs-ds", "highs-ipm")
    # what is undone after presolving may miss the tolerance; without it nothing is undone
    for presolve, method in product((True, False), methods):
        options = {
            "primal_feasibility_tolerance": LP_TOLERANCE,
            "dual_feasibility_tolerance": LP_TOLERANCE,
            "presolve": presolve,
        }
        found = linprog(
            cost, A_ub=A, b_ub=np.zeros(A.shape[0]), method=method, options=options, **rest
        )
        if found.status == 0:
            return np.asarray(found.x)
    raise TfetiError(f"a linear program of the solvability test failed: {found.message}")


# --- Balance of the load by contact and friction ----------------------------------------------

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
    """Resistance of contact and friction to motions of bodies: no overlap, work of friction.

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
        everything = CutRows(J[sets.contact], np.zeros(sets.contact.size), body)
        self._load(everything)
        self._flat = CutRows(csr_array(J[flat]), np.zeros(len(flat)), body)
        self._pressing = csr_array(J[above])
        over = size[sets.tangents]
        mu = constraints.coefficients * (over / size[constraints.pressed_by][:, None])
        self._cone = _weighted(J, sets.tangents[pressed], mu[pressed])
        work = constraints.limits * over
        self._given = _weighted(J, sets.tangents[given], work[given])
        self._patches(
            CutRows(csr_array(sum(abs(T) for T in self._given)), np.zeros(len(given)), body)
        )

    @property
    def is_idle(self) -> bool:
        """True if the load does no work on the free motions, so contact has nothing to hold."""
        return bool(np.all(np.abs(self._loads) <= self._noise))

    def _load(self, rows: CutRows) -> None:
        """The load over the size of that on the same part of the scene."""
        coarse, body = self._coarse, self._body
        load = self.Z.T @ (coarse.motions.T @ coarse.e)
        noise = coarse.bodies.negligible[body]
        part = parts_of(coarse, rows, body) if len(body) else body
        largest = load_sizes(load, noise, part) if len(body) else np.ones(0)
        self._scale = largest[part]
        self._loads, self._noise = load / self._scale, noise / self._scale

    def _patches(self, rows: CutRows) -> None:
        """Assign to each row with a bound its patch, among those of all ranks, and its load."""
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
        """Return rows that y violates, at most one of each patch and kind of this rank."""
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
        """Return a motion on which the load does more work than friction, if there is one.

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
            y, t = np.split(np.asarray(bcast_from_root(comm, y)), [len(load)])
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
        """True if some rank has rows with Coulomb's law."""
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


def sliding_body(coarse: CoarseSpace, constraints: Constraints) -> int:
    """Return a body that the load moves; -1: forces within the limits hold it. Collective.

    Args:
        coarse: The coarse space.
        constraints: Rows, with the limits of friction.
    """
    if not coarse.unheld.free.any():
        return -1
    resistance = Resistance(coarse, constraints, cones=False)
    if bcast_from_root(coarse.comm, resistance.is_idle) or (found := resistance.escape()) is None:
        return -1
    return int(np.argmax(np.abs(found.motion))) // coarse.bodies.k


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
    if bcast_from_root(coarse.comm, resistance.is_idle) or (found := resistance.escape()) is None:
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
    """Return the factor on all friction that would hold the load."""
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
    """Return rows of each axis, weighted; shapes ``(t, k)``."""
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
