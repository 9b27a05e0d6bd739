# # A mesh that finds the contact
#
# The half cylinder of `hertz_2d.py`, without knowing where and how wide the contact is: from a
# coarse uniform mesh on, each solve says how large the elements of the next one should be.
#
#     ./run mpirun -n 2 python3 demos/adaptive_2d.py --error 0.05

"""Hertz contact in 2D on meshes that follow the estimated error."""

import sys
import time
from functools import partial
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.hertz import LineContact, compare
from meshes.half_cylinder import build
from meshes.tools import sizes_from_triangles
from tfeti_dolfinx.compat import geometry_dofmap

R, E, nu, a = 1.0, 1.0, 0.3, 0.04
hertz = LineContact.from_half_width(a, R, E / (1 - nu**2))

# An element becomes at most so many times smaller or larger at once, and the error of all halved:
# a coarse mesh says little of where a fine one should be.
SMALLER, LARGER, STEP = 4.0, 2.0, 0.5


def scene(decomposition, degree=1):
    # ## Elasticity, load and contact
    #
    # As in `hertz_2d.py`. The closed form says which load; nothing else is taken from it.
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
    V = fem.functionspace(decomposition.mesh, ("Lagrange", degree, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=decomposition.mesh, subdomain_data=decomposition.facet_tags)
    traction = fem.Constant(decomposition.mesh, (0.0, -hertz.load / (2 * R)))
    axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * ds(decomposition.surface("top")),
        "bcs": [fem.dirichletbc(0.0, axis, V.sub(0))],
        "contacts": [tfeti.Obstacle("contact", tfeti.Plane((0, 0), normal=(0, 1)))],
        "decomposition": decomposition,
        "stress": elastic.stress,
    }


def new_sizes(solution, wanted):
    """Triangles with their sizes in the next mesh, on rank 0. Collective.

    With elements of size h the square of an element's error is about C h⁴, and the fewest elements
    have equal errors: h' = h (c/η²)^¼, and all errors add up to ``wanted``² for √c = wanted²/Ση.
    """
    mesh, comm = solution.decomposition.mesh, solution.decomposition.comm
    field = solution.discretisation_error
    cells = len(solution.decomposition.cell_subdomain)
    error = field.x.array[np.asarray(field.function_space.dofmap.list)[:cells, 0]]
    corners = mesh.geometry.x[geometry_dofmap(mesh)[:cells]]
    sides = corners[:, 1:, :2] - corners[:, :1, :2]
    h = np.sqrt(np.abs(np.linalg.det(sides)))
    root = wanted**2 / comm.allreduce(float(error.sum()))
    factor = np.sqrt(root / np.maximum(error, 1e-300))
    size = h * np.clip(factor, 1 / SMALLER, LARGER)
    parts = comm.gather((corners, np.repeat(size[:, None], 3, axis=1)), root=0)
    return None if parts is None else [np.concatenate(part) for part in zip(*parts, strict=True)]


def solves(goal, subdomains, options):
    """Problems that are solved, each on a better mesh, until the error is small enough. Collective.

    Yields:
        The problem, its estimate, and the seconds that gmsh has taken for the mesh. Destroying
        the problem is up to the caller.
    """
    comm, sizes = MPI.COMM_WORLD, None

    # ## Solve, estimate, mesh anew
    #
    # gmsh meshes on rank 0, from the sizes that the last estimate asks for.
    while True:
        start, model = time.perf_counter(), None
        if comm.rank == 0:
            field = None if sizes is None else partial(sizes_from_triangles, *sizes)
            model = build(R, fine=0.1 * R, fine_radius=10 * R, sizes=field)
        comm.barrier()
        meshing = time.perf_counter() - start
        decomposition = tfeti.read_gmsh(model, comm, subdomains)
        problem = tfeti.ContactProblem(**scene(decomposition), petsc_options=options)
        problem.solve()
        found = problem.estimate()
        wanted = max(STEP * found.discretisation, 0.95 * goal * found.energy)
        done = found.relative_discretisation <= goal
        if not done:
            sizes = new_sizes(problem.solution, wanted)
        yield problem, found, meshing
        if done:
            return


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    goal = arguments.error or (0.2 if arguments.quick else 0.05)
    options = {"tfeti_rtol": "auto", **demo.petsc_options}
    last = None
    for problem, found, _ in solves(goal, arguments.subdomains, options):
        if comm.rank == 0:
            print(
                f"{problem.report.primal_dofs} unknowns, error {found.relative_discretisation:.2%}",
                flush=True,
            )
        if last is not None:
            last.destroy()
        last = problem
    problem = last

    contact = problem.solution.contact(0)
    problem.report.errors.update(compare(comm, contact, contact.points[:, 0], hertz))
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        folder = demo.folder
        view = {"focus": (0.0, 4 * a, 0.0), "zoom": 0.14 * R / a, "show_edges": True}
        plot_deformed(folder / "adaptive_2d.png", problem.solution, factor=1.0, **view)
    return demo.finish(problem, "adaptive_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=8, help="subdomains")
    parser.add_argument("--error", type=float, help="relative discretisation error in energy")


if __name__ == "__main__":
    main(sys.argv[1:])
