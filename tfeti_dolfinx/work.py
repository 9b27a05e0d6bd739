"""Energies of bodies with mass, and what was done to them in a step."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.inertia import InertialForms
from tfeti_dolfinx.parallel import summed
from tfeti_dolfinx.solution import Solution

NAMES = ("load", "contact", "friction", "supports", "predictor")


def balance(forms: InertialForms, dual: Dual, solution: Solution) -> dict[str, float]:
    """Energies at the end of a step, and the work that has changed them. Collective.

    Args:
        forms: Where the step began.
        dual: Its dual problem.
        solution: Its end.

    Returns:
        ``size`` of the step; at its end ``kinetic``, ``elastic`` and ``energy``; work of the
        ``load``, of normal forces of ``contact``, of ``friction``, of ``supports`` (Dirichlet
        conditions, and what jumps at tears to the tolerance), what the ``predictor`` has added,
        at most 0; and ``defect``, what all these leave of the change of the energy: rounding.
    """
    motion, (K, M) = forms.motion, forms.matrices
    u, v = solution.displacement.x.array, solution.velocity.x.array
    kicked, way = motion.towards - motion.free, u - motion.u
    own = [
        0.5 * v @ (M @ v),
        0.5 * u @ (K @ u),
        0.5 * motion.v @ (M @ motion.v) + 0.5 * motion.u @ (K @ motion.u),
        forms.mean_load @ way,
        *_work_of_rows(dual, solution.lam, solution.dofs.to_primal(way)),
        -2.0 / motion.size**2 * kicked @ (M @ (u - motion.towards)),
    ]
    values = [float(value) for value in summed(solution.dofs.comm, np.array(own))]
    (kinetic, elastic, before), work = values[:3], values[3:]
    return {
        "size": motion.size,
        "kinetic": kinetic,
        "elastic": elastic,
        "energy": kinetic + elastic,
        **dict(zip(NAMES, work, strict=True)),
        "defect": kinetic + elastic - before - sum(work),
    }


def _work_of_rows(dual: Dual, lam: Array, way: Array) -> list[float]:
    """−λᵀB Δu of this rank's normal, tangential and other rows. Collective."""
    B, sets = dual.constraints.B, dual.constraints.sets
    moved, rows = B.createVecRight(), dual.constraints.c.duplicate()
    moved.array[:] = way[dual.subdomains.trace]
    B.mult(moved, rows)
    done = -lam * rows.array_r
    moved.destroy()
    rows.destroy()
    kinds = (sets.normals, sets.tangents.ravel(), sets.equalities)
    return [float(done[kind].sum()) for kind in kinds]


def contact_forces(solution: Solution) -> list[list[float]]:
    """Resultant on the surface of each contact, of a pair the secondary one. Collective."""
    records = solution.gluing.records
    force = solution.tangential_force - solution.force[:, None] * records.normal
    total = summed(solution.dofs.comm, sum_rows(records.contact, force, len(solution.contacts)))
    return [[float(value) for value in row] for row in total]
