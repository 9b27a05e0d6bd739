"""Dolan's and Moré's profiles of the solvers and preconditioners over random scenes.

    ./run python3 benchmarks/solver_profiles.py [--quick] [--scenes 100] [--default]

Scenes are those of ``benchmarks.stress`` (boxes in 2D and 3D: single ones, stacks, rows, bridges,
apart; obstacles, slender, of moduli and units that differ, held by contact alone), every third with
Coulomb's friction, blocks with Tresca's, and beams without contact. A scene takes part if the
package says that it has a solution and the direct solver finds it.

A solve fails that ends in an error, in more than ``--steps`` steps, after more than ``--limit``
seconds (on one rank), or with an error above 100 rtol (and 100 times what rounding does) beside the
direct solution. Where rounding of the stiffness alone changes that by more than rtol no solver can
be right to rtol: such solves are left out. A profile ρ(τ) is the share of solves that a solver ends
for at most τ times the multiplications, by F and by the preconditioner, of the best one
(Mathematical Programming 91, 2002). Results go to results/solver_profiles.md and .json.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.stability_scenes import CELLS, beam, two_bodies, with_friction
from benchmarks.stress import meshes
from benchmarks.stress.judge import judged
from benchmarks.stress.package import solve_scene
from benchmarks.stress.random_scenes import random_scene
from benchmarks.stress.reference import Answer, Untorn
from benchmarks.stress.scene import Scene
from benchmarks.stress.solve import UnsettledError
from benchmarks.tools import command_line, finish, limited, say

# of scenes with contact and without, the default first
SOLVERS = {
    "contact": ["newton, dirichlet", "newton, lumped", "newton, none", "smalse, none"],
    "no contact": ["pcpg, dirichlet", "pcpg, lumped", "pcpg, none"],
}
TOLERANCES = (1e-4, 1e-8)
WITHIN = 100.0  # of rtol, and of the noise of the direct solution
NEAR = 2.0  # of the best
WHY = ", failed"  # of a column
TAUS = (1.0, 1.5, 2.0, 4.0, 8.0, 16.0)
BEAMS, MODULI = (2.0, 5.0, 10.0, 20.0, 50.0), (1.0, 1e2, 1e4)


def scenes(count: int, seed: int, quick: bool) -> Iterator[tuple[str, Scene]]:
    """Names and scenes: random ones, every third with Coulomb's friction; blocks with Tresca's.

    Tresca's law acts on open nodes, too, if they are within reach: random gaps would decide that.
    """
    for k in range(seed, seed + count):
        scene = random_scene(k)
        yield str(k), with_friction(scene, "coulomb", 0.1 + 0.1 * (k % 5)) if k % 3 == 0 else scene
    for cell in CELLS[:1] if quick else CELLS:
        for slenderness in BEAMS[:1] if quick else BEAMS:
            yield f"beam {cell} {slenderness:g}", beam(cell, slenderness)
        for ratio in MODULI[:1] if quick else MODULI:
            scene = two_bodies(cell, ratio, 1.0)
            yield f"blocks {cell} {ratio:g}", with_friction(scene, "tresca", 1e-3)


def cost(scene: Scene, g: meshes.Grid, answer: Answer | None) -> tuple[int | None, str]:
    """Multiplications of a solve, None where it fails; and why. Collective."""
    outcome = solve_scene(scene, g, MPI.COMM_WORLD)
    why = outcome.error
    if answer is not None and not why:
        found = judged(scene, g, outcome, answer)
        if "u" in found:
            wrong = np.maximum(found["errors"], found["jump"])
            # a body that does not move has what rounding of its points makes of that
            noise = np.maximum(found["noise"], found["of points"])
            if np.any(wrong > WITHIN * np.maximum(scene.options["tfeti_rtol"], noise)):
                why = f"wrong by {found['u']:.1e}"
    why = MPI.COMM_WORLD.bcast(why)
    return None if why else outcome.report["F"] + outcome.report["S"], why


def direct(scene: Scene, g: meshes.Grid, steps: int, limit: int) -> tuple[bool, Answer | None]:
    """Whether a scene takes part, and its direct solution on rank 0. Collective."""
    comm, answer = MPI.COMM_WORLD, None
    scene = replace(scene, options={"tfeti_rtol": 1e-2, "tfeti_max_it": steps})
    try:
        outcome = limited(limit, lambda: solve_scene(scene, g, comm))
        if comm.rank == 0 and not outcome.error.startswith(("NoSolutionError", "InputError")):
            answer = limited(limit, Untorn(scene, g, outcome.mu, outcome.lmbda).answer)
    except (TimeoutError, UnsettledError, RuntimeError, np.linalg.LinAlgError) as error:
        print("no direct solution:", error, flush=True)
    return comm.bcast(answer is not None and answer.u is not None), answer


def study(name: str, scene: Scene, arguments: Any) -> list[dict[str, Any]]:
    """A row for each tolerance, with the costs of all solvers; none if the scene takes no part."""
    solvers = SOLVERS["contact" if scene.walls or scene.pairs else "no contact"]
    g, rows = meshes.grid(scene), list[dict[str, Any]]()
    takes_part, answer = direct(scene, g, arguments.steps, arguments.limit)
    known = answer is not None and answer.noise is not None
    noise = MPI.COMM_WORLD.bcast(float(answer.noise.max()) if known else 0.0)
    for rtol in (rtol for rtol in TOLERANCES if takes_part and noise <= rtol):
        rows.append({"scene": name, "rtol": rtol})
        for key in solvers[:1] if arguments.default else solvers:
            options = dict(zip(("tfeti_qp_type", "tfeti_pc_type"), key.split(", "), strict=True))
            options |= {"tfeti_rtol": rtol, "tfeti_max_it": arguments.steps}
            solve = partial(cost, replace(scene, options=options), g, answer)
            try:
                found = limited(arguments.limit, solve)
            except TimeoutError as late:
                found = None, str(late)
            rows[-1] |= {key: found[0], key + WHY: found[1].replace("|", "/")}
        say(rows[-1])
    return rows


def tabled(rows: list[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """A profile of each solver, with and without contact, and rows in which the default is poor."""
    tables, poor = dict[str, list[dict[str, Any]]](), list[dict[str, Any]]()
    for title, solvers in SOLVERS.items():
        if not (own := [row for row in rows if solvers[0] in row]):
            continue
        tried = [key for key in solvers if key in own[0]]
        values = np.array([[np.inf if row[k] is None else row[k] for k in tried] for row in own])
        values = np.maximum(values, 1.0)  # what no solver needs anything for is a tie
        best = values.min(axis=1)
        times = values / np.where(np.isinf(best), 1.0, best)[:, None]
        tables[title] = [
            {"solver": key, "solves": len(own), "failed": int(np.isinf(of).sum())}
            | {f"τ = {tau:g}": float(np.mean(of <= tau)) for tau in TAUS}
            for key, of in zip(tried, times.T, strict=True)
        ]
        for k in np.flatnonzero(times[:, 0] > NEAR):
            named = {name: own[k][name] for name in ("scene", "rtol")}
            named["best"] = None if np.isinf(best[k]) else int(best[k])
            poor.append({**named, "default": own[k][tried[0]], "why": own[k][tried[0] + WHY]})
    if poor:
        tables["default failed, or needs more than twice the best"] = poor
    return tables


def main(argv):
    """Solve all scenes by all solvers and write the profiles; returns the tables."""
    # seconds of a solve, whole; only the default solvers
    given = {"scenes": 100, "seed": 0, "steps": 1000, "limit": 60, "default": False}
    arguments, _ = command_line(__doc__, argv, **given)
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    count = 2 if arguments.quick else arguments.scenes
    rows: list[dict[str, Any]] = []
    for name, scene in scenes(count, arguments.seed, arguments.quick):
        rows += study(name, scene, arguments)
    logging.disable(before)
    rank = MPI.COMM_WORLD.rank
    tables = MPI.COMM_WORLD.bcast(tabled(rows) if rank == 0 else None)
    return finish(arguments, "solver_profiles", tables)


if __name__ == "__main__":
    main(sys.argv[1:])
