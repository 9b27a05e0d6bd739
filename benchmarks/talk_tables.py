"""The tables of Dostál's talk, beside the talk's own figures.

    ./run mpirun -n 2 python3 benchmarks/talk_tables.py [--quick | --large] [--rtol 1e-4 1e-6]

Multiplications are by F = B K⁺ Bᵀ, all but the power method's. The talk gives neither tolerance
nor geometry in full. Results go to results/talk_tables.md and .json.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.tables import markdown, write_tables
from demos import cube_3d, talk_hertz_2d

# subdomains: the talk's primal, dual, kernel dimension, multiplications, seconds
HERTZ_2D = {
    2: (40_000, 6_000, 6, 45, 10),
    32: (640_000, 11_200, 96, 88, 78),
    512: (10_240_000, 198_400, 1536, 134, 1300),
}
FRICTIONLESS_3D = {
    8: (31_944, 6_052, 48, 74, 13),
    64: (255_552, 59_051, 384, 100, 51),
    512: (2_044_416, 514_981, 3072, 154, 760),
}
TABLES = {
    "Hertz 2D": (talk_hertz_2d, HERTZ_2D),
    "Frictionless 3D": (cube_3d, FRICTIONLESS_3D),
}
SOLVER = ["-tfeti_qp_type", "smalse", "-tfeti_pc_type", "none"]


def row(report, talk, subdomains, rtol):
    """A row of a table: ours beside the talk's."""
    primal, dual, kernel, multiplications, seconds = talk
    return {
        "subdomains": subdomains,
        "rtol": f"{rtol:.0e}",
        "primal": report.primal_dofs,
        "primal, talk": primal,
        "dual": report.dual_dofs,
        "dual, talk": dual,
        "kernel": report.kernel_dim,
        "kernel, talk": kernel,
        "multiplications": report.F_multiplications,
        "multiplications, talk": multiplications,
        "power method": report.power_method_multiplications,
        "outer": report.outer_iterations,
        "seconds": report.seconds["total"],
        "of them qp": report.seconds["qp"],
        "seconds, talk": seconds,
    }


def table(demo, talk, sizes, tolerances, quick=False):
    """A row for each size and tolerance."""
    rows = []
    for subdomains in sizes:
        for rtol in tolerances:
            options = ["--subdomains", str(subdomains), *(["--quick"] if quick else [])]
            _, report = demo.run([*options, *SOLVER, "-tfeti_rtol", str(rtol)])
            rows.append(row(report, talk[subdomains], subdomains, rtol))
    return rows


def main(argv):
    """Run the tables and write them; returns them."""
    parser = argparse.ArgumentParser(description=__doc__)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="the smallest rows, on coarse meshes")
    size.add_argument("--large", action="store_true", help="the largest rows too")
    parser.add_argument("--rtol", type=float, nargs="+", default=[1e-4, 1e-6])
    parser.add_argument("--output", type=Path, default=Path("results"))
    arguments = parser.parse_args(argv)
    count = 3 if arguments.large else 1 if arguments.quick else 2
    tables = {
        title: table(demo, talk, list(talk)[:count], arguments.rtol, arguments.quick)
        for title, (demo, talk) in TABLES.items()
    }
    if MPI.COMM_WORLD.rank == 0:
        write_tables(arguments.output, "talk_tables", tables)
        for title, rows in tables.items():
            print(f"{title}\n\n{markdown(rows)}\n")
    return tables


if __name__ == "__main__":
    main(sys.argv[1:])
