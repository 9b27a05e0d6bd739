"""Series of load steps, halved where needed, with files and checkpoints."""

from __future__ import annotations

import csv
import inspect
import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, pairwise, zip_longest
from typing import Any

import dolfinx
import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.agreement import agreeing, check_same_problem
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.files import checked_path, written_whole
from tfeti_dolfinx.common.parallel import summed
from tfeti_dolfinx.common.validation import (
    checked_callable,
    checked_flag,
    checked_number,
    checked_type,
    is_whole,
    named,
    shown,
)
from tfeti_dolfinx.errors import ConvergenceError, InputError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.io.output import POINTS, Series, changing_fields, checked_target, fields_of
from tfeti_dolfinx.problem import ContactProblem
from tfeti_dolfinx.saved_state import Table, arranged, as_rows, labels_of_dofs, same_labels
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.steps.checkpoint import Checkpoint

# --- Place in a series of halved steps --------------------------------------------------------

# shares of a step are exact in a double, and parts of any real step differ
MOST_HALVINGS = 30


@dataclass(frozen=True)
class Place:
    """Before a part of a step."""

    number: int = 0  # the step
    done: float = 0.0  # share of it that is done, a multiple of 2^-level
    level: int = 0  # how often it is halved now

    def ahead(self) -> Place:
        """After a part that has converged: the next is as long as its place allows."""
        done, level = self.done + 0.5**self.level, self.level
        if done == 1.0:
            return Place(self.number + 1)
        while (done * 2 ** (level - 1)).is_integer():
            level -= 1
        return Place(self.number, done, level)

    def part(self, times: Sequence[float]) -> tuple[float, float]:
        """Return begin and end of the part; ``times`` starts with the begin of the first step."""
        begin, end = times[self.number], times[self.number + 1]
        after = self.done + 0.5**self.level
        last = end if after == 1.0 else begin + after * (end - begin)
        return begin + self.done * (end - begin), last


def checked_times(begin: float, times: Sequence[float]) -> list[float]:
    """Return the begin and all times; raise an InputError unless these are increasing numbers."""
    if isinstance(times, (str, bytes)) or not np.iterable(times):
        raise InputError(f"times is {shown(times)}; expected a list of increasing numbers")
    first = checked_number(begin, "begin")
    found = [first, *(checked_number(t, f"times[{i}]") for i, t in enumerate(times))]
    if len(found) < 2:
        raise InputError("times is empty; expected at least one time")
    for i, (before, after) in enumerate(pairwise(found)):
        if not before < after or not math.isfinite(after - before):
            raise InputError(
                f"times[{i}]={after:g} is not after {before:g}; expected increasing times "
                "after begin"
            )
    return found


# --- Progress bar -----------------------------------------------------------------------------

log = logging.getLogger(__name__)

# called with the share of the series that is done and a few words
Show = Callable[[float, str], None]


@contextmanager
def shown_progress(comm: MPI.Intracomm, wanted: bool | None) -> Iterator[Show]:
    """Return a function that shows the progress of a series, on rank 0 only. Not collective.

    Where nothing is wanted or refused: if standard error is a terminal, and rich is there.
    """
    if comm.rank != 0 or wanted is False or (wanted is None and not sys.stderr.isatty()):
        yield lambda share, text: None
        return
    try:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    except ImportError:  # it is optional
        said = "load steps {:3.0f} %: {}".format
        yield lambda share, text: wanted and print(said(100 * share, text), file=sys.stderr)
        return
    said = TextColumn("{task.fields[said]}")
    columns = (TextColumn("load steps"), BarColumn(), TimeElapsedColumn(), said)
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0, said="")
        yield lambda share, text: bar.update(task, completed=share, said=text, refresh=True)


# --- Fields of a step in a checkpoint ----------------------------------------------------------


