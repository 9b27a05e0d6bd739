"""The report of a solve, composed of the records that its stages return."""

from __future__ import annotations

import json
import resource
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from textwrap import TextWrapper
from typing import Any, Self

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import quotient, sum_rows
from tfeti_dolfinx.common.files import written_whole
from tfeti_dolfinx.common.parallel import largest, maxima, summed
from tfeti_dolfinx.common.validation import named
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.contact.partner import position_of
from tfeti_dolfinx.contact.records import ContactStatus
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.stopping import Accuracy
from tfeti_dolfinx.qp.problem import QPResult
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.solve.coulomb import FixedPointStatus

# --- Records of stages ------------------------------------------------------------------------


@dataclass
class Sizes:
    """Sizes of a problem, known before it is solved."""

    ranks: int = 0
    primal_dofs: int = 0  # of the torn mesh; with boundary elements those on their surface
    dual_dofs: int = 0  # rows of B
    subdomains: int = 0
    bodies: int = 0
    split_subdomains: int = 0  # that were not connected and were split
    contact_rows: int = 0  # of non-penetration
    contact_candidates: int = 0  # nodes of the (secondary) contact surfaces
    far_contact_nodes: int = 0  # those that were out of reach or not covered, and have no row
    unmet_contacts: list[str] = field(default_factory=list)  # none of whose nodes has a row
    dropped_contact_rows: int = 0  # that prescribed components decide alone
    tangential_rows: int = 0  # of contacts that have friction

    @classmethod
    def of_rows(cls, gluing: Gluing, inside: int, unmet: list[str]) -> Self:
        """Count rows and unknowns, ``inside`` of which boundary elements do without. Collective."""
        dofs, constraints, records = gluing.dofs, gluing.constraints, gluing.records
        comm, decomposition = dofs.comm, dofs.decomposition
        own = {
            "dual_dofs": constraints.num_rows,
            "contact_rows": len(constraints.sets.normals),
            "contact_candidates": records.candidates,
            "far_contact_nodes": records.candidates - int(np.sum(records.within_reach)),
            "dropped_contact_rows": len(constraints.contact.decided),
            "tangential_rows": constraints.sets.tangents.size,
        }
        total = summed(comm, np.array(list(own.values())))
        return cls(
            ranks=comm.size,
            primal_dofs=int(dofs.offsets[-1]) * dofs.bs - inside,
            subdomains=decomposition.num_subdomains,
            bodies=decomposition.num_bodies,
            split_subdomains=len(decomposition.split),
            unmet_contacts=unmet,
            **dict(zip(own, map(int, total), strict=True)),
        )


@dataclass
class StageCounts:
    """Counts of what was made anew for a solve."""

    factorizations: int = 0  # of subdomain matrices
    coarse_factorizations: int = 0  # of GGᵀ
    assemblies: int = 0  # of the stiffness
    searches: int = 0  # of who meets whom
    gluings: int = 0  # times that rows of B were made
    reused: list[str] = field(default_factory=list)  # stages taken over from the solve before


@dataclass
class SolverCounts:
    """Counts of a solver, which add up over linearised problems, and more and more rows."""

    late_contact_rows: int = 0  # of nodes out of reach that overlapped after a solve
    F_multiplications: int = 0  # all but the power method's
    preconditioner_multiplications: int = 0
    power_method_multiplications: int = 0  # that estimated ‖PFP‖
    recoveries: int = 0  # displacements recovered to see how right they are, each one more solve
    friction_iterations: int = 0  # problems with given bounds of Coulomb's friction
    friction_newton_steps: int = 0  # of Newton's method on Coulomb's law, beside these problems
    outer_iterations: int = 0
    newton_faces: int = 0  # that block Newton has solved on
    cg_steps: int = 0
    expansion_steps: int = 0
    proportioning_steps: int = 0
    face_factorizations: int = 0  # of G_f G_fᵀ, f a face of the rows
    soft_factorizations: int = 0  # of motions of whole clusters, one for a face
    newton_steps: int = 0  # of a nonlinear problem, each a linearised problem

    @classmethod
    def of_run(cls, dual: Dual, result: QPResult, friction: FixedPointStatus) -> Self:
        """Return the counts of a solver's run."""
        preconditioner, inner, steps = dual.preconditioner, dual.deflation, result.steps
        return cls(
            F_multiplications=dual.F.count,
            preconditioner_multiplications=(0 if preconditioner is None else preconditioner.count),
            power_method_multiplications=dual.norm_count,
            recoveries=friction.looks,
            friction_iterations=friction.iterations,
            friction_newton_steps=friction.newton_steps,
            outer_iterations=steps.outer,
            newton_faces=steps.faces,
            cg_steps=steps.cg,
            expansion_steps=steps.expansion,
            proportioning_steps=steps.proportioning,
            face_factorizations=dual.coarse.factors.count,
            soft_factorizations=0 if inner is None else inner.factors.count,
        )


