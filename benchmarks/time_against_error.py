"""Errors against seconds and memory: scenes, meshes, degrees, cells and ranks side by side.

    ./run python3 benchmarks/time_against_error.py [--quick] [--scenes "half ball" ...]

Each scene is solved on meshes that get finer, each case in processes of its own: uniform, graded by
hand, and following the estimated error (by the demos ``adaptive_2d.py`` and ``adaptive_3d.py``);
with displacements of degree 1 and 2, the latter on curved cells, too; with triangles and
quadrilaterals. ``seconds`` are from gmsh's mesh to the displacement, the best of three if short;
gmsh's own are in ``meshing``; what is paid once, for imports and the compiling of forms, is left
out: the coarsest mesh is solved once more at first. ``MB`` is the peak of resident memory of all
ranks.

Errors are relative, against a fine solution of degree 2 of the same scene: ``energy`` is that of
the stress in the energy norm, ``estimate`` what the solve itself says of it; ``pressure`` is the L²
norm inside 0.9 a; ``a`` and ``p0`` are as in benchmarks/pressures.py. The last column is against
the closed form, which belongs to half planes and half spaces.
Results go to results/time_against_error.md, .json and .png.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gmsh
import numpy as np
import ufl
from dolfinx import fem, geometry
from dolfinx import mesh as dmesh
from mpi4py import MPI

import demos
import tfeti_dolfinx as tfeti
from benchmarks.elastic import gathered
from benchmarks.error_scenes import ADAPTIVE, GRADED, NU, SCENES, UNIFORM, Scene
from benchmarks.pressures import Array, errors
from benchmarks.tools import (
    FILE,
    Tables,
    command_line,
    curves,
    finish,
    json_of,
    picture,
    write_tables,
)
from meshes.tools import element_options

TRIANGLE, QUADRILATERAL = "triangle", "quadrilateral"
# what makes gmsh mesh with them and nothing else
CELLS = {TRIANGLE: {}, QUADRILATERAL: {"RecombineAll": 1, "RecombinationAlgorithm": 3}}
FOLLOWED = {"half cylinder": "adaptive_2d", "half ball": "adaptive_3d"}
# unknowns of a subdomain, in 2D and 3D
SUBDOMAIN = {2: 2500, 3: 4000}
# seconds up to which a solve is repeated, and how often
SHORT, REPEATS = 3.0, 3
MEASURES = ("energy", "pressure")
COMM = MPI.COMM_WORLD

# --- Cases --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """What is solved."""

    scene: str  # its name
    sizes: tuple[float, ...]  # elements along a, or goals of the adaptive loop
    mesh: str = GRADED  # uniform, graded or adaptive
    cell: str = TRIANGLE  # triangles, or quadrilaterals
    degree: int = 1  # of displacements
    order: int = 1  # of the cells' geometry
    ranks: int = 1  # processes
    rtol: float | str = 1e-6  # the solver's tolerance
    processor: bool = False  # whether seconds are those of the processor, not of the wall

    @property
    def label(self) -> str:
        """The case in a few words."""
        words = [self.mesh, "" if self.cell == TRIANGLE else "quadrilaterals", f"P{self.degree}"]
        words += ["curved" if self.order == 2 else "straight"] * (self.degree == 2)
        words += [f"{self.ranks} ranks"] * (self.ranks > 1)
        return " ".join(word for word in words if word)


def both(name: str, linear: tuple[float, ...], order: int = 2, **other: Any) -> list[Case]:
    """Degree 1, and degree 2 on meshes that are twice as coarse."""
    quadratic = tuple(size / 2 for size in linear)
    return [Case(name, linear, **other), Case(name, quadratic, degree=2, order=order, **other)]


def plans() -> dict[str, tuple[list[Case], Case]]:
    """Groups of meshes of each scene, and the fine solution that errors are against."""
    sizes, found = (6.0, 12.0, 24.0, 48.0), {}

    def plan(name: str, finest: float, order: int, *groups: list[Case]) -> None:
        fine = Case(name, (finest,), degree=2, order=order, rtol=1e-7)
        found[name] = [case for group in groups for case in group], fine

    for name, everywhere, goals in (
        ("half cylinder", (1.0, 2.0, 4.0, 6.0), (0.3, 0.15, 0.08, 0.04)),
        ("cylinder on block", (1.0, 2.0, 4.0), ()),
    ):
        straight, squares = both(name, sizes, order=1)[1:], both(name, sizes, cell=QUADRILATERAL)
        uniform = both(name, everywhere, mesh=UNIFORM)
        uniform += [Case(name, goals, ADAPTIVE)] if goals else []
        two = both(name, sizes, ranks=2)
        plan(name, 64.0, 2, both(name, sizes), straight, squares, uniform, two)

    name, few = "half ball", (4.0, 6.0, 10.0)
    first = [Case(name, (*few, 16.0)), both(name, few)[1]]
    uniform = [Case(name, (0.6, 1.0, 1.5), UNIFORM), Case(name, (0.35, 0.25, 0.18), ADAPTIVE)]
    two = [replace(case, ranks=2) for case in first]
    plan(name, 10.0, 2, first, both(name, few, order=1)[1:], uniform, two)

    for name in ("rounded punch", "partial slip"):
        uniform, two = [Case(name, (1.0, 2.0, 4.0), UNIFORM)], both(name, sizes, order=1, ranks=2)
        plan(name, 64.0, 1, both(name, sizes, order=1), uniform, two)

    name, around = "shrink fit", (8.0, 16.0, 32.0, 64.0)
    kinds = {}, {"cell": QUADRILATERAL}, {"ranks": 2}
    # of no mesh a refinement: their midpoints are better
    plan(name, 90.0, 2, *(both(name, around, mesh=UNIFORM, **kind) for kind in kinds))
    return found


# --- One case, in processes of its own ------------------------------------------------------------


@dataclass(frozen=True)
class Solved:
    """A problem that is solved, with what it took."""

    problem: tfeti.ContactProblem
    seconds: float
    meshing: float
    peak: float


def memory(clear: bool = False) -> float:
    """Peak of resident memory of all ranks since it was cleared, where Linux can. Collective."""
    if clear:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return float(COMM.allreduce(int(line.split()[1]))) / 1024


def meshed(scene: Scene, case: Case, size: float) -> tuple[Any, int]:
    """gmsh's model on rank 0, and how many subdomains suit it."""
    model, parts = None, 0
    if COMM.rank == 0:
        if gmsh.isInitialized():
            gmsh.clear()  # models of earlier meshes
        with element_options(ElementOrder=case.order, **CELLS[case.cell]):
            model = scene.build(size, case.mesh)
        dim = model.getDimension()
        # of degree d, so many nodes for each one of degree 1
        nodes = len(model.mesh.getNodes()[0]) * (case.degree / case.order) ** dim
        parts = max(COMM.size, round(dim * nodes / SUBDOMAIN[dim]))
    return model, COMM.bcast(parts)


