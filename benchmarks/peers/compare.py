#!/usr/bin/env python3
"""Seconds to an error beside other programs, on the same meshes, in turns.

    python3 benchmarks/peers/compare.py [SCENE] [--quick] [--output DIR]      (not inside of ./run)

A scene is a module that says what is solved. half_cylinder, the default: Hertz's on a rigid plane,
order 1 and 2 (curved), errors of the pressure; pressed_disc, of rubber, and indentation, of a
plastic block: errors of the force. Each program has the same nodes and elements and uses one
processor. They are installed when first asked for, see benchmarks/peers/run. Seconds are those of
the processor, the best of a few if short, for set-up and solve; start, imports, compiled forms and
reading a mesh are left out, but for CalculiX' deck. Results of each run stay in DIR/peers, tables
are in DIR.
"""

import argparse
import importlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
OURS, THEIRS = [str(ROOT / "run"), "python3"], [str(HERE / "run"), "python3"]
LIMIT = 300  # seconds of the wall of a run
# processor seconds up to which a solve is repeated, and how often
SHORT, REPEATS = 3.0, 5
NAME, MESH = "tfeti_dolfinx", "mesh"  # of programs of ours
SCENES = ("half_cylinder", "pressed_disc", "indentation")
LEVELS = {"pressure": (0.05, 0.02, 0.01, 0.005, 0.002), "force": (0.01, 0.003, 0.001)}


def command(scene, program, case, file):
    """The command that solves a case of a scene by a program, in its root."""
    root = OURS if program in (NAME, MESH) else THEIRS
    return [*root, __file__, scene, "--run", program, json.dumps(case), str(file)]


def run(scene, program, case, file):
    """Solve a case and write what came out, with its seconds: the best of some."""
    # CalculiX is a process of its own
    who = resource.RUSAGE_CHILDREN if program == "CalculiX" else resource.RUSAGE_SELF
    solve, runs = scene.prepare(program, case, file), []
    while not runs or (runs[0]["seconds"] < SHORT and len(runs) < REPEATS):
        before, found = resource.getrusage(who), solve()
        after = resource.getrusage(who)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        peak = after.ru_maxrss / 1024
        runs.append({"program": program, **found, "seconds": used, "MB": peak})
    file.write_text(json.dumps({**min(runs, key=lambda run: run["seconds"]), "MB": peak}))


def facets_on(on):
    """Facets of triangles whose ends are on a surface: cells, and corners opposite."""
    import numpy as np

    cells = np.flatnonzero(on.sum(axis=1) == 2)
    return np.stack((cells, np.argmin(on[cells], axis=1)), 1)


# --- Tables ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ByForce:
    """A scene in which programs are judged by a force; each has a solve for points and cells."""

    DOCUMENT: str  # name of its tables in the documents
    TITLE: str
    sizes: tuple[int, ...]  # of meshes that get finer
    mesh: Callable[[int], Any]  # from a size to points and cells
    # from points and cells to a solve that returns force, unknowns and steps of Newton's method
    programs: dict[str, Callable[..., Callable[[], tuple[float, int, int]]]]
    MEASURE: str = "force"

    def prepare(self, program, case, file):
        """A solve of a case by a program."""
        solve = self.programs[program](*self.mesh(case))
        return lambda: dict(zip(("force", "unknowns", "steps"), solve(), strict=True))

    def _cases(self, folder):
        files = "{}_{}_{}.json".format
        return [
            (n, name, folder / files(self.DOCUMENT, n, name))
            for n in self.sizes
            for name in self.programs
        ]

    def commands(self, folder, quick):
        """What is run, as words for the screen, a command, and the file that it writes."""
        for n, name, file in self._cases(folder)[: 2 * len(self.programs) if quick else None]:
            yield f"{n} elements {name}", command(self.DOCUMENT, name, n, file), file

    def judged(self, folder):
        """Rows, with errors beside the finest mesh, and errors that finer meshes do not exceed."""
        files = [(n, file) for n, _, file in self._cases(folder) if file.exists()]
        rows = [{"n": n, **json.loads(file.read_text())} for n, file in files]
        rows = [row for row in rows if "failed" not in row]
        finest = max(row["n"] for row in rows)
        forces = [row["force"] for row in rows if row["n"] == finest]
        mean, lines = sum(forces) / len(forces), {}
        shown = ("program", "n", "unknowns", "steps", "force", "seconds", "MB")
        rows = [{key: row[key] for key in shown} for row in rows]
        for row in rows:
            row["error"] = abs(row["force"] / mean - 1.0)
        for row in reversed(rows):
            line = lines.setdefault(row["program"], [])
            line.insert(0, {**row, "force": max([row["error"], *(r["force"] for r in line[:1])])})
        return rows, {name: [lines[name]] for name in self.programs if name in lines}


