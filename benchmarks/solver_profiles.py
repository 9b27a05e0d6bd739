"""Dolan's and Moré's profiles of the solvers and preconditioners over random scenes.

    ./run python3 benchmarks/solver_profiles.py [--quick] [--scenes 100] [--default] [--resume]

Scenes are those of ``benchmarks.stress`` (boxes in 2D and 3D: single ones, stacks, rows, bridges,
apart; obstacles, slender, of moduli and units that differ, held by contact alone), every third with
Coulomb's friction, blocks with Tresca's, and beams without contact. A scene takes part if the
checks of the package say that it has a solution.

A solve fails that ends in an error, in more than ``--steps`` steps, after more than ``--limit``
seconds (on one rank), or with an error above 100 rtol (and 100 times what rounding does) beside a
direct solve. A scene with friction may have no equilibrium though forces within the law could
balance its load; where a mixed-integer program proves that (``benchmarks.stress.equilibrium``) no
solver can end, and what the default solver says is in a table of its own. Where rounding of the
stiffness alone changes the direct solution by more than rtol no solver can be right to rtol, and
may say so: such solves are in a table of their own. Where double precision has too few digits for
the direct solution with friction it is found in 240 (``benchmarks.stress.sliding_digits``). A
profile ρ(τ) is the share of solves that a solver ends for at most τ times the cost of the best one
(Mathematical Programming 91, 2002): cost in multiplications by F and by the preconditioner, and in
seconds of the solver. Each solve is written to results/solver_profiles.jsonl at once; ``--resume``
takes what is there, so that a run may be ended, or begin with the default solvers, ``--default``.
Results go to results/solver_profiles.md, .json and .png.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.pictures import picture
from benchmarks.stability_scenes import CELLS, with_friction
from benchmarks.stress import ladders, meshes
from benchmarks.stress.equilibrium import has_none
from benchmarks.stress.judge import judged
from benchmarks.stress.package import solve_scene
from benchmarks.stress.qp import UnsettledError
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
DIRECT = 600  # seconds of a direct solution, which may take 240 digits
TAUS = (1.0, 1.5, 2.0, 4.0, 8.0, 16.0)
NAMES = ("scene", "kind", "cell", "bodies", "friction", "rtol")
T = TypeVar("T")
BEAMS, MODULI = (2.0, 5.0, 10.0, 20.0, 50.0), (1.0, 1e2, 1e4)


def configure(parser):
    parser.add_argument(
        "--scenes", type=int, default=100, help="how many, but for blocks and beams"
    )
    parser.add_argument("--steps", type=int, default=1000, help="most steps of a solver")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--limit", type=int, default=60, help="most seconds of a solve, whole")
    parser.add_argument("--default", action="store_true", help="the default solvers only")
    parser.add_argument("--resume", action="store_true", help="go on with an earlier run's solves")
    configure_clock(parser)


class LateError(Exception):
    """Something has taken too long."""


def limited(seconds: int, run: Callable[[], T]) -> T:
    """What a function returns within so many seconds; on several ranks they do not count.

    Raises:
        LateError: It has not returned.
    """

    def ring(*_: object) -> None:
        raise LateError(f"beyond {seconds} s")

    if MPI.COMM_WORLD.size > 1:
        return run()
    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        return run()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


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
        if "u" in found:
            errors = np.maximum(found["errors"], found["jump"])
            # a body that does not move has what rounding of its points makes of that
            noise = np.maximum(found["noise"], found["of points"])
            if np.any(errors > WITHIN * np.maximum(rtol, noise)):
                why = f"wrong by {found['u']:.1e}"
    why = MPI.COMM_WORLD.bcast(why)
    report = outcome.report
    if why:
        return None, None, why
    return report["F"] + report["S"], report["qp"], ""


def takes_part(
    scene: Scene, g: meshes.Grid, steps: int, limit: int
) -> tuple[bool, Answer | None, bool]:
    """Whether the package says that a scene has a solution, the direct one, and if it has none."""
    scene = replace(scene, options={"tfeti_rtol": 1e-2, "tfeti_max_it": steps})
    try:
        outcome = limited(limit, lambda: solve_scene(scene, g, MPI.COMM_WORLD))
    except LateError:
        return True, None, False
    if outcome.error.startswith(("NoSolutionError", "InputError")):
        return False, None, False
    answer, none = None, False
    if MPI.COMM_WORLD.rank == 0:
        try:
            untorn = Untorn(scene, g, outcome.mu, outcome.lmbda)
            answer = limited(max(limit, DIRECT), untorn.answer)
        except UnsettledError as error:
            none = has_none(untorn)
            print("no equilibrium" if none else "no direct answer:", error, flush=True)
        except Exception as error:  # the solvers are still compared
            print("no direct answer:", error, flush=True)
        if answer is not None and answer.u is None:
            answer = None
    return True, answer, none


def study(name: str, scene: Scene, arguments: Any, known: dict[str, Any]) -> list[dict[str, Any]]:
    """A row for each solve of a scene, and one that says if it takes part; those known as they are.

    Args:
        name: Name of the scene.
        scene: The scene.
        arguments: Most steps and seconds, and which solvers.
        known: Rows of an earlier run by ``key``.
    """
    has_contact = bool(scene.walls or scene.pairs)
    solvers = CONTACT if has_contact else LINEAR
    solvers = [DEFAULT[has_contact]] if arguments.default else solvers
    works = [(qp, pc, rtol) for rtol in TOLERANCES for qp, pc in solvers]
    first = known.get(name, {})
    rows = [known[f"{name}, {work}"] for work in works if f"{name}, {work}" in known]
    if first and (not first["part"] or len(rows) == len(works)):
        return [first, *rows]
    g, noise, about = meshes.grid(scene), 0.0, described(name, scene)
    part, answer, none = takes_part(scene, g, arguments.steps, arguments.limit)
    if answer is not None and answer.noise is not None:
        noise = float(answer.noise.max())
    about |= {"none": none}
    found = [{"key": name, **about, "part": part, "direct": answer is not None, "noise": noise}]
    for work in works if part else []:
        if (row := known.get(f"{name}, {work}")) is None:
            row = {"key": f"{name}, {work}", **about, "rtol": work[2]}
            row |= {"solver": "{}, {}".format(*work), "noise": noise}
            try:
                run = partial(cost, scene, g, answer, arguments.steps, work)
                mults, seconds, why = limited(arguments.limit, run)
            except LateError as late:
                mults, seconds, why = None, None, str(late)
            row |= {"cost": mults, "seconds": seconds, "failed": why}
        found.append(row)
    return found


def gathered(solves: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each scene and tolerance, with the columns of all its solvers."""
    rows: dict[tuple[str, float], dict[str, Any]] = {}
    for solve in solves:
        if "solver" in solve:
            about = {name: solve[name] for name in (*NAMES, "noise")}
            about["none"] = solve.get("none", False)
            row = rows.setdefault((solve["scene"], solve["rtol"]), about)
            key = solve["solver"]
            row |= {key: solve["cost"], f"{key}, s": solve["seconds"]}
            row |= {f"{key}, failed": solve["failed"]}
    return list(rows.values())


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
    solvable = [row for row in rows if not row["none"]]
    reached = [row for row in solvable if row["noise"] <= row["rtol"]]
    for has_contact, solvers in ((True, CONTACT), (False, LINEAR)):
        default = "{}, {}".format(*DEFAULT[has_contact])
        own = [row for row in reached if default in row]
        # of a run that was ended, or of default solvers alone, what all rows have
        tried = [pair for pair in solvers if all("{}, {}".format(*pair) in row for row in own)]
        if own:
            what = "contact" if has_contact else "no contact"
            tables[f"{what}, multiplications"] = profiles(own, tried)
            tables[f"{what}, {unit}"] = profiles(own, tried, ", s")
    failed = "default failed, or needs more than twice the best"
    below = [row for row in solvable if row not in reached]
    none = [row for row in rows if row["none"]]
    for title, some in (
        (failed, reached),
        ("below what rounding leaves", below),
        ("no equilibrium", none),
    ):
        worst = [row for row in map(_beside_best, some) if row]
        if worst := [row for row in worst if title != failed or row["bad"]]:
            tables[title] = [{k: v for k, v in row.items() if k != "bad"} for row in worst]
    return tables


