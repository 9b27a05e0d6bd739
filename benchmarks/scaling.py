"""Demos on more subdomains, on more ranks, and cut into subdomains of other sizes.

    ./run python3 benchmarks/scaling.py weak|strong|sizes [--quick | --large] [--ranks 2]

Starts mpirun itself; runs take turns, and of each the best counts. Set-up is included; gmsh, which
meshes on one rank, has a column of its own.

weak: more subdomains of the same size, on the same ranks. A scene that scales has as many
    multiplications whatever its size, and seconds in proportion to its unknowns.
strong: the same scene on 1, 2, 4, ... ranks; ``--ranks`` is the most to try, say the cores. Beside
    the seconds is what memory gives as many ranks together: GB/s of y ← αx + y on long vectors.
sizes: one mesh cut into more and more subdomains, H/h elements along the edge of each (of METIS
    parts the cube root of their cells over 6), whose K⁺ and S are applied through sparse factors
    (``implicit``), by a dense matrix of each (``explicit``), and as the package chooses (``auto``).
    ``F measured`` are the seconds of one multiplication by F that are spent in the subdomains.

Results go to results/scaling_weak.md, .json and .png, and so on.
"""

from __future__ import annotations

import sys

from benchmarks.tools import (
    best_runs,
    column,
    command_line,
    configure_runs,
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
# sizes: unknowns or cells of the mesh, and numbers of subdomains
SIZES = {"cube_3d": (24, (8, 27, 64, 216)), "hertz_3d": (30_000, (4, 8, 16, 32, 64))}
SIZES_LARGE = {"cube_3d": (48, (64, 216, 512)), "hertz_3d": (235_000, (16, 32, 64, 128))}
SIZES_QUICK = {"cube_3d": (6, (8,)), "hertz_3d": (4_000, (4,))}
TYPES = ("implicit", "explicit", "auto")
# vertices of a tetrahedral mesh have some 5.5 cells each
CELLS_PER_NODE = 5.5


def configure(parser):
    parser.add_argument("study", choices=list(STUDIES))
    configure_runs(parser)


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


def sizes(arguments, options):
    """A table for each demo, a row for each number of subdomains and each type."""
    tables = {}
    scenes = SIZES_QUICK if arguments.quick else SIZES_LARGE if arguments.large else SIZES
    for name, (size, counts) in scenes.items():
        cases, runs = [(n, kind) for n in counts for kind in TYPES], []
        for n, kind in cases:
            mesh = ["--cells", size // round(n ** (1 / 3))]
            mesh = mesh if name == "cube_3d" else ["--unknowns", size]
            words = [*mesh, "--subdomains", n, *NEWTON, "-tfeti_local_type", kind, *options]
            runs.append((name, words, arguments.ranks))
        reports = best_runs(runs, arguments)
        tables[f"{name}, {arguments.ranks} ranks"] = [
            {
                "H/h": edge(name, size, report),
                "subdomains": report["subdomains"],
                "type": kind,
                "unknowns of one": round(report["primal_dofs"] / report["subdomains"]),
                **costs(report),
                "F measured": report["local_operators"]["F_measured"],
                "forms": ", ".join(
                    word.removeprefix("F_")
                    for word in report["local_operators"]
                    if word.startswith("F_") and word.endswith("plicit")
                ),
            }
            for (_, kind), report in zip(cases, reports, strict=True)
        ]
    return tables


def edge(name, size, report):
    """H/h of a subdomain."""
    if name == "cube_3d":
        return size // round(report["subdomains"] ** (1 / 3))
    cells = CELLS_PER_NODE * report["primal_dofs"] / 3 / report["subdomains"]
    return round((cells / 6) ** (1 / 3), 1)  # six tetrahedra fill a cube


# what is run, and the columns of its picture
STUDIES = {
    "weak": (weak, (("subdomains", "F"), ("unknowns", "processor"))),
    "strong": (strong, (("ranks", "faster"),)),
    "sizes": (sizes, (("H/h", "processor"),)),
}


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, options = command_line(__doc__, argv, configure)
    run, columns = STUDIES[arguments.study]

    def draw(path, tables):
        """A panel for each pair of columns, a line for each table, or type in it."""
        with picture(path, len(columns)) as axes:
            for panel, (x, y) in zip(axes, columns, strict=True):
                lines = {}
                for title, rows in tables.items():
                    for kind in dict.fromkeys(row.get("type", "") for row in rows):
                        own = [row for row in rows if row.get("type", "") == kind]
                        label = f"{title.split(':')[0]} {kind}".strip()
                        lines[label] = column(own, x), column(own, y)
                curves(panel, arguments.study, (x, y), lines, "x" if y == "F" else "xy")

    return finish(arguments, f"scaling_{arguments.study}", run(arguments, options), draw)


if __name__ == "__main__":
    main(sys.argv[1:])
