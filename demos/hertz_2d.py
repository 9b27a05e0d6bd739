# # Hertz contact in 2D
#
# An elastic half cylinder in plane strain is pressed on a rigid plane. The pressure and the
# half width of the contact zone are compared with Hertz's closed form.
#
#     ./run mpirun -n 2 python3 demos/hertz_2d.py --plot

"""Hertz contact in 2D: an elastic half cylinder on a rigid plane."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.hertz import LineContact, compare
from meshes.half_cylinder import build


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # gmsh meshes on rank 0 and partitions; its partitions become the subdomains.
    R, E, nu = 1.0, 1.0, 0.3
    a = 0.04 * R
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
    decomposition = tfeti.read_gmsh(model, comm)
    mesh = decomposition.mesh

    # ## Elasticity in plane strain
    #
    # Its stress is a 3×3 tensor, so that σ_zz is in von Mises' stress.
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")

    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Load and conditions
    #
    # A uniform pressure on the top carries the load P' that belongs to the half width a. The
    # axis stays on x = 0; the plane alone holds the body in y.
    hertz = LineContact.from_half_width(a, R, E / (1 - nu**2))
    traction = fem.Constant(mesh, (0.0, -hertz.load / (2 * R)))
    axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))
    bcs = [fem.dirichletbc(0.0, axis, V.sub(0))]
    contacts = [tfeti.Obstacle("contact", tfeti.Plane((0, 0), normal=(0, 1)), reach=2 * a**2 / R)]

    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(traction, v) * ds(decomposition.surface("top")),
        bcs,
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Comparison with the closed form
    contact = problem.solution.contact(0)
    x = contact.points[:, 0]
    problem.report.errors.update(compare(comm, contact, x, hertz))
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed, plot_pressure

        folder, solution = demo.folder, problem.solution
        plot_deformed(folder / "hertz_2d.png", solution, factor=1.0)
        zoom = {"focus": (0.0, 1.5 * a, 0.0), "zoom": 0.3 * R / a, "show_edges": False}
        plot_deformed(folder / "hertz_2d_contact.png", solution, factor=1.0, **zoom)
        plot_pressure(
            folder / "hertz_2d_pressure.png",
            solution,
            lambda points: points[:, 0],
            hertz.pressure,
            limit=2 * a,
        )
    return demo.finish(problem, "hertz_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--subdomains", type=int, default=8, help="gmsh partitions")
    parser.add_argument("--elements", type=int, help="elements along the half width a")


if __name__ == "__main__":
    main(sys.argv[1:])
