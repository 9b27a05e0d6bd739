"""Weak scaling: more subdomains of the same size, on the same ranks.

    ./run python3 benchmarks/weak_scaling.py [--quick | --large] [--ranks 2]

Starts mpirun itself. A scene that scales has as many multiplications whatever its size, and seconds
in proportion to its unknowns. Results go to results/weak_scaling.md, .json and .png.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.tools import (
    best_runs,
    column,
    command_line,
    configure_runs,
    curves,
    finish,
    picture,
    solve_seconds,
    stage_seconds,
)

# demo: numbers of subdomains, all but the last without --large; cells along an edge of one
SCENES = {"cube_3d": ((8, 64, 512), 10), "talk_hertz_2d": ((8, 32, 128, 512), 50)}
QUICK = {"cube_3d": ((8, 27), 3), "talk_hertz_2d": ((8,), 12)}
SOLVER = ["-tfeti_qp_type", "newton"]


def row(report):
    """A row of a table."""
    seconds = solve_seconds(report)
    return {
        "subdomains": report["subdomains"],
        "unknowns": report["primal_dofs"],
        "rows": report["dual_dofs"],
        "F": report["F_multiplications"],
        "S": report["preconditioner_multiplications"],
        **stage_seconds(report),
        "without mesh": seconds,
        "per million unknowns": seconds / report["primal_dofs"] * 1e6,
        "processor": report["processor"],
        "MB": report["peak_memory_mb"],
        "kB per unknown": report["peak_memory_mb"] / report["primal_dofs"] * 1e3,
    }


def table(name, counts, cells, arguments, options):
    """A row for each number of subdomains."""
    words = ["--cells", cells, *SOLVER, *options]
    runs = [(name, ["--subdomains", n, *words], arguments.ranks) for n in counts]
    return [row(report) for report in best_runs(runs, arguments)]


def draw(path, tables):
    """Multiplications over subdomains, and seconds of the processor over unknowns."""
    with picture(path, 2) as (counts, seconds):
        for panel, x, y, label, log in (
            (counts, "subdomains", "F", "multiplications by F", "x"),
            (seconds, "unknowns", "processor", "seconds of the processor", "xy"),
        ):
            lines = {
                title.split(":")[0]: (column(rows, x), column(rows, y))
                for title, rows in tables.items()
            }
            curves(panel, label, (x, label), lines, log)


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, options = command_line(__doc__, argv, configure_runs)
    tables = {}
    for name, (counts, cells) in (QUICK if arguments.quick else SCENES).items():
        chosen = counts if arguments.quick or arguments.large else counts[:-1]
        title = f"{name}: {cells} cells along an edge of a subdomain, {arguments.ranks} ranks"
        tables[title] = table(name, chosen, cells, arguments, options)
    return finish(arguments, "weak_scaling", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
