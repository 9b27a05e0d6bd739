"""Recovery of displacements from multipliers: u = K⁺(f − Bᵀλ) + Rα."""

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from scipy.optimize import lsq_linear
from scipy.sparse import csr_array, vstack

from tfeti_dolfinx.common.arrays import Array, rows_of
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, summed
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import TfetiError, raised_on_all_ranks
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.rigid_bodies import Motions, orthonormal_columns, parts_of_columns
from tfeti_dolfinx.qp.recycling import right_singular
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.subdomains.subdomains import Subdomains


@dataclass(frozen=True)
class Recovered:
    """Displacement of an iterate; all arrays are this rank's parts."""

    lam: Array  # the multipliers λ, shape (m,)
    u: Array  # the displacement, shape (n,)
    gap: Array  # c − B u, shape (m,)
    residual: Array  # Fλ − d, shape (m,)
    # flags of contact rows whose force is more than the solver's error, and of rows of friction
    # that the face holds, shape (m,)
    active: Array
    loose: Motions  # motions of bodies that no active row resists


def recover(
    constraints: Constraints,
    coarse: CoarseSpace,
    lam: Array,
    gradient: Array,
    face: Face,
    error: float,
    no_effect: float = 10.0,
    damping: float = 1e-8,
) -> Recovered:
    """u = K⁺(f − Bᵀλ) + Rα, and the motions that no row with a force resists. Collective.

    α = (GGᵀ)⁻¹G(Fλ − d − ν) makes the rows' residuals vanish, but for ν, the gaps of open rows
    as the solver left them. A step of the damped normal equations on the rows f that the face
    holds (equalities, λ_N > 0) makes theirs as small as α can: gaps may be far larger than u.

    Args:
        constraints: B and c.
        coarse: The coarse space.
        lam: The multipliers, shape ``(m,)``.
        gradient: Fλ − d up to the range of Gᵀ; on rows that the face does not hold it is ν.
        face: The face of λ.
        error: How large multipliers may be by the solver's error alone.
        no_effect: Of that: a larger force of a normal counts; a smaller one where it bears a load.
        damping: Of GGᵀ, added to G_f G_fᵀ: rows with a force that hold a motion by less would
            answer with their rounding over this share.
    """
    subdomains = coarse.subdomains
    u = elastic_displacement(constraints, subdomains, lam, subdomains.pinv_load)
    residual = constraints.c - constraints.jumps(u[subdomains.trace])  # = Fλ − d
    residual[coarse.springs] = -coarse.spring_ends(lam, u)
    gap = residual
    if coarse.dimension:
        held = face.holding
        alpha = coarse.solve(coarse.G(residual - np.where(held, 0.0, gradient)))
        if any_rank(coarse.comm, not np.all(held)):
            left = np.where(held, residual - coarse.rows @ alpha, 0.0)
            on_held = Face(held, face.status)
            alpha = alpha + coarse.damped_solve(on_held, coarse.G(left), damping)
        u, gap = u + coarse.kernel_motion(alpha), residual - coarse.rows @ alpha
    # what sticks to a given bound holds, pushed or not; under Coulomb's law what is pushed or pulls
    borne, active = np.abs(lam) > no_effect * error, np.zeros(len(lam), dtype=bool)
    at = constraints.pressed
    rows = constraints.sets.tangents[at]
    while True:
        active[coarse.bounded] = borne[coarse.bounded]
        active[coarse.rubbing] = True
        pulled = borne[constraints.pressed_by[at]] | np.any(borne[rows], axis=1)
        active[rows] = pulled[:, None]
        active &= face.carrying
        loose = coarse.unresisted(active)
        # what the load drives is resisted: there forces count that are small beside others
        light = np.zeros(len(lam), dtype=bool)
        light[coarse.rows_driven(loose)] = True
        light &= (lam != 0.0) & ~borne
        if not loose.count or not any_rank(coarse.comm, light):
            return Recovered(np.array(lam), u, gap, residual, active, loose)
        borne |= light


def placed(coarse: CoarseSpace, state: Recovered, begin: Array | float, unseen: float) -> Recovered:
    """Return an iterate with its bodies as near to another displacement as rows let. Collective.

    Motions that no row with a force resists are the solver's only by chance: of these places the
    nearest to ``begin`` is taken, in the mean square over each body, that overlaps nowhere. Rows
    do not see motions that they resist by less than the share ``unseen`` of others.
    """
    comm, N = coarse.comm, _basis(coarse, state)
    wanted = N.T @ coarse.bodies.part_of(begin - state.u)
    rows = coarse.bounded[~state.active[coarse.bounded]]
    own = (
        rows_of(coarse.J.csr() @ N, rows).csr(),
        np.maximum(state.gap[rows], 0.0) / coarse.row_size[rows],
    )
    ranks, motion, closed = comm.gather(own, root=0), None, None
    with raised_on_all_ranks(comm):
        if ranks is not None:
            closing, gaps = zip(*ranks, strict=True)
            C, g, motion = csr_array(vstack(closing)), np.concatenate(gaps), np.array(wanted)
            by = np.zeros(len(g))
            for part, at, dense in parts_of_columns(C):
                sigma, V = right_singular(MPI.COMM_SELF, dense)
                V = V[sigma > unseen * sigma.max(initial=0.0)]
                seen = dense @ V.T @ V
                near = least_distance(seen, g[at], wanted[part])
                # once more: what is left is rounding of a way that may be long beside gaps
                motion[part] = least_distance(seen, g[at], near)
                by[at] = seen @ motion[part]
            closed = np.split(by, np.cumsum([len(gap) for gap in gaps])[:-1])
    alpha = coarse.motions @ np.asarray(N @ bcast_from_root(comm, motion))
    u, gap = state.u + coarse.kernel_motion(alpha), state.gap - coarse.rows @ alpha
    gap[rows] = state.gap[rows] - coarse.row_size[rows] * comm.scatter(closed, root=0)
    return replace(state, u=u, gap=gap)


