"""Whether the multipliers can balance the load: Gλ = e with λ_N ≥ 0."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, hstack
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.bodies import BALANCE, Bodies
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.dual.cuts import Rows, minimise
from tfeti_dolfinx.dual.motions import Motions
from tfeti_dolfinx.dual.naming import free_to_move
from tfeti_dolfinx.dual.sparse_columns import orthonormal_columns
from tfeti_dolfinx.errors import NoSolutionError, TfetiError
from tfeti_dolfinx.parallel import agreed, any_rank

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

    What friction holds is a question of its own, see ``dual/capacity.py``.

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
    motion = agreed(coarse.comm, _driven(coarse.free_motions, load, coarse.bodies))
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
    """The part of the load on free motions, if it is more than rounding."""
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
    rows = Rows(J_N, np.zeros(J_N.shape[0]), body)
    load, noise = Z.T @ (coarse.motions.T @ coarse.e), bodies.negligible[body]
    if agreed(coarse.comm, bool(np.all(np.abs(load) <= noise))):
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
    """Size of the load on each part of the scene, 1 where there is none.

    A load that is no more than rounding is not the size of anything: else its noise would hide
    what drives the other parts.
    """
    driving, possible = np.zeros((2, part.max() + 1))
    np.maximum.at(driving, part, np.where(np.abs(load) > noise, np.abs(load), 0.0))
    np.maximum.at(possible, part, noise / BALANCE)
    sizes = np.where(driving > 0.0, driving, possible)
    return np.where(sizes > 0.0, sizes, 1.0)


def parts_of(coarse: CoarseSpace, rows: Rows, body: Array) -> Array:
    """For each column the part of the scene, connected through contact rows, that it is in."""
    links = coarse.comm.allgather(rows.links(coarse.bodies.count))
    return connected_components(csr_array(sum(links)), directed=False)[1][body]


def _most_work(A: csr_array, load: Array, noise: Array) -> Array | None:
    """A motion of much work, if that is more than rounding; A y ≤ 0, −1 ≤ y ≤ 1."""
    y = minimiser(-load, A, bounds=(-1.0, 1.0))
    if load @ y <= noise.max():
        return None
    # Motions that cost nothing are in y, too: of heavily loaded bodies they would hide that of a
    # light one. Work less what counts as none has no such motions.
    y = _halves(minimiser(np.concatenate((noise - load, noise + load)), _both(A), bounds=(0, 1)))
    # a cone: a motion that gains something gains more until a bound stops it
    return y if np.abs(y).max() > MOVES and load @ y > noise @ np.abs(y) else None


def _least_motion(A: csr_array, load: Array) -> Array:
    """The least motion (sum of moduli) of unit work, scaled to 1; A y ≤ 0."""
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
    """The minimiser of a linear program over A y ≤ 0.

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