@dataclass
class ContactSummary:
    """A contact at a solution, in one line; the same on all ranks.

    Attributes:
        name: Its name.
        surface: The surface that has its nodes, of a pair the secondary one.
        nodes: Nodes of that surface that have a condition.
        touching: Those that touch; ``sticking`` and ``sliding`` are those of them with friction.
        sticking: Nodes that stick.
        sliding: Nodes that slip.
        resultant: Force on it, friction included, ``gdim`` components.
        pressure: The largest of nodes of which the other side covers 2 % or more, if one touches.
        gap: The smallest, negative for an overlap.
    """

    name: str
    surface: str
    nodes: int
    touching: int
    sticking: int
    sliding: int
    resultant: list[float]
    pressure: float
    gap: float

    @classmethod
    def of_solution(cls, solution: Solution) -> list[Self]:
        """Sum up all contacts of a solution. Collective."""
        comm, of = solution.dofs.comm, solution.gluing.records.contact
        count = len(solution.contacts)
        if count == 0:
            return []
        status = solution.status_of_conditions
        kinds = [status == kind for kind in (ContactStatus.STICK, ContactStatus.SLIP)]
        flags = [np.ones(len(of)), status != ContactStatus.OPEN, *kinds]
        own = np.column_stack((*flags, solution.condition_forces))
        sums = summed(comm, sum_rows(of, own, count))
        counts, forces = sums[:, :4].T.astype(int).tolist(), sums[:, 4:].tolist()
        overlap = np.full(count, -np.inf)
        np.maximum.at(overlap, of, -solution.remaining_gap)
        overlap = maxima(comm, overlap)
        gaps = np.where(np.isfinite(overlap), 0.0 - overlap, 0.0)  # of no node; never −0
        pressure, others = solution.largest_pressures
        pressure = np.where(pressure > 0.0, pressure, others)
        names = zip(*((c.name, c.surfaces[0]) for c in solution.contacts), strict=True)
        columns: list[Any] = [*names, *counts, forces, pressure.tolist(), gaps.tolist()]
        return [cls(*row) for row in zip(*columns, strict=True)]

    def __str__(self) -> str:
        force = ", ".join(f"{value:.3g}" for value in self.resultant)
        line = (
            f"{self.name}: {self.touching} of {self.nodes} nodes touch, force ({force}) "
            f"on {self.surface!r}, pressure up to {self.pressure:.3g}, smallest gap {self.gap:.2g}"
        )
        rubs = self.sticking + self.sliding
        return f"{line}, {self.sticking} stick, {self.sliding} slip" if rubs else line


