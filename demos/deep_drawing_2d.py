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

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A sheet drawn by punch, die and blank holder, with springback."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--across", type=int, default=3, help="elements across the sheet")
parser.add_argument("--steps", type=int, default=24, help="load steps of the stroke")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Mesh
#
# The sheet, of rectangles.

# +
comm = MPI.COMM_WORLD
length, thickness = 48.0, 3.0  # half the length
across = 2 if arguments.quick else arguments.across
cells = (round(length / thickness * across * 0.7), across)
ends = [(0.0, 0.0), (length, thickness)]
sheet = dmesh.create_rectangle(comm, ends, cells, dmesh.CellType.quadrilateral)
sides = {
    "axis": lambda x: np.isclose(x[0], 0.0),
    "bottom": lambda x: np.isclose(x[1], 0.0),
    "top": lambda x: np.isclose(x[1], thickness),
}
decomposition = tfeti.decompose(sheet, 4, surfaces=sides)
# -

# ## Material: stainless steel, about

E, nu, strength, hardening = 2.0e5, 0.3, 250.0, 2000.0
V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
steel = tfeti.FiniteJ2Plasticity(
    elastic, u, yield_stress=strength, hardening=hardening, selective=True
)
axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))

# ## Tools
#
# The die stays, the punch goes down with the time, and the holder's way is found by its force.
# Their shapes are blocks with a rounded corner: any object with a distance and its gradient is
# one.


# +
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


width, at, holding = 20.0, 25.0, 300.0  # half the punch; the die, a clearance of 5 from it
punch, die, holder = (
    tfeti.RigidBody(Edge(corner, side, radius), name=name, **motion)
    for name, corner, side, radius, motion in (
        ("punch", (width, thickness), (-1, 1), 7.0, {"displacement": lambda t: (0.0, -t)}),
        ("die", (at, 0.0), (1, -1), 7.0, {}),
        ("holder", (at, thickness), (1, 1), 1.0, {"force": (0.0, -holding), "free": ("y",)}),
    )
)
contacts = [
    tfeti.Obstacle(surface, tool, friction=tfeti.Coulomb(0.1), name=tool.name)
    for surface, tool in (("top", punch), ("bottom", die), ("top", holder))
]


def sheet_problem(bcs, contacts):
    return tfeti.NonlinearContactProblem(
        steel.residual(v),
        u,
        bcs,
        contacts,
        decomposition,
        finite=True,
        stress=steel.stress,
        petsc_options={"tfeti_rtol": 3e-4},
    )


problem = sheet_problem([fem.dirichletbc(0.0, axis, V.sub(0))], contacts)
stroke, steps = (2.0, 2) if arguments.quick else (18.0, arguments.steps)
depths = stroke * np.arange(1, steps + 1) / steps
folder, records, pictures = arguments.output or Path("results"), [], []
for before, depth in zip([0.0, *depths], depths, strict=False):
    records += tfeti.LoadSteps(problem, lambda problem, t: None, [depth], begin=before).run()
    if arguments.plot:
        pictures.append(folder / f"deep_drawing_2d_{len(pictures)}.png")
        looks = {"factor": 1.0, "highest": 600.0, "zoom": 1.2, "unit": "MPa"}
        tfeti.plot_deformed(pictures[-1], problem.solution, **looks)
# -

# ## Balance
#
# The tools' work is a sum of trapezoids, over depths and forces that begin at 0. It goes into
# friction, plastic flow, and what the sheet keeps elastically.


# +
def total(form):
    return comm.allreduce(fem.assemble_scalar(fem.form(form)))


