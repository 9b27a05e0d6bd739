# # Deep drawing
#
# A sheet is drawn over the edge of a die by a punch, while a blank holder presses on it: three
# rigid tools, plasticity in finite strain, Coulomb's friction, plane strain. Punch and die move by
# a law, the holder is pressed by a force. Then the tools are taken away, and the sheet springs
# back. There is no closed form. What has to hold is the balance: of the forces of the tools, and of
# their work with what friction and plastic flow dissipate and what the sheet keeps elastically. A
# half is modelled, x ≥ 0; lengths are in mm, forces in N for 1 mm of width.
#
#     ./run mpirun -n 2 python3 demos/deep_drawing_2d.py --plot

"""A sheet drawn by punch, die and blank holder, with springback; balance of forces and work."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.partial_slip import draw

E, nu, STRENGTH, HARDENING = 2.0e5, 0.3, 250.0, 2000.0  # stainless steel, about
LENGTH, SHEET = 48.0, 3.0  # half the length, thickness
PUNCH, CLEARANCE, EDGE = 20.0, 5.0, 7.0  # half the width of the punch; radius of both edges
MU, HOLDING, STROKE = 0.1, 300.0, 18.0


class Edge:
    """A block with one rounded corner, in the quadrant of the signs ``side`` from ``corner`` on."""

    def __init__(self, corner, side, radius):
        self.point, self.side, self.radius = np.array([*corner, 0.0]), np.array(side), radius

    def inwards(self, x):
        """From the corner's centre towards the corner, both components."""
        return self.radius - self.side[:, None] * (x[:2] - self.point[:2, None])

    def distance(self, x):
        q = self.inwards(x)
        return np.hypot(*np.maximum(q, 0.0)) + np.minimum(q.max(axis=0), 0.0) - self.radius

    def gradient(self, x):
        q = self.inwards(x)
        n = np.where(q.max(axis=0) > 0.0, np.maximum(q, 0.0), q == q.max(axis=0))
        n = -self.side[:, None] * n / np.linalg.norm(n, axis=0)
        return np.stack((*n, np.zeros(x.shape[1])))

    def outline(self, length, shift=0.0):
        """Abscissae and ordinates of both sides, and of the corner between them."""
        angle, centre = np.linspace(0.0, np.pi / 2, 20), self.point[:2] + self.side * self.radius
        arc = centre - self.side * self.radius * np.column_stack((np.sin(angle), np.cos(angle)))
        ends = self.point[:2] + self.side * length * np.eye(2)
        x, y = np.vstack((ends[0], arc, ends[1])).T
        return x, y + shift


