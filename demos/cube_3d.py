# # A cube on a curved obstacle
#
# The frictionless 3D scene of the benchmark tables: a unit cube of N × N × N equal subdomains,
# fixed on one face, pressed from above on a curved rigid obstacle.
#
#     ./run mpirun -n 2 python3 demos/cube_3d.py --subdomains 64

"""A cube of equal subdomains, fixed on a face and pressed on a curved obstacle."""

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
    #
    # A box made in DOLFINx. The subdomains are cubes, given by a function of the cells'
    # midpoints.
    comm = MPI.COMM_WORLD
    N = round(arguments.subdomains ** (1 / 3))
    cells = arguments.cells or (5 if arguments.quick else 10)
    box = dmesh.create_box(comm, [(0, 0, 0), (1, 1, 1)], [N * cells] * 3, dmesh.CellType.hexahedron)
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
        i, j, k = np.minimum((x * N).astype(int), N - 1)
        return i + N * j + N * N * k

    return tfeti.decompose(box, subdomain, facet_tags=facet_tags, surfaces=names)


def scene(decomposition):
    mesh = decomposition.mesh

    # ## Elasticity
    #
    # Trilinear hexahedra need quadrature of degree 2; UFL's estimate would be three times dearer.
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load, conditions, obstacle
    #
    # The obstacle lies below z = 0, by 0.02 and more. Every node of the side gets its row.
    traction = fem.Constant(mesh, (0.0, 0.0, -0.05))
    fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("fixed"))
    obstacle = tfeti.SignedDistance(
        lambda x: x[2] + 0.02 + 0.1 * ((x[0] - 0.8) ** 2 + (x[1] - 0.5) ** 2),
        lambda x: np.stack((np.zeros_like(x[0]), np.zeros_like(x[0]), np.ones_like(x[0]))),
    )
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * ds(decomposition.surface("top")),
        "bcs": [fem.dirichletbc(np.zeros(3), fixed, V)],
        "contacts": [tfeti.Obstacle("bottom", obstacle, reach=np.inf)],
        "decomposition": decomposition,
        "stress": elastic.stress,
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    problem = tfeti.ContactProblem(
        **scene(torn_mesh(demo.arguments)), petsc_options=demo.petsc_options
    )
    problem.solve()
    if demo.arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "cube_3d.png", problem.solution, factor=1.0)
    return demo.finish(problem, "cube_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=8, help="their number, a cube: 8, 64")
    parser.add_argument("--cells", type=int, help="hexahedra along an edge of a subdomain")


if __name__ == "__main__":
    main(sys.argv[1:])
