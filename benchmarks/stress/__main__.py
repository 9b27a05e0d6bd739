"""Random scenes against an LP and an independent solver.

    ./run python3 -m benchmarks.stress --scenes 1000 --seed 0
    ./run mpirun -n 4 python3 -m benchmarks.stress --only 17

Every scene is solved by the package and by ``reference`` and put into a class (see ``judge``):
right, not converged, WRONG, and so on; classes in capitals must not occur. Rows go to
results/stress.json as they come, their summary is printed. Ends with 1 if a class in capitals
occurred.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from mpi4py import MPI

from benchmarks.stress.judge import run_scene
from benchmarks.stress.random_scenes import random_scene


def main(argv: list[str]) -> list[dict[str, Any]]:
    """Run scenes; returns their rows, complete on rank 0. Collective."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=100, help="how many random scenes")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--only", nargs="*", type=int, help="seeds of scenes")
    parser.add_argument("--output", type=Path, default=Path("results"))
    arguments = parser.parse_args(argv)
    comm, rows = MPI.COMM_WORLD, list[dict[str, Any]]()
    logging.disable(logging.WARNING)
    arguments.output.mkdir(parents=True, exist_ok=True)
    for seed in arguments.only or range(arguments.seed, arguments.seed + arguments.scenes):
        rows.append({"scene": seed, **run_scene(random_scene(seed), comm)})
        if comm.rank == 0:
            text = json.dumps(rows, indent=1, default=float)
            (arguments.output / "stress.json").write_text(text + "\n")
    logging.disable(logging.NOTSET)
    if comm.rank == 0:
        for name, count in Counter(row["class"] for row in rows).most_common():
            print(f"{count:6} {name}")
        for row in rows:
            if not row["class"].startswith("right"):
                text = row.get("error") or row.get("reference") or row.get("reason", "")
                print(row["scene"], row["class"], " ".join(text.split())[:160], flush=True)
    return rows


if __name__ == "__main__":
    wrong = any(row["class"].split(":")[0].isupper() for row in main(sys.argv[1:]))
    sys.exit(int(MPI.COMM_WORLD.bcast(wrong, root=0)))
