"""The price of contact beside that of one linear elasticity solve of the same untorn mesh.

    ./run mpirun -n 2 python3 benchmarks/linear_price.py [--quick | --large] [--processor]

The linear problem has the contact's solution: components that Dirichlet conditions prescribe keep
their values, nodes that carry a contact force are held where the contact's solution puts them, and
no motion is free. PETSc's CG gets it to the same error as the
contact: its tolerance is lowered by tens from rtol until the largest error of u, against the
contact's solution, is at most rtol times the largest displacement. Solvers take turns, and the best
of three runs counts, of several settings the fastest. Seconds of a contact are its set-up (K⁺ and
the Dirichlet preconditioner's factors) and its solve (coarse problem and dual solver), those of a
linear solver those of PETSc's KSP; `all` has assembly, and the search and rows of the contact, too,
but no mesh. Results go to results/linear_price.md, .json and .png.
"""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

import tfeti_dolfinx as tfeti
from benchmarks.tools import (
    choose_clock,
    command_line,
    finish,
    picture,
    say,
    solve_seconds,
    stacked,
)
from demos import petsc_options, scene
from tfeti_dolfinx.common.parallel import largest
from tfeti_dolfinx.forms.assembly import Forms

# --- The linear problem of a contact's solution on the untorn mesh ------------------------------

# what to try of each, if PETSc has it; the best one counts
GAMG, HYPRE = "-pc_type gamg", "-pc_type hypre -pc_hypre_boomeramg"
SETTINGS = {
    ("GAMG", "as PETSc has it"): GAMG,
    ("GAMG", "threshold 0.01"): f"{GAMG} -pc_gamg_threshold 0.01",
    ("GAMG", "threshold 0.03"): f"{GAMG} -pc_gamg_threshold 0.03",
    ("GAMG", "threshold 0.01, SOR"): f"{GAMG} -pc_gamg_threshold 0.01 -mg_levels_pc_type sor",
    ("BoomerAMG", "PMIS, ext+i, strong threshold 0.5"): f"{HYPRE}_strong_threshold 0.5 "
    "-pc_hypre_boomeramg_agg_nl 1 -pc_hypre_boomeramg_P_max 4 "
    "-pc_hypre_boomeramg_interp_type ext+i",
    ("BoomerAMG", "HMIS, ext+i, strong threshold 0.7"): f"{HYPRE}_strong_threshold 0.7 "
    "-pc_hypre_boomeramg_coarsen_type HMIS -pc_hypre_boomeramg_P_max 4 "
    "-pc_hypre_boomeramg_interp_type ext+i",
    ("direct", "MUMPS"): "-ksp_type preonly -pc_type cholesky -pc_factor_mat_solver_type mumps",
}
PACKAGES = {"BoomerAMG": "hypre", "direct": "mumps"}
PREFIX = "linear_"
LOWEST = 1e-4  # of rtol: where this is not low enough the table shows the error that is left


@dataclass
class Linear:
    """A K x = b, the held components taken out of it, and what is known of it."""

    A: PETSc.Mat  # the stiffness, rows and columns of held components those of the identity
    b: PETSc.Vec  # the load that is left, 0 where it is held
    # the displacement, less that of the held components alone, shape ``(n,)``
    reference: np.ndarray
    scale: float  # the largest displacement
    seconds: float  # of assembly; that copies are joined again is the benchmark's, and not counted

    def error(self, x):
        """Largest error of a solution, in terms of the largest displacement. Collective."""
        return largest(self.A.getComm().tompi4py(), x.array_r - self.reference) / self.scale


