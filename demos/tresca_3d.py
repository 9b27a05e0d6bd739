# # A cube with given friction
#
# The 3D scene of the talk's table with Tresca friction: a unit cube fixed on one face, pressed on a
# rough plane and pushed along it. The subdomains are equal cubes of 10 × 10 × 10 elements. Four of
# them make the half next to the fixed face, which does not slide as far: its bound is lower. 1024
# make a body of twice the length, which slides further: its bound is higher.
#
#     ./run mpirun -n 2 python3 demos/tresca_3d.py --subdomains 64

"""A cube on a rough plane: friction with a given bound, some nodes stick and some slip."""

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

# subdomains along the axes, length along x, and bound of the tangential traction
SCENES = {
    1: ((1, 1, 1), 1.0, 0.015),
    4: ((1, 2, 2), 0.5, 0.006),
    8: ((2, 2, 2), 1.0, 0.015),
    64: ((4, 4, 4), 1.0, 0.015),
    512: ((8, 8, 8), 1.0, 0.015),
    1024: ((16, 8, 8), 2.0, 0.05),
}


def torn_mesh(arguments):
    # ## Mesh
    comm = MPI.COMM_WORLD
    grid, length, _ = SCENES[arguments.subdomains]
    grid, size = np.array(grid), np.array((length, 1.0, 1.0))
    cells = arguments.cells or (4 if arguments.quick else 10)
    box = dmesh.create_box(comm, [(0, 0, 0), size], list(grid * cells), dmesh.CellType.hexahedron)
    names = {"fixed": 1, "bottom": 2, "top": 3}
    facets = [
        dmesh.locate_entities_boundary(box, 2, lambda x: np.isclose(x[0], 0)),
        dmesh.locate_entities_boundary(box, 2, lambda x: np.isclose(x[2], 0)),
        dmesh.locate_entities_boundary(box, 2, lambda x: np.isclose(x[2], 1)),
    ]
    values = np.repeat(np.array(list(names.values()), dtype=np.int32), [len(f) for f in facets])
    order = np.argsort(np.concatenate(facets))
    facet_tags = dmesh.meshtags(box, 2, np.concatenate(facets)[order], values[order])

    def subdomain(x):
        i, j, k = np.minimum((x.T / size * grid).astype(int), grid - 1).T
        return i + grid[0] * (j + grid[1] * k)

    return tfeti.decompose(box, subdomain, facet_tags=facet_tags, surfaces=names)


def scene(decomposition, bound):
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load, conditions, friction
    #
    # The bound is a traction: the same everywhere, whatever the pressure is.
    traction = fem.Constant(mesh, (0.0, -0.035, -0.05))
    fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("fixed"))
    plane = tfeti.Plane((0, 0, 0), normal=(0, 0, 1))
    floor = tfeti.Obstacle(
        "bottom", plane, friction=tfeti.Tresca(bound), reach=np.inf, name="floor"
    )
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * ds(decomposition.surface("top")),
        "bcs": [fem.dirichletbc(np.zeros(3), fixed, V)],
        "contacts": [floor],
        "stress": elastic.stress,
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, decomposition = demo.arguments, torn_mesh(demo.arguments)
    bound = arguments.bound or SCENES[arguments.subdomains][2]
    problem = tfeti.ContactProblem(
        **scene(decomposition, bound),
        decomposition=decomposition,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Its bound is kept
    #
    # The report has the share by which the largest tangential traction is above it.
    comm, data = decomposition.comm, problem.solution.contact("floor")
    largest = np.linalg.norm(data.tangential_traction, axis=1).max(initial=0.0)
    excess = comm.allreduce(float(largest), op=MPI.MAX) / bound - 1.0
    problem.report.errors["bound"] = max(excess, 0.0)
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "tresca_3d.png", problem.solution, factor=1.0)
    return demo.finish(problem, "tresca_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, choices=list(SCENES), default=4)
    parser.add_argument("--cells", type=int, help="hexahedra along an edge of a subdomain")
    parser.add_argument("--bound", type=float, help="of the tangential traction")


if __name__ == "__main__":
    main(sys.argv[1:])
