# # Partial slip of a line contact
#
# Two equal elastic bodies in plane strain are pressed together, then pushed along each other in
# load steps. By Coulomb's law the contact slips from its edges on, and sticks on |x| < c. Contact
# half width a, stick half width c and the largest friction are compared with the closed form of
# Cattaneo and Mindlin, c = a√(1 − Q/(μP)).
#
#     ./run mpirun -n 2 python3 demos/cattaneo_mindlin_2d.py --plot

"""Partial slip of a line contact in 2D: Coulomb's friction and Cattaneo's closed form.

a and c are found from second moments: ∫px² = a²/4 ∫p of the pressure, and the same of what is left
of friction, μp − |q|, which is a pressure of Hertz's on |x| < c. The largest friction is μp(c), p
between nodes by a line through p² over x²; the table has the largest at nodes beside it.
"""

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
from demos.hertz import LineContact
from demos.partial_slip import PartialSlip, Pushed, draw_friction, pushed_in_steps
from meshes.half_planes import build

R, L, E, nu, mu = 1.0, 1.0, 1.0, 0.3, 0.3
a = 0.04 * R
MODULUS = E / (1 - nu**2) / 2
HERTZ = LineContact.from_half_width(a, R, MODULUS)
CLOSED = PartialSlip(HERTZ, mu)


def torn_mesh(arguments):
    # ## Mesh
    #
    # Two rectangles that are mirror images, at first flat on each other. A refinement halves the
    # elements.
    comm, halved = MPI.COMM_WORLD, 2.0**-arguments.refine
    size = (0.1 if arguments.quick else 0.05) * a * halved
    growth = (0.3 if arguments.quick else 0.2) * halved
    model = None
    if comm.rank == 0:
        model = build(L, size, 1.3 * a, growth)
    return tfeti.read_gmsh(model, comm, arguments.subdomains or (2 if arguments.quick else 8))


def scene(decomposition, degree=1):
    """The loads, and what ``ContactProblem`` is made of."""
    mesh = decomposition.mesh

    # ## Elasticity in plane strain
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", degree, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Loads and conditions
    #
    # The loads are in balance on each body. What holds the lower one, two points, carries nothing;
    # contact and friction alone hold the upper one.
    loads = Pushed(V, *(ds(decomposition.surface(name)) for name in ("top", "bottom")), L)
    middle = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], 0))
    vertical = (V.sub(1), V.sub(1).collapse()[0])
    corner, _ = fem.locate_dofs_geometrical(
        vertical, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], L)
    )
    bcs = [fem.dirichletbc(np.zeros(2), middle, V), fem.dirichletbc(0.0, corner, V.sub(1))]

    # ## Contact with friction
    #
    # The bodies' shape is in the gap, x²/(2R), as in Hertz's theory: the normals of curved meshes
    # would differ by x/R, and with them pressing alone would make some friction.
    contact = tfeti.Contact(
        "upper face",
        "lower face",
        secondary="upper face",
        gap=lambda x: x[0] ** 2 / (2 * R),
        friction=tfeti.Coulomb(mu),
        reach=1.3 * a**2 / R,
        name="contact",
    )
    return loads, {
        "a": elastic.a(u, v),
        "L": loads.form(v),
        "bcs": bcs,
        "contacts": [contact],
        "decomposition": decomposition,
        "stress": elastic.stress,
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    loads, parts = scene(torn_mesh(demo.arguments))
    problem = tfeti.ContactProblem(**parts, petsc_options=demo.petsc_options)

    steps = demo.arguments.steps or (2 if demo.arguments.quick else 4)

    # ## P first, then Q in steps, and comparison with the closed form
    errors, _, curves = pushed_in_steps(problem, loads, CLOSED, steps)
    problem.report.errors.update(errors)
    if demo.arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 0.3 * L / a, "show_edges": False}
        plot_deformed(demo.folder / "cattaneo_mindlin_2d.png", problem.solution, **zoom)
        if MPI.COMM_WORLD.rank == 0:
            draw_friction(demo.folder / "cattaneo_mindlin_2d_friction.png", CLOSED, curves)
    return demo.finish(problem, "cattaneo_mindlin_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    configure_mesh(parser)
    parser.add_argument("--steps", type=int, help="load steps of Q, up to 0.8 μP")


def configure_mesh(parser):
    parser.add_argument("--subdomains", type=int, help="their number")
    parser.add_argument("--refine", type=int, default=0, help="how often elements are halved")


if __name__ == "__main__":
    main(sys.argv[1:])
