# # Hertz contact in 3D
#
# An elastic half ball is pressed on a rigid plane. Nothing but the plane holds it: it could
# still slide and turn on the plane without resistance, motions that the load does not drive.
# They are found and reported as `free_modes`.
#
#     ./run mpirun -n 2 python3 demos/hertz_3d.py --unknowns 60000 --subdomains 16

"""Hertz contact in 3D: an elastic half ball on a rigid plane."""

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
from meshes.half_ball import build

R, E, nu = 1.0, 1.0, 0.3
a = 0.05 * R
HERTZ = PointContact.from_half_width(a, R, E / (1 - nu**2))


def torn_mesh(arguments):
    # ## Mesh
    #
    # gmsh meshes on rank 0, `read_gmsh` makes subdomains. All element sizes are scaled by
    # one factor to come near the number of unknowns that is asked for.
    comm = MPI.COMM_WORLD
    unknowns = arguments.unknowns or (6_000 if arguments.quick else 60_000)
    subdomains = arguments.subdomains or max(2, round(unknowns / 4000))
    scale = (4500 / unknowns) ** (1 / 3)
    model = None
    if comm.rank == 0:
        model = build(R, fine=0.2 * a * scale, fine_radius=1.3 * a, growth=0.3 * scale)
    return tfeti.read_gmsh(model, comm, subdomains)


def scene(decomposition, degree=1):
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)

    V = fem.functionspace(mesh, ("Lagrange", degree, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Load and contact
    #
    # A uniform pressure on the top carries the force F that belongs to the radius a. The top is
    # a polygon: its own area makes the total force exact.
    top = ds(decomposition.surface("top"))
    area = mesh.comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * top)))
    traction = fem.Constant(mesh, (0.0, 0.0, -HERTZ.load / area))
    contacts = [
        tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), reach=2 * a**2 / R)
    ]
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * top,
        "bcs": [],
        "contacts": contacts,
        "decomposition": decomposition,
        "stress": elastic.stress,
    }


def run(argv):
    demo = Demo(__doc__, argv, configure)
    problem = tfeti.ContactProblem(
        **scene(torn_mesh(demo.arguments)), petsc_options=demo.petsc_options
    )
    problem.solve()

    # ## Comparison with the closed form
    contact = problem.solution.contact(0)
    r = np.hypot(contact.points[:, 0], contact.points[:, 1])
    problem.report.errors.update(compare(MPI.COMM_WORLD, contact, r, HERTZ))
    if demo.arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed, plot_pressure

        folder, solution = demo.folder, problem.solution
        plot_deformed(folder / "hertz_3d.png", solution, factor=1.0)
        plot_pressure(
            folder / "hertz_3d_pressure.png",
            solution,
            lambda points: np.hypot(points[:, 0], points[:, 1]),
            HERTZ.pressure,
            limit=2 * a,
            label="r",
        )
    return demo.finish(problem, "hertz_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--unknowns", type=int, help="about so many unknowns")
    parser.add_argument("--subdomains", type=int, help="their number")


if __name__ == "__main__":
    main(sys.argv[1:])
