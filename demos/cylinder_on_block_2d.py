# # A cylinder on a block
#
# Two elastic bodies in plane strain, meshed independently: NAFEMS' benchmark CB1, a steel
# cylinder on an aluminium block. Here the load is spread over the flat top of a half cylinder.
#
#     ./run mpirun -n 2 python3 demos/cylinder_on_block_2d.py --plot

"""A cylinder on a block in plane strain: Hertz contact of two elastic bodies (NAFEMS CB1)."""

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
from demos.hertz import LineContact, compare
from meshes.cylinder_on_block import build

# ## Data and closed form
#
# Lengths in mm, stresses in MPa, the load in N per mm.
R, P, nu = 50.0, 35e3, 0.3
young = {"cylinder": 2.1e5, "block": 7e4}


def closed_form():
    """Hertz' line contact of the two bodies."""
    return LineContact.from_load(P, R, 1 / sum((1 - nu**2) / E for E in young.values()))


def torn_mesh(arguments):
    # ## Mesh
    #
    # Near the contact the block's elements are 1.3 times as large as the cylinder's.
    comm, a = MPI.COMM_WORLD, closed_form().half_width
    elements = arguments.elements or (10 if arguments.quick else 30)
    model = None
    if comm.rank == 0:
        model = build(
            R,
            fine=a / elements,
            fine_radius=1.5 * a,
            growth=0.3 if arguments.quick else 0.12,
            partitions=arguments.subdomains,
        )
    return tfeti.read_gmsh(model, comm)


def scene(decomposition, degree=1, exchange=False):
    mesh = decomposition.mesh

    # ## Elasticity in plane strain
    #
    # Young's modulus by the names of the bodies.
    elastic = tfeti.Elasticity(decomposition, E=young, nu=nu, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", degree, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Load, conditions, contact
    #
    # The axis stays on x = 0 and the block's bottom where it is. Contact alone holds the
    # cylinder in y. The surfaces are 1.5 a²/2R apart at x = 1.2 a: farther ones need no rows.
    # Here the cylinder has the multipliers; a warning says that the softer block, whose mesh is
    # the coarser one, would be the better side (--exchange).
    traction = fem.Constant(mesh, (0.0, -P / (2 * R)))
    axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))
    bottom = fem.locate_dofs_topological(V, 1, decomposition.facets("bottom"))
    bcs = [fem.dirichletbc(0.0, axis, V.sub(0)), fem.dirichletbc(np.zeros(2), bottom, V)]
    sides = ("top", "arc") if exchange else ("arc", "top")
    reach = 0.75 * closed_form().half_width ** 2 / R
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * ds(decomposition.surface("load")),
        "bcs": bcs,
        "contacts": [tfeti.Contact(*sides, secondary=sides[0], reach=reach)],
        "decomposition": decomposition,
        "stress": elastic.stress,
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm, hertz = demo.arguments, MPI.COMM_WORLD, closed_form()
    problem = tfeti.ContactProblem(
        **scene(torn_mesh(arguments), exchange=arguments.exchange),
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Comparison with the closed form
    #
    # With a/R = 0.12 the bodies are no half planes: a finer mesh of the same bodies is the better
    # reference.
    contact = problem.solution.contact(0)
    x = contact.points[:, 0]
    problem.report.errors.update(compare(comm, contact, x, hertz))
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed, plot_pressure

        folder, solution = demo.folder, problem.solution
        zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 5.0, "show_edges": True}
        plot_deformed(folder / "cylinder_on_block_2d.png", solution, factor=1.0, **zoom)
        plot_pressure(
            folder / "cylinder_on_block_2d_pressure.png",
            solution,
            lambda points: points[:, 0],
            hertz.pressure,
            limit=2 * hertz.half_width,
        )
    return demo.finish(problem, "cylinder_on_block_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=12, help="gmsh partitions")
    parser.add_argument("--elements", type=int, help="elements along the half width a")
    parser.add_argument("--exchange", action="store_true", help="multipliers on the block")


if __name__ == "__main__":
    main(sys.argv[1:])