def let_go(coarse: CoarseSpace, state: Recovered) -> Array:
    """Return the rows of contact of loose bodies that no row with a force acts on. Collective.

    Forces there are the solver's error.
    """
    J, touched = coarse.J, np.zeros(coarse.bodies.count)
    touched[J.body[state.active[J.row]]] = 1.0
    free = state.loose.moving & (summed(coarse.comm, touched) == 0.0)
    contact = np.zeros(len(state.active), dtype=bool)
    contact[np.append(coarse.bounded, coarse.rubbing)] = True
    rows = J.row[free[J.body]]
    return np.asarray(rows[contact[rows]])


def without_loose(coarse: CoarseSpace, state: Recovered, u: Array) -> Array:
    """Return a displacement without the motions that no row with a force resists. Collective."""
    if not state.loose.count:
        return u
    N = _basis(coarse, state)
    return u - coarse.kernel_motion(coarse.motions @ (N @ (N.T @ coarse.bodies.part_of(u))))


def _basis(coarse: CoarseSpace, state: Recovered) -> csr_array:
    """Return an orthonormal basis of the loose motions, the same on all ranks. Collective."""
    return bcast_from_root(coarse.comm, orthonormal_columns(state.loose.columns))


def least_distance(C: Array, g: Array, t: Array) -> Array:
    """Return the nearest point to t of those with C y ≤ g, 0 among them, else raise a TfetiError.

    As nonnegative least squares (Lawson, Hanson, Solving Least Squares Problems, 1974, ch. 23).

    >>> least_distance(np.array([[1.0, 0.0]]), np.array([0.5]), np.array([2.0, 1.0])).tolist()
    [0.5, 1.0]
    """
    if not np.any(C @ t > g):
        return t
    size = np.linalg.norm(t)
    some = 2.0 * size * np.linalg.norm(C, axis=1) > g  # the others are out of reach
    E, f = np.vstack((-C[some].T, (C @ t - g)[some] / size)), np.append(np.zeros(len(t)), 1.0)
    # scipy's nnls ends too early on rows that depend on each other
    found = lsq_linear(E, f, (0.0, np.inf), method="bvls", tol=1e-15, max_iter=10 * len(E.T))
    if not found.success:
        raise TfetiError(f"the place of a body that nothing holds was not found: {found.message}")
    r = E @ found.x - f
    return np.asarray(t - size * r[:-1] / r[-1])


def elastic_displacement(
    constraints: Constraints, subdomains: Subdomains, lam: Array, response: Array
) -> Array:
    """K⁺(f − Bᵀλ), this rank's part, shape ``(n,)``, from K⁺f and λ. Collective."""
    return response - subdomains.solve(subdomains.extended(constraints.forces(lam)))


def min_norm_correction(
    constraints: Constraints, w: Array, closed: Array, tol: float = 1e-10, max_it: int = 100
) -> Array:
    """Return the least displacement v in D for which B_f v comes nearest to w. Collective.

    Gluing and Dirichlet rows are orthonormal in D⁻¹, and orthogonal to contact rows: D⁻¹B_fᵀw
    closes them. Contact rows are not so to each other, and may depend on each other: conjugate
    gradients for least squares (Björck, Numerical Methods for Least Squares Problems, SIAM 1996,
    section 7.4), to ``tol`` of the first gradient. With the usual eigenvalues of B_f D⁻¹ B_fᵀ, 0.6
    to 2, they take about 15 steps. w is what rows miss, zero on rows that are not asked about,
    ``closed`` flags of the local contact rows that are, in the order of ``sets.contact``. Return v
    on this rank's trace unknowns, shape ``(Σ t_s,)``.
    """
    D, contact = constraints.weights, constraints.sets.contact
    comm = constraints.B.getComm().tompi4py()

    root = np.sqrt(np.where(np.isfinite(D), D, 0.0))  # rigid bodies do not move

    def upwards(r: Array) -> tuple[Array, float]:  # s = D⁻¹B_fᵀr and ‖s‖²_D
        z = np.zeros(len(w))
        z[contact] = r
        s = constraints.forces(z) / D
        return s, float(summed(comm, np.array([(root * s) @ (root * s)]))[0])

    apart = np.array(w)
    apart[contact] = 0.0
    r = np.where(closed, w[contact], 0.0)
    x, (s, left) = constraints.forces(apart) / D, upwards(r)
    p = s
    enough = tol**2 * left
    for _ in range(max_it):
        if left <= enough:
            break
        q = np.where(closed, constraints.jumps(p)[contact], 0.0)
        if (curvature := float(summed(comm, np.array([q @ q]))[0])) == 0.0:
            break
        x = x + left / curvature * p
        r = r - left / curvature * q
        before, (s, left) = left, upwards(r)
        p = s + left / before * p
    return x
