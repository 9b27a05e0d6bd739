# # A ball bearing
#
# A deep groove ball bearing under a radial load: two rings and the balls between them, all
# elastic, and two contacts for each ball, one with each ring. Nothing but contact carries the load
# from the inner ring through the balls to the outer ring.
#
#     ./run mpirun -n 2 python3 demos/ball_bearing_3d.py --plot

"""A ball bearing: elastic rings and balls, in contact with each other."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from meshes.ball_bearing import Bearing, build


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # The bearing's axis is y, and load and bearing are symmetric about its mid plane y = 0, so
    # half of it is enough. gmsh meshes on rank 0 and partitions with METIS; the partitions become
    # the subdomains, and those that hold parts of several bodies are split. All element sizes are
    # scaled by one factor to come near the number of unknowns that is asked for. Lengths are in
    # mm, forces in N.
    bearing = Bearing(balls=arguments.balls)
    unknowns, subdomains = size(arguments)
    scale = (44_400 / unknowns) ** 0.375
    model = None
    if comm.rank == 0:
        sizes = {"fine": 0.14 * scale, "growth": 0.35 * scale, "coarse": 2.0 * scale}
        model = build(bearing, **sizes, partitions=subdomains)
    decomposition = tfeti.read_gmsh(model, comm)
    mesh = decomposition.mesh

    # ## Elasticity
    E, nu = 2.1e5, 0.3
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)

    V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 0})
    ds = ufl.Measure(
        "ds",
        domain=mesh,
        subdomain_data=decomposition.facet_tags,
        metadata={"quadrature_degree": 2},
    )
    bore = ds(decomposition.surface("bore"))

    # ## Load
    #
    # The shaft presses on the lower half of the bore; half of the load belongs to half of the
    # bearing. The bearing turns: a small centrifugal force keeps the balls that carry no load on
    # the outer ring, so that their place is defined.
    load, centrifugal = 0.5 * 5000.0, 0.5 * 7.0
    x = ufl.SpatialCoordinate(mesh)
    pressed = ufl.max_value(-x[2], 0) * ufl.as_vector((x[0], 0, x[2]))
    whole = comm.allreduce(fem.assemble_scalar(fem.form(-pressed[2] * bore)))
    traction = load / whole * pressed
    outward = fem.Function(fem.functionspace(mesh, ("DG", 0, (3,))))
    for i in range(bearing.balls):
        cells = decomposition.cell_tags.find(decomposition.volume(f"ball {i + 1}"))
        angle = bearing.angle(i)
        outward.x.array.reshape(-1, 3)[cells] = np.cos(angle), 0.0, np.sin(angle)
    push = centrifugal / (2 / 3 * np.pi * bearing.ball**3) * outward

    # ## What holds the bodies
    #
    # The outer ring is fixed on its outside, and the mid plane stays in y = 0. Frictionless contact
    # cannot keep a ball from spinning or from running along the grooves. The cage does: a spring
    # in each point of a ball that acts around the bearing's axis only. Along the radius, where the
    # rings press on it, the ball is free. Two keys in the bore, on top and at the bottom, keep
    # the inner ring from moving across the load, and so from spinning; along the load it is free.
    around = ufl.as_vector((-outward[2], 0, outward[0]))
    cage = E / bearing.ball**2
    a = elastic.a(u, v)
    a += cage * ufl.dot(u, around) * ufl.dot(v, around) * dx
    L = ufl.dot(traction, v) * bore + ufl.dot(push, v) * dx
    outside = fem.locate_dofs_topological(V, 2, decomposition.facets("outside"))
    keys = fem.locate_dofs_topological(
        V.sub(0), 2, facets_near(decomposition, "bore", lambda x: abs(x[0]) < 0.2 * bearing.bore)
    )
    plane = fem.locate_dofs_topological(V.sub(1), 2, decomposition.facets("mid plane"))
    bcs = [
        fem.dirichletbc(np.zeros(3), outside, V),
        fem.dirichletbc(0.0, plane, V.sub(1)),
        fem.dirichletbc(0.0, keys, V.sub(0)),
    ]

    # ## Contact
    #
    # A ball's whole sphere faces both grooves; only what is near gets conditions.
    contacts = [
        tfeti.Contact(ball, groove, secondary=ball, reach=0.006 * bearing.ball)
        for ball in (f"ball {i + 1}" for i in range(bearing.balls))
        for groove in ("inner groove", "outer groove")
    ]
    problem = tfeti.ContactProblem(
        a,
        L,
        bcs,
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )
    uh = problem.solve()

    # ## Balance
    #
    # For each ball the forces of both rings, of the cage and of the rotation must add up to zero,
    # and the forces of the balls on the inner ring to the load. What is left, over the load, is
    # the solver's error. (Forces along y are balanced by the other half of the bearing.) Across
    # the load only the keys hold the inner ring: they take the small `side_force` that the mesh,
    # which is not quite symmetric, leaves over.
    by_ring = contact_forces(problem.solution, bearing.balls)
    q = ufl.TestFunction(outward.function_space)
    held = -cage * ufl.dot(uh, around) * around
    by_cage, by_rotation = (
        ball_forces(decomposition, fem.form(ufl.dot(f, q) * dx), bearing.balls)
        for f in (held, push)
    )
    across = [0, 2]
    ball_sums = (by_ring.sum(axis=1) + by_cage + by_rotation)[:, across]
    on_inner_ring = -by_ring[:, 0].sum(axis=0)
    problem.report.errors.update(
        ball_balance=np.linalg.norm(ball_sums, axis=1).max() / load,
        force=on_inner_ring[2] / load - 1,
        side_force=abs(on_inner_ring[0]) / load,
    )
    if comm.rank == 0:
        print_forces(bearing, by_ring, by_cage, load)
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        looks = {"factor": 25.0, "view": (0.35, 1.0, 0.25), "zoom": 1.15, "show_edges": False}
        looks["highest"] = 600.0
        plot_deformed(demo.folder / "ball_bearing_3d.png", problem.solution, **looks)
    return demo.finish(problem, "ball_bearing_3d")


def contact_forces(solution, balls):
    """Forces of the inner and of the outer ring on each ball, shape (balls, 2, 3)."""
    contacts = [solution.contact(i) for i in range(2 * balls)]
    forces = np.array([-data.force @ data.normal for data in contacts])
    return solution.decomposition.comm.allreduce(forces).reshape(balls, 2, 3)


def ball_forces(decomposition, form, balls):
    """Sums over each ball of a linear form on piecewise constants, shape (balls, 3)."""
    per_cell = fem.assemble_vector(form).array.reshape(-1, 3)
    cells = [
        decomposition.cell_tags.find(decomposition.volume(f"ball {i + 1}")) for i in range(balls)
    ]
    return decomposition.comm.allreduce(np.array([per_cell[c].sum(axis=0) for c in cells]))


def facets_near(decomposition, surface, where):
    """Facets of a surface whose midpoints lie where a condition holds."""
    mesh, facets = decomposition.mesh, decomposition.facets(surface)
    mesh.topology.create_connectivity(2, 3)
    return facets[where(compute_midpoints(mesh, 2, facets).T)]


def print_forces(bearing, by_ring, by_cage, load):
    """A table of the forces on the balls, relative to the load."""
    print("forces on the balls over the load: from the load line, inner ring, outer ring, cage")
    for i in range(bearing.balls):
        angle = np.degrees(bearing.angle(i)) + 90
        inner, outer, cage = np.linalg.norm([*by_ring[i], by_cage[i]], axis=1) / load
        print(f"ball {i + 1:<3} {angle:6.1f}° {inner:10.6f} {outer:10.6f} {cage:10.6f}", flush=True)


def size(arguments):
    """Unknowns of the mesh before it is torn, and subdomains."""
    unknowns = 8_000 if arguments.quick else 1_310_000 if arguments.large else 80_000
    unknowns = arguments.unknowns or unknowns
    subdomains = 700 if arguments.large else max(8, round(unknowns / 2000))
    return unknowns, arguments.subdomains or subdomains


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    balls = {"choices": range(3, 15), "metavar": "N", "help": "their number, 3 to 14"}
    parser.add_argument("--balls", type=int, default=8, **balls)
    parser.add_argument("--unknowns", type=int, help="about so many unknowns")
    parser.add_argument("--subdomains", type=int, help="gmsh partitions")
    parser.add_argument("--large", action="store_true", help="700 subdomains, 1.7 M unknowns")


if __name__ == "__main__":
    main(sys.argv[1:])
