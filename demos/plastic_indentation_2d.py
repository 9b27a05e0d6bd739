# # A ball pressed into a perfectly plastic block
#
# A rigid ball is pressed into a block that does not harden, axisymmetric, in small strain (test
# SSNV506 of Code_Aster). Once all under the ball flows, the mean pressure is that of slip lines,
# and the force grows in proportion to the depth: 2.038e6 N a radian at 20 mm.
#
# Each step has to be short compared with the depth, and elements compared with the contact: the
# ring that the ball touches anew in a step, or between two nodes, is pressed by less than the
# rest.
#
#     ./run mpirun -n 2 python3 demos/plastic_indentation_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A rigid ball pressed into a perfectly plastic block.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--depth", type=float, help="how deep, in mm")
parser.add_argument("--size", type=float, help="element size under the ball, in mm")
parser.add_argument("--near", type=float, default=240.0, help="half width of the fine zone, in mm")
parser.add_argument("--steps", type=int, help="load steps")
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
# Rectangles, of equal size near the ball and growing away from it. Lengths are in mm, forces in N.

# +
comm = MPI.COMM_WORLD
R, E, nu, strength = 500.0, 2.1e5, 0.3, 50.0
fine = 20.0 if arguments.quick else arguments.size or 10.0
near = 80.0 if arguments.quick else arguments.near


def graded(far):
    """Coordinates from 0 to ``far``: of equal cells up to ``near``, from there on growing."""
    x = list(np.linspace(0.0, near, round(near / fine) + 1))
    while x[-1] < far:
        x.append(x[-1] + 1.3 * (x[-1] - x[-2]))
    x = np.array(x)
    return np.where(x > near, near + (x - near) * (far - near) / (x[-1] - near), x)


r, z = graded(1920.0), -graded(1620.0)[::-1]
cells = (len(r) - 1, len(z) - 1)
block = dmesh.create_rectangle(comm, [(0, 0), (1, 1)], cells, dmesh.CellType.quadrilateral)
for k, places in enumerate((r, z)):
    x = block.geometry.x
    x[:, k] = np.interp(x[:, k], np.linspace(0.0, 1.0, len(places)), places)
surfaces = {
    "axis": lambda x: np.isclose(x[0], 0),
    "bottom": lambda x: np.isclose(x[1], z[0]),
    "top": lambda x: np.isclose(x[1], 0),
}
decomposition = tfeti.decompose(block, 2 if arguments.quick else 4, surfaces=surfaces)
# -

# ## Material and contact
#
# Plastic flow keeps the volume, which quadrilaterals of degree 1 can if what resists a change of
# volume is integrated at their centres, `selective`. Axisymmetric: x is the radius. In small
# strain slopes are small: what counts of the ball is how far it is above the block. Forces are
# those of the whole ring.

# +
elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="axisymmetric")
V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
steel = tfeti.J2Plasticity(elastic, u, yield_stress=strength, selective=True)
bcs = []
for name, k in (("axis", 0), ("bottom", 0), ("bottom", 1)):
    held = fem.locate_dofs_topological(V.sub(k), 1, decomposition.facets(name))
    bcs.append(fem.dirichletbc(0.0, held, V.sub(k)))
ball = tfeti.SignedDistance(
    lambda x: R - np.sqrt(np.maximum(R**2 - x[0] ** 2, 0.0)) - x[1],
    lambda x: np.stack([np.zeros_like(x[0]), -np.ones_like(x[0])]),
)
problem = tfeti.NonlinearContactProblem(
    steel.residual(v),
    u,
    bcs,
    [tfeti.Obstacle("top", ball, displacement=lambda depth: (0.0, -depth), name="ball")],
    decomposition,
    stress=steel.stress,
    thickness=elastic.thickness,
    petsc_options={"tfeti_rtol": 1e-4},
)


steps = arguments.steps or (2 if arguments.quick else 10)
depths = (arguments.depth or (2.0 if arguments.quick else 20.0)) * np.arange(1, steps + 1) / steps
records = tfeti.LoadSteps(problem, lambda problem, depth: None, depths).run()
# -

# ## Comparison with slip lines

# +
forces = np.array([-record.contact_forces[0][1] for record in records]) / (2 * np.pi)
depths = np.array([record.time for record in records])  # with those of halved steps
slip_lines = 2.038e6 / 20.0 * depths  # a radian
problem.report.errors["force"] = float(forces[-1] / slip_lines[-1] - 1)
if comm.rank == 0:
    for record, force, closed in zip(records, forces, slip_lines, strict=True):
        done = record.figures
        print(
            f"depth {record.time:5.2f}: force a radian {force:.4g}, slip lines {closed:.4g}, "
            f"{done['newton_steps']} tangents, {done['F_multiplications']} iterations"
        )
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "plastic_indentation_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    look = {"zoom": 4.5, "focus": (300.0, -190.0, 0.0), "highest": strength}
    tfeti.plot_deformed(
        folder / "plastic_indentation_2d.png", problem.solution, unit="MPa", factor=1.0, **look
    )
    if comm.rank == 0:
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        axes = figure.subplots()
        axes.plot(depths, np.array(forces) / 1e6, "o-", label="finite elements")
        axes.plot(depths, np.array(slip_lines) / 1e6, label="slip lines")
        axes.set(xlabel="depth in mm", ylabel="force in MN a radian")
        axes.legend()
        figure.savefig(folder / "plastic_indentation_2d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
