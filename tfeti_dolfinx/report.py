"""The report of a solve: sizes, counters, residuals and times."""

from __future__ import annotations

import json
import os
import resource
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import named
from tfeti_dolfinx.constraints.contact_state import ContactStatus
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.stopping import Accuracy
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.qp.problem import QPResult
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.solve.coulomb import FixedPointStatus
from tfeti_dolfinx.subdomains.local_operators import ModelledOperator

# --- The report -------------------------------------------------------------------------------

PRINTED = 10  # of a list; all of it is in the file


def _counter() -> Any:
    """Return a counter, which adds up over solves in ``in_all``."""
    return field(default=0, metadata={"adds": True})


@dataclass
class Report:
    """Sizes, counters, residuals and times of a solve; the same on all ranks.

    Counters and seconds are those of the last solve; the first has what was before it, too.

    Attributes:
        primal_dofs: Unknowns of the torn mesh; with boundary elements those on their surface.
        dual_dofs: Rows of B.
        subdomains: Number of subdomains.
        bodies: Number of bodies.
        split_subdomains: Subdomains that were not connected and were split.
        clusters: Clusters of them that averages glue, 0 without.
        kernel_dim: Dimension of the kernel of K.
        soft_modes: Motions of subdomains that springs hold softly, or all of those in clusters:
            part of the preconditioner.
        free_modes: Rigid motions that nothing resists and the load does not drive.
        nearly_free: Rigid motions that contacts with a force hold hardly (``stiffness``: as a
            share of what the same contacts hold at most) or not at all (0): dicts of ``bodies``,
            ``mode`` and ``stiffness``. u has one of these motions.
        warnings: Sentences on why the answer cannot be trusted, or not as far as it seems.
        contact_rows: Non-penetration rows.
        contact_candidates: Nodes of the (secondary) contact surfaces.
        far_contact_nodes: Those that were out of reach or not covered, and have no row.
        late_contact_rows: Rows that nodes out of reach got after a solve, since they overlapped.
        unmet_contacts: Contacts none of whose nodes has a row: position in the list, and name.
        excluding_contacts: Contacts whose rows exclude each other, likewise, if the solver has
            stopped since they do.
        dropped_contact_rows: Those that prescribed components decide alone.
        active_contacts: Rows with a positive force.
        tangential_rows: Rows along tangents, of contacts that have friction.
        sticking: Nodes with friction that touch and stick.
        sliding: Those that slip.
        F_multiplications: Multiplications by F, all but the power method's.
        preconditioner_multiplications: Multiplications by the preconditioner.
        recycled_directions: Directions of this and earlier solves that the next one begins with.
        power_method_multiplications: Multiplications that estimated ‖PFP‖.
        recoveries: Displacements recovered to see how right they are, each for one more solve
            in every subdomain.
        friction_iterations: Problems with given bounds that were solved for Coulomb's friction.
        friction_newton_steps: Steps of Newton's method on Coulomb's law, beside these problems.
        friction_last: Multiplications by F of the last of these problems.
        newton_steps: Steps of Newton's method of a nonlinear problem, each a linearised problem.
        outer_iterations: Outer iterations.
        newton_faces: Faces that block Newton has solved on.
        cg_steps: Conjugate gradient steps.
        expansion_steps: Expansion steps.
        proportioning_steps: Proportioning steps.
        factorizations: Factorisations of subdomain matrices.
        local_operators: Of ``F`` and ``preconditioner``: how many subdomains apply theirs in each
            form, ``bytes`` that one multiplication moves on all ranks by the model, and its
            seconds, ``predicted`` by the model and ``measured`` (largest over ranks).
        coarse_factorizations: Factorisations of GGᵀ.
        face_factorizations: Factorisations of G_f G_fᵀ, f a face of the rows.
        soft_factorizations: Factorisations of the coarse problem of soft motions, or of whole
            clusters, one for a face.
        assemblies: Times that the stiffness was assembled.
        searches: Times that it was searched who meets whom.
        gluings: Times that rows of B were made.
        reused: Stages that this solve took over from the one before, see ``stages``.
        converged_reason: Name of the ConvergedReason; NO_SOLUTION where there is none,
            NOT_SOLVED before a solve and where one ended in another error.
        peak_memory_mb: Peak resident memory, summed over ranks.
        seconds: Wall seconds of each stage (largest over ranks), and ``total``.
        residuals: ``projected_gradient`` and ``equilibrium`` relative to b₀;
            ``displacement_error``, the estimated error of u in the maximum norm relative to the
            displacement of the body where it is worst; ``energy_error``, that in energy relative
            to ‖u‖_K; in physical units ``gluing_jump`` and
            ``penetration`` (lengths), ``tension`` (most negative pressure), ``complementarity``
            (largest force times gap), ``balance`` (force left on a kernel mode where
            it is largest beside the forces there); ``friction``, the last change of the bounds of
            Coulomb's friction over their size.
        tolerances: What they were at most allowed to be, all but the first two.
        motion: Of bodies with mass the energies at the end of the step and what was done in it,
            see ``ContactDynamics``.
        contact_forces: Of bodies with mass the mean force of the step on the surface of each
            contact, of a pair on the secondary one, a vector.
        in_all: Solves, counters and ``seconds`` of all solves together.
        estimates: What ``ContactProblem.estimate`` has found since, and what it took; see
            ``Estimates``.
        errors: Relative errors against closed forms, filled by demos.
    """

    primal_dofs: int = 0
    dual_dofs: int = 0
    subdomains: int = 0
    bodies: int = 0
    split_subdomains: int = 0
    clusters: int = 0
    kernel_dim: int = 0
    soft_modes: int = 0
    free_modes: int = 0
    nearly_free: list[dict[str, object]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    contact_rows: int = 0
    contact_candidates: int = 0
    far_contact_nodes: int = 0
    late_contact_rows: int = _counter()
    unmet_contacts: list[str] = field(default_factory=list)
    excluding_contacts: list[str] = field(default_factory=list)
    dropped_contact_rows: int = 0
    active_contacts: int = 0
    tangential_rows: int = 0
    sticking: int = 0
    sliding: int = 0
    F_multiplications: int = _counter()
    preconditioner_multiplications: int = _counter()
    recycled_directions: int = 0
    power_method_multiplications: int = _counter()
    recoveries: int = _counter()
    friction_iterations: int = _counter()
    friction_newton_steps: int = _counter()
    friction_last: int = 0
    newton_steps: int = 0
    outer_iterations: int = _counter()
    newton_faces: int = _counter()
    cg_steps: int = _counter()
    expansion_steps: int = _counter()
    proportioning_steps: int = _counter()
    factorizations: int = _counter()
    local_operators: dict[str, float] = field(default_factory=dict)
    coarse_factorizations: int = _counter()
    face_factorizations: int = _counter()
    soft_factorizations: int = _counter()
    assemblies: int = _counter()
    searches: int = _counter()
    gluings: int = _counter()
    reused: list[str] = field(default_factory=list)
    converged_reason: str = "NOT_SOLVED"
    peak_memory_mb: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    residuals: dict[str, float] = field(default_factory=dict)
    tolerances: dict[str, float] = field(default_factory=dict)
    estimates: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    motion: dict[str, float] = field(default_factory=dict)
    contact_forces: list[list[float]] = field(default_factory=list)
    in_all: dict[str, float] = field(default_factory=dict)

    def begin(self) -> None:
        """Reset all figures but the sums over solves, so that none stays after an error."""
        seconds = {} if self.in_all else self.seconds
        fresh = Report(seconds=seconds, in_all=self.in_all)
        for f in fields(self):
            setattr(self, f.name, getattr(fresh, f.name))

    def end(self) -> None:
        """Add the counters and seconds of a solve, whatever its end was, to ``in_all``."""
        self.seconds["total"] = sum(v for k, v in self.seconds.items() if k != "total")
        added = {f.name: getattr(self, f.name) for f in fields(self) if f.metadata.get("adds")}
        for name, value in {"solves": 1, **added, "seconds": self.seconds["total"]}.items():
            self.in_all[name] = self.in_all.get(name, 0) + value

    def __str__(self) -> str:
        lines = []
        for name, value in asdict(self).items():
            if isinstance(value, dict) and value:
                lines += [f"{name}.{key:<22} {item:.6g}" for key, item in value.items()]
            elif isinstance(value, list) and value:
                lines += [f"{name:<31} {_item(item)}" for item in value[:PRINTED]]
                lines += [f"{name:<31} {len(value)} in all"]
            else:
                lines.append(f"{name:<31} {'-' if value in ({}, []) else value}")
        return "\n".join(lines)

    def to_json(self) -> str:
        """Return the report as JSON."""
        return json.dumps(asdict(self), indent=2)

    def write(self, path: str | Path, comm: MPI.Intracomm) -> None:
        """Write the report as a JSON file; it appears whole. Collective.

        Raises:
            InputError: The file cannot be written.
        """
        with raised_on_all_ranks(comm), named(f"cannot write {path}", OSError):
            if comm.rank == 0:
                _write_whole(Path(path), self.to_json() + "\n")


def _write_whole(target: Path, text: str) -> None:
    """Write a file aside and give it its name when it is whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.partial")
    partial.write_text(text)
    try:
        os.replace(partial, target)
    except OSError:
        partial.unlink()
        raise


def _item(item: str | list[float] | dict[str, Any]) -> str:
    """Return a contact, a force, or a motion that is nearly free, as text."""
    if isinstance(item, str):
        return item
    if isinstance(item, list):
        return " ".join(f"{value:.6g}" for value in item)
    return f"{', '.join(item['bodies'])}: {item['mode']}, stiffness {item['stiffness']:.2g}"


def peak_memory_mb(comm: MPI.Intracomm) -> float:
    """Peak resident memory of all ranks in megabytes. Collective."""
    return float(comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0))


# --- Filling of the report --------------------------------------------------------------------


def fill_sizes(
    report: Report, dofs: TornDofs, decomposition: Decomposition, gluing: Gluing, inside: int
) -> None:
    """Fill in the sizes that are known before the dual problem. Collective.

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
    settling: FixedPointStatus,
) -> None:
    """Fill in the results of a solve; counters add up over rounds. Collective."""
    comm = dual.coarse.comm
    report.clusters = dual.subdomains.num_clusters
    report.kernel_dim = dual.coarse.dimension
    report.free_modes = dual.coarse.num_free_motions
    if accuracy.recovered is not None:
        report.nearly_free = dual.nearly_free(accuracy.recovered.active)
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
        "penetration": allowed.jump,
        "tension": 0.0,
        "complementarity": _largest(dual, solution.force) * allowed.jump,
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
