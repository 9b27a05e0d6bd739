# # A square with given friction
#
# The 2D scene of the talk's table with Tresca friction: a unit square fixed on one side, pressed on
# a rough line and pulled along it. The subdomains are equal squares of 50 × 50 elements.
#
#     ./run mpirun -n 2 python3 demos/tresca_2d.py --subdomains 16

"""A square on a rough line: friction with a given bound, some nodes stick and some slip."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo


def torn_mesh(arguments):
    # ## Mesh
    comm = MPI.COMM_WORLD
    N = round(arguments.subdomains**0.5)
    cells = arguments.cells or (8 if arguments.quick else 50)
    square = dmesh.create_rectangle(
        comm, [(0, 0), (1, 1)], [N * cells] * 2, dmesh.CellType.quadrilateral
    )
    names = {"fixed": 1, "bottom": 2, "top": 3}
    facets = [
        dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[0], 0)),
        dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[1], 0)),
        dmesh.locate_entities_boundary(square, 1, lambda x: np.isclose(x[1], 1)),
    ]
    values = np.repeat(np.array(list(names.values()), dtype=np.int32), [len(f) for f in facets])
    order = np.argsort(np.concatenate(facets))
    facet_tags = dmesh.meshtags(square, 1, np.concatenate(facets)[order], values[order])

    def subdomain(x):
        i, j = np.minimum((x[:2] * N).astype(int), N - 1)
        return i + N * j

    return tfeti.decompose(square, subdomain, facet_tags=facet_tags, surfaces=names)


def scene(decomposition, bound):
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load, conditions, friction
    #
    # The bound is a traction: the same everywhere, whatever the pressure is.
    traction = fem.Constant(mesh, (0.05, -0.05))
    fixed = fem.locate_dofs_topological(V, 1, decomposition.facets("fixed"))
    line = tfeti.Plane((0, 0), normal=(0, 1))
    floor = tfeti.Obstacle("bottom", line, friction=tfeti.Tresca(bound), reach=np.inf, name="floor")
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * ds(decomposition.surface("top")),
        "bcs": [fem.dirichletbc(np.zeros(2), fixed, V)],
        "contacts": [floor],
        "stress": elastic.stress,
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, decomposition = demo.arguments, torn_mesh(demo.arguments)
    problem = tfeti.ContactProblem(
        **scene(decomposition, arguments.bound),
        decomposition=decomposition,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Its bound is kept
    #
    # The report has the share by which the largest tangential traction is above it.
    comm, data = decomposition.comm, problem.solution.contact("floor")
    largest = np.linalg.norm(data.tangential_traction, axis=1).max(initial=0.0)
    excess = comm.allreduce(float(largest), op=MPI.MAX) / arguments.bound - 1.0
    problem.report.errors["bound"] = max(excess, 0.0)
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "tresca_2d.png", problem.solution, factor=1.0)
    return demo.finish(problem, "tresca_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=16, help="their number, a square")
    parser.add_argument("--cells", type=int, help="quadrilaterals along an edge of a subdomain")
    parser.add_argument("--bound", type=float, default=0.006, help="of the tangential traction")


if __name__ == "__main__":
    main(sys.argv[1:])