def solve(scene: Scene, case: Case, size: float) -> Solved:
    """Mesh, then set up and solve by the clock: from gmsh's mesh to displacements. Collective."""
    if case.mesh == ADAPTIVE:
        return adapted(case, size)
    start = time.perf_counter()
    model, parts = meshed(scene, case, size)
    memory(clear=True)
    begin = time.perf_counter()
    decomposition = tfeti.read_gmsh(model, COMM, parts)
    made = scene.make(decomposition, case.degree)
    problem = tfeti.ContactProblem(**made, petsc_options={"tfeti_rtol": case.rtol})
    scene.solve(problem)
    COMM.barrier()
    return Solved(problem, time.perf_counter() - begin, begin - start, memory())


def adapted(case: Case, goal: float) -> Solved:
    """All solves of a demo that follows its error, and their estimates. Collective."""
    generate, meshing = gmsh.model.mesh.generate, [0.0]

    def watched(dim: int) -> None:
        start = time.perf_counter()
        generate(dim)
        meshing[0] += time.perf_counter() - start

    memory(clear=True)
    begin = time.perf_counter()
    with patch.object(gmsh.model.mesh, "generate", watched):
        problem = demos.names_of(FOLLOWED[case.scene], ["--error", goal])["problem"]
    COMM.barrier()
    spent = COMM.bcast(meshing[0])
    return Solved(problem, time.perf_counter() - begin - spent, spent, memory())


def densities(sigma: Array) -> Array:
    """Eσ : C⁻¹σ of stresses, shape ``(n, 3, 3)``."""
    squares = (1 + NU) * np.einsum("nij,nij->n", sigma, sigma)
    return squares - NU * np.einsum("nii->n", sigma) ** 2


