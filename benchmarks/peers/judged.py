"""What the peers' programs share: a mesh's loaded length, repeats, and the file that they write."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# processor seconds up to which a solve is repeated, and how often
SHORT, REPEATS = 3.0, 5


def length(data: Any) -> float:
    """The length of the loaded top."""
    ends = data["points"][data["top"][:, :2]]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def facets_on(on: Any) -> Any:
    """Facets of triangles whose ends are on a surface: cells, and corners opposite."""
    cells = np.flatnonzero(on.sum(axis=1) == 2)
    return np.stack((cells, np.argmin(on[cells], axis=1)), 1)


def processor(who: int) -> float:
    """Seconds of the processor of this process, or of those that it has waited for."""
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


def best(solve: Callable[[], Any], who: int = resource.RUSAGE_SELF) -> dict[str, Any]:
    """What a solve returns, and its seconds of the processor: the best of some."""
    runs: list[dict[str, Any]] = []
    while not runs or (runs[0]["seconds"] < SHORT and len(runs) < REPEATS):
        start, found = processor(who), solve()
        runs.append({"found": found, "seconds": processor(who) - start})
    peak = resource.getrusage(who).ru_maxrss / 1024
    return {**min(runs, key=lambda run: run["seconds"]), "MB": peak}


def write(file: str, program: str, run: dict[str, Any], unknowns: int, steps: int) -> None:
    """Write what a peer has found; ``run["found"]`` begins with places and pressures there."""
    x, pressure = (np.asarray(value).tolist() for value in run.pop("found")[:2])
    made = {"program": program, "unknowns": unknowns, "steps": steps, **run}
    print(made)
    Path(file).write_text(json.dumps({**made, "points": x, "values": pressure}))
