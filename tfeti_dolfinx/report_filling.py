"""The report of a solve, from the objects that took part in it."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.coulomb import Settling
from tfeti_dolfinx.dual.accuracy import Accuracy
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.qp.problem import QPResult
from tfeti_dolfinx.report import Report, peak_memory_mb
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.states import ContactStatus
from tfeti_dolfinx.subdomains.local import ModelledOperator


def fill_sizes(
    report: Report, dofs: TornDofs, decomposition: Decomposition, gluing: Gluing, inside: int
) -> None:
    """Fill in what is known before the dual problem is. Collective.

    Args:
        report: Takes it.
        dofs: Dof maps.
        decomposition: The torn mesh.
        gluing: Rows.
        inside: Unknowns that boundary elements do without.
    """
    comm, constraints = dofs.comm, gluing.constraints
    report.primal_dofs = int(dofs.offsets[-1]) * dofs.bs - inside
    report.dual_dofs = comm.allreduce(constraints.num_rows)
    report.subdomains, report.bodies = decomposition.num_subdomains, decomposition.num_bodies
    report.split_subdomains = len(decomposition.split)
    report.contact_rows = comm.allreduce(len(constraints.sets.normals))
    report.tangential_rows = comm.allreduce(constraints.sets.tangents.size)
    report.contact_candidates = comm.allreduce(gluing.records.candidates)
    within_reach = comm.allreduce(int(np.sum(gluing.records.within_reach)))
    report.far_contact_nodes = report.contact_candidates - within_reach
    report.dropped_contact_rows = comm.allreduce(len(gluing.contact.decided))


def fill_result(
    report: Report,
    solution: Solution,
    dual: Dual,
    result: QPResult,
    accuracy: Accuracy,
    settling: Settling,
) -> None:
    """Fill in what a solve has found; counters add up over rounds. Collective."""
    comm = dual.coarse.comm
    report.clusters = dual.subdomains.num_clusters
    report.kernel_dim = dual.coarse.dimension
    report.free_modes = dual.coarse.num_free_motions
    report.nearly_free = dual.nearly_free
    active = solution.carrying[solution.gluing.constraints.sets.normals]
    report.active_contacts = comm.allreduce(int(np.sum(active)))
    status = solution.status_of_conditions
    report.sticking = comm.allreduce(int(np.sum(status == ContactStatus.STICK)))
    report.sliding = comm.allreduce(int(np.sum(status == ContactStatus.SLIP)))
    report.F_multiplications += dual.F.count["solver"]
    report.power_method_multiplications += dual.F.count["power method"]
    report.recycled_directions = 0 if dual.recycled is None else dual.recycled.count
    if dual.preconditioner is not None:
        report.preconditioner_multiplications += dual.preconditioner.count["solver"]
    report.friction_iterations += settling.iterations
    report.friction_newton_steps += settling.newton_steps
    report.friction_last = settling.last
    report.outer_iterations += result.steps.outer
    report.newton_faces += result.steps.faces
    report.face_factorizations += dual.coarse.factors.count["face"]
    if dual.soft is not None:
        report.soft_factorizations += dual.soft.factors.count["face"]
        report.soft_modes = dual.soft.count
    report.cg_steps += result.steps.cg
    report.expansion_steps += result.steps.expansion
    report.proportioning_steps += result.steps.proportioning
    report.converged_reason = result.reason.name
    report.local_operators = _local_operators(dual)
    report.recoveries += accuracy.looks
    report.residuals = _residuals(solution, dual, result, accuracy)
    report.residuals["friction"] = settling.change
    report.tolerances = _tolerances(solution, dual, accuracy)
    report.tolerances["friction"] = settling.tolerance
    report.peak_memory_mb = peak_memory_mb(comm)


def settle_seconds(report: Report, comm: MPI.Intracomm) -> None:
    """Make the seconds of each stage those of the slowest rank. Collective."""
    of_ranks = comm.allgather(report.seconds)
    names = dict.fromkeys(name for seconds in of_ranks for name in seconds)
    report.seconds.update({name: max(s.get(name, 0.0) for s in of_ranks) for name in names})


def _local_operators(dual: Dual) -> dict[str, float]:
    """Forms of the local operators, and what they cost."""
    found: dict[str, float] = {}
    for name, operator in (("F", dual.F), ("preconditioner", dual.preconditioner)):
        if operator is None or not isinstance(operator.local, ModelledOperator):
            continue
        forms = dual.coarse.comm.allreduce(operator.local.forms)
        found |= {f"{name}_{form}": float(forms[form]) for form in sorted(forms)}
        found[f"{name}_bytes"] = dual.coarse.comm.allreduce(operator.local.traffic)
        for word, value in (
            ("predicted", operator.local.predicted),
            ("measured", operator.local_seconds),
        ):
            found[f"{name}_{word}"] = dual.coarse.comm.allreduce(value, op=MPI.MAX)
    return found


def _residuals(
    solution: Solution, dual: Dual, result: QPResult, accuracy: Accuracy
) -> dict[str, float]:
    reference = result.reference or 1.0
    gap = solution.remaining_gap
    return {
        "projected_gradient": result.projected_gradient / reference,
        "equilibrium": result.norm * result.equality / reference,
        "displacement_error": accuracy.relative_error(),
        "energy_error": accuracy.energy_error()[0],
        "gluing_jump": _largest(dual, _jumps(solution)),
        "penetration": _largest(dual, -gap),
        "tension": _largest(dual, 0.0 - solution.contact_pressure),
        "complementarity": _largest(dual, np.abs(solution.force * gap)),
        "balance": accuracy.balance,
    }


def _tolerances(solution: Solution, dual: Dual, accuracy: Accuracy) -> dict[str, float]:
    allowed = accuracy.tolerances()
    return {
        "displacement_error": accuracy.rtol,
        "energy_error": accuracy.energy_error()[1],
        "gluing_jump": allowed.jump,
        "penetration": allowed.penetration,
        "tension": 0.0,
        "complementarity": _largest(dual, solution.force) * allowed.penetration,
        "balance": allowed.balance,
    }


def _largest(dual: Dual, values: Array) -> float:
    return float(dual.coarse.comm.allreduce(float(np.max(values, initial=0.0)), op=MPI.MAX))


def _jumps(solution: Solution) -> Array:
    """For each owned group how far its copies are apart, and from prescribed values. Collective."""
    dofs, prescribed = solution.dofs, solution.gluing.prescribed
    u = solution.u.reshape(-1, dofs.bs)
    low, high = dofs.reduce(u, np.minimum, np.inf), dofs.reduce(u, np.maximum, -np.inf)
    held_low = np.where(prescribed.flag, np.minimum(low, prescribed.value), low)
    held_high = np.where(prescribed.flag, np.maximum(high, prescribed.value), high)
    return held_high - held_low
