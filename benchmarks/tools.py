"""What the benchmarks share: command line, tables and pictures, runs of demos on several ranks."""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.tables import markdown, write_tables

ROOT = Path(__file__).resolve().parents[1]
MPI_VARIABLES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE")
# of the report; the rest of the total is the demo's own: forms, closed forms, output
STAGES = ("mesh", "assembly", "contact", "gluing", "subdomains", "dual", "qp", "recovery")
COLUMNS = {"subdomains": "K⁺"}  # a table may have a column for their number
# lines of what a program has printed that are shown where it fails
SHOWN = 20

Tables = dict[str, list[dict[str, Any]]]


def command_line(
    description: str | None,
    argv: Sequence[str],
    configure: Callable[[argparse.ArgumentParser], None] | None = None,
) -> tuple[argparse.Namespace, list[str]]:
    """The parsed arguments, and the PETSc options that follow them."""
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="PETSc options such as -tfeti_rtol 1e-8 may follow, see docs/options.md.",
    )
    parser.add_argument("--quick", action="store_true", help="sizes of a few seconds")
    parser.add_argument("--output", type=Path, default=Path("results"), help="folder")
    if configure is not None:
        configure(parser)
    arguments, rest = parser.parse_known_args(argv)
    if unknown := [word for word in rest if word.startswith("--")]:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    return arguments, rest


def configure_runs(parser: argparse.ArgumentParser) -> None:
    """Arguments of benchmarks that start demos."""
    parser.add_argument("--large", action="store_true", help="the largest sizes, too")
    parser.add_argument("--ranks", type=int, default=2, help="ranks of each run")
    parser.add_argument("--repeats", type=int, default=3, help="runs, of which the best counts")


def configure_clock(parser: argparse.ArgumentParser) -> None:
    """An argument of benchmarks that may share their machine."""
    parser.add_argument(
        "--processor", action="store_true", help="seconds of the processor, not of the wall"
    )


def choose_clock(arguments: argparse.Namespace) -> str:
    """What seconds are; from now on all clocks count those of the processor, if asked for.

    On a machine that others use, too, they say more than those of the wall.
    """
    if not arguments.processor:
        return "seconds"
    time.perf_counter = time.process_time
    return "seconds of the processor"


def finish(
    folder: Path, name: str, tables: Tables, draw: Callable[[Path, Tables], None], rank: int = 0
) -> Tables:
    """Write and print tables and their picture on rank 0; the tables."""
    if rank == 0:
        write_tables(folder, name, tables)
        draw(folder / f"{name}.png", tables)
        for title, rows in tables.items():
            print(f"{title}\n\n{markdown(rows)}\n", flush=True)
    return tables


def run_demo(name: str, arguments: Sequence[object], ranks: int) -> dict[str, Any]:
    """The report of a demo, run on so many ranks in processes of its own.

    It also has seconds of the ``processor``: of all ranks, start and mesh included. On a machine
    that others use, too, they say more than those of the wall, but for waiting for each other.

    Raises:
        RuntimeError: This process is one of several itself, or the demo fails.
    """
    if any(int(os.environ.get(variable, 1)) > 1 for variable in MPI_VARIABLES):
        raise RuntimeError("this benchmark starts mpirun itself; run it without")
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = ["mpirun", "-n", ranks, sys.executable, ROOT / "demos" / f"{name}.py"]
        command += [*arguments, "--report", report]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        words = [str(word) for word in command]
        before = processor_seconds()
        done = subprocess.run(words, capture_output=True, text=True, env=environment)
        if done.returncode != 0 or not report.exists():
            said = "\n".join((done.stdout + done.stderr).splitlines()[-SHOWN:])
            raise RuntimeError(f"{' '.join(words)} failed:\n{said}")
        return {**json.loads(report.read_text()), "processor": processor_seconds() - before}


def processor_seconds() -> float:
    """Of all processes that this one has started and waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def best_runs(
    runs: Sequence[tuple[str, Sequence[object], int]], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """The fastest report of each run of a demo; the runs take turns, so that noise hits all."""
    reports: list[list[dict[str, Any]]] = [[] for _ in runs]
    for _ in range(1 if arguments.quick else arguments.repeats):
        for run, found in zip(runs, reports, strict=True):
            found.append(run_demo(*run))
            name, words, ranks = run
            print(
                f"{name}, {ranks} ranks:", *words, f"{solve_seconds(found[-1]):.3g} s", flush=True
            )
    return [min(found, key=solve_seconds) for found in reports]


def solve_seconds(report: dict[str, Any]) -> float:
    """Seconds of all stages but the mesh."""
    return sum(report["seconds"].get(stage, 0.0) for stage in STAGES[1:])


def stage_seconds(report: dict[str, Any]) -> dict[str, float]:
    """Columns of a table: seconds of each stage, that of the subdomains by what it makes."""
    return {COLUMNS.get(stage, stage): report["seconds"].get(stage, 0.0) for stage in STAGES}