@dataclass
class Outcome:
    """The end of a solver's last run, and diagnostics of its answer; see docs/report.md."""

    solver: str = ""  # options qp_type and pc_type
    contacts: list[ContactSummary] = field(default_factory=list)
    clusters: int = 0  # of subdomains that averages glue
    kernel_dim: int = 0  # of K
    soft_modes: int = 0  # motions that springs hold softly, or all of clusters
    free_modes: int = 0  # rigid motions that nothing resists and the load does not drive
    # rigid motions that contacts with a force hold hardly or not (0): bodies, mode, stiffness
    nearly_free: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)  # why the answer cannot be trusted
    notes: list[str] = field(default_factory=list)  # what is worth knowing, and needs no change
    excluding_contacts: list[str] = field(default_factory=list)  # that exclude each other, or slip
    active_contacts: int = 0  # rows with a positive force
    sticking: int = 0  # nodes with friction that touch and stick
    sliding: int = 0  # those that slip
    recycled_directions: int = 0  # that the next solve begins with
    # of F and preconditioner: subdomains in each form, seconds of a multiplication
    local_operators: dict[str, float] = field(default_factory=dict)
    converged_reason: str = "NOT_SOLVED"  # a ConvergedReason, or NO_SOLUTION
    peak_memory_mb: float = 0.0  # summed over ranks
    residuals: dict[str, float] = field(default_factory=dict)
    tolerances: dict[str, float] = field(default_factory=dict)  # what they may be at most
    estimates: dict[str, float] = field(default_factory=dict)  # see ``Estimates``
    tools: list[str] = field(default_factory=list)  # motion and forces of each rigid body

    @classmethod
    def of_answer(
        cls,
        solution: Solution,
        dual: Dual,
        result: QPResult,
        accuracy: Accuracy,
        friction: FixedPointStatus,
        excluding: list[str],
        nearly_free: list[dict[str, Any]],
    ) -> Self:
        """Measure an answer, warnings apart. Collective."""
        active = np.sum(solution.carrying[solution.gluing.constraints.sets.normals])
        own = np.array([active, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss])
        active, kilobytes = map(int, summed(dual.coarse.comm, own))
        contacts = ContactSummary.of_solution(solution)
        return cls(
            contacts=contacts,
            clusters=dual.subdomains.num_clusters,
            kernel_dim=dual.coarse.dimension,
            soft_modes=(dual.deflation.count if dual.deflation else dual.subdomains.num_springs),
            free_modes=dual.coarse.free_motions.count,
            nearly_free=nearly_free,
            excluding_contacts=excluding,
            active_contacts=active,
            sticking=sum(contact.sticking for contact in contacts),
            sliding=sum(contact.sliding for contact in contacts),
            recycled_directions=0 if dual.recycled is None else dual.recycled.count,
            local_operators=_local_operators(dual),
            converged_reason=result.reason.name,
            peak_memory_mb=kilobytes / 1024.0,
            residuals=_residuals(solution, dual, result, accuracy) | {"friction": friction.change},
            tolerances=_tolerances(solution, accuracy) | {"friction": friction.tolerance},
            estimates=accuracy.estimates,
            tools=[str(solution.tool(i)) for i in range(len(solution.tool_motions))],
        )


# --- The report -------------------------------------------------------------------------------

PRINTED = 10  # of a list, and lines but for those of contacts; all of it is in the file
WIDTH = 100  # of the printed lines, but for those of contacts: each has one
STAGES = 4  # whose seconds are printed, the longest
SHOWN = ("penetration", "balance")  # residuals of the short report, after the rule's first
# what adds up over solves, in ``in_all``
COUNTERS = [f.name for kind in (SolverCounts, StageCounts) for f in fields(kind) if f.default == 0]