def seconds_at(rows, name, level):
    """Seconds at an error, between two meshes on straight lines of logarithms."""
    from benchmarks.time_against_error import between

    if rows[0][name] <= level:
        return rows[0]["seconds"]
    for ends in pairwise(rows):
        if ends[1][name] <= level < ends[0][name]:
            return between([e[name] for e in ends], [e["seconds"] for e in ends], level)
    return None


def tables_of(title, rows, lines, measure):
    """The rows, and seconds to equal errors, each program at its better line of meshes."""
    table = []
    for program, own in lines.items():
        row = {"program": program}
        for level in LEVELS[measure]:
            found = [seconds_at(line, measure, level) for line in own]
            row[f"{level:.1%}"] = min((s for s in found if s is not None), default=None)
        table.append(row)
    return {title: rows, f"{title}, seconds to an error": table}


def write(scene, folder, commit=None):
    """Write the tables of a folder, in ./run, with a commit into docs/, too; returns them."""
    from benchmarks.tools import curves, finish, picture

    name, title, measure = scene.DOCUMENT, scene.TITLE, scene.MEASURE
    tables = tables_of(title, *scene.judged(folder), measure)

    def draw(path, tables):
        lines = {}
        # an error of 1 is no answer: that point is left to the table
        for row in (row for row in tables[title] if row["pressure"] < 1.0):
            lines.setdefault(f"{row['program']}, order {row['order']}", []).append(row)
        with picture(path, 1, 4.6) as (panel,):
            labels = "seconds of the processor", "relative error of the pressure inside 0.9 a"
            curves(panel, title, labels, lines, ("seconds", "pressure"))

    given = argparse.Namespace(output=folder.parent, document=commit)
    return finish(given, name, tables, draw if measure == "pressure" else None)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?", choices=SCENES, default=SCENES[0])
    parser.add_argument("--quick", action="store_true", help="two coarse meshes")
    parser.add_argument("--output", type=Path, default=Path("results"), help="folder")
    parser.add_argument("--document", metavar="COMMIT", help="put the tables into docs/, too")
    parser.add_argument("--tables", action="store_true", help="of a folder of results, in ./run")
    parser.add_argument("--run", nargs=3, metavar=("PROGRAM", "CASE", "FILE"), help="in its root")
    arguments = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    scene = importlib.import_module(arguments.scene).SCENE
    folder = arguments.output.resolve() / "peers"
    if arguments.run:
        program, case, file = arguments.run
        return run(scene, program, json.loads(case), Path(file))
    if arguments.tables:
        return write(scene, folder, arguments.document)
    folder.mkdir(parents=True, exist_ok=True)
    # where forms of many programs lie, to find one takes longer
    os.environ["TFETI_JIT_CACHE"] = str(folder / "forms")
    for label, words, file in scene.commands(folder, arguments.quick):
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, cwd=ROOT)
            said = (done.stdout + done.stderr)[-500:] if done.returncode else ""
        except subprocess.TimeoutExpired:
            said = f"stopped after {LIMIT} s"
        print(label, said or "done", flush=True)
        if said:
            if file is None:
                sys.exit(1)
            file.write_text(json.dumps({"failed": said}))
    given = ["--document", arguments.document] if arguments.document else []
    words = [*OURS, __file__, arguments.scene, "--tables", "--output", folder.parent, *given]
    sys.exit(subprocess.run(words).returncode)


if __name__ == "__main__":
    main()
