# # A ball pressed into a perfectly plastic block
#
# A rigid ball is pressed into a block that does not harden, axisymmetric, in small strain (test
# SSNV506 of Code_Aster). Once all under the ball flows, the mean pressure is that of slip lines,
# and the force grows in proportion to the depth: 2.038e6 N a radian at 20 mm.
#
# Each step has to be short beside the depth, and elements beside the contact: the ring that the
# ball touches anew in a step, or between two nodes, is pressed by less than the rest.
#
#     ./run mpirun -n 2 python3 demos/plastic_indentation_2d.py --plot

"""A rigid ball pressed into a perfectly plastic block, beside the force of slip lines."""

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

R, E, nu, STRENGTH = 500.0, 2.1e5, 0.3, 50.0  # mm, N
WIDTH, HEIGHT, GROWTH = 1920.0, 1620.0, 1.3
SLIP_LINES = 2.038e6 / 20.0  # force a radian over depth


def graded(fine, near, far):
    """Coordinates from 0 to ``far``: of equal cells up to ``near``, from there on growing."""
    x = list(np.linspace(0.0, near, round(near / fine) + 1))
    while x[-1] < far:
        x.append(x[-1] + GROWTH * (x[-1] - x[-2]))
    x = np.array(x)
    beyond = x > near
    x[beyond] = near + (x[beyond] - near) * (far - near) / (x[-1] - near)
    return x


def torn_mesh(fine, near, subdomains, comm=MPI.COMM_WORLD):
    """The block, of rectangles: "axis", "bottom", "top"."""
    r, z = graded(fine, near, WIDTH), -graded(fine, near, HEIGHT)[::-1]
    cells = (len(r) - 1, len(z) - 1)
    mesh = dmesh.create_rectangle(
        comm, [[0.0, 0.0], [1.0, 1.0]], cells, dmesh.CellType.quadrilateral
    )
    places = (("axis", 0, 0.0), ("bottom", 1, 0.0), ("top", 1, 1.0))
    sides = [
        dmesh.locate_entities_boundary(mesh, 1, lambda x, k=k, at=at: np.isclose(x[k], at))
        for _, k, at in places
    ]
    facets = np.concatenate(sides)
    values = np.repeat(np.arange(1, 4, dtype=np.int32), [len(side) for side in sides])
    order = np.argsort(facets)
    tags = dmesh.meshtags(mesh, 1, facets[order], values[order])
    x = mesh.geometry.x
    for k, places_of in enumerate((r, z)):
        x[:, k] = np.interp(x[:, k], np.linspace(0.0, 1.0, len(places_of)), places_of)
    names = {name: tag for tag, (name, _, _) in enumerate(places, 1)}
    return tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names)


def made(decomposition, petsc_options=None):
    """The problem; ``press`` says how deep the ball is."""
    # ## Material
    #
    # Plastic flow keeps the volume, which quadrilaterals of degree 1 can if what resists a change
    # of volume is integrated at their centres, `selective`.
    mesh = decomposition.mesh
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="axisymmetric")
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v, du = fem.Function(V), ufl.TestFunction(V), ufl.TrialFunction(V)
    steel = tfeti.J2Plasticity(elastic, u, yield_stress=STRENGTH, selective=True)
    bcs = [
        fem.dirichletbc(
            0.0, fem.locate_dofs_topological(V.sub(k), 1, decomposition.facets(name)), V.sub(k)
        )
        for name, k in (("axis", 0), ("bottom", 0), ("bottom", 1))
    ]
    # in small strain slopes are small: what counts of the ball is how far it is above
    ball = tfeti.Obstacle("top", tfeti.Plane((0.0, 0.0), normal=(0.0, -1.0)), name="ball")
    return tfeti.NonlinearContactProblem(
        steel.residual(v),
        u,
        bcs,
        [ball],
        decomposition,
        J=steel.tangent(du, v),
        state=steel.state,
        update=steel.update,
        stress=steel.stress,
        thickness=elastic.thickness,
        petsc_options={"tfeti_rtol": 1e-4, **(petsc_options or {})},
    )


def press(problem, depth):
    """Put the ball so deep."""
    problem.update(gap={"ball": lambda x: R - depth - np.sqrt(np.maximum(R**2 - x[0] ** 2, 0.0))})


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    depth = arguments.depth or (2.0 if arguments.quick else 20.0)
    fine, near = (20.0, 80.0) if arguments.quick else (arguments.size, 240.0)
    steps = arguments.steps or (2 if arguments.quick else 10)
    decomposition = torn_mesh(fine, near, 2 if arguments.quick else 4)
    problem = made(decomposition, demo.petsc_options)

    depths = depth * np.arange(1, steps + 1) / steps
    records = tfeti.LoadSteps(problem, press, depths).run()
    d = np.array([record.time for record in records])
    # a ring of 2π, pressed down
    forces = np.array([-record.contact_forces[0][1] for record in records]) / (2 * np.pi)
    problem.report.errors["force"] = float(forces[-1] / (SLIP_LINES * d[-1]) - 1)
    if comm.rank == 0:
        for record, force in zip(records, forces, strict=True):
            print(
                f"depth {record.time:5.2f}: force a radian {force:.4g}, slip lines "
                f"{SLIP_LINES * record.time:.4g}, {record.figures['newton_steps']} tangents, "
                f"{record.figures['F_multiplications']} F",
                flush=True,
            )
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        look = {"zoom": 3.5, "focus": (260.0, -200.0, 0.0), "highest": STRENGTH}
        path = demo.folder / "plastic_indentation_2d.png"
        plot_deformed(path, problem.solution, factor=1.0, **look)
        if comm.rank == 0:
            curves = {"TFETI": (d, forces), "slip lines": (d, SLIP_LINES * d)}
            labels = ("depth in mm", "force in N a radian")
            draw(demo.folder / "plastic_indentation_2d_force.png", [(labels, {}, curves)])
    return demo.finish(problem, "plastic_indentation_2d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--depth", type=float, help="how deep, in mm")
    parser.add_argument("--size", type=float, default=10.0, help="element size under the ball")
    parser.add_argument("--steps", type=int, help="load steps")


if __name__ == "__main__":
    main(sys.argv[1:])
