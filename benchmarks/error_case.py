"""Solves of one scene on meshes that get finer, in a process of its own, for time_against_error.

    ./run python3 benchmarks/error_case.py '{"scene": "half ball", "sizes": [4, 6]}' FILE REFERENCE

The coarsest mesh is solved once more at first: what that takes longer are imports in functions
and forms that are compiled or looked up. Results go to FILE, a row of JSON for each size. REFERENCE
has the stresses that errors are against; one that is not there yet is written, of the last size.
"""

from __future__ import annotations

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv[:1])

import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any

import gmsh
import numpy as np
import ufl
from dolfinx import fem, geometry
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.adaptive import solves
from benchmarks.error_scenes import (
    ADAPTIVE,
    GRADED,
    SCENES,
    Scene,
    half_ball_on_plane,
    half_cylinder_on_plane,
)
from benchmarks.profiles import Array
from meshes import half_ball, half_cylinder
from meshes.tools import element_options

TRIANGLE, QUADRILATERAL = "triangle", "quadrilateral"
# what makes gmsh mesh with them and nothing else
CELLS = {TRIANGLE: {}, QUADRILATERAL: {"RecombineAll": 1, "RecombinationAlgorithm": 3}}
# unknowns of a subdomain, in 2D and 3D
SUBDOMAIN = {2: 2500, 3: 4000}
# seconds up to which a solve is repeated, and how often
SHORT, REPEATS = 3.0, 3
NU = 0.3  # of all scenes
AUTO = {"tfeti_rtol": "auto"}
# solves on meshes that follow the error
FOLLOWED = {
    "half cylinder": lambda goal: solves(
        lambda sizes: half_cylinder.build(1.0, fine=0.1, fine_radius=10.0, sizes=sizes),
        half_cylinder_on_plane,
        goal,
        lambda nodes: 8,
        AUTO,
        MPI.COMM_WORLD,
    ),
    "half ball": lambda goal: solves(
        lambda sizes: half_ball.build(1.0, fine=0.2, fine_radius=10.0, sizes=sizes),
        lambda d: half_ball_on_plane(d, reach=None),
        goal,
        lambda nodes: max(2, round(3 * nodes / SUBDOMAIN[3])),
        AUTO,
        MPI.COMM_WORLD,
    ),
}


@dataclass(frozen=True)
class Case:
    """What is solved.

    Attributes:
        scene: Its name.
        sizes: Elements along a, or goals of the adaptive loop.
        mesh: Uniform, graded or adaptive.
        cell: Triangles, or quadrilaterals.
        degree: Of displacements.
        order: Of the cells' geometry.
        ranks: Processes.
        rtol: The solver's tolerance.
        processor: Whether seconds are those of the processor, not of the wall.
    """

    scene: str
    sizes: tuple[float, ...]
    mesh: str = GRADED
    cell: str = TRIANGLE
    degree: int = 1
    order: int = 1
    ranks: int = 1
    rtol: float | str = 1e-6
    processor: bool = False

    @classmethod
    def read(cls, text: str) -> Case:
        """From JSON."""
        found = json.loads(text)
        return cls(**{f.name: found[f.name] for f in fields(cls) if f.name in found})

    def write(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self))


@dataclass(frozen=True)
class Solved:
    """A problem that is solved, with what it took."""

    problem: tfeti.ContactProblem
    seconds: float
    meshing: float
    peak: float


def clear_peak() -> None:
    """From now on the peak of resident memory is counted anew, where Linux can."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def peak_megabytes(comm: MPI.Intracomm) -> float:
    """Peak of resident memory since ``clear_peak``, of all ranks. Collective."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return float(comm.allreduce(int(line.split()[1]))) / 1024


def meshed(scene: Scene, case: Case, size: float, comm: MPI.Intracomm) -> tuple[Any, int]:
    """gmsh's model on rank 0, and how many subdomains suit it."""
    model, parts = None, 0
    if comm.rank == 0:
        if gmsh.isInitialized():
            gmsh.clear()  # models of earlier meshes
        options = {"ElementOrder": case.order, **CELLS[case.cell]}
        with element_options(**options):
            model = scene.build(size, case.mesh)
        dim = model.getDimension()
        # of degree d, so many nodes for each one of degree 1
        nodes = len(model.mesh.getNodes()[0]) * (case.degree / case.order) ** dim
        parts = max(comm.size, round(dim * nodes / SUBDOMAIN[dim]))
    return model, comm.bcast(parts)


def solve(scene: Scene, case: Case, size: float, comm: MPI.Intracomm) -> Solved:
    """Mesh, then set up and solve by the clock: from gmsh's mesh to displacements. Collective."""
    if case.mesh == ADAPTIVE:
        return adapted(case, size, comm)
    start = time.perf_counter()
    model, parts = meshed(scene, case, size, comm)
    comm.barrier()
    clear_peak()
    begin = time.perf_counter()
    decomposition = tfeti.read_gmsh(model, comm, parts)
    problem = tfeti.ContactProblem(
        **scene.make(decomposition, case.degree), petsc_options={"tfeti_rtol": case.rtol}
    )
    scene.solve(problem)
    comm.barrier()
    end = time.perf_counter()
    return Solved(problem, end - begin, begin - start, peak_megabytes(comm))


def adapted(case: Case, goal: float, comm: MPI.Intracomm) -> Solved:
    """All solves of the adaptive loop, and their estimates. Collective."""
    clear_peak()
    begin, meshing, last = time.perf_counter(), 0.0, None
    for problem, _, seconds in FOLLOWED[case.scene](goal):
        meshing += seconds
        if last is not None:
            last.destroy()
        last = problem
    assert last is not None
    comm.barrier()
    return Solved(last, time.perf_counter() - begin - meshing, meshing, peak_megabytes(comm))


