# # A belt on a drum
#
# An elastic belt lies on a drum over an angle θ. A weight pulls at one end, the other one is held.
# When the weight is hung on, all of the belt slips towards it; when the drum then turns the other
# way, all of it slips back. With Coulomb's friction the forces at the ends are related by the
# capstan equation (Euler, Eytelwein): first T₂ = T₁ exp(−μθ), then T₂ = T₁ exp(μθ).
#
#     ./run mpirun -n 2 python3 demos/belt_2d.py --plot

"""A belt that slips on a drum: Coulomb's friction and the capstan equation."""

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
from meshes.belt import BeltDrive, build

YOUNG = {"belt": 5000.0, "drum": 2.1e5}
PULL = 5.0


def subdomains_of(drive, count):
    """From midpoints of cells to subdomains: so many of the belt, half as many of the drum.

    They are sectors. Long thin ones would bend easily, which the solver does not like.
    """
    leg = np.arctan2(drive.leg, drive.radius)

    def subdomain(x):
        radius, angle = np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])
        angle = np.where(angle < -0.5 * np.pi, angle + 2.0 * np.pi, angle)
        along = (angle + leg) / (drive.angle + 2.0 * leg)
        around, sectors = (angle + 0.5 * np.pi) / (2.0 * np.pi), (count + 1) // 2
        belt = np.clip((along * count).astype(int), 0, count - 1)
        drum = count + np.clip((around * sectors).astype(int), 0, sectors - 1)
        return np.where(radius > drive.radius, belt, drum)

    return subdomain


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD

    # ## Mesh
    #
    # Lengths are in mm, forces in N for each mm of width. Belt and drum have meshes that do not
    # match.
    drive, mu = BeltDrive(angle=np.radians(arguments.angle)), arguments.friction
    cells = arguments.cells or (40 if arguments.quick else 80)
    model = build(drive, cells) if comm.rank == 0 else None
    count = arguments.subdomains or (16 if arguments.quick else 32)
    decomposition = tfeti.read_gmsh(model, comm, subdomains_of(drive, count))
    mesh = decomposition.mesh

    # ## Elasticity
    elastic = tfeti.Elasticity(decomposition, E=YOUNG, nu=0.3, model="plane_stress")

    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

    # ## Load, conditions, contact
    #
    # The left end is pulled; the right one is held along the belt, and free across it. The gap is
    # given as 0: that between two polygons would not be.
    rotation = fem.Function(V)
    hub = fem.locate_dofs_topological(V, 1, decomposition.facets("hub"))
    end = fem.locate_dofs_topological(V.sub(1), 1, decomposition.facets("right end"))
    pull = fem.Constant(mesh, PULL / drive.thickness * np.array(drive.pull))
    belt = tfeti.Contact(
        "inside", "rim", secondary="inside", gap=0.0, friction=tfeti.Coulomb(mu), name="belt"
    )
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(pull, v) * ds(decomposition.surface("left end")),
        [fem.dirichletbc(rotation, hub), fem.dirichletbc(0.0, end, V.sub(1))],
        [belt],
        decomposition,
        stress=elastic.stress,
        petsc_options=demo.petsc_options,
    )

    # ## Two load steps
    #
    # The drum turns, to the left on top, by half as much again as the belt stretches, so that all
    # of it slips. That is by less than a hundredth of its radius, which linear kinematics bears.
    # The force that holds the right end is the work of the stress on a displacement that is 1
    # there and 0 at all other nodes.
    unit = fem.Function(V)
    unit.x.array[end] = -1.0

    def solved():
        force = fem.form(elastic.a(problem.solve(), unit))
        return comm.allreduce(fem.assemble_scalar(force)) / PULL

    hung = solved()
    problem.accept()
    exponent = exponent_of(drive, mu)
    turn = 1.5 * stretch(drive, exponent) / drive.radius
    rotation.interpolate(lambda x: turn * np.stack((-x[1], x[0])))
    turned = solved()

    # ## Comparison with the capstan equation
    #
    # `capstan` and `capstan_hung` allow for the belt's thickness, `capstan_thin` does not.
    problem.report.errors.update(
        capstan=turned / np.exp(exponent) - 1,
        capstan_hung=hung / np.exp(-exponent) - 1,
        capstan_thin=turned / np.exp(mu * drive.angle) - 1,
    )
    if arguments.plot:
        plots(demo.folder, problem.solution, drive, exponent)
    return demo.finish(problem, "belt_2d")


def exponent_of(drive, mu):
    """Logarithm of T₂/T₁.

    The tension acts in the middle of the belt and friction on its inside, so the moments about
    the axis give (R + t/2) dT = μ R T dθ.
    """
    return mu * drive.angle * drive.radius / (drive.radius + 0.5 * drive.thickness)


def stretch(drive, exponent):
    """How much longer the belt becomes when all of it slips on the turning drum."""
    arc = drive.angle * (drive.radius + 0.5 * drive.thickness)
    largest = np.exp(exponent)
    forces = largest * drive.leg + (largest - 1.0) / exponent * arc
    return PULL * forces / (YOUNG["belt"] * drive.thickness)


def plots(folder, solution, drive, exponent):
    """Pictures of the belt, and of its pressure over the angle with the closed form."""
    from tfeti_dolfinx.plot import plot_deformed, plot_pressure

    plot_deformed(folder / "belt_2d.png", solution, factor=10.0, show_edges=False)
    plot_pressure(
        folder / "belt_2d_pressure.png",
        solution,
        lambda x: np.degrees(np.arctan2(x[:, 1], x[:, 0]) + 0.5 * np.pi) % 360.0 - 90.0,
        lambda angle: (
            PULL / drive.radius * np.exp(exponent * (1.0 - np.radians(angle) / drive.angle))
        ),
        label="angle from the held side, degrees",
    )


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--angle", type=float, default=180.0, help="on the drum, in degrees")
    parser.add_argument("--friction", type=float, default=0.3, help="its coefficient")
    parser.add_argument("--subdomains", type=int, help="of the belt; the drum has half as many")
    parser.add_argument("--cells", type=int, help="quadrilaterals along the belt on the drum")


if __name__ == "__main__":
    main(sys.argv[1:])
