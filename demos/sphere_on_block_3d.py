# # A ball on a block
#
# A quarter of an elastic half ball on a quarter of an elastic block, both of tetrahedra that do
# not match. Radius and pressure of the contact are compared with Hertz's closed form.
#
#     ./run mpirun -n 2 python3 demos/sphere_on_block_3d.py --plot

"""A ball on a block: Hertz contact of two elastic bodies in 3D, a quarter of them."""

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
from demos.hertz import PointContact, compare
from meshes.ball_on_block import build


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # gmsh meshes on rank 0, `read_gmsh` makes subdomains. All element sizes are scaled by
    # one factor to come near the number of unknowns that is asked for.
    R, E, nu = 1.0, 1.0, 0.3
    a = 0.05 * R
    unknowns = arguments.unknowns or (8_000 if arguments.quick else 60_000)
    subdomains = arguments.subdomains or max(4, round(unknowns / 4000))
    scale = (2400 / unknowns) ** (1 / 3)
    model = None
    if comm.rank == 0:
        model = build(R, R, fine=0.2 * a * scale, fine_radius=1.3 * a, growth=0.3 * scale)
    decomposition = tfeti.read_gmsh(model, comm, subdomains)
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Load, conditions, contact
    #
    # A uniform pressure on the ball's flat top carries a quarter of the force F that belongs to
    # the radius a. The cuts are planes of symmetry; contact alone holds the ball in z. The block,
    # whose mesh is the coarser one, carries the multipliers.
    hertz = PointContact.from_half_width(a, R, E / (1 - nu**2) / 2)
    load = ds(decomposition.surface("load"))
    area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * load)))
    traction = fem.Constant(mesh, (0.0, 0.0, -hertz.load / 4 / area))
    bottom = fem.locate_dofs_topological(V, 2, decomposition.facets("bottom"))
    bcs = [fem.dirichletbc(np.zeros(3), bottom, V)]
    for axis, cut in enumerate(("x=0", "y=0")):
        dofs = fem.locate_dofs_topological(V.sub(axis), 2, decomposition.facets(cut))
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    sides = ("cap", "top") if arguments.exchange else ("top", "cap")
    contacts = [tfeti.Contact(*sides, secondary=sides[0], reach=a**2 / R)]
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(traction, v) * load,
        bcs,
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Comparison with the closed form
    contact = problem.solution.contact(0)
    r = np.hypot(contact.points[:, 0], contact.points[:, 1])
    problem.report.errors.update(compare(comm, contact, r, hertz, 1 / 4))
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed, plot_pressure

        folder, solution = demo.folder, problem.solution
        plot_deformed(
            folder / "sphere_on_block_3d.png",
            solution,
            factor=1.0,
            view=(-1.0, -1.6, 0.5),
            focus=(0.0, 0.0, 0.0),
            zoom=3.0,
            show_edges=False,
            highest=0.008,
        )
        plot_pressure(
            folder / "sphere_on_block_3d_pressure.png",
            solution,
            lambda points: np.hypot(points[:, 0], points[:, 1]),
            hertz.pressure,
            limit=2 * a,
            label="r",
        )
    return demo.finish(problem, "sphere_on_block_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--unknowns", type=int, help="about so many unknowns")
    parser.add_argument("--subdomains", type=int, help="their number")
    parser.add_argument("--exchange", action="store_true", help="multipliers on the ball")


if __name__ == "__main__":
    main(sys.argv[1:])
