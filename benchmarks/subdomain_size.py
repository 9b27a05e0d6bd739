"""The size of subdomains, and how their operators are applied: implicit against explicit.

    ./run python3 benchmarks/subdomain_size.py [--quick | --large] [--ranks 2]

Starts mpirun itself. One mesh is cut into more and more subdomains, H/h elements along the edge of
each (of METIS parts the cube root of their cells over 6), and their K⁺ and S are applied through
sparse factors (`implicit`), by a dense matrix of each (`explicit`), and as the package chooses
(`auto`). `measured` are the seconds of one multiplication by F that are spent in the subdomains.
Results go to
results/subdomain_size.md, .json and .png.
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
)

TYPES = ("implicit", "explicit", "auto")
# demo: unknowns or cells of the mesh, and numbers of subdomains, all but the first with --large
SIZES = {
    "quick": {"cube_3d": (6, (8,)), "hertz_3d": (4_000, (4,))},
    "default": {"cube_3d": (24, (8, 27, 64, 216)), "hertz_3d": (30_000, (4, 8, 16, 32, 64))},
    "large": {"cube_3d": (48, (64, 216, 512)), "hertz_3d": (235_000, (16, 32, 64, 128))},
}
# vertices of a tetrahedral mesh have some 5.5 cells each
CELLS_PER_NODE = 5.5


def words(name, size, subdomains):
    """Arguments of a demo."""
    given = ["--subdomains", subdomains, "-tfeti_qp_type", "newton"]
    if name == "cube_3d":
        return ["--cells", size // round(subdomains ** (1 / 3)), *given]
    return ["--unknowns", size, *given]


def edge(name, size, report):
    """H/h of a subdomain."""
    if name == "cube_3d":
        return size // round(report["subdomains"] ** (1 / 3))
    cells = CELLS_PER_NODE * report["primal_dofs"] / 3 / report["subdomains"]
    return round((cells / 6) ** (1 / 3), 1)  # six tetrahedra fill a cube


def row(name, size, local_type, report):
    """A row of a table."""
    seconds, local = report["seconds"], report["local_operators"]
    return {
        "H/h": edge(name, size, report),
        "subdomains": report["subdomains"],
        "type": local_type,
        "unknowns of one": round(report["primal_dofs"] / report["subdomains"]),
        "F": report["F_multiplications"],
        "S": report["preconditioner_multiplications"],
        "K⁺": seconds["subdomains"],
        **{stage: seconds[stage] for stage in ("dual", "qp")},
        "without mesh": solve_seconds(report),
        "processor": report["processor"],
        "MB": report["peak_memory_mb"],
        "F measured": local["F_measured"],
        "forms": ", ".join(
            word.removeprefix("F_")
            for word in local
            if word.startswith("F_") and word.endswith("plicit")
        ),
    }


def table(name, size, counts, arguments, options):
    """A row for each number of subdomains and each type."""
    cases = [(n, local_type) for n in counts for local_type in TYPES]
    runs = [
        (name, [*words(name, size, n), "-tfeti_local_type", kind, *options], arguments.ranks)
        for n, kind in cases
    ]
    reports = best_runs(runs, arguments)
    return [row(name, size, kind, r) for (_, kind), r in zip(cases, reports, strict=True)]


def draw(path, tables):
    """Seconds of the processor over H/h, a line for each type."""
    with picture(path, len(tables)) as axes:
        for panel, (title, rows) in zip(axes, tables.items(), strict=True):
            lines = {}
            for kind in TYPES:
                of_kind = [row for row in rows if row["type"] == kind]
                lines[kind] = column(of_kind, "H/h"), column(of_kind, "processor")
            curves(panel, title, ("H/h", "seconds of the processor"), lines)


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, options = command_line(__doc__, argv, configure_runs)
    kind = "quick" if arguments.quick else "large" if arguments.large else "default"
    tables = {
        f"{name}, {arguments.ranks} ranks": table(name, size, counts, arguments, options)
        for name, (size, counts) in SIZES[kind].items()
    }
    return finish(arguments, "subdomain_size", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
