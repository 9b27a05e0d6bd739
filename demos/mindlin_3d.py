# # Partial slip of a point contact
#
# Two equal elastic bodies, shaped like spheres where they touch, are pressed together, then pushed
# along each other in load steps; the half where y ≥ 0. By Coulomb's law the contact slips from its
# edge on, and sticks on r < c. c and the largest friction are compared with Mindlin's closed form,
# c = a(1 − Q/(μP))^(1/3).
#
#     ./run mpirun -n 2 python3 demos/mindlin_3d.py --plot

"""Partial slip of a point contact in 3D: Coulomb's friction and Mindlin's closed form.

The radius c of stick is found from the second moment of what is left of friction, μp − |q|, a
pressure of Hertz's on r < c: ∫(μp − |q|)r² = 2c²/5 ∫(μp − |q|). Mindlin lets friction be along x
everywhere. Coulomb's law wants it against the slip, which for ν > 0 is not quite along x.
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
from demos.hertz import PointContact
from demos.partial_slip import PartialSlip, Pushed, draw_friction, pushed_in_steps
from meshes.half_spaces import build

R, L, E, nu, mu = 1.0, 1.0, 1.0, 0.3, 0.3
a = 0.05 * R
HERTZ = PointContact.from_half_width(a, R, E / (1 - nu**2) / 2)
CLOSED = PartialSlip(HERTZ, mu)


def torn_mesh(arguments):
    # ## Mesh
    #
    # Two boxes that are mirror images, at first flat on each other. `read_gmsh` parts them.
    comm, model = MPI.COMM_WORLD, None
    elements = arguments.elements or (4 if arguments.quick else 10)
    if comm.rank == 0:
        model = build(L, a / elements, 1.2 * a, growth=3 / elements)
    return tfeti.read_gmsh(model, comm, arguments.subdomains or (2 if arguments.quick else 10))


def scene(decomposition):
    """The loads, and what ``ContactProblem`` is made of."""
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Loads and conditions
    #
    # The loads are in balance on each body. What holds the lower one, two corners, carries nothing;
    # contact and friction alone hold the upper one.
    loads = Pushed(V, *(ds(decomposition.surface(name)) for name in ("top", "bottom")), L, 1 / 2)
    cut = fem.locate_dofs_topological(V.sub(1), 2, decomposition.facets("y=0"))
    bcs = [fem.dirichletbc(0.0, cut, V.sub(1))]
    for side, axis in ((-1, 0), (-1, 2), (1, 2)):
        corner, _ = fem.locate_dofs_geometrical(
            (V.sub(axis), V.sub(axis).collapse()[0]),
            lambda x, side=side: np.all(np.isclose(x.T, (side * L, 0.0, -L)), axis=1),
        )
        bcs.append(fem.dirichletbc(0.0, corner, V.sub(axis)))

    # ## Contact with friction
    #
    # The bodies' shape is in the gap, r²/(2R), as in Hertz's theory.
    contact = tfeti.Contact(
        "upper face",
        "lower face",
        secondary="upper face",
        gap=lambda x: (x[0] ** 2 + x[1] ** 2) / (2 * R),
        friction=tfeti.Coulomb(mu),
        reach=a**2 / R,
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

        zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 0.4 * L / a, "view": (0.0, -1.0, 0.0)}
        plot_deformed(demo.folder / "mindlin_3d.png", problem.solution, show_edges=False, **zoom)
        if MPI.COMM_WORLD.rank == 0:
            draw_friction(demo.folder / "mindlin_3d_friction.png", CLOSED, curves)
    return demo.finish(problem, "mindlin_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, help="their number")
    parser.add_argument("--elements", type=int, help="elements along the radius a")
    parser.add_argument("--steps", type=int, help="load steps of Q, up to 0.8 μP")


if __name__ == "__main__":
    main(sys.argv[1:])
