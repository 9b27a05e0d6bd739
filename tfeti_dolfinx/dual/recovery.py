"""From multipliers back to displacements."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# Of GGᵀ, added to G_f G_fᵀ: rows with a force that hold a motion by less are not asked about it,
# since they would answer with their rounding over this share.
DAMPING = 1e-8


def recover(
    B: PETSc.Mat,
    c: PETSc.Vec,
    coarse: CoarseSpace,
    lam: PETSc.Vec,
    gradient: PETSc.Vec,
    face: Face,
    pinv_load: Array,
) -> tuple[Array, Array, Array]:
    """u = K⁺(f − Bᵀλ) + Rα. Collective.

    α = (GGᵀ)⁻¹G(Fλ − d − ν) makes the rows' residuals vanish, but for ν, the gaps of open rows
    as the solver left them. A step of the damped normal equations on the rows f that the face
    holds (equalities, λ_N > 0) makes theirs as small as α can.

    Args:
        B: Dual rows × trace unknowns.
        c: Right sides.
        coarse: The coarse space.
        lam: The multipliers.
        gradient: Fλ − d up to the range of Gᵀ; on rows that the face does not hold it is ν.
        face: The face of λ.
        pinv_load: K⁺f, shape ``(n,)``.

    Returns:
        This rank's part of u, shape ``(n,)``, of c − B u, and of Fλ − d, shape ``(m,)``.
    """
    v, residual = B.createVecRight(), c.duplicate()
    subdomains = coarse.subdomains
    u = bent(B, subdomains, lam, pinv_load)
    v.array[:] = u[subdomains.trace]
    B.mult(v, residual)
    residual.aypx(-1.0, c)  # c − B K⁺(f − Bᵀλ) = Fλ − d
    g = np.array(residual.array_r)
    for vec in (v, residual):
        vec.destroy()
    nu = np.where(face.holding, 0.0, gradient.array_r)
    alpha = _alpha(coarse, g, face.holding, nu)
    return moved(u, coarse, alpha), g - coarse.Gt @ alpha, g


def missed(constraints: Constraints, v: Array) -> PETSc.Vec:
    """B v − c, a new vector, of displacements on this rank's trace. Collective."""
    trace, w = constraints.B.createVecRight(), constraints.c.duplicate()
    trace.array[:] = v
    constraints.B.mult(trace, w)
    w.axpy(-1.0, constraints.c)
    trace.destroy()
    return w


def bent(B: PETSc.Mat, subdomains: Subdomains, lam: PETSc.Vec, pinv_load: Array) -> Array:
    """K⁺(f − Bᵀλ), this rank's part, shape ``(n,)``. Collective.

    Args:
        B: Dual rows × trace unknowns.
        subdomains: This rank's Blocks.
        lam: The multipliers.
        pinv_load: K⁺f, shape ``(n,)``.
    """
    w = B.createVecRight()
    B.multTranspose(lam, w)
    u = pinv_load - subdomains.solve(subdomains.extended(w.array_r))
    w.destroy()
    return np.asarray(u)


def at_rest(subdomains: Subdomains, u: Array) -> Array:
    """u less its motions, u − R Rᵀu, shape ``(n,)``; twice, since these may be far larger."""
    for _ in range(2):
        u = u - subdomains.kernel_motion(subdomains.kernel_part(u))
    return u


def moved(u: Array, coarse: CoarseSpace, alpha: Array) -> Array:
    """u + Rα."""
    return u + coarse.subdomains.kernel_motion(coarse.local_alpha(alpha))


def _alpha(coarse: CoarseSpace, gradient: Array, free: Array, nu: Array) -> Array:
    """Kernel coordinates that make the rows' residuals vanish as far as they can."""
    if coarse.dimension == 0:
        return np.zeros(0)
    alpha = coarse.solve(coarse.G(gradient - nu))
    if coarse.comm.allreduce(int(np.sum(~free))) == 0:
        return alpha
    factor = coarse.damped_factor(free, DAMPING)
    left = np.where(free, gradient - coarse.Gt @ alpha, 0.0)
    step = factor.solve(coarse.G(left))
    factor.destroy()
    return alpha + step
