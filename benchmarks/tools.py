"""Share a command line, tables, pictures and runs of demos on several ranks between benchmarks."""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

ROOT = Path(__file__).resolve().parents[1]
MPI_VARIABLES = ("OMPI_COMM_WORLD_SIZE", "PMI_SIZE")
FILE = "«file»"  # among words of a command: where what it finds is to be written
# of the report; the rest of the total is the demo's own: forms, closed forms, output
STAGES = ("mesh", "assembly", "contact", "constraints", "factors", "coarse", "solve", "recovery")
# lines of what a program has printed that are shown where it fails
SHOWN = 20
FEW = 8  # values that all can stand beside an axis
BELOW = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.18), "ncols": 2}  # a large legend

Tables = dict[str, list[dict[str, Any]]]


def command_line(
    description: str | None, argv: Sequence[str], **given: Any
) -> tuple[argparse.Namespace, list[str]]:
    """The parsed arguments, and the PETSc options that follow them.

    A benchmark's own arguments are ``given``: False makes a switch, a number is a default, and so
    is a list of numbers, of whole ones if it is empty; words are choices, of which some may be
    given, None if none are.
    """
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="PETSc options such as -tfeti_rtol 1e-8 may follow, see docs/options.md.",
    )
    parser.add_argument("--quick", action="store_true", help="sizes of a few seconds")
    parser.add_argument("--output", type=Path, default=Path("results"), help="folder")
    parser.add_argument("--document", metavar="COMMIT", help="put the tables into docs/, too")
    for name, default in given.items():
        several = list(default) if isinstance(default, Iterable) else []
        if default is False:
            parser.add_argument(f"--{name}", action="store_true")
        elif several and isinstance(several[0], str):
            parser.add_argument(f"--{name}", nargs="+", choices=several)
        else:
            kind = type((several or [default or 0])[0])  # of an empty list, too
            many = {"nargs": "+"} if isinstance(default, list) else {}
            help = f"default {default}"
            parser.add_argument(f"--{name}", type=kind, default=default, help=help, **many)
    arguments, rest = parser.parse_known_args(argv)
    if unknown := [word for word in rest if word.startswith("--")]:
        parser.error(f"unrecognized arguments: {' '.join(unknown)}")
    return arguments, rest


def choose_clock(arguments: argparse.Namespace) -> str:
    """What seconds are; with ``--processor`` all clocks count those of the processor from now on.

    On a machine that others use, too, they say more than those of the wall.
    """
    if not arguments.processor:
        return "seconds"
    time.perf_counter = time.process_time
    return "seconds of the processor"


def finish(
    arguments: argparse.Namespace,
    name: str,
    tables: Tables,
    draw: Callable[[Path, Tables], None] | None = None,
    shown: Callable[[Tables], Tables] = dict,
) -> Tables:
    """Write and print tables and their picture on rank 0; the tables.

    With ``--document`` those that ``shown`` makes of them go between their marks in docs/.
    """
    if MPI.COMM_WORLD.rank == 0:
        write_tables(arguments.output, name, tables)
        if draw is not None:
            draw(arguments.output / f"{name}.png", tables)
        if arguments.document:
            write_documents(name, shown(tables), arguments.document)
        for title, rows in tables.items():
            print(f"{title}\n\n{markdown(rows)}\n", flush=True)
    return tables


def say(row: Mapping[str, Any]) -> None:
    """Print a row on rank 0 at once: large scenes take their time."""
    if MPI.COMM_WORLD.rank == 0:
        print(*map(_text, row.values()), sep=" | ", flush=True)