@dataclass
class Report(Outcome, SolverCounts, StageCounts, Sizes):
    """Sizes, counters, residuals and times of a solve; the same on all ranks.

    Counters and seconds are those of the last solve; the first has what was before it, too. The
    fields of its bases are its own; docs/report.md says what each means.
    """

    seconds: dict[str, float] = field(default_factory=dict)  # of each stage, and ``total``
    motion: dict[str, float] = field(default_factory=dict)  # of bodies with mass: energies, work
    contact_forces: list[list[float]] = field(default_factory=list)  # of bodies with mass: means
    in_all: dict[str, float] = field(default_factory=dict)  # solves, counters, seconds of all
    errors: dict[str, float] = field(default_factory=dict)  # against closed forms, by demos

    @classmethod
    def composed(
        cls,
        records: tuple[Sizes, StageCounts, SolverCounts, Outcome],
        own_seconds: Mapping[str, float],
        before: Mapping[str, float],
        comm: MPI.Intracomm,
    ) -> Report:
        """Compose the report of a solve; ``before`` is ``in_all`` of the solves before it.

        The seconds of a stage are those of the slowest rank. Collective.
        """
        known = {name: value for record in records for name, value in vars(record).items()}
        of_ranks = comm.allgather(dict(own_seconds))
        stages = dict.fromkeys(name for seconds in of_ranks for name in seconds)
        seconds = {name: max(own.get(name, 0.0) for own in of_ranks) for name in stages}
        total = sum(seconds.values())
        own = {"solves": 1, **{name: known[name] for name in COUNTERS}, "seconds": total}
        return cls(**known, seconds={**seconds, "total": total}, in_all=added(before, own))

    def contact(self, which: int | str = 0) -> ContactSummary:
        """Return the entry of a contact, given its name or its position."""
        return self.contacts[position_of([contact.name for contact in self.contacts], which)]

    @property
    def counters(self) -> dict[str, int]:
        """The counters, by name."""
        return {name: getattr(self, name) for name in COUNTERS}

    @property
    def sizes(self) -> dict[str, Any]:
        """The sizes, by name."""
        return {of.name: getattr(self, of.name) for of in fields(Sizes)}

    def __str__(self) -> str:
        numbers = (self.primal_dofs, self.bodies, self.subdomains, self.ranks)
        sizes = zip(numbers, ("unknowns", "bodies", "subdomains", "ranks"), strict=True)
        work = (
            (self.F_multiplications, "iterations"),
            (self.preconditioner_multiplications, "preconditioned"),
            (self.newton_faces, "active sets"),
            (0 if self.newton_faces else self.outer_iterations, "outer steps"),
            (0 if self.newton_faces else self.cg_steps, "CG steps"),
            (self.friction_newton_steps, "steps on Coulomb's law"),
            (self.newton_steps, "Newton steps"),
        )
        solves, total = self.in_all.get("solves", 0), self.seconds.get("total", 0.0)
        most = sorted(self.seconds.items(), key=lambda item: -item[1])
        stages = [f"{name} {s:.2g}" for name, s in most if name != "total" and s >= 0.005]
        seconds = f": {', '.join(stages[:STAGES])}" * bool(stages)
        accuracy = [
            f"{name.replace('_', ' ')} {self.residuals[name]:.1e}"
            + f" (allowed {self.tolerances.get(name, 0.0):.1e})" * bool(self.tolerances.get(name))
            for name in dict.fromkeys([*list(self.tolerances)[:1], *SHOWN])
            if name in self.residuals
        ]
        rest, warned = len(self.contacts) - PRINTED, len(self.warnings)
        contacts = [f"  contact   {contact}" for contact in self.contacts[:PRINTED]]
        contacts += [f"  contacts  and {rest} contacts more, see details()"] * (rest > 0)
        # a tool's force is on its contacts' lines
        moved = [t.partition(", force")[0].replace(": displacement", "", 1) for t in self.tools]
        rows = [
            ("model", _counted(sizes), 1),
            ("tools", f"moved: {'; '.join(moved)}" * bool(moved), 1),
            ("accuracy", ", ".join(accuracy), 2),
            ("solver", f"{self.solver}: {_counted(work)}", 2),
            ("time", f"{total:.3g} s{seconds}; {self.peak_memory_mb:.0f} MB", 1),
            ("warnings", f"{warned} logged; report.warnings has the text" * bool(warned), 1),
        ]
        model, *lines = [line for row in rows for line in _wrapped(*row)]
        head = f"tfeti_dolfinx: {self.converged_reason}" + f", solve {solves}" * (solves > 1)
        lines += _wrapped("notes", "; ".join(self.notes), PRINTED - 2 - len(lines))
        return "\n".join([head, model, *contacts, *lines])

    def details(self) -> str:
        """Return all fields as text, one in a line."""
        lines = []
        for name, value in asdict(self).items():
            if isinstance(value, dict):
                items = [(f"{name}.{key}", f"{item:.6g}") for key, item in value.items()]
            elif isinstance(value, list):
                items = [(name, _item(item)) for item in value[:PRINTED]]
                items += [(name, f"{len(value)} in all")] * bool(value)
            else:
                items = [(name, f"{value:.6g}" if isinstance(value, float) else str(value))]
            lines += [f"{key:<40} {text}" for key, text in items or [(name, "-")]]
        return "\n".join(lines)

    def write(self, path: str | Path, comm: MPI.Intracomm) -> None:
        """Write the report as a JSON file; it appears whole. Collective.

        Raises:
            InputError: The file cannot be written.
        """
        with raised_on_all_ranks(comm), named(f"cannot write {path}", OSError):
            if comm.rank == 0:
                with written_whole(Path(path)) as partial:
                    partial.write_text(json.dumps(asdict(self), indent=2) + "\n")


