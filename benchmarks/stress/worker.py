"""Runs scenes one after the other and writes a line of JSON for each; started by ``__main__``."""

from __future__ import annotations

import faulthandler
import gc
import json
import logging
import sys

import petsc4py

petsc4py.init(sys.argv[:1])

from mpi4py import MPI

from benchmarks.stress.judge import run_scene
from benchmarks.stress.random_scenes import random_scene


def main(path: str, limit: float, names: list[str]) -> None:
    """Scenes by their seeds; where one stands near its limit is printed."""
    comm = MPI.COMM_WORLD
    logging.disable(logging.WARNING)
    with open(path if comm.rank == 0 else "/dev/null", "a", buffering=1) as lines:
        for name in names:
            lines.write(json.dumps({"begins": name}) + "\n")
            faulthandler.dump_traceback_later(0.9 * limit)
            row = {"scene": name, **run_scene(random_scene(int(name)), comm)}
            lines.write(json.dumps(row, default=float) + "\n")
            faulthandler.cancel_dump_traceback_later()
            gc.collect()
            comm.barrier()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), sys.argv[3:])
