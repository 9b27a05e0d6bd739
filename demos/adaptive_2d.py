# # A mesh that finds the contact
#
# The half cylinder of `hertz_2d.py`, without knowing where and how wide the contact is: from a
# coarse uniform mesh on, each solve says how large the elements of the next one should be.
#
#     ./run mpirun -n 2 python3 demos/adaptive_2d.py --error 0.05

"""Hertz contact in 2D on meshes that follow the estimated error."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.adaptive import last_of, solves
from demos.demo_tools import Demo
from demos.hertz import LineContact, compare
from meshes.half_cylinder import build

R, E, nu, a = 1.0, 1.0, 0.3, 0.04
hertz = LineContact.from_half_width(a, R, E / (1 - nu**2))


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


def steps(goal, subdomains, options):
    """Solve, estimate, mesh anew, until the error is small enough. Collective."""

    # ## Meshes
    #
    # gmsh makes them on rank 0, a coarse uniform one at first, then from the sizes that the last
    # estimate asks for.
    def mesh(sizes):
        return build(R, fine=0.1 * R, fine_radius=10 * R, sizes=sizes)

    return solves(mesh, scene, goal, lambda nodes: subdomains, options, MPI.COMM_WORLD)


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    goal = arguments.error or (0.2 if arguments.quick else 0.05)
    options = {"tfeti_rtol": "auto", **demo.petsc_options}
    problem = last_of(steps(goal, arguments.subdomains, options))

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
