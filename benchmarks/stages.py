"""Seconds and memory of each stage of a solve.

    ./run mpirun -n 2 python3 benchmarks/stages.py [--quick | --large] [--processor]

Memory is what all ranks have in use when a stage ends, and what their processes hold then: what is
freed may stay theirs (Open MPI wants it so), and is used for what comes later. Results go to
results/stages.md and .json.
"""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import ClassVar

from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.tools import STAGES, choose_clock, command_line, configure_clock, finish
from demos import petsc_options, scene

DEMOS = ("cube_3d", "hertz_3d")
# unknowns and subdomains of the half ball
QUICK, SMALL, MIDDLE, LARGE = (4_000, 4), (60_000, 16), (235_000, 64), (2_090_000, 256)


def sizes(default, large):
    """Arguments of both demos, quick, default and large; those of the half ball are given."""
    cubes = {"quick": (8, 4), "default": (64, 10), "large": (512, 10)}
    balls = {"quick": QUICK, "default": default, "large": large}
    return {
        name: {
            "cube_3d": dict(zip(("subdomains", "cells"), cubes[name], strict=True)),
            "hertz_3d": dict(zip(("unknowns", "subdomains"), balls[name], strict=True)),
        }
        for name in cubes
    }


SIZES = sizes(SMALL, MIDDLE)
STATUS = Path("/proc/self/status")


class Watched(dict):
    """Seconds of stages that also notes what memory this rank has when a stage ends.

    Args:
        seconds: Of the mesh, and of what else is known.
        mesh: ``memory()`` when the mesh was made.

    Attributes:
        memory: Megabytes in use, and held, at the end of each stage.
    """

    def __init__(self, seconds, mesh):
        self.memory = {"mesh": mesh}
        super().__init__(seconds)

    def __setitem__(self, name, value):
        super().__setitem__(name, value)
        self.memory.setdefault(name, memory())  # at its first end: contact comes back at the last

    def __reduce__(self):
        """What travels between ranks is the seconds."""
        return dict, (dict(self),)


class Mallinfo(ctypes.Structure):
    """What mallinfo2 of glibc returns."""

    NAMES = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_: ClassVar = [(name, ctypes.c_size_t) for name in NAMES.split()]


def memory():
    """Megabytes that this process has in use, and those that it holds. Without glibc the same."""
    (line,) = (line for line in STATUS.read_text().splitlines() if line.startswith("VmRSS"))
    held = float(line.split()[1]) / 1024
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except AttributeError:
        return held, held
    mallinfo.restype = Mallinfo
    info = mallinfo()
    return (info.uordblks + info.hblkhd) / 2**20, held


def words_of(size):
    """Arguments of a demo's command line."""
    return [word for name, value in size.items() for word in (f"--{name}", value)]


def solved(demo, size, options):
    """The report of a scene, its seconds watched."""
    made = scene(demo, words_of(size))
    mesh = memory()
    problem = tfeti.ContactProblem(**made, petsc_options={"tfeti_qp_type": "newton", **options})
    seconds = problem._seconds = Watched(problem._seconds, mesh)
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
            "MB in use": comm.allreduce(seconds.memory[name][0]),
            "MB held": comm.allreduce(seconds.memory[name][1]),
        }
        for name in STAGES
        if name in seconds
    ]


def configure(parser):
    parser.add_argument("--large", action="store_true", help="larger scenes")
    configure_clock(parser)


def main(argv):
    """Run the scenes and write their tables; returns them."""
    arguments, rest = command_line(__doc__, argv, configure)
    size = "quick" if arguments.quick else "large" if arguments.large else "default"
    comm, tables, unit = MPI.COMM_WORLD, {}, choose_clock(arguments)
    for name in DEMOS:
        report, seconds = solved(name, SIZES[size][name], petsc_options(rest))
        title = f"{name}, {report.primal_dofs} unknowns, {comm.size} ranks, {unit}"
        tables[title] = stage_rows(seconds)
    return finish(arguments, "stages", tables)


if __name__ == "__main__":
    main(sys.argv[1:])
