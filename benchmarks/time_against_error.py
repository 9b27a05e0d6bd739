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
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np

from benchmarks.error_case import QUADRILATERAL, TRIANGLE, Case
from benchmarks.error_scenes import ADAPTIVE, SCENES, UNIFORM, Scene
from benchmarks.profiles import errors
from benchmarks.tools import (
    MPI_VARIABLES,
    ROOT,
    SHOWN,
    Tables,
    command_line,
    configure_clock,
    curves,
    finish,
    picture,
    slope,
    write_tables,
)

LEVELS = (0.05, 0.02, 0.01)
MEASURES = ("energy", "pressure")


@dataclass(frozen=True)
class Plan:
    """Cases of a scene.

    Attributes:
        cases: Groups of meshes.
        reference: The fine solution that errors are against.
        quick: Groups of a quick run.
        quick_reference: Its reference.
    """

    cases: tuple[Case, ...]
    reference: Case
    quick: tuple[Case, ...]
    quick_reference: Case


def label(case: Case) -> str:
    """A case in a few words."""
    words = [case.mesh, "" if case.cell == TRIANGLE else "quadrilaterals", f"P{case.degree}"]
    if case.degree == 2:
        words.append("curved" if case.order == 2 else "straight")
    words.append(f"{case.ranks} ranks" if case.ranks > 1 else "")
    return " ".join(word for word in words if word)


def case(name: str, sizes: tuple[float, ...], **other: Any) -> Case:
    """A case of degree 1; of degree 2 on curved cells if ``order=2``."""
    return Case(name, sizes, **other)


def both(name: str, linear: tuple[float, ...], order: int = 2, **other: Any) -> list[Case]:
    """Degree 1, and degree 2 on meshes that are twice as coarse."""
    quadratic = tuple(size / 2 for size in linear)
    return [
        case(name, linear, **other),
        case(name, quadratic, degree=2, order=order, **other),
    ]


def plan(name: str, cases: list[Case], finest: float, order: int = 2) -> Plan:
    """A plan with its quick form: the first two groups, their two coarsest meshes."""
    reference = case(name, (finest,), degree=2, order=order)
    quick = tuple(replace(one, sizes=one.sizes[:2]) for one in cases[:2])
    coarse = replace(reference, sizes=(quick[0].sizes[1],))
    return Plan(tuple(cases), replace(reference, rtol=1e-7), quick, coarse)


def _line() -> Plan:
    name, sizes = "half cylinder", (6.0, 12.0, 24.0, 48.0)
    cases = both(name, sizes)
    cases += both(name, sizes, order=1)[1:]
    cases += both(name, sizes, cell=QUADRILATERAL)
    cases += both(name, (1.0, 2.0, 4.0, 6.0), mesh=UNIFORM)
    cases.append(case(name, (0.3, 0.15, 0.08, 0.04), mesh=ADAPTIVE))
    cases += both(name, sizes, ranks=2)
    return plan(name, cases, 64.0)


def _ball() -> Plan:
    name, sizes = "half ball", (4.0, 6.0, 10.0, 16.0)
    cases = both(name, sizes[:3])
    cases[0] = case(name, sizes)
    cases += both(name, sizes[:3], order=1)[1:]
    cases.append(case(name, (0.6, 1.0, 1.5), mesh=UNIFORM))
    cases.append(case(name, (0.35, 0.25, 0.18), mesh=ADAPTIVE))
    cases += [replace(one, ranks=2) for one in cases[:2]]
    return plan(name, cases, 10.0)


def _half_planes(name: str) -> Plan:
    sizes = (6.0, 12.0, 24.0, 48.0)
    cases = both(name, sizes, order=1)
    cases.append(case(name, (1.0, 2.0, 4.0), mesh=UNIFORM))
    cases += both(name, sizes, order=1, ranks=2)
    return plan(name, cases, 64.0, order=1)


def _rings() -> Plan:
    name, sizes = "shrink fit", (8.0, 16.0, 32.0, 64.0)
    cases = both(name, sizes, mesh=UNIFORM)
    cases += both(name, sizes, mesh=UNIFORM, cell=QUADRILATERAL)
    cases += both(name, sizes, mesh=UNIFORM, ranks=2)
    return plan(name, cases, 90.0)  # of no mesh a refinement: their midpoints are better


def _cylinder() -> Plan:
    name, sizes = "cylinder on block", (6.0, 12.0, 24.0, 48.0)
    cases = both(name, sizes)
    cases += both(name, sizes, order=1)[1:]
    cases += both(name, sizes, cell=QUADRILATERAL)
    cases += both(name, (1.0, 2.0, 4.0), mesh=UNIFORM)
    cases += both(name, sizes, ranks=2)
    return plan(name, cases, 64.0)


PLANS = {
    "half cylinder": _line(),
    "half ball": _ball(),
    "rounded punch": _half_planes("rounded punch"),
    "partial slip": _half_planes("partial slip"),
    "shrink fit": _rings(),
    "cylinder on block": _cylinder(),
}


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
    """Errors over seconds, on one rank: bands of three scenes, energy above pressure."""
    titles = [title for title in tables if title in SCENES]
    columns = min(len(titles), 3)
    bands = -(-len(titles) // columns)
    with picture(path, columns, 8.6 * bands, rows=2 * bands) as axes:
        for unused in range(len(titles), columns * bands):
            for panel in axes[-2 * columns :][unused % columns :: columns]:
                panel.remove()
        for k, title in enumerate(titles):
            band = axes[2 * columns * (k // columns) :][: 2 * columns]
            panels = band[k % columns :: columns]
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
    return finish(arguments, "time_against_error", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
