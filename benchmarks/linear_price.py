"""The price of contact beside that of one linear elasticity solve of the same untorn mesh.

    ./run mpirun -n 2 python3 benchmarks/linear_price.py [--quick | --large] [--processor]

The linear problem (``benchmarks/linear.py``) has the contact's solution: nodes that carry a contact
force are held where the contact's solution puts them. PETSc's CG gets it to the same error as the
contact: its tolerance is lowered by tens from rtol until the largest error of u, against the
contact's solution, is at most rtol times the largest displacement. Solvers take turns, and the best
of three runs counts, of several settings the fastest. Seconds of a contact are its set-up (K⁺ and
the Dirichlet preconditioner's factors) and its solve (coarse problem and dual solver), those of a
linear solver those of PETSc's KSP; `all` has assembly, and the search and rows of the contact, too,
but no mesh. Results go to results/linear_price.md, .json and .png.
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

import tfeti_dolfinx as tfeti
from benchmarks.linear import (
    DEFAULT_RTOL,
    SETTINGS,
    available,
    first_tolerance,
    linear_problem,
    solve,
)
from benchmarks.stages import DEMOS, LARGE, MIDDLE, sizes
from benchmarks.tools import (
    choose_clock,
    command_line,
    configure_clock,
    finish,
    picture,
    solve_seconds,
    stacked,
)
from demos.demo_tools import petsc_options

OTHERS = [kind for kind in SETTINGS if kind != "GAMG"]
SIZES = sizes(MIDDLE, LARGE)


def configure(parser):
    parser.add_argument("--large", action="store_true", help="2 million unknowns, no direct solver")
    parser.add_argument("--scenes", nargs="+", choices=list(DEMOS), default=list(DEMOS))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--others", nargs="*", choices=OTHERS, default=OTHERS, help="than GAMG")
    configure_clock(parser)
    parser.add_argument("--no-smalse", action="store_true", help="block Newton alone")


def contact(scene, qp_type, options):
    """Solve a contact from scratch; the problem and a row."""
    types = {"tfeti_qp_type": qp_type, "tfeti_pc_type": "auto"}
    problem = tfeti.ContactProblem(**scene, petsc_options={**options, **types})
    problem.solve()
    report = problem.report
    seconds = report.seconds
    row = {
        "solver": f"contact, {qp_type}",
        "setting": f"rtol {problem.options.number:.0e}",
        "steps": f"{report.F_multiplications} F + {report.preconditioner_multiplications} S",
        "set-up": seconds["subdomains"],
        "solve": seconds["dual"] + seconds["qp"],
        "all": solve_seconds({"seconds": seconds}),
        "error": report.residuals["displacement_error"],
    }
    say(row)
    return problem, row


def linear_row(linear, kind, setting, rtol):
    """Solve the linear problem; a row."""
    found = solve(linear, SETTINGS[kind][setting], rtol)
    row = {
        "solver": kind,
        "setting": f"{setting}, rtol {rtol:.0e}",
        "steps": found["iterations"],
        "set-up": found["set-up"],
        "solve": found["solve"],
        "all": linear.seconds + found["set-up"] + found["solve"],
        "error": found["error"],
    }
    say(row)
    return row


def say(row):
    """Print a row at once: large scenes take their time."""
    if MPI.COMM_WORLD.rank == 0:
        print(*(f"{value:.4g}" if isinstance(value, float) else value for value in row.values()))
        sys.stdout.flush()


def study(demo, size, options, repeats, arguments):
    """A row for each solver and setting, the fastest of several runs that take turns."""
    scene = demo.scene(demo.torn_mesh(argparse.Namespace(quick=False, **size)))
    rtol = float(options.get("tfeti_rtol", DEFAULT_RTOL))
    problem, row = contact(scene, "newton", options)
    linear = linear_problem(scene, problem.solution)
    problem.destroy()
    rows = [[row]]
    work = tried(linear, rtol, arguments)
    for repeat in range(repeats):
        for i, (kind, setting, tolerance) in enumerate(work):
            if repeat == 0:
                rows.append([])
            rows[i + 1].append(linear_row(linear, kind, setting, tolerance))
        if repeat + 1 < repeats:
            problem, row = contact(scene, "newton", options)
            problem.destroy()
            rows[0].append(row)
    linear.destroy()
    if not arguments.no_smalse:  # once: it takes its time
        problem, row = contact(scene, "smalse", options)
        problem.destroy()
        rows.insert(1, [row])
    return [min(found, key=price) for found in rows], problem.report


def tried(linear, rtol, arguments):
    """Kind, setting and tolerance of the linear solvers that PETSc has."""
    comm = linear.A.getComm().tompi4py()
    return [
        (kind, setting, first_tolerance(linear, text, rtol))
        for kind in ("GAMG", *arguments.others)
        for setting, text in SETTINGS[kind].items()
        if available(kind, setting, comm) and not (arguments.large and kind == "direct")
    ]


def price(row):
    """Seconds of set-up and solve."""
    return row["set-up"] + row["solve"]


def with_ratios(rows):
    """The rows, with what each costs in terms of the cheapest one of GAMG."""
    of_gamg = [row for row in rows if row["solver"] == "GAMG"]
    gamg, whole = min(map(price, of_gamg)), min(row["all"] for row in of_gamg)
    return [
        {**row, "of GAMG": price(row) / gamg, "all, of GAMG": row["all"] / whole} for row in rows
    ]


def draw(path, tables):
    """The contacts and the best setting of each linear solver."""
    with picture(path, len(tables), height=2.8) as axes:
        for panel, (title, rows) in zip(axes, tables.items(), strict=True):
            best = {}
            for row in sorted(rows, key=price, reverse=True):
                best[row["solver"]] = row
            chosen = [row for row in rows if row is best[row["solver"]]]
            stacked(panel, title.split(":")[0], chosen, ["set-up", "solve"])


def main(argv):
    """Run the studies and write them; returns the tables."""
    arguments, rest = command_line(__doc__, argv, configure)
    size = "quick" if arguments.quick else "large" if arguments.large else "default"
    repeats = 1 if arguments.quick else arguments.repeats
    options, comm, unit = petsc_options(rest), MPI.COMM_WORLD, choose_clock(arguments)
    tables = {}
    for name in arguments.scenes:
        rows, report = study(DEMOS[name], SIZES[size][name], options, repeats, arguments)
        sizes = f"{report.primal_dofs} unknowns, {report.subdomains} subdomains"
        tables[f"{name}: {sizes}, {comm.size} ranks, {unit}"] = with_ratios(rows)
    return finish(arguments, "linear_price", tables, draw, comm.rank)


if __name__ == "__main__":
    main(sys.argv[1:])
