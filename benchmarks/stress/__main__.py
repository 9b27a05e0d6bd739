"""Random scenes against an LP and an independent solver.

    ./run python3 -m benchmarks.stress --scenes 1000 --seed 0
    ./run mpirun -n 4 python3 -m benchmarks.stress --only 17

Every scene is solved by the package and by ``reference`` and put into a class (see ``judge``):
right, not converged, WRONG, and so on; classes in capitals must not occur. Rows go to
results/stress.json as they come, their summary is printed. Ends with 1 if a class in capitals
occurred.
"""

from __future__ import annotations

import sys
from typing import Any

from mpi4py import MPI

from benchmarks.stress.judge import run_scene
from benchmarks.stress.random_scenes import random_scene
from benchmarks.tools import over_seeds, wrong


def main(argv: list[str]) -> list[dict[str, Any]]:
    """Run scenes; returns their rows, complete on rank 0. Collective."""
    comm = MPI.COMM_WORLD
    return over_seeds(__doc__, argv, 100, "stress", lambda k: run_scene(random_scene(k), comm))


if __name__ == "__main__":
    sys.exit(wrong(main(sys.argv[1:])))
