"""Recovery of displacements from multipliers: u = K⁺(f − Bᵀλ) + Rα."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, least, summed
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.rigid_bodies import orthonormal_columns
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
    """u = K⁺(f − Bᵀλ) + Rα; of displacements that differ by free motions the smallest. Collective.

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
        no_effect: Of that: a larger force of a normal counts.
        damping: Of GGᵀ, added to G_f G_fᵀ: rows with a force that hold a motion by less would
            answer with their rounding over this share.
    """
    subdomains = coarse.subdomains
    u = elastic_displacement(constraints, subdomains, lam, subdomains.pinv_load)
    residual = constraints.c - constraints.jumps(u[subdomains.trace])  # = Fλ − d
    residual[coarse.springs] = -coarse.spring_ends(lam, u)
    alpha: Array = np.zeros(0)
    if coarse.dimension:
        held = face.holding
        alpha = coarse.solve(coarse.G(residual - np.where(held, 0.0, gradient)))
        if any_rank(coarse.comm, not np.all(held)):
            left = np.where(held, residual - coarse.rows @ alpha, 0.0)
            on_held = Face(held, face.status)
            alpha = alpha + coarse.damped_solve(on_held, coarse.G(left), damping)
        u = u + coarse.kernel_motion(alpha)
    gap = residual - coarse.Gt @ alpha
    if (N := coarse.free_basis).shape[1]:  # gaps do not change
        u = u - coarse.kernel_motion(coarse.motions @ (N @ (N.T @ coarse.bodies.part_of(u))))
    # what sticks to a given bound holds, pushed or not; under Coulomb's law what is pushed or pulls
    borne, active = np.abs(lam) > no_effect * error, np.zeros(len(lam), dtype=bool)
    active[coarse.bounded] = borne[coarse.bounded]
    active[coarse.rubbing] = True
    at = constraints.pressed
    rows = constraints.sets.tangents[at]
    active[rows] = (borne[constraints.pressed_by[at]] | np.any(borne[rows], axis=1))[:, None]
    active &= face.carrying
    return Recovered(np.array(lam), u, gap, residual, active)


def nearest(coarse: CoarseSpace, state: Recovered, rest: Array, nothing: float = 1e-10) -> Array:
    """Return of displacements that are as right as one the nearest to another. Collective.

    Motions that no active row holds go as far as the gaps of the other rows allow; what a row then
    stops holds, and the others go on.

    Args:
        coarse: The coarse space.
        state: The displacement, with its gaps and active rows.
        rest: The other one, shape ``(n,)``.
        nothing: Share of the largest motion of a body: a gap that changes by less does not change.
    """
    u, gap, held, rows, left = state.u, state.gap, state.active, coarse.bounded, np.inf
    while True:
        N = bcast_from_root(coarse.comm, orthonormal_columns(coarse.unresisted(held).columns))
        if not 0 < N.shape[1] < left:
            return u
        left = N.shape[1]
        motion = N @ (N.T @ coarse.bodies.part_of(rest - u))
        alpha = coarse.motions @ motion
        closing = coarse.Gt @ alpha
        closes = closing > nothing * np.abs(motion).max() * coarse.row_size
        at = rows[(closes & ~held)[rows]]
        allowed = np.maximum(gap[at], 0.0) / closing[at]
        share = least(coarse.comm, float(allowed.min(initial=1.0)))
        u, gap = u + share * coarse.kernel_motion(alpha), gap - share * closing
        if share == 1.0:
            return u
        held = np.array(held)
        held[at[allowed <= share]] = True


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