d = np.array([0.0, *(record.time for record in records)])
force = np.array([0.0, *(-record.contact_forces[0][1] for record in records)])
lift = records[-1].tools["holder displacement y"]
work = float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(d))) - holding * lift
friction = sum(record.dissipation for record in records)
mu, kappa, s, p = E / 2 / (1 + nu), E / 3 / (1 - 2 * nu), ufl.dev(steel.stress(u)), steel.p
flow = total((strength * p + hardening / 2 * p**2) * steel.dx)
dilatation = ufl.ln(ufl.det(ufl.Identity(2) + ufl.grad(u)))
centre = ufl.dx(metadata={"quadrature_degree": 1})  # of cells, where `selective` takes it
kept = total(ufl.inner(s, s) / 4 / mu * steel.dx) + total(kappa / 2 * dilatation**2 * centre)
errors = problem.report.errors
resting = np.sum([contact[1] for contact in records[-1].contact_forces])
errors["balance_of_tools"] = float(resting / force[-1])
errors["balance_of_work"] = (friction + flow + kept) / work - 1
if comm.rank == 0:
    for record, own in zip(records, force[1:], strict=True):
        done = record.figures
        print(
            f"depth {record.time:5.2f}: force {own:.1f}, {done['newton_steps']} tangents, "
            f"{done['F_multiplications']} iterations"
        )
    print(
        f"work {work:.0f} = friction {friction:.0f} + flow {flow:.0f} + elastic {kept:.0f} "
        f"{errors['balance_of_work']:+.1%}"
    )
# -

# ## Springback
#
# Without its tools the sheet is another problem, which begins with what it has become. A point
# of its middle is held.


# +
def side_now(height):
    """Where the sheet's nodes of a height are, from its middle on."""
    x, moved = V.tabulate_dof_coordinates(), u.x.array.reshape(-1, 2)
    on = np.flatnonzero(np.isclose(x[: len(moved), 1], height))
    whole = np.concatenate(comm.allgather(np.column_stack((x[on, 0], x[on, :2] + moved[on]))))
    _, first = np.unique(whole[:, 0].round(9), return_index=True)  # torn nodes once
    return whole[first, 1:]


low = dmesh.locate_entities_boundary(
    decomposition.mesh, 0, lambda x: np.isclose(x[0], 0.0) & np.isclose(x[1], 0.0)
)
point = fem.locate_dofs_topological(V.sub(1), 0, low)
here = comm.allreduce(float(np.min(u.x.array[point], initial=np.inf)), op=MPI.MIN)
pressed = [side_now(height) for height in (0.0, thickness)]
bcs = [fem.dirichletbc(0.0, axis, V.sub(0)), fem.dirichletbc(here, point, V.sub(1))]
free = sheet_problem(bcs, [])
free.solve()
sprung = [side_now(height) for height in (0.0, thickness)]
before, after = (np.max(np.arctan2(*np.diff(of[0], axis=0).T[::-1])) for of in (pressed, sprung))
errors["springback_degrees"] = float(np.degrees(before - after))
if comm.rank == 0:
    print(f"slope of the wall {np.degrees(before):.2f}°, without tools {np.degrees(after):.2f}°")
free.destroy()
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "deep_drawing_2d.bp", problem.solution)
if arguments.plot and comm.rank == 0:
    from matplotlib.figure import Figure
    from PIL import Image

    frames = [Image.open(path).resize((600, 450)) for path in pictures]
    path, more = folder / "deep_drawing_2d.gif", frames[1:]
    frames[0].save(path, save_all=True, append_images=more, duration=250, loop=0)
    pictures[-1].replace(folder / "deep_drawing_2d.png")
    for path in pictures[:-1]:
        path.unlink()

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(d, force, "o-")
    left.set(xlabel="depth in mm", ylabel="force of half the punch in N a mm")
    for name, (lower, upper) in {"pressed": pressed, "without tools": sprung}.items():
        right.plot(*np.vstack((lower, upper[::-1])).T, label=name)
    far = length - at
    for tool, long, shift in ((punch, width, -stroke), (die, far, 0.0), (holder, far, lift)):
        right.plot(*tool.shape.outline(long, shift), color="grey")
    right.set(xlabel="x in mm", ylabel="y in mm")
    right.legend()
    figure.savefig(folder / "deep_drawing_2d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
