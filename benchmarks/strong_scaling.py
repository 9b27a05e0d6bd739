"""Strong scaling: the same scene on 1, 2, 4, ... ranks, as many as the machine has cores.

    ./run python3 benchmarks/strong_scaling.py [--quick | --large] [--ranks 8]

Starts mpirun itself; `--ranks` is the most to try, by default the cores. Runs on different ranks
take turns, and of each the best counts. Set-up is included; gmsh, which meshes on one rank, has a
column of its own. Results go to results/strong_scaling.md, .json and .png.
"""

from __future__ import annotations

import os
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

SCENES = {
    "cube_3d": ["--subdomains", 64],
    "talk_hertz_2d": ["--subdomains", 32],
    "hertz_3d": ["--unknowns", 60_000, "--subdomains", 64],
}
LARGE = {**SCENES, "hertz_3d": ["--unknowns", 235_000, "--subdomains", 64]}
QUICK = {"cube_3d": ["--subdomains", 8, "--cells", 3]}
SOLVER = ["-tfeti_qp_type", "newton"]


def configure(parser):
    configure_runs(parser)
    parser.set_defaults(ranks=len(os.sched_getaffinity(0)))


def powers(most):
    """1, 2, 4, ... and the most."""
    return sorted({*(2**k for k in range(most.bit_length()) if 2**k <= most), most})


def table(name, words, arguments, options):
    """A row for each number of ranks."""
    runs = [(name, [*words, *SOLVER, *options], ranks) for ranks in powers(arguments.ranks)]
    reports = best_runs(runs, arguments)
    serial = solve_seconds(reports[0])
    return [
        {
            "ranks": ranks,
            "unknowns": report["primal_dofs"],
            "F": report["F_multiplications"],
            **stage_seconds(report),
            "without mesh": solve_seconds(report),
            "faster": serial / solve_seconds(report),
            "processor": report["processor"],
            "MB": report["peak_memory_mb"],
        }
        for (_, _, ranks), report in zip(runs, reports, strict=True)
    ]


def draw(path, tables):
    """How many times faster more ranks are."""
    lines = {
        title: (column(rows, "ranks"), column(rows, "faster")) for title, rows in tables.items()
    }
    most = max(x[-1] for x, _ in lines.values())
    with picture(path, 1) as (axes,):
        curves(axes, "strong scaling", ("ranks", "times faster"), lines)
        axes.plot([1, most], [1, most], linestyle="--", color="grey")


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, options = command_line(__doc__, argv, configure)
    scenes = QUICK if arguments.quick else LARGE if arguments.large else SCENES
    tables = {name: table(name, words, arguments, options) for name, words in scenes.items()}
    return finish(arguments, "strong_scaling", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