def limited(seconds: int, run: Callable[[], Any]) -> Any:
    """What a function returns within so many seconds; on several ranks they do not count.

    Raises:
        TimeoutError: It has not returned.
    """

    def ring(*_: object) -> None:
        raise TimeoutError(f"beyond {seconds} s")

    if MPI.COMM_WORLD.size > 1:
        return run()
    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        return run()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def over_seeds(
    description: str, argv: Sequence[str], count: int, name: str, run: Callable[[int], dict]
) -> list[dict[str, Any]]:
    """Run random scenes and write ``name.json`` as rows come; the rows, complete on rank 0.

    Collective. A row has a ``class``; what is not right is printed.
    """
    # how many, the first seed, or all seeds
    arguments, _ = command_line(description, argv, scenes=count, seed=0, only=[])
    rows = list[dict[str, Any]]()
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    arguments.output.mkdir(parents=True, exist_ok=True)
    for seed in arguments.only or range(arguments.seed, arguments.seed + arguments.scenes):
        rows.append({"scene": seed, **run(seed)})
        if MPI.COMM_WORLD.rank == 0:
            text = json.dumps(rows, indent=1, default=float)
            (arguments.output / f"{name}.json").write_text(text + "\n")
            if not rows[-1]["class"].startswith("right"):
                keys = ("class", "kind", "law", "error", "reference", "reason")
                said = " ".join(str(rows[-1].get(key, "")) for key in keys)
                print(seed, " ".join(said.split())[:300], flush=True)
    logging.disable(before)
    if MPI.COMM_WORLD.rank == 0:
        for kind, number in Counter(row["class"] for row in rows).most_common():
            print(f"{number:6} {kind}")
    return rows


def wrong(rows: Sequence[Mapping[str, Any]]) -> int:
    """1 on all ranks if a class is in capitals. Collective."""
    found = any(row["class"].split(":")[0].isupper() for row in rows)
    return int(MPI.COMM_WORLD.bcast(found))


def write_documents(name: str, tables: Tables, commit: str, folder: Path = ROOT / "docs") -> None:
    """Replace what stands between marks of a benchmark's tables in documents.

    A mark is ``<!-- NAME: TITLE, at COMMIT -->``, the end of a table ``<!-- end -->``.
    """
    for path in sorted(folder.rglob("*.md")):
        text = made = path.read_text()
        for title, rows in tables.items():  # one that no document marks is left out
            mark = re.escape(f"<!-- {name}: {title}, at ") + r"\w+ -->\n.*?<!-- end -->"
            new = f"<!-- {name}: {title}, at {commit} -->\n\n{markdown(rows)}\n\n<!-- end -->"
            made = re.sub(mark, lambda _, new=new: new, made, flags=re.DOTALL)
        if made != text:
            path.write_text(made)


def json_of(words: Sequence[object], ranks: int) -> Any:
    """The JSON that a program writes where ``FILE`` stands among its words, run on so many ranks.

    Raises:
        RuntimeError: This process is one of several itself, or the program fails.
    """
    if any(int(os.environ.get(variable, 1)) > 1 for variable in MPI_VARIABLES):
        raise RuntimeError("this benchmark starts mpirun itself; run it without")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "found.json"
        words = [file if word is FILE else word for word in words]
        command = ["mpirun", "-n", *map(str, (ranks, *words))]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode != 0:
            said = "\n".join((done.stdout + done.stderr).splitlines()[-SHOWN:])
            raise RuntimeError(f"{' '.join(command)} failed:\n{said}")
        return json.loads(file.read_text())


