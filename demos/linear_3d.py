# # Linear elasticity, no contact
#
# A beam of two materials, clamped at one end and loaded at the other. Without contact the dual
# problem is solved by projected conjugate gradients with the Dirichlet preconditioner: the scene
# has no inequality rows and does not pay for any.
#
#     ./run mpirun -n 2 python3 demos/linear_3d.py --subdomains 32

"""A beam of two materials without contact, by PCPG."""

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


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # A box of tetrahedra, its upper half of another material. `decompose` makes the subdomains.
    n = arguments.cells or (4 if arguments.quick else 12)
    box = dmesh.create_box(comm, [(0, 0, 0), (4, 1, 1)], [4 * n, n, n])
    cells = np.arange(box.topology.index_map(3).size_local, dtype=np.int32)
    upper = dmesh.compute_midpoints(box, 3, cells)[:, 2] > 0.5
    cell_tags = dmesh.meshtags(box, 3, cells, np.where(upper, 2, 1).astype(np.int32))
    ends = [
        dmesh.locate_entities_boundary(box, 2, lambda x: np.isclose(x[0], 0)),
        dmesh.locate_entities_boundary(box, 2, lambda x: np.isclose(x[0], 4)),
    ]
    values = np.repeat(np.array([1, 2], dtype=np.int32), [len(f) for f in ends])
    order = np.argsort(np.concatenate(ends))
    decomposition = tfeti.decompose(
        box,
        arguments.subdomains,
        cell_tags,
        dmesh.meshtags(box, 2, np.concatenate(ends)[order], values[order]),
        surfaces={"clamped": 1, "loaded": 2},
        volumes={"lower": 1, "upper": 2},
    )
    mesh = decomposition.mesh

    # ## Elasticity
    #
    # Young's modulus by the names of the volumes.
    young = {"lower": 1.0, "upper": arguments.ratio}
    elastic = tfeti.Elasticity(decomposition, E=young, nu=0.3)

    V = fem.functionspace(mesh, ("Lagrange", arguments.degree, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)
    clamped = fem.locate_dofs_topological(V, 2, decomposition.facets("clamped"))
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(fem.Constant(mesh, (0.0, 0.0, -1e-3)), v) * ds(decomposition.surface("loaded")),
        [fem.dirichletbc(np.zeros(3), clamped, V)],
        [],
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "linear_3d.png", problem.solution)
    return demo.finish(problem, "linear_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=16, help="their number")
    parser.add_argument("--cells", type=int, help="cubes along the height of the beam")
    parser.add_argument("--degree", type=int, default=1, help="of the displacement")
    parser.add_argument("--ratio", type=float, default=10.0, help="modulus of the upper half")


if __name__ == "__main__":
    main(sys.argv[1:])
