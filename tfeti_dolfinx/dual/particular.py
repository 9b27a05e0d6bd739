"""Multipliers that balance the load: the smallest ones, with and without tension."""

from __future__ import annotations

import logging

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.feasible_sets import Bounds, FeasibleSet, Product
from tfeti_dolfinx.qp.homogenised import natural

# far more than Newton takes where it converges, so that a cycle ends
MAX_STEPS = 100
# Of ‖e‖: what the coarse problem's factors leave at best, and what is let pass: below any rtol,
# and the solver makes Gλ = e good afterwards.
BALANCED, LET_PASS = 1e-13, 1e-9
# of GGᵀ: keeps the steps' matrices regular where few rows carry a force; above rounding, and small
# beside 1, so that steps stay Newton's
DAMPING = 1e-8
# a step of this share of Newton's changes nothing that is left above rounding
SHORTEST = 1e-8

log = logging.getLogger(__name__)


def feasible_particular(coarse: CoarseSpace, bounded: Array) -> Array:
    """λ̄ of min ½‖λ‖² subject to Gλ = e, λ_N ≥ 0. Collective.

    λ̄ = Gᵀα on free rows and (Gᵀα)₊ on bounded ones; α by a semismooth Newton method, each
    step of which factors G_f G_fᵀ, f the rows that carry a force (Dostál's talk, item (ii)).
    Where that does not end, λ̄ = Gᵀ(GGᵀ)⁻¹e is taken, and a warning says so.

    Args:
        coarse: The coarse space; the problem has been found solvable.
        bounded: Local rows with λ ≥ 0.

    Returns:
        This rank's part of λ̄.
    """
    feasible = Product([(bounded, Bounds())])
    alpha = start = coarse.solve(coarse.e)
    for _ in range(MAX_STEPS):
        force = feasible.project(coarse.Gt @ alpha)
        residual = coarse.e - coarse.G(force)
        left = float(np.linalg.norm(residual))
        if agreed(coarse.comm, left <= BALANCED * float(np.linalg.norm(coarse.e))):
            return force
        factor = coarse.damped_factor(feasible.face(force, force).carrying, DAMPING)
        step = factor.solve(residual)
        factor.destroy()
        length = _damping(coarse, feasible, alpha, step)
        if length <= SHORTEST:
            break
        alpha = alpha + length * step
    if agreed(coarse.comm, left <= LET_PASS * float(np.linalg.norm(coarse.e))):
        return force
    if coarse.comm.rank == 0:
        log.warning(
            "homogenization feasible: the smallest feasible multipliers were not found (Gλ − e "
            "is %.1e of e); natural is taken instead",
            left / float(np.linalg.norm(coarse.e)),
        )
    return np.asarray(coarse.Gt @ start)


def _damping(coarse: CoarseSpace, feasible: FeasibleSet, alpha: Array, step: Array) -> float:
    """Step length that does not raise ½‖λ(α)‖² − αᵀe."""

    def cost(alpha: Array) -> float:
        force = feasible.project(coarse.Gt @ alpha)
        return 0.5 * float(coarse.comm.allreduce(float(force @ force))) - float(alpha @ coarse.e)

    start, length = cost(alpha), 1.0
    while length > SHORTEST and agreed(coarse.comm, cost(alpha + length * step) > start):
        length *= 0.5
    return length


def _feasible(coarse: CoarseSpace, like: PETSc.Vec) -> PETSc.Vec:
    x = like.duplicate()
    x.array[:] = feasible_particular(coarse, coarse.bounded)
    return x


# solutions of Gλ̄ = e
PARTICULAR = {"natural": natural, "feasible": _feasible}
