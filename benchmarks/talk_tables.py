"""The tables of Dostál's talk, beside the talk's own figures.

    ./run mpirun -n 2 python3 benchmarks/talk_tables.py [--large] [--rtol 1e-4 1e-6]

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
from demos import cube_3d

# subdomains: the talk's primal, dual, kernel dimension, multiplications, seconds
FRICTIONLESS_3D = {
    8: (31_944, 6_052, 48, 74, 13),
    64: (255_552, 59_051, 384, 100, 51),
    512: (2_044_416, 514_981, 3072, 154, 760),
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
        "MB": report.peak_memory_mb,
    }


def frictionless_3d(sizes, tolerances):
    """Cubes of 10³ hexahedra on a curved obstacle."""
    rows = []
    for subdomains in sizes:
        for rtol in tolerances:
            options = [*SOLVER, "-tfeti_rtol", str(rtol)]
            _, report = cube_3d.run(["--subdomains", str(subdomains), *options])
            rows.append(row(report, FRICTIONLESS_3D[subdomains], subdomains, rtol))
    return rows


def main(argv):
    """Run the tables and write them; returns them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--large", action="store_true", help="the largest rows too")
    parser.add_argument("--rtol", type=float, nargs="+", default=[1e-4, 1e-6])
    parser.add_argument("--output", type=Path, default=Path("results"))
    arguments = parser.parse_args(argv)
    sizes = list(FRICTIONLESS_3D) if arguments.large else [8, 64]
    tables = {"Frictionless 3D": frictionless_3d(sizes, arguments.rtol)}
    if MPI.COMM_WORLD.rank == 0:
        write_tables(arguments.output, "talk_tables", tables)
        for title, rows in tables.items():
            print(f"{title}\n\n{markdown(rows)}\n")
    return tables


if __name__ == "__main__":
    main(sys.argv[1:])
