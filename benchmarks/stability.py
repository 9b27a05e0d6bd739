"""What hard scenes cost, and whether their answers are right: ladders from friendly to hard.

    ./run python3 benchmarks/stability.py [--quick] [--groups moduli nu ...] [--cells triangle ...]

Each scene is solved by the package, and directly on the untorn mesh (``benchmarks.stress``: dense
programs and active sets, with friction Alart's and Curnier's method). A row has what came out:

* ``right``: converged, and the displacement of each body in the maximum norm within 100 rtol and
  within 100 times what the report estimates its error to be, or within 100 times what rounding of
  the stiffness does to the direct solution;
* ``warned``: converged, not that right, and the report's warnings or notes say so;
* ``named``: an error with its cause; ``no solution``: the same, and there is none;
* in capitals what must not occur: ``SILENT``, a wrong answer that nobody warns of, ``WRONG
  VERDICT``, a solution where there is none or the other way round, ``CRASH``.

``F`` are multiplications by F, ``of friendly`` those over the ones of the friendly scene,
``error`` the largest error of a body, ``estimate`` what the report says of it. Results go to
results/stability.md and .json.
"""

from __future__ import annotations

import logging
import sys
from typing import Any

from mpi4py import MPI

from benchmarks.stability_scenes import CELLS, LADDERS, Ladder, label
from benchmarks.stress.judge import run_scene
from benchmarks.stress.scene import Scene
from benchmarks.tools import Tables, command_line, finish, say

WITHIN = 100.0  # of rtol, of the report's estimate, of the noise of the direct solution
QUICK = ("triangle",)
GROUPS = tuple(dict.fromkeys(ladder.group for ladder in LADDERS))


def verdict(scene: Scene, row: dict[str, Any]) -> str:
    """What came out, in one word."""
    if scene.joined and row["error"].startswith("NoSolutionError"):
        return "named"  # bodies that only nodes join are not joined, docs/theory.md
    if "u" not in row:
        return {"not converged": "named", "right: no solution": "no solution"}.get(
            row["class"], row["class"]
        )
    claimed = min(scene.options["tfeti_rtol"], row["estimate"])
    allowed = max(claimed, row.get("noise", 0.0))
    if max(row["u"], row["jump"]) <= WITHIN * allowed:
        return "right"
    return "warned" if row["warnings"] else "SILENT"


def climb(ladder: Ladder, cell: str, quick: bool) -> list[dict[str, Any]]:
    """A row for each rung of a ladder."""
    values = list(ladder.values)
    rows: list[dict[str, Any]] = []
    for value in [values[0], values[-1]] if quick else values:
        scene = ladder.rung(cell, value)
        found = run_scene(scene, MPI.COMM_WORLD)
        row = {"scene": ladder.name, "cell": cell, "value": label(ladder, value)}
        if MPI.COMM_WORLD.rank == 0:
            row |= {"verdict": verdict(scene, found), "F": found.get("F", 0)}
            row["of friendly"] = row["F"] / max((rows or [row])[0]["F"], 1)
            row |= {"error": found.get("u", "-"), "estimate": found.get("estimate", "-")}
            row["size"] = found.get("size", "-")
            row["says"] = said(found)
            say(row)
        rows.append(row)
    return rows


def said(found: dict[str, Any]) -> str:
    """The error, or the warnings."""
    text = found["error"] or found.get("reference", "") or "; ".join(found.get("warnings", []))
    return " ".join(text.split()).replace("|", "/")


def locking(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The largest displacement of degree 1 over that of degree 2, on the same cells."""
    size = {(row["scene"], row["cell"], row["value"]): row["size"] for row in rows}
    return [
        {"cell": cell, "nu": nu, "P1 over P2": size["P1", cell, nu] / value}
        for (scene, cell, nu), value in size.items()
        if scene == "P2"
    ]


def ladders(tables: Tables) -> Tables:
    """A row for each ladder: of all cells the multiplications over the friendly scene's."""
    found = {title: rows for title, rows in tables.items() if title == "locking"}
    found["ladders"] = []
    for all_rows in (rows for title, rows in tables.items() if title not in found):
        for name in dict.fromkeys(row["scene"] for row in all_rows):
            rows = [row for row in all_rows if row["scene"] == name]
            right = [row for row in rows if row["verdict"] == "right"]
            rungs = dict.fromkeys(row["value"] for row in right)
            times = [max(r["of friendly"] for r in right if r["value"] == v) for v in rungs]
            others = [f"{r['cell']} {r['value']}: {r['verdict']}" for r in rows if r not in right]
            found["ladders"].append(
                {
                    "ladder": name,
                    "rungs": "; ".join(map(str, rungs)),
                    "times": "; ".join(f"{most:.1f}" for most in times),
                    "largest error": f"{max(row['error'] for row in right):.0e}",
                    "not right": ", ".join(others),
                }
            )
    return found


def main(argv):
    """Climb the ladders and write what came out; returns the tables."""
    arguments, _ = command_line(__doc__, argv, groups=GROUPS, cells=CELLS)
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    cells = arguments.cells or (QUICK if arguments.quick else CELLS)
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in arguments.groups or GROUPS}
    for ladder in LADDERS:
        if ladder.group in tables:
            for cell in ladder.cells:
                if cell in cells:
                    tables[ladder.group] += climb(ladder, cell, arguments.quick)
    logging.disable(before)
    if MPI.COMM_WORLD.rank == 0 and "nu" in tables:
        tables["locking"] = locking(tables["nu"])
    tables = MPI.COMM_WORLD.bcast({title: rows for title, rows in tables.items() if rows})
    return finish(arguments, "stability", tables, shown=ladders)


if __name__ == "__main__":
    found = main(sys.argv[1:])
    sys.exit(any(row.get("verdict", "").isupper() for rows in found.values() for row in rows))
