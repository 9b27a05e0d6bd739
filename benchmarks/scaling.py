"""Demos on more subdomains of the same size, on the same ranks.

    ./run python3 benchmarks/scaling.py [--quick | --large] [--ranks 2]

Starts mpirun itself; runs take turns, and of each the best counts. Set-up is included; gmsh, which
meshes on one rank, is not. A scene that scales has as many multiplications whatever its size, and
seconds in proportion to its unknowns. Results go to results/scaling.md, .json and .png.
"""

from __future__ import annotations

import sys

from benchmarks.tools import best_runs, command_line, curves, finish, picture, solve_seconds

# numbers of subdomains, all but the last without --large; cells along an edge of one
SCENES = {"cube_3d": ((8, 64, 512), 10), "talk_hertz_2d": ((8, 32, 128, 512), 50)}
QUICK = {"cube_3d": ((8, 27), 3), "talk_hertz_2d": ((8,), 12)}


def table(name, counts, cells, arguments, options):
    """A row for each number of subdomains of a demo."""
    words = ["--cells", cells, "-tfeti_qp_type", "newton", *options]
    runs = [(name, ["--subdomains", n, *words], arguments.ranks) for n in counts]
    return [
        {
            "subdomains": report["subdomains"],
            "unknowns": report["primal_dofs"],
            "rows": report["dual_dofs"],
            "F": report["F_multiplications"],
            "S": report["preconditioner_multiplications"],
            "without mesh": (seconds := solve_seconds(report)),
            "processor": report["processor"],
            "MB": report["peak_memory_mb"],
            "per million unknowns": seconds / report["primal_dofs"] * 1e6,
        }
        for report in best_runs(runs, arguments)
    ]


def draw(path, tables):
    """Multiplications and seconds, a line for each table."""
    lines, title = {title.split(":")[0]: rows for title, rows in tables.items()}, "weak scaling"
    with picture(path, 2) as (left, right):
        columns, what = ("subdomains", "F"), "multiplications by F"
        curves(left, title, (columns[0], what), lines, columns, "x")
        columns, what = ("unknowns", "processor"), "processor seconds of all ranks"
        curves(right, title, (columns[0], what), lines, columns)


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, options = command_line(__doc__, argv, large=False, ranks=2, repeats=3)
    tables = {}
    for name, (counts, cells) in (QUICK if arguments.quick else SCENES).items():
        chosen = counts if arguments.quick or arguments.large else counts[:-1]
        title = f"{name}: {cells} cells along an edge of a subdomain, {arguments.ranks} ranks"
        tables[title] = table(name, chosen, cells, arguments, options)
    return finish(arguments, "scaling", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
