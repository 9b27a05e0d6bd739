# # A ball pressed beyond its yield stress
#
# A half ball is pressed on a rigid plane, past the yield stress, and let go. Hertz' closed form
# holds up to the force at which it first yields, F_y = π³R²(1.6 σ_y)³/(6E*²) for ν = 0.3 (Johnson,
# Contact Mechanics, 1985, chapter 6). Unloaded, it keeps a flat imprint and stresses of its own.
#
#     ./run mpirun -n 2 python3 demos/plastic_hertz_3d.py --plot

"""A half ball pressed beyond its yield stress and let go: imprint and residual stress."""

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
STRENGTH, HARDENING = 0.005, 0.02
MODULUS = E / (1 - nu**2)
FIRST_YIELD = np.pi**3 * R**2 * (1.6 * STRENGTH) ** 3 / (6 * MODULUS**2)


def hertz(d):
    """Force of a rigid plane at the approach d, elastic."""
    return 4 / 3 * MODULUS * np.sqrt(R) * np.maximum(d, 0.0) ** 1.5


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    size = arguments.size or (0.06 if arguments.quick else 0.03)
    model = None
    if comm.rank == 0:
        model = build(R, fine=size, fine_radius=0.15, growth=0.5 if arguments.quick else 0.35)
    decomposition = tfeti.read_gmsh(model, comm, subdomains=2 if arguments.quick else 12)

    # ## Material
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
    u, v, du = fem.Function(V), ufl.TestFunction(V), ufl.TrialFunction(V)
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
    steel = tfeti.J2Plasticity(elastic, u, yield_stress=STRENGTH, hardening=HARDENING)
    down = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
    top = fem.locate_dofs_topological(V, 2, decomposition.facets("top"))
    plane = tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), name="plane")
    problem = tfeti.NonlinearContactProblem(
        steel.residual(v),
        u,
        [fem.dirichletbc(down, top, V)],
        [plane],
        decomposition,
        J=steel.tangent(du, v),
        state=steel.state,
        update=steel.update,
        stress=steel.stress,
        petsc_options={"tfeti_rtol": 1e-5, **demo.petsc_options},
    )

    # ## Loading and unloading
    #
    # In steps of time, down up to t = 1 and up again; after a third of the way the plane is free.
    most = 0.01 * R

    def depth_at(t):
        return most * np.interp(t, [0.0, 1.0, 2.0], [0.0, 1.0, 0.0])

    def apply(_, t):
        down.value[2] = -depth_at(t)

    up = 2 if arguments.quick else 6
    times = np.append(np.arange(1, up + 1) / up, 1 + np.array([0.1, 0.2, 0.3, 1.0]))
    records = tfeti.LoadSteps(problem, apply, times).run()
    d = np.array([depth_at(record.time) for record in records])
    forces = np.array([record.contact_forces[0][2] for record in records])
    # what the lowest point does not come back
    low = decomposition.mesh.comm.allreduce(_lowest(problem), op=MPI.MIN)
    problem.report.errors["imprint"] = float(low / most)
    if comm.rank == 0:
        print(f"first yield at a force of {FIRST_YIELD:.2e}")
        for record, depth, force in zip(records, d, forces, strict=True):
            figures = record.figures
            print(
                f"d/R = {depth / R:.5f}: force {force:.3e}, elastic {hertz(depth):.3e}, "
                f"{figures['newton_steps']} tangents, {figures['F_multiplications']} F",
                flush=True,
            )
        print(f"imprint {low:.2e}, of a displacement {most:.2e}")
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        look = {"cut": ((0, 0, 0), (0, -1, 0)), "view": (0.0, -1.0, -0.1)}
        look |= {"zoom": 4.0, "focus": (0.0, 0.0, 0.15)}
        path = demo.folder / "plastic_hertz_3d.png"
        plot_deformed(path, problem.solution, factor=1.0, **look)
        if comm.rank == 0:
            fine = np.linspace(0.0, most, 101)
            path = (np.append(0.0, d), np.append(0.0, forces))
            curves = {"J2": path, "elastic, Hertz": (fine, hertz(fine))}
            labels = ("displacement / R", "force / E R²")
            draw(demo.folder / "plastic_hertz_3d_force.png", [(labels, {}, curves)])
    return demo.finish(problem, "plastic_hertz_3d")


def _lowest(problem):
    """How far the lowest point of this rank's mesh stays up, or a large number."""
    V = problem.u.function_space
    x, u = V.tabulate_dof_coordinates(), problem.u.x.array.reshape(-1, 3)
    at = np.linalg.norm(x, axis=1) < 1e-8 * R
    return float(np.min(u[at, 2], initial=np.inf))


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--size", type=float, help="element size near the contact")


if __name__ == "__main__":
    main(sys.argv[1:])