def torn_mesh(across, subdomains):
    """The sheet, of rectangles, so many across it: "axis", "bottom", "top"."""
    cells = (round(LENGTH / SHEET * across * 0.7), across)
    ends = [[0.0, 0.0], [LENGTH, SHEET]]
    mesh = dmesh.create_rectangle(MPI.COMM_WORLD, ends, cells, dmesh.CellType.quadrilateral)
    sides = {
        "axis": lambda x: np.isclose(x[0], 0.0),
        "bottom": lambda x: np.isclose(x[1], 0.0),
        "top": lambda x: np.isclose(x[1], SHEET),
    }
    return tfeti.decompose(mesh, subdomains, surfaces=sides)


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    stroke = 2.0 if arguments.quick else STROKE
    steps = 2 if arguments.quick else arguments.steps
    decomposition = torn_mesh(2 if arguments.quick else arguments.across, 4)

    # ## Material
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
    steel = tfeti.FiniteJ2Plasticity(
        elastic, u, yield_stress=STRENGTH, hardening=HARDENING, selective=True
    )
    axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))

    # ## Tools
    #
    # The die stays, the punch goes down with the time, and the holder's way is found by its force.
    at = PUNCH + CLEARANCE
    punch, die, holder = (
        tfeti.RigidBody(Edge(corner, side, radius), name=name, **motion)
        for name, corner, side, radius, motion in (
            ("punch", (PUNCH, SHEET), (-1, 1), EDGE, {"displacement": lambda t: (0.0, -t)}),
            ("die", (at, 0.0), (1, -1), EDGE, {}),
            ("holder", (at, SHEET), (1, 1), 1.0, {"force": (0.0, -HOLDING), "free": ("y",)}),
        )
    )
    rough = tfeti.Coulomb(MU)
    contacts = [
        tfeti.Obstacle(surface, tool, friction=rough, name=tool.name)
        for surface, tool in (("top", punch), ("bottom", die), ("top", holder))
    ]
    problem = tfeti.NonlinearContactProblem(
        steel.residual(v),
        u,
        [fem.dirichletbc(0.0, axis, V.sub(0))],
        contacts,
        decomposition,
        finite=True,
        state=steel.state,
        update=steel.update,
        stress=steel.stress,
        petsc_options={"tfeti_rtol": 3e-4, **demo.petsc_options},
    )
    depths = stroke * np.arange(1, steps + 1) / steps
    records = tfeti.LoadSteps(problem, lambda problem, t: None, depths).run()

    # ## Balance
    #
    # The tools' work is a sum of trapezoids, over depths and forces that begin at 0.
    d = np.array([0.0, *(record.time for record in records)])
    force = np.array([0.0, *(-record.contact_forces[0][1] for record in records)])
    lift = records[-1].tools["holder displacement y"]
    work = float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(d))) - HOLDING * lift
    friction = sum(record.dissipation for record in records)
    flow, kept = energies(steel, comm)
    errors = problem.report.errors
    resting = np.sum([contact[1] for contact in records[-1].contact_forces])
    errors["balance_of_tools"] = float(resting / force[-1])
    errors["balance_of_work"] = (friction + flow + kept) / work - 1
    if comm.rank == 0:
        for record, depth, own in zip(records, d[1:], force[1:], strict=True):
            figures = record.figures
            print(
                f"depth {depth:5.2f}: force {own:.1f}, {figures['newton_steps']} tangents, "
                f"{figures['F_multiplications']} F",
                flush=True,
            )
        print(
            f"work {work:.0f} = friction {friction:.0f} + flow {flow:.0f} + elastic {kept:.0f} "
            f"{errors['balance_of_work']:+.1%}"
        )
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        path = demo.folder / "deep_drawing_2d.png"
        plot_deformed(path, problem.solution, factor=1.0, highest=600.0, zoom=1.2)

    # ## Springback
    #
    # Without its tools the sheet is another problem, which begins with what it has become. A point
    # of its middle is held.
    low = dmesh.locate_entities_boundary(
        decomposition.mesh, 0, lambda x: np.isclose(x[0], 0.0) & np.isclose(x[1], 0.0)
    )
    point = fem.locate_dofs_topological(V.sub(1), 0, low)
    here = comm.allreduce(float(np.min(u.x.array[point], initial=np.inf)), op=MPI.MIN)
    bcs = [fem.dirichletbc(0.0, axis, V.sub(0)), fem.dirichletbc(here, point, V.sub(1))]
    free = tfeti.NonlinearContactProblem(
        steel.residual(v),
        u,
        bcs,
        [],
        decomposition,
        finite=True,
        state=steel.state,
        update=steel.update,
        stress=steel.stress,
        petsc_options={"tfeti_rtol": 3e-4, **demo.petsc_options},
    )
    pressed = [side_now(u, height, comm) for height in (0.0, SHEET)]
    free.solve()
    sprung = [side_now(u, height, comm) for height in (0.0, SHEET)]
    before, after = (
        np.max(np.arctan2(*np.diff(low, axis=0).T[::-1])) for low, _ in (pressed, sprung)
    )
    errors["springback_degrees"] = float(np.degrees(before - after))
    if comm.rank == 0:
        print(
            f"slope of the wall {np.degrees(before):.2f}°, without tools {np.degrees(after):.2f}°"
        )
    if arguments.plot and comm.rank == 0:
        curves = {
            name: np.vstack((low, high[::-1])).T
            for name, low, high in (("pressed", *pressed), ("without tools", *sprung))
        }
        curves |= {
            "punch": punch.shape.outline(PUNCH, -stroke),
            "die": die.shape.outline(LENGTH - at),
            "holder": holder.shape.outline(LENGTH - at, lift),
        }
        labels = ("depth in mm", "force of half the punch in N a mm")
        path = demo.folder / "deep_drawing_2d_force.png"
        draw(path, [(labels, {}, {"punch": (d, force)}), (("x in mm", "y in mm"), {}, curves)])
    free.destroy()
    return demo.finish(problem, "deep_drawing_2d")


def energies(steel, comm):
    """What plastic flow has dissipated, and what the sheet keeps elastically."""
    u, p, mu, kappa = steel.u, steel.p, E / 2 / (1 + nu), E / 3 / (1 - 2 * nu)
    s = ufl.dev(steel.stress(u))
    dilatation = ufl.ln(ufl.det(ufl.Identity(2) + ufl.grad(u)))
    centre = ufl.dx(metadata={"quadrature_degree": 1})  # of cells, where `selective` takes it
    parts = (
        (STRENGTH * p + HARDENING / 2 * p**2) * steel.dx,
        ufl.inner(s, s) / 4 / mu * steel.dx,
        kappa / 2 * dilatation**2 * centre,
    )
    flow, shape, volume = (comm.allreduce(fem.assemble_scalar(fem.form(part))) for part in parts)
    return flow, shape + volume


def side_now(u, height, comm):
    """Where the sheet's nodes of a height are, from its middle on."""
    x, moved = u.function_space.tabulate_dof_coordinates(), u.x.array.reshape(-1, 2)
    on = np.flatnonzero(np.isclose(x[: len(moved), 1], height))
    parts = comm.allgather(np.column_stack((x[on, 0], x[on, :2] + moved[on])))
    whole = np.concatenate(parts)
    _, first = np.unique(whole[:, 0].round(9), return_index=True)  # torn nodes once
    return whole[first, 1:]


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--across", type=int, default=3, help="elements across the sheet")
    parser.add_argument("--steps", type=int, default=24, help="load steps of the stroke")


if __name__ == "__main__":
    main(sys.argv[1:])
