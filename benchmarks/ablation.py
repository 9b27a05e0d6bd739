"""Worth of each mechanism: what user scenes cost, and answer, without it.

    ./run python3 -m benchmarks.ablation [--quick] [--only SCENE ...] [--mechanisms NAME ...]

A mechanism stays in the core only if at least two scenes need a tenth more multiplications without
it, or fail.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

from mpi4py import MPI
from petsc4py import PETSc

import demos
from benchmarks.stability_scenes import LADDERS
from benchmarks.stress.judge import run_scene
from benchmarks.tools import Tables, command_line, finish, say
from tfeti_dolfinx import ContactProblem
from tfeti_dolfinx.mesh.partition import PARTITIONERS
from tfeti_dolfinx.options import MECHANISMS

# name, demo and its arguments, or a rung of a ladder of stability.py: its name, cells and value
SCENES = {
    "Hertz 2D": "hertz_2d",
    "cylinder on block": "cylinder_on_block_2d",
    "semicoercive": "semicoercive_2d",
    "talk's Hertz": "talk_hertz_2d --quick",
    "Tresca 2D": "tresca_2d",
    "belt": "belt_2d",
    "four bodies": "four_bodies_2d",
    "Cattaneo": "cattaneo_mindlin_2d",
    "unloading": "unloading_2d",
    "clamps": "clamped_connection_3d",
    "Tresca 3D": "tresca_3d --subdomains 64",
    "stacked blocks": "stacked_blocks_3d",
    "cube": "cube_3d --subdomains 64",
    "no contact": "linear_3d",
    "moduli 1 : 1000": "linear_3d --ratio 1000",
    "sphere": "sphere_on_block_3d --quick",
    "Mindlin": "mindlin_3d --quick",
    "ball bearing": "ball_bearing_3d --quick",
    "Hertz 3D": "hertz_3d --quick",
    "bars": "impact_of_bars --quick",
    "falling balls": "falling_balls_3d --quick",
    "springs": "linear_3d --springs 1e-4",
    "cube on springs": "cube_3d --subdomains 64 --springs 1e-2",
    "flat block 1 : 100": "ladder flat block, hexahedron, 100",
    "moduli of cells 1 : 1e6": "ladder cells, hexahedron, 1e6",
    "three pairs of a node": "ladder pairs of a node, hexahedron, 3",
    "the same, tetrahedra": "ladder pairs of a node, tetrahedron, 3",
}
# beside those of -tfeti_without what decompose and read_gmsh do by default
KNOWN = {**MECHANISMS, "round_parts": "parts of round shape, not those of bisection"}
QUICK = ("semicoercive", "talk's Hertz")


@dataclass
class Counts:
    """Totals over all solves of a scene."""

    F: int = 0
    S: int = 0
    u: float = 0.0
    reasons: Counter[str] = field(default_factory=Counter)


@contextlib.contextmanager
def counted() -> Iterator[Counts]:
    """Count the multiplications of all solves within."""
    counts, solve = Counts(), ContactProblem.solve

    def solve_and_count(problem: ContactProblem, *given: Any, **named: Any) -> Any:
        try:
            return solve(problem, *given, **named)
        finally:
            report = problem.report
            counts.F += report.F_multiplications
            counts.S += report.preconditioner_multiplications
            counts.reasons[report.converged_reason] += 1
            counts.u = float(problem.u.x.petsc_vec.norm())

    with patch.object(ContactProblem, "solve", solve_and_count):
        yield counts


def run(scene: str, without: str) -> Counts:
    """Run a demo or a rung without a mechanism; what it raises stands among the reasons."""
    name, *words = scene.split()
    round_parts = "bisection" if without == "round_parts" else "round"
    options = PETSc.Options()
    options.setValue("-tfeti_without", without if without in MECHANISMS else "")
    with (
        patch.dict(PARTITIONERS, round=PARTITIONERS[round_parts]),
        contextlib.redirect_stdout(io.StringIO()),
        counted() as counts,
    ):
        try:
            if name == "ladder":
                title, cell, value = scene.removeprefix("ladder ").split(", ")
                (ladder,) = (one for one in LADDERS if one.name == title)
                run_scene(ladder.rung(cell, float(value)), MPI.COMM_WORLD)
            else:
                demos.names_of(name, words)
        except Exception as error:
            counts.reasons[type(error).__name__] += 1
    options.delValue("-tfeti_without")
    return counts


def compared(counts: Counts, whole: Counts) -> tuple[str, str]:
    """Return the multiplications over those with all mechanisms, or what has failed; and |du|."""
    ratio = f"{(counts.F + counts.S) / max(whole.F + whole.S, 1):.2f}"
    failed = counts.reasons - whole.reasons
    change = abs(counts.u - whole.u) / max(whole.u, 1e-300)
    return ", ".join(failed) if failed else ratio, f"{change:.0e}"


def main(argv: list[str]) -> Tables:
    """Run all scenes without each mechanism; returns the tables."""
    arguments, _ = command_line(__doc__, argv, only=SCENES, mechanisms=KNOWN)
    names = arguments.only or (QUICK if arguments.quick else tuple(SCENES))
    mechanisms = arguments.mechanisms or tuple(KNOWN)
    tables: Tables = {"Multiplications": [], "Change of u": []}
    for name in names:
        whole = run(SCENES[name], "")
        row = {"scene": name, "F + S": f"{whole.F} + {whole.S}"}
        found = {m: compared(run(SCENES[name], m), whole) for m in mechanisms}
        tables["Multiplications"].append(row | {m: cost for m, (cost, _) in found.items()})
        tables["Change of u"].append(row | {m: change for m, (_, change) in found.items()})
        say(tables["Multiplications"][-1])
    tables["Mechanisms"] = [{"name": f"`{m}`", "what": KNOWN[m]} for m in mechanisms]
    return finish(arguments, "ablation", tables)


if __name__ == "__main__":
    main(sys.argv[1:])
