# # A mesh that finds the contact, in 3D
#
# The half ball of `hertz_3d.py`, without knowing where and how wide the contact is: from a coarse
# uniform mesh on, each solve says how large the tetrahedra of the next one should be.
#
#     ./run mpirun -n 2 python3 demos/adaptive_3d.py --error 0.2

"""Hertz contact in 3D on meshes that follow the estimated error."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import numpy as np
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos import hertz_3d
from demos.adaptive import last_of, solves
from demos.demo_tools import Demo
from demos.hertz import compare
from demos.hertz_3d import HERTZ, R, a
from meshes.half_ball import build

# unknowns of a subdomain
SUBDOMAIN = 4000


def scene(decomposition):
    # ## Elasticity, load and contact
    #
    # As in `hertz_3d.py`. The closed form says which load; here the contact may be anywhere on the
    # ball.
    plane = tfeti.Plane((0, 0, 0), normal=(0, 0, 1))
    return {**hertz_3d.scene(decomposition), "contacts": [tfeti.Obstacle("contact", plane)]}


def steps(goal, options):
    """Solve, estimate, mesh anew, until the error is small enough. Collective."""

    # ## Meshes
    #
    # gmsh makes them on rank 0, a coarse uniform one at first, then from the sizes that the last
    # estimate asks for.
    def mesh(sizes):
        return build(R, fine=0.2 * R, fine_radius=10 * R, sizes=sizes)

    def subdomains(nodes):
        return max(2, round(3 * nodes / SUBDOMAIN))

    return solves(mesh, scene, goal, subdomains, options, MPI.COMM_WORLD)


def run(argv):
    demo = Demo(__doc__, argv, configure)
    goal = demo.arguments.error or (0.6 if demo.arguments.quick else 0.2)
    problem = last_of(steps(goal, {"tfeti_rtol": "auto", **demo.petsc_options}))

    contact = problem.solution.contact(0)
    r = np.hypot(contact.points[:, 0], contact.points[:, 1])
    problem.report.errors.update(compare(MPI.COMM_WORLD, contact, r, HERTZ))
    if demo.arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed, plot_pressure

        folder, solution = demo.folder, problem.solution
        plot_deformed(folder / "adaptive_3d.png", solution, factor=1.0, show_edges=True)
        plot_pressure(
            folder / "adaptive_3d_pressure.png",
            solution,
            lambda points: np.hypot(points[:, 0], points[:, 1]),
            HERTZ.pressure,
            limit=2 * a,
            label="r",
        )
    return demo.finish(problem, "adaptive_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--error", type=float, help="relative discretisation error in energy")


if __name__ == "__main__":
    main(sys.argv[1:])
