"""Errors against seconds and memory: scenes, meshes, degrees, cells and ranks side by side.

    ./run python3 benchmarks/time_against_error.py [--quick] [--scenes "half ball" ...]

Each scene is solved on meshes that get finer: uniform, graded by hand, and following the estimated
error; with displacements of degree 1 and 2, the latter on curved cells, too; with triangles and
quadrilaterals. ``seconds`` are from gmsh's mesh to the displacement, the best of three if short;
gmsh's own are in ``meshing``; what is paid once, the start of the program with its imports and the
compiling of forms, has a table of its own. ``MB`` is the peak of resident memory of all ranks.

Errors are relative, against a fine solution of degree 2 of the same scene: ``energy`` is that of
the stress in the energy norm, ``estimate`` what the solve itself says of it; ``J`` is the total
energy; ``pressure`` is the L² norm inside 0.9 a; ``a`` and ``p0`` are as in benchmarks/profiles.py.
The last column is against the closed form, which belongs to half planes and half spaces.
Results go to results/time_against_error.md, .json and .png.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.error_case import Case
from benchmarks.error_plan import PLANS, label
from benchmarks.error_scenes import SCENES, Scene
from benchmarks.pictures import curves, picture
from benchmarks.profiles import errors
from benchmarks.tables import slope, write_tables
from benchmarks.tools import (
    MPI_VARIABLES,
    ROOT,
    SHOWN,
    Tables,
    command_line,
    configure_clock,
    finish,
)

LEVELS = (0.05, 0.02, 0.01)
MEASURES = ("energy", "pressure")


def configure(parser):
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    configure_clock(parser)
    parser.add_argument("--ranks", nargs="+", type=int, default=[1, 2], help="numbers of ranks")


def run_case(case: Case, reference: Path) -> dict[str, Any]:
    """What a case gives, solved in processes of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        program = [sys.executable, str(ROOT / "benchmarks" / "error_case.py"), case.write()]
        command = ["mpirun", "-n", str(case.ranks), *program, str(file), str(reference)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "LAUNCHED": str(time.time())}
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        if done.returncode != 0 or not file.exists():
            said = "\n".join((done.stdout + done.stderr).splitlines()[-SHOWN:])
            raise RuntimeError(f"{case} failed:\n{said}")
        found: dict[str, Any] = json.loads(file.read_text())
        return found


def compared(scene: Scene, found: dict[str, Any], best: dict[str, Any]) -> dict[str, Any]:
    """A row of the table, from what a solve gives and the reference."""
    profile = np.array(found["profile"])
    against = errors(scene.samples, profile, np.array(best["profile"]))
    shown = ("size", "unknowns", "seconds", "meshing", "MB", "F")
    closed = errors(scene.samples, profile, scene.exact)
    return {
        **{name: found[name] for name in shown},
        "energy": found["energy"],
        "estimate": found["estimate"],
        "J": found["J"] / best["J"] - 1,
        **against,
        "pressure, closed form": closed["pressure"],
    }


def seconds_at(rows: Sequence[dict[str, Any]], name: str, level: float) -> float | None:
    """Seconds at an error, between two meshes on straight lines of logarithms."""
    if rows[0][name] <= level:
        return float(rows[0]["seconds"])
    for coarse, fine in pairwise(rows):
        if fine[name] <= level < coarse[name]:
            ends = np.log([fine[name], coarse[name]]), np.log([fine["seconds"], coarse["seconds"]])
            return float(np.exp(np.interp(np.log(level), *ends)))
    return None


