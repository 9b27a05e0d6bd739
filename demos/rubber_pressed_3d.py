# # A half ball of rubber pressed flat
#
# A half ball of neo-Hooke is pressed on a rigid plane by 40 % of its radius: finite strain, and
# contact where the ball is. At first the force is that of Hertz, F = 4/3 E* √R d^{3/2}; then the
# contact is no longer small beside the ball, and the ball is stiffer.
#
#     ./run mpirun -n 2 python3 demos/rubber_pressed_3d.py --plot

"""Half a ball of rubber pressed by 40 % of its radius, beside Hertz at small displacements."""

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
from demos.partial_slip import draw
from meshes.half_ball import build

R, E, nu = 1.0, 1.0, 0.3
MOST = 0.4 * R


def hertz(d):
    """Force of a rigid plane at the approach d, for a ball whose contact is small."""
    return 4 / 3 * E / (1 - nu**2) * np.sqrt(R) * d**1.5


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    size = arguments.size or (0.25 if arguments.quick else 0.1)
    steps = arguments.steps or (2 if arguments.quick else 8)
    model = build(R, fine=size, fine_radius=0.5, growth=0.1) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, subdomains=2 if arguments.quick else 16)

    # ## Material
    #
    # `residual` is the derivative of the energy, and `update` keeps its tangent definite.
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    rubber = tfeti.NeoHooke(tfeti.Elasticity(decomposition, E=E, nu=nu), u)

    # ## Contact
    #
    # The upper side goes down and is held across. In finite strain the gap is measured from
    # where the ball is, in each Newton step.
    down = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
    top = fem.locate_dofs_topological(V, 2, decomposition.facets("top"))
    plane = tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), name="plane")
    problem = tfeti.NonlinearContactProblem(
        rubber.residual(v),
        u,
        [fem.dirichletbc(down, top, V)],
        [plane],
        decomposition,
        finite=True,
        update=rubber.update,
        stress=rubber.stress,
        petsc_options={"tfeti_rtol": 2e-5, **demo.petsc_options},
    )

    def apply(_, d):
        down.value[2] = -d

    depths = MOST * np.arange(1, steps + 1) / steps
    records = tfeti.LoadSteps(problem, apply, depths).run()
    forces = np.array([record.contact_forces[0][2] for record in records])
    first = forces[0] / hertz(records[0].time) - 1
    problem.report.errors["force_of_the_first_step"] = float(first)
    if comm.rank == 0:
        for record, force in zip(records, forces, strict=True):
            figures = record.figures
            print(
                f"d/R = {record.time / R:.3f}: force {force:.4f}, Hertz {hertz(record.time):.4f}, "
                f"{figures['newton_steps']} tangents, {figures['F_multiplications']} F"
            )
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        path, view = demo.folder / "rubber_pressed_3d.png", (0.3, -1.0, -0.4)
        plot_deformed(path, problem.solution, factor=1.0, view=view)
        if comm.rank == 0:
            fine = np.linspace(0.0, MOST, 101)
            d = np.array([0.0, *(record.time for record in records)])
            curves = {"neo-Hooke": (d, np.array([0.0, *forces])), "Hertz": (fine, hertz(fine))}
            labels = ("displacement / R", "force / E R²")
            draw(demo.folder / "rubber_pressed_3d_force.png", [(labels, {}, curves)])
    return demo.finish(problem, "rubber_pressed_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--size", type=float, help="element size near the contact")
    parser.add_argument("--steps", type=int, help="load steps")


if __name__ == "__main__":
    main(sys.argv[1:])
