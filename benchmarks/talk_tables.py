"""The tables of Dostál's talk by both solvers, beside the talk's own figures.

    ./run mpirun -n 2 python3 benchmarks/talk_tables.py [--quick | --large] [--rtol 1e-4 1e-6]

Multiplications are by F = B K⁺ Bᵀ, all but the power method's, which only SMALSE-M needs, and by
the preconditioner S, which only block Newton has. The talk gives neither tolerance nor geometry in
full; its solver is SMALSE-M. Seconds are those of all but the mesh. Results go to
results/talk_tables.md, .json and .png.
"""

from __future__ import annotations

import sys

from benchmarks.tools import command_line, curves, finish, picture, solve_seconds
from demos import run

# subdomains: the talk's primal, dual, kernel dimension, multiplications, seconds (none are given
# with friction)
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
TRESCA_2D = {
    1: (5_202, 153, 3, 66, None),
    16: (83_232, 3_033, 48, 130, None),
    256: (1_331_712, 50_913, 768, 208, None),
}
TRESCA_3D = {
    4: (15_972, 1_694, 24, 76, None),
    64: (255_552, 50_634, 384, 216, None),
    1024: (4_088_832, 942_954, 6144, 325, None),
}
# the kernels of 64 and 216 subdomains are misprinted in the talk, and so are the 216
TBETI = {
    8: (11_712, 5_023, 48, 130, None),
    64: (93_696, 43_441, 384, 137, None),
    216: (316_224, 63_275, 1296, 133, None),
}
TABLES = {
    "Hertz 2D": ("talk_hertz_2d", HERTZ_2D),
    "Frictionless 3D": ("cube_3d", FRICTIONLESS_3D),
    "Tresca 2D": ("tresca_2d", TRESCA_2D),
    "Tresca 3D": ("tresca_3d", TRESCA_3D),
    "TBETI": ("tbeti_cube_3d", TBETI),
}
SHARES = ("sticking", "sliding")  # of the contact nodes, where there is friction
SOLVERS = {
    "Newton": ["-tfeti_qp_type", "newton"],
    "SMALSE": ["-tfeti_qp_type", "smalse", "-tfeti_pc_type", "none"],
}


def row(reports, talk, subdomains, rtol):
    """A row of a table: ours beside the talk's."""
    primal, dual, kernel, multiplications, seconds = talk
    newton, smalse = reports["Newton"], reports["SMALSE"]
    rubbing = {name: getattr(newton, name) / newton.contact_rows for name in SHARES}
    return {
        "subdomains": subdomains,
        "rtol": f"{rtol:.0e}",
        "primal": newton.primal_dofs,
        "primal, talk": primal,
        "dual": newton.dual_dofs,
        "dual, talk": dual,
        "kernel": newton.kernel_dim,
        "kernel, talk": kernel,
        "F, Newton": newton.F_multiplications,
        "S, Newton": newton.preconditioner_multiplications,
        "F, SMALSE": smalse.F_multiplications,
        "F, talk": multiplications,
        "outer, Newton": newton.outer_iterations,
        "outer, SMALSE": smalse.outer_iterations,
        "power method": smalse.power_method_multiplications,
        **(rubbing if newton.tangential_rows else {}),
        **{f"seconds, {name}": solve_seconds(vars(report)) for name, report in reports.items()},
        **({} if seconds is None else {"seconds, talk": seconds}),
    }


def table(demo, talk, sizes, arguments, options):
    """A row for each size and tolerance."""
    rows = []
    for subdomains in sizes:
        for rtol in arguments.rtol:
            words = ["--subdomains", str(subdomains), *(["--quick"] if arguments.quick else [])]
            words += ["-tfeti_rtol", str(rtol), *options]
            reports = {name: run(demo, [*words, *solver])[1] for name, solver in SOLVERS.items()}
            rows.append(row(reports, talk[subdomains], subdomains, rtol))
    return rows


def draw(path, tables):
    """Multiplications by F over subdomains, at the last tolerance."""
    with picture(path, len(tables)) as axes:
        for panel, (title, rows) in zip(axes, tables.items(), strict=True):
            last = [row for row in rows if row["rtol"] == rows[-1]["rtol"]]
            names = {"F, Newton": "Newton", "F, SMALSE": "SMALSE-M", "F, talk": "talk"}
            lines = {label: [{**row, "F": row[of]} for row in last] for of, label in names.items()}
            labels, columns = ("subdomains", "multiplications by F"), ("subdomains", "F")
            curves(panel, f"{title}, rtol {rows[-1]['rtol']}", labels, lines, columns, log="x")


def main(argv):
    """Run the tables and write them; returns them."""
    arguments, options = command_line(__doc__, argv, large=False, rtol=[1e-4, 1e-6])
    count = 3 if arguments.large else 1 if arguments.quick else 2
    tables = {
        title: table(demo, talk, list(talk)[:count], arguments, options)
        for title, (demo, talk) in TABLES.items()
    }
    return finish(arguments, "talk_tables", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