def summary(case: Case, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Slopes of a group of meshes, and seconds at equal errors."""
    made: dict[str, Any] = {"meshes": label(case)}
    for name in MEASURES:
        values = [row[name] for row in rows]
        for over in ("unknowns", "seconds"):
            made[f"{name}, slope over {over}"] = slope([row[over] for row in rows], values)
        for level in LEVELS:
            made[f"{name}, seconds to {level:.0%}"] = seconds_at(rows, name, level)
    return made


def degrees(groups: dict[str, Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Errors of degree 1 over those of degree 2 in the same time, on straight lines of logarithms.

    Args:
        groups: Rows of groups of meshes, by their names.
    """
    table = []
    for name, quadratic in groups.items():
        linear = groups.get(name.replace("P2 curved", "P1").replace("P2 straight", "P1"), quadratic)
        if linear is quadratic:
            continue
        start = max(rows[0]["seconds"] for rows in (linear, quadratic))
        end = min(rows[-1]["seconds"] for rows in (linear, quadratic))
        for seconds in [start, np.sqrt(start * end), end] if start < end else []:
            row = {"meshes": name, "seconds": float(seconds)}
            for measure in MEASURES:
                one, two = (error_at(rows, measure, seconds) for rows in (linear, quadratic))
                row[f"{measure}, P1"], row[f"{measure}, P2"] = one, two
                row[f"{measure}, P1 over P2"] = one / two
            table.append(row)
    return table


def error_at(rows: Sequence[dict[str, Any]], name: str, seconds: float) -> float:
    """The error that is reached in some seconds, which are within those of the rows."""
    ordered = sorted(rows, key=lambda row: row["seconds"])
    x, y = ([np.log(row[key]) for row in ordered] for key in ("seconds", name))
    return float(np.exp(np.interp(np.log(seconds), x, y)))


def study(name: str, arguments: argparse.Namespace, folder: Path) -> Tables:
    """The tables of a scene; what its reference has goes into a folder."""
    plan, scene, reference = PLANS[name], SCENES[name](), folder / "reference.npz"
    finest = plan.quick_reference if arguments.quick else plan.reference
    best = run_case(finest, reference)["rows"][-1]
    rows, groups, once, by_name = [], [], [], {}
    for planned in plan.quick if arguments.quick else plan.cases:
        if planned.ranks not in arguments.ranks:
            continue
        case = replace(planned, processor=arguments.processor)
        found = run_case(case, reference)
        made = [compared(scene, one, best) for one in found["rows"]]
        rows += [{"meshes": label(case), **row} for row in made]
        by_name[label(case)] = made
        groups.append(summary(case, made))
        once.append({"meshes": label(case), **found["once"]})
        print(name, *groups[-1].values(), sep=" | ", flush=True)
    tables = {name: rows, f"{name}, slopes and seconds": groups, f"{name}, paid once": once}
    beside = degrees(by_name)
    return {**tables, f"{name}, degrees at equal seconds": beside} if beside else tables


def draw(path, tables):
    """Errors over seconds, on one rank."""
    titles = [title for title in tables if title in SCENES]
    with picture(path, len(titles), 8.6, rows=2) as axes:
        for k, title in enumerate(titles):
            panels = axes[k :: len(titles)]
            for panel, name in zip(panels, MEASURES, strict=True):
                lines: dict[str, tuple[list[float], list[float]]] = {}
                for row in tables[title]:
                    if not row["meshes"].endswith("ranks"):
                        x, y = lines.setdefault(row["meshes"], ([], []))
                        x.append(row["seconds"])
                        y.append(row[name])
                curves(panel, title, ("seconds", f"relative error, {name}"), lines)
            panels[0].get_legend().remove()
            below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.18), "ncols": 2}
            panels[1].legend(fontsize="small", **below)


def main(argv):
    """Run the cases and write their tables; returns them."""
    arguments, _ = command_line(__doc__, argv, configure)
    if any(int(os.environ.get(variable, 1)) > 1 for variable in MPI_VARIABLES):
        raise RuntimeError("this benchmark starts mpirun itself; run it without")
    tables: Tables = {}
    for name in arguments.scenes:
        with tempfile.TemporaryDirectory() as folder:
            tables |= study(name, arguments, Path(folder))
        write_tables(arguments.output, "time_against_error", tables)  # a later scene may fail
    return finish(arguments.output, "time_against_error", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
