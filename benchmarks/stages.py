"""Seconds and memory of each stage of a solve, and bandwidth of F beside that of a copy.

    ./run mpirun -n 2 python3 benchmarks/stages.py [--quick | --large]

Memory is what all ranks hold when a stage ends, and the most that they held in it. A multiplication
by F reads each subdomain's factor twice, or its dense matrix once: if the machine's memory is what
limits it, its bytes per second come near those of a copy of an array larger than the cache, by all
ranks at once (reading and writing both count). Results go to results/stages.md, .json and .png.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import numpy as np
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from benchmarks.pictures import picture, stacked
from benchmarks.tools import STAGES, command_line, finish
from demos import cube_3d, hertz_3d
from demos.demo_tools import petsc_options

DEMOS = {"cube_3d": cube_3d, "hertz_3d": hertz_3d}
SIZES = {
    "quick": {
        "cube_3d": {"subdomains": 8, "cells": 4},
        "hertz_3d": {"unknowns": 4_000, "subdomains": 4},
    },
    "default": {
        "cube_3d": {"subdomains": 64, "cells": 10},
        "hertz_3d": {"unknowns": 60_000, "subdomains": 16},
    },
    "large": {
        "cube_3d": {"subdomains": 512, "cells": 10},
        "hertz_3d": {"unknowns": 235_000, "subdomains": 64},
    },
}
# numbers of an array that is copied; the caches of today's processors hold less
COPIED = {True: 2**20, False: 2**25}
STATUS, REFERENCES = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Watched(dict):
    """Seconds of stages that also notes what memory this rank holds when a stage ends.

    Args:
        seconds: Of the mesh, and of what else is known.
        before: ``memory()`` when the mesh was made.

    Attributes:
        held: Megabytes at the end of each stage.
        most: The most in it; since the run began, where the system does not say of a stage.
    """

    def __init__(self, seconds, before):
        held, most = before
        self.held, self.most = {"mesh": held}, {"mesh": most}
        super().__init__(seconds)

    def __setitem__(self, name, value):
        super().__setitem__(name, value)
        self.held[name], most = memory()
        self.most[name] = max(self.most.get(name, 0.0), most)
        forget_peak()

    def __reduce__(self):
        """What travels between ranks is the seconds."""
        return dict, (dict(self),)


def memory():
    """Megabytes that this process holds, and the most since ``forget_peak``."""
    lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
    return tuple(float(lines[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))


def forget_peak():
    """Let the system count the most memory anew, if it does that."""
    try:
        REFERENCES.write_text("5")
    except OSError:
        return


def solved(demo, size, options):
    """The report of a scene, its seconds watched."""
    scene = demo.scene(demo.torn_mesh(argparse.Namespace(quick=False, **size)))
    before = memory()
    forget_peak()
    problem = tfeti.ContactProblem(**scene, petsc_options={"tfeti_qp_type": "newton", **options})
    seconds = problem.report.seconds = Watched(problem.report.seconds, before)
    problem.solve()
    problem.destroy()
    return problem.report, seconds


def stage_rows(seconds):
    """A row for each stage. Collective."""
    comm = MPI.COMM_WORLD
    whole = sum(seconds.get(name, 0.0) for name in STAGES)
    return [
        {
            "stage": name,
            "seconds": seconds[name],
            "share": seconds[name] / whole,
            "MB at its end": comm.allreduce(seconds.held.get(name, 0.0)),
            "MB at most": comm.allreduce(seconds.most.get(name, 0.0)),
        }
        for name in STAGES
        if name in seconds
    ]


def bandwidth_row(operator, local, copy):
    """Bytes, seconds and bandwidth of a multiplication by F or the preconditioner."""
    rate = local[f"{operator}_bytes"] / local[f"{operator}_measured"]
    return {
        "operator": operator,
        "MB": local[f"{operator}_bytes"] / 1e6,
        "seconds": local[f"{operator}_measured"],
        "predicted": local[f"{operator}_predicted"],
        "GB/s": rate / 1e9,
        "copy, GB/s": copy / 1e9,
        "of copy": rate / copy,
    }


def copy_bandwidth(count):
    """Bytes per second that all ranks read and write together in a copy. Collective."""
    comm, least = MPI.COMM_WORLD, np.inf
    source, target = np.ones(count), np.empty(count)
    for _ in range(5):
        comm.barrier()
        start = time.perf_counter()
        np.copyto(target, source)
        least = min(least, comm.allreduce(time.perf_counter() - start, op=MPI.MAX))
    return comm.size * 2 * source.nbytes / least


def configure(parser):
    parser.add_argument("--large", action="store_true", help="larger scenes")


def draw(path, tables):
    """Seconds of stages."""
    stages = {title: rows for title, rows in tables.items() if "stage" in rows[0]}
    with picture(path, len(stages)) as axes:
        for panel, (title, rows) in zip(axes, stages.items(), strict=True):
            stacked(panel, title, rows, ["seconds"])


def main(argv):
    """Run the scenes and write their tables; returns them."""
    arguments, rest = command_line(__doc__, argv, configure)
    size = "quick" if arguments.quick else "large" if arguments.large else "default"
    comm, tables = MPI.COMM_WORLD, {}
    copy = copy_bandwidth(COPIED[arguments.quick])
    for name, demo in DEMOS.items():
        report, seconds = solved(demo, SIZES[size][name], petsc_options(rest))
        local = report.local_operators
        title = f"{name}, {report.primal_dofs} unknowns, {comm.size} ranks"
        tables[title] = stage_rows(seconds)
        tables[f"{name}, local operators"] = [
            bandwidth_row(operator, local, copy)
            for operator in ("F", "preconditioner")
            if f"{operator}_bytes" in local
        ]
    return finish(arguments.output, "stages", tables, draw, comm.rank)


if __name__ == "__main__":
    main(sys.argv[1:])
