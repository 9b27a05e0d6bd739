"""Tables and a picture of what benchmarks/peers/compare.py has found in a folder.

./run python3 benchmarks/peers/tables.py FOLDER
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.error_scenes import SCENES, Scene
from benchmarks.profiles import errors
from benchmarks.time_against_error import seconds_at
from benchmarks.tools import Tables, curves, finish, picture

OURS = "tfeti_dolfinx"
LEVELS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)


def found_by(file: Path, scene: Scene) -> dict[str, Any] | None:
    """What a program has found, with its pressure at the scene's samples; None if it failed."""
    found = json.loads(file.read_text())
    if "failed" in found:
        return None
    if "rows" in found:
        (row,) = found["rows"]
        return {**row, "program": OURS, "steps": row["F"]}
    points, values = np.array(found["points"]), np.array(found["values"])
    return {**found, "profile": scene.samples.at(points, values)}


def rows_of(name: str, folder: Path) -> list[dict[str, Any]]:
    """A row for each mesh and program."""
    stem, scene = name.replace(" ", "_"), SCENES[name]()
    reference = found_by(folder / f"{stem}_reference.json", scene)
    if reference is None:
        raise RuntimeError(f"{folder / stem}_reference.json: the reference of {name} failed")
    best = np.array(reference["profile"])
    rows = []
    for file in sorted(folder.glob(f"{stem}_[12]_*_*.json")):
        order, size = file.stem.removeprefix(f"{stem}_").split("_")[:2]
        found = found_by(file, scene)
        if found is None:
            continue
        shown = ("unknowns", "steps", "seconds", "MB")
        against = errors(scene.samples, np.array(found["profile"]), best)
        rows.append(
            {
                "program": found["program"],
                "order": int(order),
                "size": int(size),
                **{key: found[key] for key in shown},
                **against,
            }
        )
    return sorted(
        rows, key=lambda row: (row["program"] != OURS, row["program"], row["order"], row["size"])
    )


def lines_of(rows: list[dict[str, Any]]) -> dict[tuple[str, int], list[dict[str, Any]]]:
    """Rows by program and order."""
    lines: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        lines.setdefault((row["program"], row["order"]), []).append(row)
    return lines


def equal_errors(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Seconds to equal errors of the pressure, each program at its better order, and ratios."""
    fastest: dict[tuple[str, float], float] = {}
    for (program, _), line in lines_of(rows).items():
        for level in LEVELS:
            seconds = seconds_at(line, "pressure", level)
            if seconds is not None:
                key = program, level
                fastest[key] = min(seconds, fastest.get(key, np.inf))
    table = []
    for program in dict.fromkeys(row["program"] for row in rows):
        row: dict[str, Any] = {"program": program}
        for level in LEVELS:
            theirs, ours = fastest.get((program, level)), fastest.get((OURS, level))
            row[f"seconds to {level:.1%}"] = theirs
            row[f"over ours, {level:.1%}"] = theirs / ours if theirs and ours else None
        table.append(row)
    return table


def draw(path: Path, tables: Tables) -> None:
    """Errors of the pressure over seconds."""
    titles = [title for title in tables if title in SCENES]
    with picture(path, len(titles), 4.6) as axes:
        for panel, title in zip(axes, titles, strict=True):
            lines = {
                f"{program}, order {order}": (
                    [row["seconds"] for row in line],
                    [row["pressure"] for row in line],
                )
                for (program, order), line in lines_of(tables[title]).items()
            }
            labels = ("seconds of the processor", "relative L² error of the pressure inside 0.9 a")
            curves(panel, title, labels, lines)


def main(argv: list[str]) -> Tables:
    """Write the tables of a folder; returns them."""
    folder, tables = Path(argv[0]), {}
    for name in SCENES:
        if (folder / f"{name.replace(' ', '_')}_reference.json").exists():
            rows = rows_of(name, folder)
            tables |= {name: rows, f"{name}, equal errors": equal_errors(rows)}
    given = argparse.Namespace(output=folder.parent, document=None)
    return finish(given, "peers", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
