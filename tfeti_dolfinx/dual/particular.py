"""Multipliers that balance the load: the smallest ones, with and without tension."""

from __future__ import annotations

import logging

from petsc4py import PETSc

from tfeti_dolfinx.dual.coarse import CoarseSpace
from tfeti_dolfinx.qp.feasible_sets import Bounds, Product
from tfeti_dolfinx.qp.homogenised import natural
from tfeti_dolfinx.qp.nearest import nearest

# Of ‖e‖: what is let pass: below any rtol, and the solver makes Gλ = e good afterwards.
LET_PASS = 1e-9

log = logging.getLogger(__name__)


def feasible_particular(coarse: CoarseSpace, like: PETSc.Vec) -> PETSc.Vec:
    """λ̄ of min ½‖λ‖² subject to Gλ = e, λ_N ≥ 0. Collective.

    The nearest feasible point to 0 (Dostál's talk, item (ii)). Where that is not found,
    λ̄ = Gᵀ(GGᵀ)⁻¹e is taken, and a warning says so.

    Args:
        coarse: The coarse space; the problem has been found solvable.
        like: A vector of the right layout.
    """
    zero = like.duplicate()
    zero.set(0.0)
    feasible = Product([(coarse.bounded, Bounds())])
    found = nearest(coarse, feasible, zero, coarse.solve(coarse.e))
    zero.destroy()
    if found.missing <= LET_PASS:
        return found.lam
    found.lam.destroy()
    if coarse.comm.rank == 0:
        log.warning(
            "homogenization feasible: the smallest feasible multipliers were not found (Gλ − e "
            "is %.1e of e); natural is taken instead",
            found.missing,
        )
    return natural(coarse, like)


# solutions of Gλ̄ = e
PARTICULAR = {"natural": natural, "feasible": feasible_particular}