def linear_problem(made, solution):
    """The linear problem of a scene whose contact has been solved. Collective."""
    dofs, comm = solution.dofs, solution.decomposition.comm
    forms = Forms(made["a"], made["L"], dofs.V, made["decomposition"], {}, {})
    comm.barrier()
    start = time.perf_counter()
    K, f = forms.stiffness(), forms.load().values
    seconds = time.perf_counter() - start
    A = untorn(K, dofs)
    b = A.createVecRight()
    load = dofs.to_primal(f).reshape(-1, dofs.bs)
    b.array[:] = dofs.reduce(load, np.add).ravel()
    u = dofs.reduce(solution.u.reshape(-1, dofs.bs), np.maximum)
    held = solution.gluing.prescribed.flag.copy()
    held[solution.gluing.records.group[solution.force > 0.0]] = True
    x = b.duplicate()
    x.array[:] = np.where(held, u, 0.0).ravel()
    rows = np.flatnonzero(held.ravel()) + A.getOwnershipRange()[0]
    A.zeroRowsColumns(rows.astype(PETSc.IntType), 1.0, x, b)
    b.array[held.ravel()] = 0.0
    x.destroy()
    reference, seconds = np.where(held, 0.0, u).ravel(), comm.allreduce(seconds, op=MPI.MAX)
    return Linear(A, b, reference, largest(comm, u), seconds)


def untorn(K, dofs):
    """The stiffness of the untorn mesh, with its rigid motions: copies are added. Collective."""

    def parallel(local, csr):
        sizes = tuple((size, None) for size in local)
        return PETSc.Mat().createAIJ(sizes, bsize=dofs.bs, csr=csr, comm=dofs.comm)

    group = np.empty(dofs.num_nodes, dtype=PETSc.IntType)
    group[dofs.dolfinx_node] = dofs.group
    index = (group[:, None] * dofs.bs + np.arange(dofs.bs, dtype=PETSc.IntType)).ravel()
    n, g = dofs.num_nodes * dofs.bs, dofs.num_groups * dofs.bs
    rows = np.arange(n + 1, dtype=PETSc.IntType)
    copies = parallel((n, g), (rows, index, np.ones(n)))
    columns = (K.indices + dofs.offsets[dofs.comm.rank] * dofs.bs).astype(PETSc.IntType)
    torn = parallel((n, n), (K.indptr.astype(PETSc.IntType), columns, K.data))
    A = torn.ptap(copies)
    torn.destroy()
    copies.destroy()
    A.setOption(PETSc.Mat.Option.SPD, True)
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, : dofs.bs]
    points = A.createVecRight()
    points.setBlockSize(dofs.bs)
    points.array[:] = dofs.reduce(x, np.maximum).ravel()
    A.setNearNullSpace(PETSc.NullSpace().createRigidBody(points))
    return A


def linear_row(linear, key, rtol):
    """Set up and solve the linear problem; a row. Collective."""
    comm, x = linear.A.getComm().tompi4py(), linear.b.duplicate()
    with solver(SETTINGS[key], rtol) as ksp:
        ksp.setOperators(linear.A)
        comm.barrier()
        start = time.perf_counter()
        ksp.setUp()
        ready = time.perf_counter()
        ksp.solve(linear.b, x)
        parts = ready - start, time.perf_counter() - ready
        steps = ksp.getIterationNumber()
    row = {"solver": key[0], "setting": f"{key[1]}, rtol {rtol:.0e}", "steps": steps}
    row["set-up"], row["solve"] = (comm.allreduce(part, op=MPI.MAX) for part in parts)
    row |= {"all": linear.seconds + price(row), "error": linear.error(x)}
    x.destroy()
    say(row)
    return row


def first_tolerance(linear, text, rtol):
    """The first of rtol, rtol/10, ... with which CG stops at an error of at most rtol. Collective.

    Looked up in the steps of one solve.
    """
    residuals, errors = [], []

    def look(ksp, _, norm):
        residuals.append(norm)
        errors.append(linear.error(ksp.buildSolution()))

    with solver(text, LOWEST * rtol) as ksp:
        if ksp.getType() == PETSc.KSP.Type.PREONLY:
            return rtol
        x = linear.b.duplicate()
        ksp.setOperators(linear.A)
        ksp.setMonitor(look)
        ksp.solve(linear.b, x)
    x.destroy()
    wrong = [norm for norm, error in zip(residuals, errors, strict=True) if error > rtol]
    tolerance = rtol
    while any(norm <= tolerance * residuals[0] for norm in wrong) and tolerance > LOWEST * rtol:
        tolerance /= 10
    return linear.A.getComm().tompi4py().bcast(tolerance)