def labels_of_fields(solution: Solution, interior: bool) -> dict[str, Array]:
    """Return the labels of the unknowns of ``fields_of``, and of the points. Collective."""
    d, labels = solution.decomposition, dict[str, Array]()
    for f in chain(*changing_fields(solution, interior)):
        dofmap = f.function_space.dofmap
        labels[f.name] = labels_of_dofs(np.asarray(dofmap.list), len(f.x.array) // dofmap.bs, d)
    labels[POINTS] = labels_of_dofs(geometry_dofmap(d.mesh), len(d.mesh.geometry.x), d)
    return labels


def in_order(table: Table, labels: dict[str, Array]) -> dict[str, Array]:
    """Return fields as ``fields_of`` does, from a table whose rows have labels."""
    found = {}
    for name, (values, kept) in table.items():
        here = labels.get(name, kept)
        if kept is None or here is None or not same_labels(kept, here):
            raise InputError(
                f"the checkpoint has other unknowns of the field {name} than the problem; expected "
                "the spaces and the mesh that it was written with"
            )
        found[name] = arranged(values, kept, here)
    return found


# --- The series of load steps -----------------------------------------------------------------

Apply = Callable[[ContactProblem, float], None]


@dataclass(frozen=True)
class StepRecord:
    """Record of a converged step; the same on all ranks.

    Attributes:
        number: Position in the times of the step that this is, or is a part of.
        time: Its end.
        size: Its length.
        dissipation: What friction has dissipated in it, all contacts together.
        figures: Sizes, counters and the reason from the report.
        residuals: Those of the report.
        seconds: Wall seconds.
        motion: Energies and work, from the report, of bodies with mass.
        contact_forces: Resultant of the forces on each contact's surface, of a pair the secondary
            one; of bodies with mass their mean over the step.
        tools: Motion and forces of rigid bodies, as the columns of ``LoadSteps.write_csv``.
    """

    number: int
    time: float
    size: float
    dissipation: float
    figures: dict[str, Any]
    residuals: dict[str, float]
    seconds: float
    motion: dict[str, float] = field(default_factory=dict)
    contact_forces: list[list[float]] = field(default_factory=list)
    tools: dict[str, float] = field(default_factory=dict)


class LoadSteps:
    """A series of load steps of one problem. Creation and ``run`` are collective.

    Each step starts from the one before, makes again only what depends on its changes, and is
    accepted when it has converged: friction acts on the slip since then. One that does not
    converge is halved: it begins again at the last accepted step with half the way.

    Args:
        problem: The problem.
        apply: Called as ``apply(problem, t)`` before each solve, on all ranks: sets constants,
            functions, values, points, or calls ``problem.update``. What it sets may depend on t
            alone, not on what was set before: steps are halved, and a series goes on in a new run.
        times: Ends of the steps, increasing.
        begin: Where the first step begins.
        path: File for ParaView with all steps, ``.bp``, or ``.pvd`` as ``write_pvd``; None: none.
            It has its name when the series has ended, also by an error of this package, unless
            that is its own, as on a full disk; before that it is
            ``.<name>.partial`` in the same folder.
        interior: Whether the file has the fields of ``solution.interior``, too, as ``write_vtx``.
        checkpoint: Folder for the last converged step, with nothing else in it; None: none.
        max_halvings: How often a step may be halved.
        progress: Whether rank 0 shows a bar; default where its standard error is a terminal.

    Attributes:
        records: A ``StepRecord`` for each converged step so far.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    def __init__(
        self,
        problem: ContactProblem,
        apply: Apply,
        times: Sequence[float],
        *,
        begin: float = 0.0,
        path: str | os.PathLike[str] | None = None,
        interior: bool = False,
        checkpoint: str | os.PathLike[str] | None = None,
        max_halvings: int = 5,
        progress: bool | None = None,
    ) -> None:
        checked_type(problem, ContactProblem, "problem", "a tfeti_dolfinx.ContactProblem")
        self._comm = problem.decomposition.comm
        with agreeing(self._comm, "LoadSteps") as given:
            expected = "a function of the problem and a time"
            checked_callable(apply, "apply", expected)
            with named(f"apply: expected {expected}"):
                inspect.signature(apply).bind(problem, begin)
            if not is_whole(max_halvings) or not 0 <= max_halvings <= MOST_HALVINGS:
                raise InputError(
                    f"max_halvings={shown(max_halvings)}: expected an integer, 0 to {MOST_HALVINGS}"
                )
            self._times = checked_times(begin, times)
            self._path = None if path is None else checked_path(path, ".bp", ".pvd")
            if str(path).endswith(".bp") and not dolfinx.has_adios2:
                raise InputError(f"{path}: this DOLFINx has no ADIOS2; expected a name with .pvd")
            self._interior = checked_flag(interior, "interior")
            if self._interior and path is None:
                raise InputError("interior=True: expected LoadSteps(..., path=) too")
            given |= {"begin": self._times[0], "times": self._times[1:], "path": path}
            given |= {"interior": interior, "checkpoint": checkpoint, "max_halvings": max_halvings}
        self._checkpoint = (
            None
            if checkpoint is None
            else Checkpoint(checkpoint, self._comm, problem.decomposition.subdomains)
        )
        self._problem, self._apply = problem, apply
        self._max_halvings, self._progress = int(max_halvings), progress
        self._series: Series | None = None
        self.records: list[StepRecord] = []

    def run(self, resume: bool = False) -> list[StepRecord]:
        """Solve all steps.

        Args:
            resume: Go on after the last step of the checkpoint, if there is one: in a new run of
                the same program, on any number of ranks. Times that were not reached yet may be
                others, reached ones may differ by 1e-6 of the shortest step.

        Returns:
            The records, with those of earlier runs.

        Raises:
            InputError: As ``ContactProblem.solve``, or the checkpoint is of another series or
                damaged, or a file cannot be written.
            NoSolutionError: A step has no solution; a note of the error has its time.
            ConvergenceError: A step did not converge, halved as often as allowed.
        """
        with agreeing(self._comm, "LoadSteps.run") as given:
            given["resume"] = bool(resume)
            if resume and self._checkpoint is None:
                raise InputError("resume=True: expected LoadSteps(..., checkpoint=) too")
        self._close(drop=True)  # a file that an interrupt has ended
        with nullcontext() if self._checkpoint is None else self._checkpoint.locked():
            place = self._begin(resume)
            try:
                with shown_progress(self._comm, self._progress) as show:
                    self._steps(place, show)
            except Exception as error:  # on all ranks, of `apply` too; steps before it are whole
                try:
                    self._close()
                except TfetiError as another:
                    error.add_note(str(another))
                raise
        self._close()
        return self.records

    def write_csv(self, path: str | os.PathLike[str]) -> None:
        """Write a table of the steps so far, a line a step, by rank 0. Collective.

        Columns: time, the force on each contact by name and axis, motion and forces of each rigid
        body, ``report.motion`` of bodies with mass, what friction dissipates, iterations, seconds.

        Args:
            path: File, ending in ``.csv``; one that is there is replaced.

        Raises:
            InputError: The path does not fit, or the file cannot be written.
        """
        with agreeing(self._comm, "LoadSteps.write_csv") as given:
            given["path"] = path
            target = checked_path(path, ".csv")
        axes = "xyz"[: self._problem.dofs.bs]
        names = [contact.name for contact in self._problem.contacts]
        with raised_on_all_ranks(self._comm), named(f"cannot write {target}", OSError):
            if self._comm.rank == 0:
                forces = [f"{name} {axis}" for name in names for axis in axes]
                others = [{**r.tools, **r.motion} for r in self.records]
                known = list(others[0]) if others else []
                last = ["dissipation", "iterations", "seconds"]
                table: list[list[Any]] = [["time", *forces, *known, *last]]
                for r, other in zip(self.records, others, strict=True):
                    values = [*chain(*r.contact_forces), *(other[name] for name in known)]
                    count = r.figures["F_multiplications"]
                    table.append([r.time, *values, r.dissipation, count, r.seconds])
                with (
                    written_whole(target) as partial,
                    partial.open("w", newline="", encoding="utf-8") as file,
                ):
                    csv.writer(file).writerows(table)

    def _steps(self, place: Place, show: Show) -> None:
        problem, times = self._problem, self._times
        while place.number < len(times) - 1:
            begin, t = place.part(times)
            show(place.number / (len(times) - 1), f"t = {t:.6g}")
            try:
                problem.take_step(t - begin)
                self._set(t)
                problem.solve()
                reason = problem.report.converged_reason
                if not reason.startswith("CONVERGED"):  # options let it be
                    raise ConvergenceError(f"the dual solver stopped: {reason}")
            except TfetiError as error:
                error.add_note(f"load step {place.number}, t = {t:.6g}")
                if not isinstance(error, ConvergenceError):
                    raise
                problem.go_back()
                if place.level >= self._max_halvings:
                    raise ConvergenceError(
                        f"load step {place.number}, from t = {begin:.9g} to {t:.9g}, does not "
                        f"converge, halved {place.level} times "
                        f"(max_halvings={self._max_halvings}): {error}"
                    ) from error
                place = replace(place, level=place.level + 1)
                continue
            problem.accept()
            self.records.append(self._record(place.number, t, t - begin))
            if self._comm.rank == 0:
                figures = self.records[-1].figures
                log.info(
                    "load step %d of %d, t = %.6g: %d iterations, %.2g s",
                    *(place.number + 1, len(times) - 1, t),
                    *(figures["F_multiplications"], self.records[-1].seconds),
                )
            place = place.ahead()
            self._keep(place, t)
        show(1.0, "done")

    def _set(self, t: float) -> None:
        with agreeing(self._comm, "apply"):
            self._problem.time = t
            self._apply(self._problem, t)

    def _record(self, number: int, t: float, size: float) -> StepRecord:
        report, solution = self._problem.report, self._problem.solution
        lost = float(summed(self._comm, np.array([np.sum(solution.dissipation)]))[0])
        forces: list[Any] = report.contact_forces  # of bodies with mass they have blows, too
        if not forces:
            which = range(len(solution.contacts))
            forces = [solution.contact(i).resultant.force for i in which]
        tools: dict[str, float] = {}
        for i in range(len(solution.tool_motions)):
            tools |= solution.tool(i).numbers
        return StepRecord(
            number=number,
            time=t,
            size=size,
            dissipation=lost,
            figures={k: v for k, v in vars(report).items() if isinstance(v, (int, str))},
            residuals=dict(report.residuals),
            seconds=report.seconds["total"],
            motion=dict(report.motion),
            contact_forces=[list(map(float, force)) for force in forces],
            tools=tools,
        )

    def _keep(self, place: Place, t: float) -> None:
        """Write a step that has converged, and the place of the next."""
        fields: dict[str, Array] = {}
        solution = self._problem.solution
        if self._path is not None:
            fields = fields_of(solution, self._interior)
        if self._checkpoint is not None:  # before the file, which can be written from it anew
            about = {"place": asdict(place), "begin": self._times[0]}
            if place.done:  # where its step goes
                about["towards"] = self._times[place.number + 1]
            record, digest = asdict(self.records[-1]), self._problem.digest()
            labels = labels_of_fields(solution, self._interior) if fields else {}
            table: Table = {
                name: (as_rows(values, labels[name]), labels[name])
                for name, values in fields.items()
            }
            state, number = self._problem.state(), len(self.records)
            self._checkpoint.write(number, record, digest, about, state, table)
        self._write(t, fields)

    def _write(self, t: float, fields: Mapping[str, Array]) -> None:
        """Add a step to the file of all steps, if there is to be one."""
        if self._path is None:
            return
        if self._series is None:
            solution = self._problem.solution
            target = checked_target(self._path, self._path.suffix, solution)
            self._series = Series(target, solution, self._interior)
        self._series.write(t, fields)

    def _begin(self, resume: bool) -> Place:
        """Return the place to begin at, and restore its state."""
        self.records = []
        checkpoint = self._checkpoint
        if checkpoint is None:
            return Place()
        kept = checkpoint.read() if resume else []
        if not kept:
            checkpoint.forget()
            return Place()
        about = checkpoint.index.about
        place = Place(**about["place"])
        records = [StepRecord(**step.record) for step in kept]
        ends = {record.number: record.time for record in records}
        reached = [about["begin"], *(ends[number] for number in range(place.number))]
        reached += [about["towards"]] if place.done else []
        # but for rounding, as of a longer ``linspace``
        given, rounding = self._times[: len(reached)], 1e-6 * min(np.diff(reached), default=0.0)
        for now, before in zip_longest(given, reached):
            if now is None or abs(now - before) > rounding:
                raise InputError(
                    f"the checkpoint is of a series with the times {shown(reached)}, begin "
                    f"first; expected those, got {shown(given)}, {now} instead of {before}"
                )
        self._problem.take_step(records[-1].size)
        self._set(records[-1].time)
        digest = self._problem.digest()
        with raised_on_all_ranks(self._comm):
            check_same_problem(checkpoint.index.digest, digest)
        self._problem.restore(checkpoint.read_state())
        self.records = records
        if self._path is not None:  # a file of ADIOS2 cannot be continued
            try:
                here = labels_of_fields(self._problem.solution, self._interior)
                for number, step in enumerate(kept, start=1):
                    table = checkpoint.read_fields(number, step)
                    self._write(records[number - 1].time, in_order(table, here))
            except TfetiError:  # on all ranks
                self._close(drop=True)
                raise
        return place

    def _close(self, drop: bool = False) -> None:
        """End the file of all steps: under its name, or not at all."""
        series, self._series = self._series, None
        if series is not None:
            (series.drop if drop else series.close)()
