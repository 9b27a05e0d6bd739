"""Demos on more subdomains, and on more ranks.

    ./run python3 benchmarks/scaling.py [weak | strong] [--quick | --large] [--ranks 2]

Starts mpirun itself; runs take turns, and of each the best counts. Set-up is included; gmsh, which
meshes on one rank, has a column of its own.

weak: more subdomains of the same size, on the same ranks. A scene that scales has as many
    multiplications whatever its size, and seconds in proportion to its unknowns.
strong: the same scene on 1, 2, 4, ... ranks; ``--ranks`` is the most to try, say the cores. Beside
    the seconds is what memory gives as many ranks together: GB/s of y ← αx + y on long vectors.
Results go to results/scaling_weak.md, .json and .png, and so on.
"""

from __future__ import annotations

import sys

from benchmarks.tools import (
    best_runs,
    column,
    command_line,
    curves,
    finish,
    picture,
    solve_seconds,
    started,
)

NEWTON = ["-tfeti_qp_type", "newton"]
# weak: numbers of subdomains, all but the last without --large; cells along an edge of one
WEAK = {"cube_3d": ((8, 64, 512), 10), "talk_hertz_2d": ((8, 32, 128, 512), 50)}
WEAK_QUICK = {"cube_3d": ((8, 27), 3), "talk_hertz_2d": ((8,), 12)}
# strong: arguments of each demo
STRONG = {
    "cube_3d": ["--subdomains", 64],
    "talk_hertz_2d": ["--subdomains", 32],
    "hertz_3d": ["--unknowns", 60_000, "--subdomains", 64],
}
STRONG_LARGE = {**STRONG, "hertz_3d": ["--unknowns", 235_000, "--subdomains", 64]}
STRONG_QUICK = {"cube_3d": ["--subdomains", 8, "--cells", 3]}


TRIAD = """
import time
import numpy as np
from mpi4py import MPI
from scipy.linalg.blas import daxpy
comm, x, y, seconds = MPI.COMM_WORLD, np.ones(2**25), np.ones(2**25), []
for _ in range(10):
    comm.barrier()
    start = time.perf_counter()
    daxpy(x, y, a=0.5)
    seconds.append(comm.allreduce(time.perf_counter() - start, op=MPI.MAX))
if comm.rank == 0:
    print(3e-9 * comm.size * x.nbytes / min(seconds))
"""


def bandwidth(ranks):
    """GB/s between memory and so many ranks together, the best of ten runs."""
    return float(started([sys.executable, "-c", TRIAD], ranks))


def costs(report):
    """Columns that all studies have."""
    return {
        "F": report["F_multiplications"],
        "S": report["preconditioner_multiplications"],
        "without mesh": solve_seconds(report),
        "processor": report["processor"],
        "MB": report["peak_memory_mb"],
    }


def weak(arguments, options):
    """A table for each demo, a row for each number of subdomains."""
    tables = {}
    for name, (counts, cells) in (WEAK_QUICK if arguments.quick else WEAK).items():
        chosen = counts if arguments.quick or arguments.large else counts[:-1]
        words = ["--cells", cells, *NEWTON, *options]
        runs = [(name, ["--subdomains", n, *words], arguments.ranks) for n in chosen]
        title = f"{name}: {cells} cells along an edge of a subdomain, {arguments.ranks} ranks"
        tables[title] = [
            {
                "subdomains": report["subdomains"],
                "unknowns": report["primal_dofs"],
                "rows": report["dual_dofs"],
                **costs(report),
                "per million unknowns": solve_seconds(report) / report["primal_dofs"] * 1e6,
            }
            for report in best_runs(runs, arguments)
        ]
    return tables


def strong(arguments, options):
    """A table for each demo, a row for each number of ranks: 1, 2, 4, ... and the most."""
    most, tables = arguments.ranks, {}
    counts = sorted({*(2**k for k in range(most.bit_length()) if 2**k <= most), most})
    scenes = STRONG_QUICK if arguments.quick else STRONG_LARGE if arguments.large else STRONG
    for name, words in scenes.items():
        reports = best_runs([(name, [*words, *NEWTON, *options], n) for n in counts], arguments)
        memory = [bandwidth(n) for n in counts]
        tables[name] = [
            {
                "ranks": n,
                "unknowns": report["primal_dofs"],
                **costs(report),
                "faster": solve_seconds(reports[0]) / solve_seconds(report),
                "GB/s": given,
                "GB/s faster": given / memory[0],
            }
            for n, report, given in zip(counts, reports, memory, strict=True)
        ]
    return tables


# what axes say of columns; then what is run, and the columns of its picture
WORDS = {"F": "multiplications by F", "processor": "processor seconds of all ranks"}
STUDIES = {
    "weak": (weak, (("subdomains", "F"), ("unknowns", "processor"))),
    "strong": (strong, (("ranks", "faster"),)),
}


def main(argv):
    """Run the tables and write them; returns them."""
    study = "strong" if "strong" in argv else "weak"
    rest = [word for word in argv if word not in STUDIES]
    arguments, options = command_line(__doc__, rest, large=False, ranks=2, repeats=3)
    run, columns = STUDIES[study]

    def draw(path, tables):
        """A panel for each pair of columns, a line for each table."""
        with picture(path, len(columns)) as axes:
            for panel, (x, y) in zip(axes, columns, strict=True):
                lines = {
                    title.split(":")[0]: (column(rows, x), column(rows, y))
                    for title, rows in tables.items()
                }
                log = "x" if y == "F" else "xy"
                curves(panel, f"{study} scaling", (x, WORDS.get(y, y)), lines, log)

    return finish(arguments, f"scaling_{study}", run(arguments, options), draw)


if __name__ == "__main__":
    main(sys.argv[1:])
