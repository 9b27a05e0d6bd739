"""Dolan's and Moré's profiles of the solvers and preconditioners over random scenes.

    ./run python3 benchmarks/solver_profiles.py [--quick] [--scenes 100] [--processor]

Scenes are those of ``benchmarks.stress`` (boxes in 2D and 3D: single ones, stacks, rows, bridges,
apart; obstacles, slender, of moduli and units that differ, held by contact alone), every third with
Coulomb's friction, blocks with Tresca's, and beams without contact. A scene takes part if the
checks of the package say that it has a solution.

A solve fails that ends in an error, in more than ``--steps`` steps, or with an error above 100 rtol
(and 100 times what rounding does) beside a direct solve. A profile ρ(τ) is the share of scenes that
a solver solves for at most τ times the cost of the best one (Mathematical Programming 91, 2002):
cost in multiplications by F and by the preconditioner, and in seconds of the solver. Results go to
results/solver_profiles.md, .json and .png.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.pictures import picture
from benchmarks.stability_scenes import CELLS, with_friction
from benchmarks.stress import ladders, meshes
from benchmarks.stress.judge import judged
from benchmarks.stress.package import solve_scene
from benchmarks.stress.random_scenes import random_scene
from benchmarks.stress.reference import Answer, Untorn
from benchmarks.stress.scene import Scene
from benchmarks.tools import choose_clock, command_line, configure_clock, finish

PRECONDITIONERS = ("none", "lumped", "dirichlet")
CONTACT = [(qp, pc) for qp in ("newton", "smalse") for pc in PRECONDITIONERS]
LINEAR = [("pcpg", pc) for pc in PRECONDITIONERS]
DEFAULT = {True: ("newton", "dirichlet"), False: ("pcpg", "dirichlet")}
TOLERANCES = (1e-4, 1e-8)
WITHIN = 100.0  # of rtol, and of the noise of the direct solution
NEAR = 2.0  # of the best
TAUS = (1.0, 1.5, 2.0, 4.0, 8.0, 16.0)
BEAMS, MODULI = (2.0, 5.0, 10.0, 20.0, 50.0), (1.0, 1e2, 1e4)


def configure(parser):
    parser.add_argument(
        "--scenes", type=int, default=100, help="how many, but for blocks and beams"
    )
    parser.add_argument("--steps", type=int, default=1000, help="most steps of a solver")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    configure_clock(parser)


def scenes(count: int, seed: int, quick: bool) -> Iterator[tuple[str, Scene]]:
    """Names and scenes: random ones, every third with Coulomb's friction; blocks with Tresca's.

    Tresca's law acts on open nodes, too, if they are within reach: random gaps would decide that.
    """
    for k in range(seed, seed + count):
        scene = random_scene(k)
        yield str(k), with_friction(scene, "coulomb", 0.1 + 0.1 * (k % 5)) if k % 3 == 0 else scene
    for cell in CELLS[:1] if quick else CELLS:
        for slenderness in BEAMS[:1] if quick else BEAMS:
            yield f"beam {cell} {slenderness:g}", ladders.beam(cell, slenderness)
        for ratio in MODULI[:1] if quick else MODULI:
            scene = ladders.two_bodies(cell, ratio, 1.0)
            yield f"blocks {cell} {ratio:g}", with_friction(scene, "tresca", 1e-3)


def described(name: str, scene: Scene) -> dict[str, Any]:
    """Columns on a scene."""
    laws = {c.friction[0] for c in (*scene.walls, *scene.pairs) if c.friction}
    return {
        "scene": name,
        "kind": scene.note or name.split()[0],
        "cell": scene.cell,
        "bodies": len(scene.bodies),
        "friction": ", ".join(laws) or "-",
    }


def cost(
    scene: Scene, g: meshes.Grid, answer: Answer | None, steps: int, work: tuple[str, str, float]
):
    """Multiplications and seconds of a solve, None where it fails; and why."""
    qp_type, pc_type, rtol = work
    options = {"tfeti_qp_type": qp_type, "tfeti_pc_type": pc_type, "tfeti_rtol": rtol}
    scene = replace(scene, options={**options, "tfeti_max_it": steps})
    outcome = solve_scene(scene, g, MPI.COMM_WORLD)
    why = outcome.error
    if MPI.COMM_WORLD.rank == 0 and not why and answer is not None:
        found = judged(scene, g, outcome, answer)
        allowed = WITHIN * max(rtol, found["noise"])
        if "u" in found and max(found["u"], found["jump"]) > allowed:
            why = f"wrong by {found['u']:.1e}"
    why = MPI.COMM_WORLD.bcast(why)
    report = outcome.report
    if why:
        return None, None, why
    return report["F"] + report["S"], report["qp"], ""


def takes_part(scene: Scene, g: meshes.Grid):
    """The direct answer of a scene that has a solution, or what the package says there is none."""
    outcome = solve_scene(replace(scene, options={"tfeti_rtol": 1e-2}), g, MPI.COMM_WORLD)
    if outcome.error.startswith(("NoSolutionError", "InputError")):
        return False, None
    answer = None
    if MPI.COMM_WORLD.rank == 0:
        try:
            answer = Untorn(scene, g, outcome.mu, outcome.lmbda).answer()
        except Exception as error:  # the solvers are still compared
            print("no direct answer:", error, flush=True)
        if answer is not None and answer.u is None:
            answer = None
    return True, answer


def study(name: str, scene: Scene, steps: int) -> list[dict[str, Any]]:
    """A row for each tolerance."""
    g, rows = meshes.grid(scene), []
    part, answer = takes_part(scene, g)
    if not part:
        return rows
    solvers = CONTACT if scene.walls or scene.pairs else LINEAR
    for rtol in TOLERANCES:
        row = {**described(name, scene), "rtol": rtol}
        for qp_type, pc_type in solvers:
            mults, seconds, why = cost(scene, g, answer, steps, (qp_type, pc_type, rtol))
            key = f"{qp_type}, {pc_type}"
            row |= {key: mults, f"{key}, s": seconds, f"{key}, failed": why}
        rows.append(row)
        if MPI.COMM_WORLD.rank == 0:
            counts = [row[f"{qp}, {pc}"] for qp, pc in solvers]
            failed = [row[f"{qp}, {pc}, failed"][:110] for qp, pc in solvers[2:3]]
            print(name, row["kind"], row["friction"], rtol, *counts, *failed, flush=True)
    return rows


def profiles(rows: list[dict[str, Any]], solvers, suffix: str = "") -> list[dict[str, Any]]:
    """A row for each solver: failures, and its profile at a few τ."""
    keys = [f"{qp}, {pc}" for qp, pc in solvers]
    values = np.array(
        [
            [np.inf if row[key + suffix] is None else row[key + suffix] for key in keys]
            for row in rows
        ]
    ).reshape(len(rows), len(keys))
    best = np.min(values, axis=1, keepdims=True)
    # what no solver needs anything for is a tie
    ratio = np.where(
        np.isinf(values), np.inf, values / np.where(np.isinf(best), 1.0, np.maximum(best, 1e-9))
    )
    ratio = np.where((values <= 1e-9) & np.isfinite(values), 1.0, ratio)
    return [
        {
            "solver": key,
            "solves": len(rows),
            "failed": int(np.isinf(values[:, k]).sum()),
            **{f"τ = {tau:g}": float(np.mean(ratio[:, k] <= tau)) for tau in TAUS},
        }
        for k, key in enumerate(keys)
    ]


def tabled(rows: list[dict[str, Any]], unit: str) -> dict[str, list[dict[str, Any]]]:
    """Profiles of multiplications and seconds, and what failed by default."""
    tables: dict[str, list[dict[str, Any]]] = {}
    for has_contact, solvers in ((True, CONTACT), (False, LINEAR)):
        own = [row for row in rows if "{}, {}".format(*solvers[0]) in row]
        if own:
            what = "contact" if has_contact else "no contact"
            tables[f"{what}, multiplications"] = profiles(own, solvers)
            tables[f"{what}, {unit}"] = profiles(own, solvers, ", s")
    worst = []
    for row in rows:
        for default in DEFAULT.values():
            key = "{}, {}".format(*default)
            others = [row[k] for k in row if k + ", failed" in row and row[k] is not None]
            if key in row and (row[key] is None or row[key] > NEAR * min(others)):
                names = ("scene", "kind", "cell", "bodies", "friction", "rtol")
                least = min(others, default="-")
                worst.append(
                    {**{n: row[n] for n in names}, "default": row[key] or "-", "best": least}
                    | {"why": row[f"{key}, failed"].replace("|", "/")}
                )
    if worst:
        tables["default failed, or needs more than twice the best"] = worst
    return tables


def draw(path, tables):
    """The profiles as steps."""
    shown = {title: rows for title, rows in tables.items() if "τ = 1" in rows[0]}
    with picture(path, len(shown)) as axes:
        for panel, (title, rows) in zip(axes, shown.items(), strict=True):
            for row in rows:
                panel.step(
                    TAUS, [row[f"τ = {tau:g}"] for tau in TAUS], where="post", label=row["solver"]
                )
            panel.set_xscale("log", base=2)
            panel.set_ylim(0.0, 1.02)
            panel.set_xlabel("τ, times the best")
            panel.set_title(title, fontsize="medium")
            panel.grid(alpha=0.3)
            panel.legend(fontsize="small")


def main(argv):
    """Solve all scenes by all solvers and write the profiles; returns the tables."""
    arguments, _ = command_line(__doc__, argv, configure)
    unit, before = choose_clock(arguments), logging.root.manager.disable
    logging.disable(logging.WARNING)
    count, rows = 4 if arguments.quick else arguments.scenes, []
    for name, scene in scenes(count, arguments.seed, arguments.quick):
        rows += study(name, scene, arguments.steps)
    logging.disable(before)
    rank = MPI.COMM_WORLD.rank
    tables = MPI.COMM_WORLD.bcast(tabled(rows, unit) if rank == 0 else None)
    return finish(arguments.output, "solver_profiles", tables, draw, rank)


if __name__ == "__main__":
    main(sys.argv[1:])
