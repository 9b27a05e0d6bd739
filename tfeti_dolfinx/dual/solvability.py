"""Whether the multipliers can balance the load: Gλ = e with λ_N ≥ 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import NULL, CoarseSpace, SemidefiniteFactor
from tfeti_dolfinx.errors import NoSolutionError

BALANCE = 1e-9
TINY = 1e-14
# of the largest coefficient: what takes part in a motion, what it is named after; bodies named
PART, DOMINANT, NAMED = 1e-3, 0.3, 4


def check_solvable(
    coarse: CoarseSpace,
    bounded: slice,
    load_norm: float,
    body_names: Sequence[str],
    mode_names: Sequence[str],
) -> None:
    """Raise if the load moves a body that nothing holds. Collective.

    Args:
        coarse: The coarse space.
        bounded: Local rows with λ ≥ 0.
        load_norm: ‖f‖ over all subdomains.
        body_names: Names of the bodies.
        mode_names: Names of their modes.

    Raises:
        NoSolutionError: Names the body and the mode.
    """
    if coarse.dimension == 0:
        return
    push = coarse.free_modes.T @ coarse.e
    if np.linalg.norm(push) > BALANCE * load_norm:
        motion = coarse.free_motions @ (coarse.free_motions.T @ (coarse.body_modes.T @ coarse.e))
        raise NoSolutionError(
            f"{_name(motion, body_names, mode_names)}: nothing resists that and the load drives "
            "it; add a Dirichlet condition, a contact or a spring, or balance the load"
        )
    motion = escape(coarse, bounded)
    if motion is not None:
        raise NoSolutionError(
            f"{_name(motion, body_names, mode_names)}: only contact could resist that, and the "
            "load drives out of contact"
        )


def _name(motion: Array, body_names: Sequence[str], mode_names: Sequence[str]) -> str:
    """The bodies that take part in a motion, and what it is mostly."""
    parts = np.abs(motion.reshape(len(body_names), len(mode_names)))
    moving = np.flatnonzero(parts.max(axis=1) > PART * parts.max())
    share = parts[moving].max(axis=0)
    modes = " and ".join(mode_names[m] for m in np.flatnonzero(share > DOMINANT * share.max()))
    if len(moving) == 1:
        return f"{body_names[moving[0]]} is free to move ({modes})"
    names = ", ".join(body_names[b] for b in moving[:NAMED])
    more = f" and {len(moving) - NAMED} more" if len(moving) > NAMED else ""
    return f"{names}{more} are free to move together ({modes})"


def escape(coarse: CoarseSpace, bounded: slice) -> Array | None:
    """A motion of the bodies that opens contacts and on which the load does work. Collective.

    By Farkas' lemma Gλ = e has a solution with λ_N ≥ 0 just if there is none. With J = B R Z, Z
    the bodies' modes, it is sought by Newton's method for
    min ½‖J_E z‖² + ½‖(J_N z)₊‖² + ½ε‖z‖² − zᵀZᵀe, whose minimiser tends to a multiple of it.

    Returns:
        Coefficients of the bodies' modes, or None.
    """
    basis = coarse.motion_basis
    held = np.ones(coarse.Gt.shape[0], dtype=bool)
    held[bounded] = False
    H_E = basis.T @ coarse.body_gram(held) @ basis
    if np.linalg.eigvalsh(H_E).min(initial=1.0) > NULL:
        return None
    J_N = np.asarray((coarse.Gt[bounded] @ coarse.body_modes) @ basis)
    load = basis.T @ (coarse.body_modes.T @ coarse.e)
    if np.linalg.norm(load) <= TINY:
        return None
    z = _one_sided_newton(H_E, J_N, load, coarse.comm)
    z /= max(float(np.linalg.norm(z)), 1e-300)
    resistance = z @ H_E @ z + coarse.comm.allreduce(float(np.sum(np.maximum(J_N @ z, 0.0) ** 2)))
    escapes = resistance <= NULL and z @ load > BALANCE * np.linalg.norm(load)
    return basis @ z if escapes else None


def _one_sided_newton(H_E: Array, J_N: Array, load: Array, comm: MPI.Intracomm) -> Array:
    """Minimise the piecewise quadratic of ``escape`` by damped Newton steps."""
    epsilon = TINY * max(1.0, np.abs(H_E).max())
    z: Array = np.zeros(len(load))

    def evaluate(z: Array) -> tuple[float, Array, Array]:
        push = np.maximum(J_N @ z, 0.0)
        active = J_N[push > 0.0]
        parts = np.concatenate(([push @ push], J_N.T @ push, (active.T @ active).ravel()))
        comm.Allreduce(MPI.IN_PLACE, parts, op=MPI.SUM)
        n = len(z)
        gradient = H_E @ z + parts[1 : n + 1] + epsilon * z - load
        hessian = H_E + parts[n + 1 :].reshape(n, n) + epsilon * np.eye(n)
        cost = 0.5 * (z @ H_E @ z + parts[0] + epsilon * z @ z) - load @ z
        return float(cost), gradient, hessian

    for _ in range(100):
        value, gradient, hessian = evaluate(z)
        if np.linalg.norm(gradient) <= 1e-10 * np.linalg.norm(load):
            break
        step = -np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        damping = 1.0
        while damping > 1e-8 and evaluate(z + damping * step)[0] > value:
            damping *= 0.5
        z = z + damping * step
    return z


def feasible_particular(coarse: CoarseSpace, bounded: slice) -> Array:
    """λ̄ of min ½‖λ‖² subject to Gλ = e, λ_N ≥ 0. Collective.

    λ̄ = Gᵀα on free rows and (Gᵀα)₊ on bounded ones; α by a semismooth Newton method, each
    step of which factors G_f G_fᵀ, f the rows that carry a force (Dostál's talk, item (ii)).

    Args:
        coarse: The coarse space; the problem has been found solvable.
        bounded: Local rows with λ ≥ 0.

    Returns:
        This rank's part of λ̄.
    """
    carrying = np.ones(coarse.Gt.shape[0], dtype=bool)
    gram, alpha = coarse.gram(), coarse.solve(coarse.e)
    for _ in range(100):
        force = coarse.Gt @ alpha
        carrying[bounded] = force[bounded] > 0.0
        residual = coarse.e - coarse.G(np.where(carrying, force, 0.0))
        if np.linalg.norm(residual) <= 1e-13 * np.linalg.norm(coarse.e):
            break
        damped = csr_array(coarse.gram(carrying) + 1e-8 * gram)
        factor = SemidefiniteFactor(damped, coarse.free_modes)
        step = factor.solve(residual)
        factor.destroy()
        alpha = alpha + _damping(coarse, bounded, alpha, step) * step
    return np.where(carrying, coarse.Gt @ alpha, 0.0)


def _damping(coarse: CoarseSpace, bounded: slice, alpha: Array, step: Array) -> float:
    """Step length that does not raise ½‖λ(α)‖² − αᵀe."""

    def cost(alpha: Array) -> float:
        force = coarse.Gt @ alpha
        force[bounded] = np.maximum(force[bounded], 0.0)
        return 0.5 * float(coarse.comm.allreduce(float(force @ force))) - float(alpha @ coarse.e)

    start, length = cost(alpha), 1.0
    while length > 1e-8 and cost(alpha + length * step) > start:
        length *= 0.5
    return length
