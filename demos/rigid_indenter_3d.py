# # A rigid indenter in 3D
#
# A rigid ball is pressed into an elastic body, in load steps: first by its displacement, then by
# the forces that this took. Both give the same curve F(d), and Hertz' closed form has it for a
# half space. The body is half a ball, clamped on its cap, large beside the contact.
#
#     ./run python3 demos/rigid_indenter_3d.py --plot

"""A rigid ball pressed into an elastic body, by displacement and by force: the same curve F(d)."""

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
from meshes.tools import graded_field

R, E, nu = 1.0, 1.0, 0.3
MODULUS = E / (1 - nu**2)
deepest = 0.01 * R
a = np.sqrt(R * deepest)
size = 40 * a  # of the body


def torn_mesh(arguments):
    # ## Mesh
    #
    # The flat side is "top", at z = size; elements are finest where the ball touches it.
    comm = MPI.COMM_WORLD
    unknowns = arguments.unknowns or (4_000 if arguments.quick else 60_000)
    scale = (6000 / unknowns) ** (1 / 3)
    model = None
    if comm.rank == 0:
        middle = (0.0, 0.0, size)
        finest = 0.2 * a * scale
        model = build(size, sizes=lambda: graded_field(middle, finest, 1.3 * a, 0.35 * scale))
    return tfeti.read_gmsh(model, comm, max(2, round(unknowns / 4000)))


def problem_with(tool, decomposition, petsc_options):
    """Return the problem, with a rigid body on the flat side."""
    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dofs = fem.locate_dofs_topological(V, 2, decomposition.facets("contact"))
    clamp = fem.dirichletbc(np.zeros(3), dofs, V)

    # ## The indenter
    #
    # It stands where an obstacle has its shape.
    ball = tfeti.Obstacle("top", tool, reach=deepest)
    return tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.ZeroBaseForm((v,)),
        [clamp],
        [ball],
        decomposition,
        stress=elastic.stress,
        petsc_options=petsc_options,
    )


def run(argv):
    demo = Demo(__doc__, argv, configure)
    comm, steps = MPI.COMM_WORLD, 4 if demo.arguments.quick else 10
    decomposition = torn_mesh(demo.arguments)
    shape = tfeti.Sphere((0, 0, size + R), R)

    # ## By displacement
    #
    # A law is a function of the time of the load steps. It changes gaps, no row and no factor.
    tool = tfeti.RigidBody(shape, displacement=lambda t: (0, 0, -t * deepest), name="indenter")
    problem = problem_with(tool, decomposition, demo.petsc_options)
    times = np.linspace(0, 1, steps + 1)[1:]
    pressed = tfeti.LoadSteps(problem, lambda problem, t: None, times)
    d = [-record.tools["indenter displacement z"] for record in pressed.run()]
    force = [record.tools["indenter force z"] for record in pressed.records]

    # ## By force
    #
    # The ball is free along z: one unknown more, of the coarse problem. Forces of a step are
    # those of the curve.
    tool = tfeti.RigidBody(
        shape,
        force=lambda t: (0, 0, -np.interp(t, times, force)),
        free=("z",),
        name="indenter",
    )
    by_force = problem_with(tool, decomposition, demo.petsc_options)
    loaded = tfeti.LoadSteps(by_force, lambda problem, t: None, times)
    way = [-record.tools["indenter displacement z"] for record in loaded.run()]
    counts = [sum(r.figures["F_multiplications"] for r in s.records) for s in (pressed, loaded)]
    by_force.destroy()

    # ## Comparison with the closed form
    #
    # F = 4/3 E* √R d^(3/2); a and p₀ are those that belong to the force that was found.
    hertz = 4 / 3 * MODULUS * np.sqrt(R) * np.array(d) ** 1.5
    at_end = (3 * force[-1] * R / (4 * MODULUS)) ** (1 / 3)
    contact = problem.solution.contact(0)
    r = np.hypot(contact.points[:, 0], contact.points[:, 1])
    errors = compare(comm, contact, r, PointContact.from_half_width(at_end, R, MODULUS))
    errors["force"] = force[-1] / hertz[-1] - 1  # at this depth
    errors["depth_by_force"] = float(np.max(np.abs(np.array(way) / d - 1)))
    problem.report.errors.update(errors)
    if comm.rank == 0:
        print("d / R, F by displacement, d / R by the force, F of a half space (Hertz)")
        for row in zip(d, force, way, hertz, strict=True):
            print("  {:.4f}  {:.6f}  {:.4f}  {:.6f}".format(*row))
        print(f"multiplications by F: {counts[0]} by displacement, {counts[1]} by force")
    if demo.arguments.plot:
        from tfeti_dolfinx.plot import plot_pressure

        plot_pressure(
            demo.folder / "rigid_indenter_3d_pressure.png",
            problem.solution,
            lambda points: np.hypot(points[:, 0], points[:, 1]),
            PointContact.from_half_width(at_end, R, MODULUS).pressure,
            limit=2 * a,
            label="r",
        )
        if comm.rank == 0:
            plot_curve(demo.folder / "rigid_indenter_3d_curve.png", d, force, way)
    return demo.finish(problem, "rigid_indenter_3d")


def plot_curve(path, d, force, way):
    """Draw the force over the depth."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    x = np.linspace(0, max(d), 100)
    axes.plot(x, 4 / 3 * MODULUS * np.sqrt(R) * x**1.5, "k-", label="Hertz, half space")
    axes.plot(d, force, "o", label="pressed by displacement")
    axes.plot(way, force, "x", label="pressed by force")
    axes.set(xlabel="depth d / R", ylabel="force F / (E R²)")
    axes.legend()
    FigureCanvasAgg(figure).print_figure(path, dpi=120)


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--unknowns", type=int, help="about so many unknowns")


if __name__ == "__main__":
    main(sys.argv[1:])
