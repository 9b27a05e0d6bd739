"""Solvability: can contact and friction balance the load on bodies that nothing else holds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, diags_array, vstack
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import TINY, Array, rows_of
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import NoSolutionError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.feti.coarse import CoarseSpace


@dataclass(frozen=True)
class SolvabilityParameters:
    """Parameters of the linear programs."""

    # least slope against a contact, of a motion of mean square 1, that is an overlap
    slope: float = 1e-9
    program: float = 1e-10  # tolerance of the programs
    # of the work of the load: less than this friction lets pass, so that a load at the capacity is
    # tried
    work: float = 1e-7
    # the same for what is left of the work of friction where cutting planes end
    exact: float = 1e-7
    max_programs: int = 300  # most programs; then the solver will see
    enough: float = 1e3  # the factor on friction that would hold is sought up to this, to a share
    share: float = 1e-4  # that share


PARAMETERS = SolvabilityParameters()


# --- Escape of rigid bodies: linear programs with cutting planes ------------------------------


@dataclass(frozen=True)
class RigidScene:
    """Bodies that are rigid, what contact and friction do to them, and the load; on one rank.

    A motion y, −1 ≤ y ≤ 1, escapes if the load does more work on it than friction takes, and
    nothing overlaps: N y ≤ 0 for normals, P_i y + ‖M_i y‖ ≤ 0 under Coulomb's law, M_i = μ_i T_i,
    and Σ‖W_i y‖, W_i = ψ_i T_i, is the work of friction with given bounds. By Farkas' lemma forces
    balance the load just if no motion escapes.
    """

    load: Array  # work of the load on each motion, shape (n,)
    noise: Array  # work that counts as none, shape (n,)
    body: Array  # body of each motion, shape (n,)
    normals: csr_array  # N, shape (m, n)
    pressing: csr_array  # P, shape (c, n)
    cones: tuple[csr_array, ...] = ()  # M, for each axis a matrix of shape (c, n)
    given: tuple[csr_array, ...] = ()  # W, the same with a row for each point

    def escape(self, factor: float = 1.0) -> Array | None:
        """Return a motion that escapes friction of so many times its size, if there is one.

        Programs in y = p − q, p, q ≥ 0, and the work t of friction begin without rows; those that
        their minimiser violates are added until there are none. None, too, where that takes too
        many programs: then the solver will see.
        """
        n = len(self.load)
        scale = self._scale() if n else self.load
        if not scale.any():
            return None
        cones = tuple(factor * M for M in self.cones)
        given = tuple(factor * W @ diags_array(scale) for W in self.given)
        load, noise = scale * self.load, np.where(scale > 0.0, scale * self.noise, 1.0)
        # rows of (y, t) as rows of (p, q, t)
        cuts, own, one = csr_array((0, n + 1)), np.arange(n), np.ones(n)
        places = np.concatenate((own, own, [n])), np.concatenate((own, n + own, [2 * n]))
        parts = csr_array((np.concatenate((one, -one, [1.0])), places))

        def minimised(cost: Array, upper: float | None, **rest: Any) -> tuple[Array, float]:
            nonlocal cuts
            count, bounds = 2 * n, [(0.0, upper)] * (2 * n) + [(0.0, None)]
            for _ in range(PARAMETERS.max_programs):
                if upper is not None and not cuts.shape[0]:  # no program where only bounds hold
                    x = np.where(cost < 0.0, upper, 0.0)
                else:
                    x = minimiser(cost, cuts @ parts, bounds=bounds, **rest)
                y = x[:n] - x[n : 2 * n]
                size = max(np.abs(y).max(initial=0.0), 1.0)
                new = self._violated(cones, given, y / size, float(x[-1]) / size, count)
                if new.shape[0] == 0:
                    return y, float(cost @ x)
                if n == 1 and not given:  # what stops the only motion leaves none
                    break
                cuts, count = vstack([cuts, new], format="csr"), 2 * count
            return np.zeros(n), 0.0

        # 1. the most work, less what counts as none: of heavily loaded bodies that would hide a
        # light one. A motion that gains something gains more until a bound stops it.
        least = PARAMETERS.work if cones or given else 0.0
        y, value = minimised(np.concatenate((noise - load, noise + load, [1.0])), 1.0)
        if value >= -least or np.abs(y).max() <= 0.5:
            return None
        # 2. the least motion (sum of moduli) of that work, which leaves out what costs nothing; of
        # unit work it is so large, where friction nearly holds, that the rows' tolerance forbids it
        work = csr_array(np.concatenate((load, -load, [-1.0]))[None, :])
        gain = np.atleast_1d(noise @ np.abs(y) - value)
        y, _ = minimised(np.append(np.ones(2 * n), 0.0), None, A_eq=work, b_eq=gain)
        largest = np.abs(y).max()
        return y / largest if largest > 0.0 else None

    def _scale(self) -> Array:
        """Inverse size of the load on each part that does not meet others; 0: it is rounding."""
        n = len(self.load)
        bodies = csr_array((np.ones(n), (self.body, np.arange(n))))
        all_rows = [bodies, self.normals, self.pressing, *self.cones, *self.given]
        rows = abs(vstack(all_rows, format="csr"))
        count, label = connected_components(rows.T @ rows, directed=False)
        size = np.zeros(count)
        np.maximum.at(size, label, np.where(abs(self.load) > self.noise, abs(self.load), 0.0))
        return np.where(size > 0.0, 1.0 / np.maximum(size, TINY), 0.0)[label]

    def _violated(
        self,
        cones: tuple[csr_array, ...],
        given: tuple[csr_array, ...],
        y: Array,
        t: float,
        count: int,
    ) -> csr_array:
        """Rows of (y, t) that a motion violates most, so many of each kind."""
        excess = self.normals @ y
        cut = np.argsort(-excess)[:count]
        rows = [self.normals[cut[excess[cut] > PARAMETERS.slope]]]
        if cones:
            size, direction = _directions(cones, y)
            excess = self.pressing @ y + size
            cut = np.argsort(-excess)[:count]
            cut = cut[excess[cut] > PARAMETERS.slope]
            rows.append(self.pressing[cut])
            for d, M in zip(direction.T, cones, strict=True):
                rows[-1] = rows[-1] + diags_array(d[cut]) @ M[cut]
        flat = vstack(rows, format="csr")
        flat.resize(flat.shape[0], len(y) + 1)
        found = [flat]
        if given:
            size, direction = _directions(given, y)
            if size.sum() - t > PARAMETERS.exact:
                slope = sum(d @ W for d, W in zip(direction.T, given, strict=True))
                found.append(csr_array(np.append(slope, -1.0)[None, :]))
        return vstack(found, format="csr")


def _directions(rows: Sequence[csr_array], y: Array) -> tuple[Array, Array]:
    """‖T_i y‖ and T_i y over it, T_i with a row for each axis."""
    slip = np.stack([T @ y for T in rows], axis=1)
    size = np.linalg.norm(slip, axis=1)
    return size, slip / np.maximum(size, TINY)[:, None]


def minimiser(cost: Array, A: csr_array, **rest: Any) -> Array:
    """Return the minimiser of a linear program over A y ≤ 0.

    Raise a TfetiError where neither the simplex nor the interior point method found it.
    """
    options = {
        "primal_feasibility_tolerance": PARAMETERS.program,
        "dual_feasibility_tolerance": PARAMETERS.program,
        "presolve": False,  # what is undone after presolving may miss the tolerance
    }
    for method in ("highs-ds", "highs-ipm"):
        found = linprog(
            cost, A_ub=A, b_ub=np.zeros(A.shape[0]), method=method, options=options, **rest
        )
        if found.status == 0:
            return np.asarray(found.x)
    raise TfetiError(f"a linear program of the solvability test failed: {found.message}")


# --- Checks of the dual problem ---------------------------------------------------------------


def check_solvable(
    coarse: CoarseSpace, constraints: Constraints, pulling: Array, load: Array
) -> None:
    """Raise if the load moves a body that neither contact nor friction can hold. Collective.

    ``load`` is its work on each motion of the bodies; ``pulling`` are local rows of contact that
    hold both ways, as far as is known before the solve.
    """
    motion = bcast_from_root(coarse.comm, coarse.bodies.driven(coarse.free_motions, load))
    reason = (
        "nothing resists that and the load drives it; add a Dirichlet condition, a contact or a "
        "spring, or balance the load"
    )
    if motion is None and coarse.unheld.free.any():
        scene, found = rigid_scene(coarse, constraints, pulling, cones=True), None
        with raised_on_all_ranks(coarse.comm):
            if scene is not None:
                found = _explained(scene, coarse, constraints.sets.tangents.shape[1])
        motion, reason = bcast_from_root(coarse.comm, found) or (None, reason)
    if motion is not None:
        words = coarse.bodies.sentence(coarse.bodies.amounts(motion))
        raise NoSolutionError(f"{words}: {reason}")


def sliding_motion(coarse: CoarseSpace, constraints: Constraints, pulling: Array) -> Array | None:
    """Return how the load moves bodies; None: forces within the limits hold them. Collective."""
    if not coarse.unheld.free.any():
        return None
    scene, motion = rigid_scene(coarse, constraints, pulling, cones=False), None
    with raised_on_all_ranks(coarse.comm):
        if scene is not None and (y := scene.escape()) is not None:
            motion = coarse.unheld.alone @ y
    return bcast_from_root(coarse.comm, motion)


def rigid_scene(
    coarse: CoarseSpace, constraints: Constraints, pulling: Array, cones: bool
) -> RigidScene | None:
    """Gather the rows of all ranks on rank 0; None on others. Collective.

    With ``cones`` Coulomb's law bounds friction by the forces of normals; else the present limits
    do.
    """
    bodies, Z, sets = coarse.bodies, coarse.unheld.alone, constraints.sets
    body = np.repeat(np.arange(bodies.count), coarse.unheld.free.sum(axis=1))
    J, size = coarse.J.csr() @ Z, coarse.row_size
    pressed = constraints.pressed if cones else np.empty(0, dtype=np.int64)
    given = np.setdiff1d(np.arange(len(sets.tangents)), pressed)
    above = constraints.pressed_by[pressed]
    over = size[sets.tangents]
    mu = constraints.coefficients * (over / size[constraints.pressed_by][:, None])
    along = [
        [rows_of(J, at, of).csr() for at, of in zip(sets.tangents[some].T, w[some].T, strict=True)]
        for some, w in ((pressed, mu), (given, constraints.limits * over))
    ]
    presses = vstack([J[np.setdiff1d(sets.normals, above)], -J[pulling]], format="csr")
    own = (presses, J[above], *along)
    ranks = coarse.comm.gather(own, root=0)
    if ranks is None:
        return None
    normals, pressing, *tangential = zip(*ranks, strict=True)
    axes = [[vstack(axis, format="csr") for axis in zip(*of, strict=True)] for of in tangential]
    # nothing where no rank has rows
    of_cones, of_given = (tuple(of) if of and of[0].shape[0] else () for of in axes)
    N, P = (vstack(rows, format="csr") for rows in (normals, pressing))
    load, noise = Z.T @ coarse.work(coarse.e), bodies.negligible[body]
    return RigidScene(load, noise, body, N, P, of_cones, of_given)


def _explained(
    scene: RigidScene, coarse: CoarseSpace, num_tangents: int
) -> tuple[Array, str] | None:
    """Return the motion that escapes, if there is one, and why nothing holds it."""
    y = scene.escape()
    if y is None:
        return None
    motion = np.asarray(coarse.unheld.alone @ y)
    if not scene.cones and not scene.given:
        return motion, "only contact could resist that, and the load drives out of contact"
    if scene.escape(PARAMETERS.enough) is not None:
        return motion, (
            "only contact could resist that, and the load drives out of it, or along it where "
            "there is no friction"
        )
    if scene.cones:
        low, high = 1.0, 2.0
        while scene.escape(high) is not None:
            low, high = high, 2.0 * high
        while high - low > PARAMETERS.share * low:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if scene.escape(middle) is None else (middle, high)
        return motion, (
            "friction does not hold the load: the coefficients of friction would have to be "
            f"{0.5 * (low + high):.4g} times as large"
        )
    # of a motion whose largest translation, or turn, is 1
    amounts = np.abs(coarse.bodies.amounts(motion))
    size = amounts[:, : num_tangents + 1].max(initial=0.0) or amounts.max(initial=0.0)
    capacity = float(_directions(scene.given, y)[0].sum())
    return motion, (
        f"the load does the work {float(scene.load @ y) / size:.4g} on a motion of size 1, and "
        f"friction takes {capacity / size:.4g} at most"
    )
