# # A yielding clamped connection
#
# A mine support yields: two U-profiles overlap, and two bolted clamps press them on each other, so
# that they slide before they bend. Here the load along the support is below what friction can
# take: a part of the contact slips, the rest sticks. Six bodies, five contacts with Coulomb's
# friction, which alone holds the upper profile along its axis. The talk has such a scene of 1.6
# million unknowns in 250 subdomains (`--large`); it does not say its measures.
#
#     ./run mpirun -n 2 python3 demos/clamped_connection_3d.py --plot

"""The clamped connection of a mine support: U-profiles, clamps, Coulomb's friction."""

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
from meshes.clamped_connection import CLAMPS, Connection, build

# N; of each bolt, and along the support
BOLT, LOAD = 30e3, 12e3
PROFILES = ("upper outside", "lower inside")
BARS = [
    pair
    for i in range(1, CLAMPS + 1)
    for pair in ((f"lower bar {i}", "bottom"), (f"upper bar {i}", "lips"))
]


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # Sections are drawn along z, in hexahedra. Lengths are in mm, forces in N.
    connection = Connection()
    size, subdomains = resolution(arguments)
    model = build(connection, size) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, subdomains)
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=2.1e5, nu=0.3)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    degree = {"quadrature_degree": 2}
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

    # ## Load and conditions
    #
    # The bolts pull the bars of a clamp towards each other, and keep their ends where they are
    # across that. One end of the support is fixed; the other one is guided, and pushed along the
    # axis.
    def area(name):
        one = fem.form(fem.Constant(mesh, 1.0) * ds(decomposition.surface(name)))
        return comm.allreduce(fem.assemble_scalar(one))

    bolts = 2 * CLAMPS * BOLT
    L = -arguments.load / area("upper end") * v[2] * ds(decomposition.surface("upper end"))
    L += bolts / area("bolts below") * v[1] * ds(decomposition.surface("bolts below"))
    L -= bolts / area("bolts above") * v[1] * ds(decomposition.surface("bolts above"))
    fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("lower end"))
    bcs = [fem.dirichletbc(np.zeros(3), fixed, V)]
    for name, across in (("upper end", (0, 1)), ("bolts below", (0, 2)), ("bolts above", (0, 2))):
        for i in across:
            guided = fem.locate_dofs_topological(V.sub(i), 2, decomposition.facets(name))
            bcs.append(fem.dirichletbc(0.0, guided, V.sub(i)))

    # ## Contact
    #
    # Nearly all nodes of the bars slip. Newton's method on Coulomb's law does not mind; problems
    # with given bounds alone (`-tfeti_friction_type fixed_point`) take three times as long.
    law = tfeti.Coulomb(arguments.friction)
    contacts = [
        tfeti.Contact(a, b, secondary=a, friction=law, reach=1.0, name=a)
        for a, b in [PROFILES, *BARS]
    ]
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        L,
        bcs,
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    problem.solve()

    # ## Balance
    #
    # Friction alone holds the upper profile along z: that of the lower one, and that of the bars
    # on its lips.
    by_lower, *by_bars = (
        along_axis(problem.solution, name) for name in (PROFILES[0], *(a for a, _ in BARS[1::2]))
    )
    problem.report.errors["force"] = (by_lower - sum(by_bars)) / arguments.load - 1
    if arguments.plot:
        plots(demo.folder, problem.solution)
    return demo.finish(problem, "clamped_connection_3d")


def plots(folder, solution):
    """Pictures of the bodies and of what sticks and slips between the profiles."""
    from demos.pictures import plot_friction
    from tfeti_dolfinx.plot import plot_deformed

    plot_deformed(
        folder / "clamped_connection_3d.png",
        solution,
        factor=50.0,
        highest=80.0,
        view=(0.9, 0.8, 0.6),
    )
    file = folder / "clamped_connection_3d_friction.png"
    plot_friction(file, solution, [PROFILES[0]], axes=(2, 0), labels=("z", "x"))


def along_axis(solution, name):
    """Friction along z on the secondary side of a contact."""
    data = solution.contact(name)
    force = float(data.area @ data.tangential_traction[:, 2])
    return solution.decomposition.comm.allreduce(force)


def resolution(arguments):
    """Size of the elements and number of subdomains."""
    size = 24.0 if arguments.quick else 2.3 if arguments.large else 12.0
    subdomains = 12 if arguments.quick else 250 if arguments.large else 24
    return arguments.size or size, arguments.subdomains or subdomains


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--size", type=float, help="of the hexahedra, in mm")
    parser.add_argument("--subdomains", type=int, help="their number")
    parser.add_argument("--friction", type=float, default=0.3, help="its coefficient")
    parser.add_argument("--load", type=float, default=LOAD, help="along the support, in N")
    parser.add_argument("--large", action="store_true", help="250 subdomains, 1.6 M unknowns")


if __name__ == "__main__":
    main(sys.argv[1:])
