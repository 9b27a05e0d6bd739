"""What the peers' programs share: repeats, and the file that they write."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# processor seconds up to which a solve is repeated, and how often
SHORT, REPEATS = 3.0, 3


def processor(who: int) -> float:
    """Seconds of the processor of this process, or of those that it has waited for."""
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


def best(solve: Callable[[], Any], who: int = resource.RUSAGE_SELF) -> dict[str, Any]:
    """What a solve returns, and its seconds of the wall and of the processor: the best of some."""
    runs = []
    while not runs or (runs[0]["processor"] < SHORT and len(runs) < REPEATS):
        start, used = time.perf_counter(), processor(who)
        found = solve()
        wall, used = time.perf_counter() - start, processor(who) - used
        runs.append({"found": found, "wall": wall, "processor": used})
    peak = resource.getrusage(who).ru_maxrss / 1024
    return {**min(runs, key=lambda run: run["processor"]), "MB": peak}


def write(file: str, version: str, run: dict[str, Any], *, unknowns: int, steps: int) -> None:
    """Write what a peer has found; ``run["found"]`` begins with points and pressures there."""
    points, pressure = run["found"][:2]
    across = np.asarray(points)[:, :-1]
    made = {
        "program": version,
        "unknowns": unknowns,
        "steps": steps,
        "seconds": run["processor"],
        "wall": run["wall"],
        "MB": run["MB"],
        "points": across.tolist(),
        "values": np.asarray(pressure).tolist(),
    }
    Path(file).write_text(json.dumps(made))
    print({name: value for name, value in made.items() if name not in ("points", "values")})