def stresses(solution: tfeti.Solution, points: Array, cells: Array) -> Array:
    """Stress at points of some cells of this rank."""
    return solution.stress.eval(points, cells).reshape(-1, 3, 3)


def write_stresses(file: Path, solution: tfeti.Solution, young: Callable[[Array], Array]) -> None:
    """Write the stress at the midpoints of all cells, with what each counts. Collective."""
    mesh = solution.decomposition.mesh
    cells = np.arange(len(solution.decomposition.cell_subdomain), dtype=np.int32)
    W = fem.functionspace(mesh, ("DG", 0))
    points = dmesh.compute_midpoints(mesh, mesh.topology.dim, cells)
    volumes = fem.assemble_vector(fem.form(ufl.TestFunction(W) * ufl.dx)).array
    weights = volumes[np.asarray(W.dofmap.list)[cells, 0]]
    x, w, sigma = gathered(points, weights, stresses(solution, points, cells))
    if COMM.rank == 0:
        np.savez(file, points=x, weights=w / young(x), sigma=sigma)


def energy_error(file: Path, solution: tfeti.Solution) -> float:
    """‖σ_h − σ‖ in energy over ‖σ‖, where the two meshes both are. Collective."""
    mesh = solution.decomposition.mesh
    with np.load(file) as fine:
        points, weights, sigma = (fine[name] for name in ("points", "weights", "sigma"))
    cells = np.arange(len(solution.decomposition.cell_subdomain), dtype=np.int32)
    tree = geometry.bb_tree(mesh, mesh.topology.dim, entities=cells)
    near = geometry.compute_collisions_points(tree, points)
    hit = geometry.compute_colliding_cells(mesh, near, points)
    inside = np.diff(hit.offsets) > 0
    # a point between subdomains is in several ranks' cells: the first one counts it
    first = np.where(inside, COMM.rank, COMM.size)
    COMM.Allreduce(MPI.IN_PLACE, first, op=MPI.MIN)
    own = np.flatnonzero(inside & (first == COMM.rank))
    found = stresses(solution, points[own], hit.array[hit.offsets[own]])
    error = weights[own] @ densities(found - sigma[own])
    return float(np.sqrt(COMM.allreduce(error) / (weights @ densities(sigma))))


def solved_row(case: Case, size: float, reference: Path) -> dict[str, Any]:
    """The best of some solves, and what came out; writes a reference that is not there yet."""
    scene, timed = SCENES[case.scene](), reference.exists()
    last = solve(scene, case, size)
    runs = [last]
    while timed and len(runs) < REPEATS and COMM.bcast(runs[0].seconds) < SHORT:
        last.problem.destroy()
        last = solve(scene, case, size)
        runs.append(last)
    best = min(runs, key=lambda run: run.seconds)
    problem, report = last.problem, last.problem.report
    data = problem.solution.contact(0)
    points, pressure = gathered(scene.place(data.points), scene.force(data))
    row = {
        "size": size,
        "unknowns": report.primal_dofs,
        "seconds": best.seconds,
        "meshing": best.meshing,
        "MB": best.peak,
        "F": int(report.in_all["F_multiplications"]),
        "energy": energy_error(reference, problem.solution) if timed else None,
        "estimate": problem.estimate().relative_discretisation,
        "profile": scene.samples.at(points, pressure).tolist(),
    }
    if not timed:
        write_stresses(reference, problem.solution, scene.young)
    problem.destroy()
    return row


def worker(text: str, file: str, reference: Path) -> None:
    """Solve the case of a JSON text, and write its rows. Collective."""
    case = Case(**json.loads(text))
    if case.processor:
        time.perf_counter = time.process_time
    if reference.exists():  # compiles forms; the reference itself is not timed
        solve(SCENES[case.scene](), case, case.sizes[0]).problem.destroy()
    rows = [solved_row(case, size, reference) for size in case.sizes]
    if COMM.rank == 0:
        Path(file).write_text(json.dumps({"rows": rows}))


# --- Tables ---------------------------------------------------------------------------------------


