# # Ironing
#
# A half disc, ten times as stiff, is pressed into a slab and drawn along it, with Coulomb's
# friction 0.3: large sliding in finite strain, as in the shallow ironing of Fischer and Wriggers
# (Comput. Methods Appl. Mech. Engrg. 195, 2006). There is no closed form.
#
#     ./run mpirun -n 2 python3 demos/ironing_2d.py --plot

"""A stiff half disc drawn along a soft slab with Coulomb's friction: large sliding, forces."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.partial_slip import draw
from meshes.tools import graded_size, started_model

MU, nu = 0.3, 0.3
E = {"slab": 1.0, "die": 10.0}
LENGTH, HEIGHT, R = 8.0, 2.0, 1.5
DEPTH, WAY = 0.5, 3.0


def torn_mesh(size, subdomains):
    """The slab under y = 0, and a half disc on it at x = 2."""
    comm, model = MPI.COMM_WORLD, None
    if comm.rank == 0:
        model = started_model("ironing")
        geo = model.geo
        corners = ((0, -HEIGHT), (LENGTH, -HEIGHT), (LENGTH, 0), (0, 0))
        points = [geo.addPoint(x, y, 0.0) for x, y in corners]
        sides = [geo.addLine(points[k], points[(k + 1) % 4]) for k in range(4)]
        slab = geo.addPlaneSurface([geo.addCurveLoop(sides)])
        ends = ((2 - R, R), (2, R), (2 + R, R), (2, 0))
        left, centre, right, low = (geo.addPoint(x, y, 0.0) for x, y in ends)
        arcs = [geo.addCircleArc(left, centre, low), geo.addCircleArc(low, centre, right)]
        grip = geo.addLine(right, left)
        die = geo.addPlaneSurface([geo.addCurveLoop([*arcs, grip])])
        geo.synchronize()
        for name, body in (("slab", slab), ("die", die)):
            model.addPhysicalGroup(2, [body], name=name)
        for name, curves in (("bottom", sides[:1]), ("surface", sides[2:3]), ("arc", arcs)):
            model.addPhysicalGroup(1, curves, name=name)
        model.addPhysicalGroup(1, [grip], name="grip")
        graded_size((0.0, 0.0, 0.0), size, LENGTH, 0.0)
        gmsh.model.mesh.generate(2)
    return tfeti.read_gmsh(model, comm, subdomains)


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    decomposition = torn_mesh(arguments.size or (0.35 if arguments.quick else 0.18), 8)

    # ## Two bodies of one material, with moduli by their names
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
    rubber = tfeti.NeoHooke(elastic, u)
    place = fem.Constant(decomposition.mesh, (0.0, 0.0))
    held = fem.Constant(decomposition.mesh, (0.0, 0.0))
    bcs = [
        fem.dirichletbc(value, fem.locate_dofs_topological(V, 1, decomposition.facets(name)), V)
        for name, value in (("bottom", held), ("grip", place))
    ]
    pair = tfeti.Contact("surface", "arc", friction=tfeti.Coulomb(MU), name="die")
    problem = tfeti.NonlinearContactProblem(
        rubber.residual(v),
        u,
        bcs,
        [pair],
        decomposition,
        finite=True,
        update=rubber.update,
        stress=rubber.stress,
        petsc_options={"tfeti_rtol": 2e-5, **demo.petsc_options},
    )

    # ## Down, then along
    #
    # In a load step friction acts on what slips since its begin, along tangents that turn with
    # the surface.
    down, along = (2, 1) if arguments.quick else (5, arguments.steps)
    stride = WAY / (10 if arguments.quick else along)

    def apply(_, t):
        place.value = (stride * max(t - down, 0.0), -DEPTH * min(t / down, 1.0))

    times = np.arange(1.0, down + along + 1)
    records = tfeti.LoadSteps(problem, apply, times).run()
    # on the slab: drawn along and pressed down
    forces = np.array([record.contact_forces[0] for record in records])
    ratio = forces[:, 0] / forces[:, 1]
    problem.report.errors["force_along_over_force_down"] = float(-ratio[-1])
    if comm.rank == 0:
        for record, force in zip(records, forces, strict=True):
            figures = record.figures
            print(
                f"step {record.time:4.1f}: force down {-force[1]:.4f}, along {force[0]:.4f}, "
                f"{figures['newton_steps']} tangents, {figures['F_multiplications']} F",
                flush=True,
            )
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        plot_deformed(demo.folder / "ironing_2d.png", problem.solution, factor=1.0)
        if comm.rank == 0:
            t = np.array([record.time for record in records])
            curves = {"pressed down": (t, -forces[:, 1]), "drawn along": (t, forces[:, 0])}
            labels = ("load step", "force on the slab")
            draw(demo.folder / "ironing_2d_force.png", [(labels, {}, curves)])
    return demo.finish(problem, "ironing_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--size", type=float, help="element size")
    parser.add_argument("--steps", type=int, default=10, help="load steps along the slab")


if __name__ == "__main__":
    main(sys.argv[1:])