def _counted(numbers: Iterable[tuple[int, str]]) -> str:
    """Return numbers with what they count, in the plural; of those that are 0 the first alone."""
    one = {"bodies": "body"}
    return ", ".join(
        f"{number} {one.get(name, name.removesuffix('s')) if number == 1 else name}"
        for i, (number, name) in enumerate(numbers)
        if number or i == 0
    )


def _wrapped(name: str, text: str, most: int) -> list[str]:
    """Return the printed lines of a row, none of no text, at most so many."""
    wrapper = TextWrapper(WIDTH, f"  {name:<9} ", " " * 12, break_on_hyphens=False)
    wrapper.max_lines, wrapper.placeholder = most, " … see details()"
    return wrapper.wrap(text)


def _item(item: str | list[float] | dict[str, Any]) -> str:
    """Return a contact, a force, or a motion that is nearly free, as text."""
    if isinstance(item, str):
        return item
    if isinstance(item, list):
        return " ".join(f"{value:.6g}" for value in item)
    if "touching" in item:
        return str(ContactSummary(**item))
    return f"{', '.join(item['bodies'])}: {item['mode']}, stiffness {item['stiffness']:.2g}"


# --- Residuals and costs ----------------------------------------------------------------------


def added(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sums of numbers by name."""
    return {name: one.get(name, 0) + other.get(name, 0) for name in {**one, **other}}


def _local_operators(dual: Dual) -> dict[str, float]:
    """Forms of the local operators, and what they cost."""
    found, means = Counter[str](), dict[str, float]()
    for name, operator in (("F", dual.F), ("preconditioner", dual.preconditioner)):
        if operator is None or (own := getattr(operator.local, "forms", None)) is None:
            continue
        found.update({f"{name}_{form}": count for form, count in own.items()})
        means[f"{name}_measured"] = operator.seconds / max(operator.times, 1)
    comm = dual.coarse.comm
    seconds = maxima(comm, np.array(list(means.values())))
    forms = {name: float(count) for name, count in sorted(comm.allreduce(found).items())}
    return forms | dict(zip(means, map(float, seconds), strict=True))


def _residuals(
    solution: Solution, dual: Dual, result: QPResult, accuracy: Accuracy
) -> dict[str, float]:
    comm, gap, constraints = solution.dofs.comm, solution.remaining_gap, solution.gluing.constraints
    reference = result.reference or 1.0
    checks = Accuracy.criteria(accuracy) | accuracy.checks  # of errors that are not checked, too
    # of a set of one's own, as of glue that lets go, a force may pull, across a gap too
    missing = dual.feasible.project(solution.lam) - solution.lam
    missing = constraints.scale * missing[constraints.sets.normals]
    tension = quotient(missing, solution.area[constraints.contact.normals])
    closed = solution.status_of_conditions != ContactStatus.OPEN
    # how far copies of a node are apart, and from prescribed values
    dofs, prescribed = solution.dofs, solution.gluing.prescribed
    u = solution.u.reshape(-1, dofs.bs)
    low, high = dofs.reduce(u, np.minimum), dofs.reduce(u, np.maximum)
    at, value = prescribed.flag, prescribed.value
    jumps = np.where(at, np.maximum(high, value), high) - np.where(at, np.minimum(low, value), low)
    return {
        "projected_gradient": result.projected_gradient / reference,
        "equilibrium": result.norm * result.equality / reference,
        **{name: check.relative()[0] for name, check in checks.items()},
        "gluing_jump": largest(comm, jumps),
        "penetration": largest(comm, np.minimum(gap, 0.0)),
        "tension": largest(comm, np.maximum(tension, 0.0)),
        "complementarity": largest(comm, (solution.force * gap)[closed]),
    }


def _tolerances(solution: Solution, accuracy: Accuracy) -> dict[str, float]:
    allowed = {name: check.relative()[1] for name, check in accuracy.checks.items()}
    if (jump := allowed.get("penetration")) is not None:
        force = largest(solution.dofs.comm, np.maximum(solution.force, 0.0))
        allowed |= {"gluing_jump": jump, "complementarity": force * jump}
    return allowed | {"tension": 0.0}
