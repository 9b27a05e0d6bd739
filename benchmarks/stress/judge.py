"""The package's outcome beside the independent answer: a verdict on a scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from benchmarks.stress import meshes
from benchmarks.stress.package import Outcome, solve_scene
from benchmarks.stress.reference import Answer, Untorn, body_errors, body_sizes, resultants
from benchmarks.stress.scene import Scene
from benchmarks.stress.solve import UnsettledError

RIGHT = 1e-4  # error of u that must hold at rtol 1e-6
OF_LOAD = 1e-2  # contact forces below are small
OF_NOISE = 100.0  # beyond what rounding in K explains

NAMED = ("InputError", "NoSolutionError", "ConvergenceError", "FactorError", "TfetiError")


def run_scene(scene: Scene, comm: MPI.Intracomm) -> dict[str, Any]:
    """Solve and judge a scene. Collective; the row is complete on rank 0."""
    g = meshes.grid(scene)
    outcome = solve_scene(scene, g, comm)
    row: dict[str, Any] = {"class": "", "error": outcome.error, "seconds": outcome.seconds}
    if comm.rank == 0:
        row |= {"note": scene.note, "cell": scene.cell, **outcome.report}
        if outcome.disagree:
            row |= {"class": "RANKS DISAGREE", "error": outcome.disagree}
        else:
            row |= judged(scene, g, outcome)
    return row


def judged(
    scene: Scene, g: meshes.Grid, outcome: Outcome, answer: Answer | None = None
) -> dict[str, Any]:
    """The class of an outcome, and its errors; the answer is found if it is not given."""
    kind = outcome.error.split(":")[0]
    if outcome.error and kind not in NAMED:
        return {"class": "CRASH"}
    if outcome.mu is None:
        return {"class": "refused"}
    try:
        if answer is None:
            answer = Untorn(scene, g, outcome.mu, outcome.lmbda).answer()
    except (UnsettledError, RuntimeError, np.linalg.LinAlgError) as error:
        return {"class": "not judged", "reference": f"{type(error).__name__}: {error}"}
    row: dict[str, Any] = {"verdict": answer.verdict}
    if answer.noise is not None:
        row["noise"] = float(answer.noise.max())
    if answer.verdict == "borderline":
        return {**row, "class": "not judged"}
    if outcome.error:
        return {**row, "class": _named(answer.verdict, outcome.error)}
    if answer.verdict != "solvable":
        return {**row, "class": "WRONG VERDICT"}
    return {**row, **_compared(scene, answer, outcome)}


def _named(verdict: str, error: str) -> str:
    """The class of a scene in which the package raised an error of its own."""
    kind = error.split(":")[0]
    prescribed = kind == "InputError" and verdict == "contradiction"
    if kind == "NoSolutionError" or prescribed or "DIVERGED_CONTRADICTION" in error:
        return "right: no solution" if verdict != "solvable" else "WRONG VERDICT"
    if kind == "InputError":
        return "refused"
    return "not converged" if verdict == "solvable" else "NO VERDICT"


def _compared(scene: Scene, answer: Answer, outcome: Outcome) -> dict[str, Any]:
    """Errors of u per body and of the contact resultants, penetration, and their class."""
    node = _nodes(scene, answer, outcome)
    u = np.zeros_like(answer.u)
    u[node] = outcome.u
    scale = body_sizes(answer, u)
    jump = np.abs(outcome.u - u[node]).max(axis=1) / scale[outcome.body]
    error = body_errors(answer, u)
    resultant = resultants(answer, answer.forces)
    size = max(np.abs(answer.forces).max(), np.abs(resultant).max(), OF_LOAD * answer.load)
    force = np.abs(outcome.forces - resultant).max() / (size or 1.0)
    inside = answer.rows @ u.ravel() - answer.gap
    most = max(np.abs(answer.u).max(), answer.point_noise.max())
    penetration = inside.max(initial=0.0) / most
    row = {
        "u": float(error.max()),
        "size": float(np.abs(u).max()),
        "u of all": float((error * scale).max() / scale.max()),
        "errors": [float(e) for e in error],
        "jump": float(jump.max()),
        "force": float(force),
        "overlap": float(penetration),
    }
    own = np.maximum(answer.rows @ answer.u.ravel() - answer.gap, 0.0).max(initial=0.0)
    # what the reference itself overlaps by, and what is no motion
    of_points = np.maximum(own, answer.point_noise) / scale
    row["of points"] = [float(share) for share in of_points]
    noise = np.maximum(answer.noise, of_points)
    allowed = np.maximum(RIGHT, OF_NOISE * noise)
    copies = np.array([jump[outcome.body == b].max() for b in range(len(scene.bodies))])
    worst = np.maximum(np.maximum(error, copies), penetration)
    if np.any(worst > allowed) or not np.all(np.isfinite(worst)):
        of_one = row["u of all"] <= RIGHT and force <= RIGHT
        found = "WRONG OF A BODY" if of_one else "WRONG"
    elif force > max(allowed.max(), OF_NOISE * answer.force_noise / (size or 1.0)):
        found = "WRONG FORCE"
    else:
        found = "right" if max(worst.max(), force) <= RIGHT else "right but for rounding"
    if found.isupper() and np.any(own > RIGHT * scale):
        found = "not judged"  # the reference has not kept the conditions itself
    return {**row, "class": found}


def _nodes(scene: Scene, answer: Answer, outcome: Outcome) -> np.ndarray:
    """Node of the untorn mesh for each torn copy."""
    found = np.zeros(len(outcome.x), dtype=int)
    for b, box in enumerate(scene.bodies):
        size = np.array(box.high) - np.array(box.low)
        own, torn = np.flatnonzero(answer.body == b), np.flatnonzero(outcome.body == b)
        if scene.joined:
            own = np.arange(len(answer.x))
        tree = cKDTree(answer.x[own, : scene.gdim] / size)
        away, k = tree.query(outcome.x[torn, : scene.gdim] / size)
        assert away.max() < 1e-6
        found[torn] = own[k]
    return found