def profile(scene: Scene, solution: tfeti.Solution, comm: MPI.Intracomm) -> Array:
    """The pressure at the scene's samples. Collective."""
    data = solution.contact(0)
    parts = comm.allgather((scene.place(data.points), scene.force(data)))
    points, pressure = (np.concatenate(part) for part in zip(*parts, strict=True))
    return scene.samples.at(points, pressure)


def dual_value(problem: tfeti.ContactProblem, energy: float, comm: MPI.Intracomm) -> float:
    """q(λ) = −½‖u‖²_K − λᵀc, the least total energy J(u*) up to the algebraic error. Collective.

    With K u = f − Bᵀλ it is ½uᵀKu − fᵀu + λᵀ(Bu − c); its error is of second order.
    """
    solution = problem.solution
    work = comm.allreduce(float(solution.lam @ solution.gluing.constraints.c))
    return -0.5 * energy**2 - work


def densities(sigma: Array) -> Array:
    """Eσ : C⁻¹σ of stresses, shape ``(n, 3, 3)``."""
    squares = (1 + NU) * np.einsum("nij,nij->n", sigma, sigma)
    return squares - NU * np.einsum("nii->n", sigma) ** 2


def stresses(solution: tfeti.Solution, points: Array, cells: Array) -> Array:
    """Stress at points of some cells of this rank."""
    return solution.stress.eval(points, cells).reshape(-1, 3, 3)


def write_stresses(file: Path, solution: tfeti.Solution, young: Callable[[Array], Array]) -> None:
    """Write the stress at the midpoints of all cells, with what each counts. Collective."""
    mesh, comm = solution.decomposition.mesh, solution.decomposition.comm
    cells = np.arange(len(solution.decomposition.cell_subdomain), dtype=np.int32)
    W = fem.functionspace(mesh, ("DG", 0))
    points = dmesh.compute_midpoints(mesh, mesh.topology.dim, cells)
    volumes = fem.assemble_vector(fem.form(ufl.TestFunction(W) * ufl.dx)).array
    weights = volumes[np.asarray(W.dofmap.list)[cells, 0]]
    found = comm.gather((points, weights, stresses(solution, points, cells)))
    if found is not None:
        x, w, sigma = (np.concatenate(part) for part in zip(*found, strict=True))
        np.savez(file, points=x, weights=w / young(x), sigma=sigma)


def energy_error(file: Path, solution: tfeti.Solution) -> float:
    """‖σ_h − σ‖ in energy over ‖σ‖, where the two meshes both are. Collective."""
    mesh, comm = solution.decomposition.mesh, solution.decomposition.comm
    with np.load(file) as fine:
        points, weights, sigma = (fine[name] for name in ("points", "weights", "sigma"))
    cells = np.arange(len(solution.decomposition.cell_subdomain), dtype=np.int32)
    tree = geometry.bb_tree(mesh, mesh.topology.dim, entities=cells)
    near = geometry.compute_collisions_points(tree, points)
    hit = geometry.compute_colliding_cells(mesh, near, points)
    inside = np.diff(hit.offsets) > 0
    # a point between subdomains is in several ranks' cells: the first one counts it
    first = np.where(inside, comm.rank, comm.size)
    comm.Allreduce(MPI.IN_PLACE, first, op=MPI.MIN)
    own = np.flatnonzero(inside & (first == comm.rank))
    found = stresses(solution, points[own], hit.array[hit.offsets[own]])
    error = weights[own] @ densities(found - sigma[own])
    size = weights @ densities(sigma)
    return float(np.sqrt(comm.allreduce(error) / size))


def row(case: Case, size: float, reference: Path, comm: MPI.Intracomm) -> dict[str, Any]:
    """The best of some solves, and what came out. Collective.

    A reference that is not there yet is written.
    """
    scene = SCENES[case.scene]()
    best = solve(scene, case, size, comm)
    if reference.exists() and comm.bcast(best.seconds) < SHORT:
        for _ in range(REPEATS - 1):
            best.problem.destroy()
            again = solve(scene, case, size, comm)
            best = (
                again
                if comm.bcast(again.seconds < best.seconds)
                else Solved(again.problem, best.seconds, best.meshing, best.peak)
            )
    problem, report = best.problem, best.problem.report
    found = problem.estimate()
    made = {
        "size": size,
        "unknowns": report.primal_dofs,
        "subdomains": report.subdomains,
        "F": int(report.in_all["F_multiplications"]),
        "S": int(report.in_all["preconditioner_multiplications"]),
        "seconds": best.seconds,
        "meshing": best.meshing,
        "MB": best.peak,
        "J": dual_value(problem, found.energy, comm),
        "energy": energy_error(reference, problem.solution) if reference.exists() else None,
        "estimate": found.relative_discretisation,
        "profile": profile(scene, problem.solution, comm).tolist(),
    }
    if made["energy"] is None:
        write_stresses(reference, problem.solution, scene.young)
    problem.destroy()
    return made


def main(argv):
    """Solve a case, write its rows, and return them."""
    started, comm, case = time.time(), MPI.COMM_WORLD, Case.read(argv[0])
    file, reference = (Path(word) for word in argv[1:])
    if case.processor:
        time.perf_counter = time.process_time
    first = None
    if reference.exists():  # the reference itself is not timed
        solved = solve(SCENES[case.scene](), case, case.sizes[0], comm)
        solved.problem.destroy()
        first = solved.seconds
    rows = [row(case, size, reference, comm) for size in case.sizes]
    launched = float(os.environ.get("LAUNCHED", started))
    once = {"start": started - launched, "first": first and first - rows[0]["seconds"]}
    if comm.rank == 0:
        file.write_text(json.dumps({"rows": rows, "once": once}))
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