@contextmanager
def solver(text, rtol):
    """CG, or what the text says."""
    options, words = PETSc.Options(PREFIX), text.split()
    for name, value in zip(words[::2], words[1::2], strict=True):
        options[name.removeprefix("-")] = value
    ksp = PETSc.KSP().create(MPI.COMM_WORLD)
    ksp.setOptionsPrefix(PREFIX)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setTolerances(rtol=rtol, max_it=2000)
    ksp.setFromOptions()
    yield ksp
    ksp.destroy()
    for name in words[::2]:  # smoothers read theirs in the set-up
        options.delValue(name.removeprefix("-"))


# --- Contact beside it ---------------------------------------------------------------------------

# arguments of the demos, by the size of the run
CUBES = {"quick": (8, 4), "default": (64, 10), "large": (512, 10)}
BALLS = {"quick": (4_000, 4), "default": (235_000, 64), "large": (2_090_000, 256)}
SCENES = {
    "cube_3d": {name: ["--subdomains", n, "--cells", m] for name, (n, m) in CUBES.items()},
    "hertz_3d": {name: ["--unknowns", m, "--subdomains", n] for name, (m, n) in BALLS.items()},
}


def contact(made, qp_type, options):
    """Solve a contact from scratch; the solution, the report, and a row."""
    types = {"tfeti_qp_type": qp_type, "tfeti_pc_type": "auto"}
    problem = tfeti.ContactProblem(**made, petsc_options={**options, **types})
    problem.solve()
    report = problem.report
    row = {
        "solver": f"contact, {qp_type}",
        "setting": f"rtol {problem.options.number:.0e}",
        "steps": f"{report.F_multiplications} F + {report.preconditioner_multiplications} S",
        "set-up": report.seconds["factors"],
        "solve": report.seconds["coarse"] + report.seconds["solve"],
        "all": solve_seconds(vars(report)),
        "error": report.residuals["displacement_error"],
    }
    problem.destroy()
    say(row)
    return problem.solution, report, row


def study(made, options, arguments):
    """A row for each solver and setting, the fastest of several runs that take turns."""
    rtol, found = float(options.get("tfeti_rtol", 1e-6)), []
    solution, _, row = contact(made, "newton", options)
    linear = linear_problem(made, solution)
    work = [
        (key, first_tolerance(linear, text, rtol))
        for key, text in SETTINGS.items()
        if key[0] == "GAMG" or PETSc.Sys.hasExternalPackage(PACKAGES[key[0]])
        if not (arguments.large and key[0] == "direct")
    ]
    for repeat in range(1 if arguments.quick else arguments.repeats):
        if repeat:
            *_, row = contact(made, "newton", options)
        found.append([row, *(linear_row(linear, *given) for given in work)])
    linear.A.destroy()
    linear.b.destroy()
    rows = [min(runs, key=price) for runs in zip(*found, strict=True)]
    _, report, smalse = contact(made, "smalse", options)  # once: it takes its time
    return [rows[0], smalse, *rows[1:]], report


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
            best = {row["solver"]: row for row in sorted(rows, key=price, reverse=True)}
            chosen = [row for row in rows if row is best[row["solver"]]]
            stacked(panel, title.split(":")[0], chosen, ["set-up", "solve"])


def main(argv):
    """Run the studies and write them; returns the tables."""
    given = {"large": False, "scenes": SCENES, "repeats": 3, "processor": False}
    arguments, rest = command_line(__doc__, argv, **given)
    size = "quick" if arguments.quick else "large" if arguments.large else "default"
    options, ranks, unit = petsc_options(rest), MPI.COMM_WORLD.size, choose_clock(arguments)
    tables = {}
    for name in arguments.scenes or SCENES:
        made = scene(name, SCENES[name][size])
        rows, report = study(made, options, arguments)
        sizes = f"{report.primal_dofs} unknowns, {report.subdomains} subdomains"
        tables[f"{name}: {sizes}, {ranks} ranks, {unit}"] = with_ratios(rows)
    named = {title.split(":")[0]: rows for title, rows in tables.items()}
    return finish(arguments, "linear_price", tables, draw, lambda _: named)


if __name__ == "__main__":
    main(sys.argv[1:])
