"""From multipliers back to displacements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import CoarseSpace, SemidefiniteFactor
from tfeti_dolfinx.dual.operator import trace_slices
from tfeti_dolfinx.subdomains.block import Block


def recover(
    B: PETSc.Mat,
    c: PETSc.Vec,
    blocks: Sequence[Block],
    coarse: CoarseSpace,
    lam: PETSc.Vec,
    bounded: slice,
    nu: Array,
) -> list[Array]:
    """u = K⁺(f − Bᵀλ) + Rα. Collective.

    α = (G_f G_fᵀ)⁻¹G_f(Fλ − d) on the free rows f, those of equalities and of λ_N > 0. Where the
    free rows let a body move that all rows together hold, α = (GGᵀ)⁻¹G(Fλ − d − ν).

    Args:
        B: Dual rows × trace unknowns.
        c: Right sides.
        blocks: This rank's Blocks.
        coarse: The coarse space.
        lam: The multipliers.
        bounded: Local rows with λ ≥ 0.
        nu: Multipliers of λ_N ≥ 0 on all local rows, zero on free ones, shape ``(m,)``.

    Returns:
        Displacements of each Block, each of shape ``(n_s,)``.
    """
    w, v, residual = B.createVecRight(), B.createVecRight(), c.duplicate()
    B.multTranspose(lam, w)
    slices = trace_slices(blocks)
    u = [block.recover(w.array_r[part]) for block, part in zip(blocks, slices, strict=True)]
    for block, part, u_s in zip(blocks, slices, u, strict=True):
        v.array[part] = u_s[block.trace_dofs]
    B.mult(v, residual)
    residual.aypx(-1.0, c)  # c − B K⁺(f − Bᵀλ) = Fλ − d
    alpha = _alpha(coarse, residual.array_r, lam.array_r, bounded, nu)
    for vec in (w, v, residual):
        vec.destroy()
    return [
        u_s + block.kernel_motion(a)
        for u_s, block, a in zip(u, blocks, coarse.alpha_of(alpha), strict=True)
    ]


def _alpha(coarse: CoarseSpace, gradient: Array, lam: Array, bounded: slice, nu: Array) -> Array:
    """Kernel coordinates that make the rows' residuals vanish as far as they can."""
    if coarse.dimension == 0:
        return np.zeros(0)
    free = np.ones(len(lam), dtype=bool)
    free[bounded] = lam[bounded] > 0.0
    if coarse.comm.allreduce(int(np.sum(~free))) == 0:
        return coarse.solve(coarse.G(gradient))
    motions = coarse.null_motions(free)
    if motions.shape[1] > coarse.free_motions.shape[1]:
        return coarse.solve(coarse.G(gradient - nu))
    factor = SemidefiniteFactor(coarse.gram(free), coarse.modes_of(motions))
    alpha = factor.solve(coarse.G(np.where(free, gradient, 0.0)))
    factor.destroy()
    return alpha
