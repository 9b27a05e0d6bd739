# # Stacked blocks
#
# A base, two blocks on it, and a beam across them: four bodies with meshes of hexahedra that do
# not match. Only the base is fixed. Contact alone holds the others, in z; nothing resists that
# they slide and turn on their flat sides, and no load drives them to: these are free modes.
#
#     ./run mpirun -n 2 python3 demos/stacked_blocks_3d.py --plot

"""Four stacked blocks under a load, three of them held by contact alone."""

import sys
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
from meshes.blocks import build, tower

PAIRS = [
    ("left bottom", "base top"),
    ("right bottom", "base top"),
    ("left top", "beam bottom"),
    ("right top", "beam bottom"),
]


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    cells = arguments.cells or (4 if arguments.quick else 12)
    model = build(tower(cells)) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, arguments.subdomains)
    mesh = decomposition.mesh

    # ## Elasticity
    #
    # Trilinear hexahedra need quadrature of degree 2.
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=decomposition.cell_tags, metadata=degree)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load and contacts
    #
    # The weight of all blocks, and a pressure on the beam that is larger in the middle.
    x = ufl.SpatialCoordinate(mesh)
    weight = fem.Constant(mesh, (0.0, 0.0, -0.002))
    pressure = 0.02 * x[0] * (2 - x[0])
    base = fem.locate_dofs_topological(V, 2, decomposition.facets("base bottom"))
    top = ds(decomposition.surface("beam top"))
    contacts = [tfeti.Contact(*pair, secondary=pair[0], reach=0.05) for pair in PAIRS]
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(weight, v) * dx - pressure * v[2] * top,
        [fem.dirichletbc(np.zeros(3), base, V)],
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Balance
    #
    # The base bears the pressure and the weight of what stands on it.
    def total(form):
        return comm.allreduce(fem.assemble_scalar(fem.form(form)))

    carried = [decomposition.volume(name) for name in ("left", "right", "beam")]
    load = total(pressure * top) + sum(total(-weight[2] * dx(volume)) for volume in carried)
    on_base = [problem.solution.contact(i) for i in (0, 1)]
    force = sum(comm.allreduce(contact.force.sum()) for contact in on_base)
    problem.report.errors["force_base"] = force / load - 1
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        looks = {"view": (-0.6, -1.5, 0.6), "highest": 0.05}
        plot_deformed(demo.folder / "stacked_blocks_3d.png", problem.solution, **looks)
    return demo.finish(problem, "stacked_blocks_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=16, help="their number")
    parser.add_argument("--cells", type=int, help="hexahedra along an edge of a block, about")


if __name__ == "__main__":
    main(sys.argv[1:])
