# # Four bodies with given friction
#
# A wedge is driven between two blocks that stand on a base: four bodies in eight subdomains, four
# contacts with Tresca's friction. Contact alone holds the wedge. The talk has a scene of four
# bodies, 67 330 unknowns and 8 subdomains, and does not say what it looks like.
#
#     ./run mpirun -n 2 python3 demos/four_bodies_2d.py --plot

"""A wedge between two blocks on a base: four bodies, given friction."""

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
from meshes.four_bodies import build

PAIRS = [
    ("wedge left", "left side"),
    ("wedge right", "right side"),
    ("left bottom", "base top"),
    ("right bottom", "base top"),
]
PRESSURE = 0.01


def subdomain(x):
    """Two of each body: left and right halves of the base, else lower and upper ones."""
    base = x[1] < 0.0
    wedge = np.abs(x[0]) < 0.4 + 0.25 * x[1]
    body = np.where(base, 0, np.where(wedge, 1, np.where(x[0] < 0.0, 2, 3)))
    upper = x[1] > np.where(wedge, 1.2, 0.8)
    return 2 * body + np.where(base, x[0] > 0.0, upper)


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # No meshes match where bodies meet.
    cells = arguments.cells or (12 if arguments.quick else 64)
    model = build(cells) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, subdomain)
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load, conditions, contact
    #
    # The wedge is pressed down, the base fixed, and the blocks stand between walls on which they
    # may slide.
    top = ds(decomposition.surface("wedge top"))
    bottom = fem.locate_dofs_topological(V, 1, decomposition.facets("base bottom"))
    bcs = [fem.dirichletbc(np.zeros(2), bottom, V)]
    for name in ("left wall", "right wall"):
        wall = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets(name))
        bcs.append(fem.dirichletbc(0.0, wall, V.sub(0)))
    law = tfeti.Tresca(arguments.bound)
    contacts = [
        tfeti.Contact(a, b, secondary=a, friction=law, reach=0.05, name=a) for a, b in PAIRS
    ]
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        -PRESSURE * v[1] * top,
        bcs,
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Balance
    #
    # The sides of the wedge bear the load, and the base bears it through the blocks.
    load = PRESSURE * comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * top)))
    pairs = [problem.solution.contact(name) for name, _ in PAIRS]
    data = [d.tangential_traction[:, 1] * d.area - d.force * d.normal[:, 1] for d in pairs]
    up = [comm.allreduce(float(forces.sum())) for forces in data]
    problem.report.errors.update(
        force_wedge=(up[0] + up[1]) / load - 1, force_base=(up[2] + up[3]) / load - 1
    )
    if arguments.plot:
        from demos.pictures import plot_friction
        from tfeti_dolfinx.plot import plot_deformed

        folder, solution = demo.folder, problem.solution
        plot_deformed(
            folder / "four_bodies_2d.png", solution, factor=1.0, show_edges=False, highest=0.03
        )
        names = [name for name, _ in PAIRS]
        plot_friction(folder / "four_bodies_2d_friction.png", solution, names, normal=True)
    return demo.finish(problem, "four_bodies_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--cells", type=int, help="quadrilaterals along a side of a subdomain")
    parser.add_argument("--bound", type=float, default=0.008, help="of the tangential traction")


if __name__ == "__main__":
    main(sys.argv[1:])