def compared(scene: Scene, found: dict[str, Any], best: dict[str, Any]) -> dict[str, Any]:
    """A row of the table, from what a solve gives and the reference."""
    pressure = np.array(found.pop("profile"))
    against = errors(scene.samples, pressure, np.array(best["profile"]))
    closed = errors(scene.samples, pressure, scene.exact)
    return {**found, **against, "pressure, closed form": closed["pressure"]}


def between(x: Sequence[float], y: Sequence[float], at: float) -> float:
    """y at an x, on straight lines of logarithms."""
    order = np.argsort(x)
    return float(np.exp(np.interp(np.log(at), np.log(x)[order], np.log(y)[order])))


def degrees(groups: dict[str, Sequence[dict[str, Any]]]) -> list[dict[str, Any]]:
    """Errors of degree 1 over those of degree 2 in the same time, by the names of groups."""
    table = []
    for name, quadratic in groups.items():
        linear = groups.get(name.replace("P2 curved", "P1").replace("P2 straight", "P1"), quadratic)
        if linear is quadratic:
            continue
        start = max(rows[0]["seconds"] for rows in (linear, quadratic))
        end = min(rows[-1]["seconds"] for rows in (linear, quadratic))
        for seconds in [start, np.sqrt(start * end), end] if start < end else []:
            row = {"meshes": name, "seconds": float(seconds)}
            for measure in MEASURES:
                one, two = (
                    between([r["seconds"] for r in rows], [r[measure] for r in rows], seconds)
                    for rows in (linear, quadratic)
                )
                row |= {f"{measure}, P1": one, f"{measure}, P2": two}
                row[f"{measure}, P1 over P2"] = one / two
            table.append(row)
    return table


def study(name: str, arguments: Any, folder: Path) -> Tables:
    """The tables of a scene; what its reference has goes into a folder."""
    (cases, finest), scene, reference = plans()[name], SCENES[name](), folder / "reference.npz"
    if arguments.quick:  # the first two groups, their two coarsest meshes
        cases = [replace(case, sizes=case.sizes[:2]) for case in cases[:2]]
        finest = replace(finest, sizes=cases[0].sizes[1:], rtol=1e-6)

    def run(case: Case) -> list[dict[str, Any]]:  # in processes of its own
        words = [sys.executable, __file__, "--worker", json.dumps(asdict(case)), FILE, reference]
        return list(json_of(words, case.ranks)["rows"])

    best = run(finest)[-1]
    rows, by_name = [], {}
    for case in cases:
        if case.ranks in arguments.ranks:
            found = run(replace(case, processor=arguments.processor))
            made = [compared(scene, one, best) for one in found]
            rows += [{"meshes": case.label, **row} for row in made]
            by_name[case.label] = made
            print(name, case.label, flush=True)
    beside = degrees(by_name)
    return {name: rows} | ({f"{name}, degrees at equal seconds": beside} if beside else {})


def draw(path, tables):
    """Errors over seconds, on one rank: a row of panels for each scene, energy and pressure."""
    scenes = {title: rows for title, rows in tables.items() if title in SCENES}
    labels = dict.fromkeys(row["meshes"] for rows in scenes.values() for row in rows)
    names = [label for label in labels if not label.endswith("ranks")]
    with picture(path, len(MEASURES), 4.3 * len(scenes), rows=len(scenes)) as axes:
        for k, (title, rows) in enumerate(scenes.items()):
            own = {of: [row for row in rows if row["meshes"] == of] for of in names}
            for panel, name in zip(axes[2 * k :], MEASURES, strict=False):
                labels, columns = ("seconds", f"relative error, {name}"), ("seconds", name)
                lines = {of: group for of, group in own.items() if group}
                curves(panel, title, labels, lines, columns, names=names)


def main(argv):
    """Run the cases and write their tables; returns them."""
    if argv[:1] == ["--worker"]:
        return worker(*argv[1:3], Path(argv[3]))
    given = {"scenes": SCENES, "ranks": [1, 2], "processor": False}
    arguments, _ = command_line(__doc__, argv, **given)
    tables: Tables = {}
    for name in arguments.scenes or SCENES:
        with tempfile.TemporaryDirectory() as folder:
            tables |= study(name, arguments, Path(folder))
        write_tables(arguments.output, "time_against_error", tables)  # a later scene may fail
    return finish(arguments, "time_against_error", tables, draw)


if __name__ == "__main__":
    main(sys.argv[1:])