def run_demo(name: str, arguments: Sequence[object], ranks: int) -> dict[str, Any]:
    """The report of a demo, run on so many ranks in processes of its own.

    It also has seconds of the ``processor``: of all ranks, start and mesh included. On a machine
    that others use, too, they say more than those of the wall, but for waiting for each other.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    demo = [sys.executable, ROOT / "demos" / f"{name}.py", *arguments, "--report", FILE]
    report, after = json_of(demo, ranks), resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**report, "processor": seconds}


def best_runs(
    runs: Sequence[tuple[str, Sequence[object], int]], arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    """The fastest report of each run of a demo; the runs take turns, so that noise hits all."""
    reports: list[list[dict[str, Any]]] = [[] for _ in runs]
    for _ in range(1 if arguments.quick else arguments.repeats):
        for (name, words, ranks), found in zip(runs, reports, strict=True):
            found.append(run_demo(name, words, ranks))
            seconds = f"{solve_seconds(found[-1]):.3g} s"
            print(f"{name}, {ranks} ranks:", *words, seconds, flush=True)
    return [min(found, key=solve_seconds) for found in reports]


def solve_seconds(report: dict[str, Any]) -> float:
    """Seconds of all stages but the mesh."""
    return sum(report["seconds"].get(stage, 0.0) for stage in STAGES[1:])


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table of rows that have the same keys."""
    names = list(rows[0])
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(_text(row[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def _text(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_tables(folder: Path, name: str, tables: dict[str, Sequence[dict[str, Any]]]) -> None:
    """Write ``name.md`` and ``name.json``; they appear whole."""
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join(f"## {title}\n\n{markdown(rows)}" for title, rows in tables.items())
    for suffix, content in ((".md", text), (".json", json.dumps(tables, indent=2))):
        partial = folder / f".{name}{suffix}.partial"
        partial.write_text(content + "\n")
        os.replace(partial, folder / f"{name}{suffix}")


@contextmanager
def picture(path: Path, panels: int, height: float = 3.4, rows: int = 1) -> Iterator[list[Any]]:
    """Axes of panels side by side, row by row, written when the block ends.

    Panels of one row that are more than three are drawn in two columns.
    """
    from matplotlib.figure import Figure

    count = rows * panels
    if rows == 1 and panels > 3:
        panels, rows = 2, -(-panels // 2)
        height *= rows
    figure = Figure(figsize=(4.6 * panels, height), layout="constrained")
    axes = list(figure.subplots(rows, panels, squeeze=False).ravel())
    for unused in axes[count:]:
        unused.remove()
    yield axes[:count]
    figure.savefig(path, dpi=120)


def stacked(axes: Any, title: str, rows: Sequence[Mapping[str, Any]], parts: Sequence[str]) -> None:
    """A bar for each row, labelled with its first column, made of columns that are seconds."""
    labels, left = [str(next(iter(row.values()))) for row in rows], np.zeros(len(rows))
    for part in parts:
        widths = np.array([row[part] for row in rows])
        axes.barh(labels, widths, left=left, label=part)
        left += widths
    axes.invert_yaxis()
    axes.set(xlim=(0.0, 1.3 * max(left)), xlabel="seconds")  # room for the legend
    axes.set_title(title, fontsize="medium")
    axes.legend(fontsize="small")


def curves(
    axes: Any,
    title: str,
    labels: tuple[str, str],
    tables: Mapping[str, Sequence[Mapping[str, Any]]],
    columns: tuple[str, str],
    log: str = "xy",
    names: Sequence[str] = (),
) -> None:
    """A curve of two columns for each name, logarithmic axes in ``log``; ``names`` have colours."""
    lines = {name: [[row[c] for row in rows] for c in columns] for name, rows in tables.items()}
    for name, (x, y) in lines.items():
        axes.plot(x, y, marker="o", label=name, color=f"C{names.index(name)}" if names else None)
    if "x" in log:
        axes.set_xscale("log")
        plain(axes.xaxis, sorted({value for x, _ in lines.values() for value in x}))
    if "y" in log:
        axes.set_yscale("log")
        plain(axes.yaxis)
    else:
        axes.set_ylim(0.0, 1.4 * max(max(y) for _, y in lines.values()))  # room for the legend
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.set_title(title, fontsize="medium")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", **(BELOW if len(lines) > 4 or names else {}))


def plain(axis: Any, ticks: Sequence[float] | None = None) -> None:
    """Numbers as they are on a logarithmic axis: those given if few and short, or 1, 2, 5, ...

    Of a horizontal axis of more than two decades, another one of more than three, 1, 10, 100, ...
    """
    from matplotlib.ticker import FixedLocator, LogLocator

    short = ticks is not None and max(ticks) < 1000 and len(ticks) <= FEW
    low, high = axis.get_data_interval()
    wide = high > (1e2 if axis.axis_name == "x" else 1e3) * low
    few = LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0))
    axis.set_major_locator(FixedLocator(ticks) if short else few)
    axis.minorticks_off()
    axis.set_major_formatter("{x:g}")
