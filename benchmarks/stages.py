"""Seconds and memory of each stage of a solve.

    ./run mpirun -n 2 python3 benchmarks/stages.py [--quick | --large] [--processor]

Memory is what all ranks have in use when a stage ends, not what their processes hold then: what is
freed may stay theirs (Open MPI wants it so), and is used for what comes later. Results go to
results/stages.md and .json.
"""

from __future__ import annotations

import ctypes
import sys
from typing import ClassVar

from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.tools import STAGES, choose_clock, command_line, configure_clock, finish
from demos import petsc_options, scene

# arguments of the demos, by the size of the run
CUBES = {"quick": (8, 4), "default": (64, 10), "large": (512, 10)}
BALLS = {"quick": (4_000, 4), "default": (60_000, 16), "large": (235_000, 64)}
DEMOS = {
    "cube_3d": {name: ["--subdomains", n, "--cells", m] for name, (n, m) in CUBES.items()},
    "hertz_3d": {name: ["--unknowns", m, "--subdomains", n] for name, (m, n) in BALLS.items()},
}


class Mallinfo(ctypes.Structure):
    """What mallinfo2 of glibc returns."""

    NAMES = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_: ClassVar = [(name, ctypes.c_size_t) for name in NAMES.split()]


def memory():
    """Megabytes that this process has in use."""
    mallinfo = ctypes.CDLL(None).mallinfo2
    mallinfo.restype = Mallinfo
    info = mallinfo()
    return (info.uordblks + info.hblkhd) / 2**20


class Watched(dict):
    """Seconds of stages that also notes what memory this rank has when a stage first ends."""

    def __init__(self, seconds):
        self.memory = {"mesh": memory()}
        super().__init__(seconds)

    def __setitem__(self, name, value):
        super().__setitem__(name, value)
        self.memory.setdefault(name, memory())

    def __reduce__(self):
        """What travels between ranks is the seconds."""
        return dict, (dict(self),)


def table(made, options):
    """Unknowns, and a row for each stage. Collective."""
    problem = tfeti.ContactProblem(**made, petsc_options={"tfeti_qp_type": "newton", **options})
    seconds = problem._seconds = Watched(problem._seconds)
    problem.solve()
    problem.destroy()
    whole = sum(seconds.get(name, 0.0) for name in STAGES)
    return problem.report.primal_dofs, [
        {
            "stage": name,
            "seconds": seconds[name],
            "share": seconds[name] / whole,
            "MB in use": MPI.COMM_WORLD.allreduce(seconds.memory[name]),
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
    tables, unit = {}, choose_clock(arguments)
    for name, words in DEMOS.items():
        unknowns, rows = table(scene(name, words[size]), petsc_options(rest))
        tables[f"{name}, {unknowns} unknowns, {MPI.COMM_WORLD.size} ranks, {unit}"] = rows
    return finish(arguments, "stages", tables)


if __name__ == "__main__":
    main(sys.argv[1:])