def _beside_best(row: dict[str, Any]) -> dict[str, Any]:
    """What the default solver and the best one need; nothing where the default was not tried."""
    for default in DEFAULT.values():
        key = "{}, {}".format(*default)
        others = [row[k] for k in row if k + ", failed" in row and row[k] is not None]
        if key in row:
            bad = row[key] is None or row[key] > NEAR * min(others)
            found = {"default": "-" if row[key] is None else row[key]}
            found |= {"best": min(others, default="-"), "bad": bad}
            why = row[f"{key}, failed"].replace("|", "/")
            return {**{name: row[name] for name in NAMES}, **found, "why": why}
    return {}


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
    count, rank = 2 if arguments.quick else arguments.scenes, MPI.COMM_WORLD.rank
    journal, solves, known = arguments.output / "solver_profiles.jsonl", [], {}
    if arguments.resume and journal.exists():
        lines = journal.read_text().splitlines()
        known = {row["key"]: row for row in map(json.loads, lines)}
    if rank == 0:
        journal.parent.mkdir(parents=True, exist_ok=True)
        journal.write_text("".join(json.dumps(row) + "\n" for row in known.values()))
    for name, scene in scenes(count, arguments.seed, arguments.quick):
        found = study(name, scene, arguments, known)
        solves += found
        if rank == 0 and (new := [row for row in found if row["key"] not in known]):
            with journal.open("a") as file:
                file.writelines(json.dumps(row) + "\n" for row in new)
            said = [
                (row["solver"], row["rtol"], row["cost"], row["failed"][:110]) for row in new[1:]
            ]
            print(name, found[0]["kind"], found[0]["friction"], *said, flush=True)
    rows = gathered(solves)
    logging.disable(before)
    tables = MPI.COMM_WORLD.bcast(tabled(rows, unit) if rank == 0 else None)
    return finish(arguments.output, "solver_profiles", tables, draw, rank)


if __name__ == "__main__":
    main(sys.argv[1:])
