# # A half ball of rubber pressed flat
#
# A half ball of neo-Hooke is pressed on a rigid plane by 40 % of its radius: finite strain, and
# contact where the ball is. At first the force is that of Hertz, F = 4/3 E* √(R d³); then the
# contact is no longer small compared with the ball, and the ball is stiffer.
#
#     ./run mpirun -n 2 python3 demos/rubber_pressed_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="Half a ball of rubber pressed by 40 % of its radius.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--size", type=float, help="element size near the contact")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--steps", type=int, help="load steps")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Mesh

# +
comm = MPI.COMM_WORLD
R, E, nu = 1.0, 1.0, 0.3
size = arguments.size or (0.25 if arguments.quick else 0.1)

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model = gmsh.model
if comm.rank == 0:
    ball = model.occ.addSphere(0, 0, R, R, angle1=-np.pi / 2, angle2=0)
    model.occ.synchronize()
    surfaces = [tag for _, tag in model.getBoundary([(3, ball)], oriented=False)]
    top = max(surfaces, key=lambda tag: model.occ.getCenterOfMass(2, tag)[2])
    model.addPhysicalGroup(3, [ball], name="body")
    model.addPhysicalGroup(2, [tag for tag in surfaces if tag != top], name="contact")
    model.addPhysicalGroup(2, [top], name="top")
    far = f"(sqrt(x^2+y^2+(z)^2)-{0.5})"
    field = model.mesh.field.add("MathEval")
    model.mesh.field.setString(field, "F", f"{size}+{0.1}*0.5*({far}+fabs({far}))")
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
subdomains = arguments.subdomains or (2 if arguments.quick else 16)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
# -

# ## Material
#
# `residual` is the derivative of the energy, with a tangent that stays definite.

V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
u, v = fem.Function(V), ufl.TestFunction(V)
rubber = tfeti.NeoHooke(tfeti.Elasticity(decomposition, E=E, nu=nu), u)

# ## Contact
#
# The upper side goes down and is held across. In finite strain the gap is measured from
# where the ball is, in each Newton step.

# +
down = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
top = fem.locate_dofs_topological(V, 2, decomposition.facets("top"))
problem = tfeti.NonlinearContactProblem(
    rubber.residual(v),
    u,
    [fem.dirichletbc(down, top, V)],
    [tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), name="plane")],
    decomposition,
    finite=True,
    stress=rubber.stress,
    petsc_options={"tfeti_rtol": 1e-5},
)


def press(problem, d):
    down.value[2] = -d


steps = arguments.steps or (2 if arguments.quick else 8)
depths = 0.4 * R * np.arange(1, steps + 1) / steps
folder, records, pictures = arguments.output or Path("results"), [], []
for before, depth in zip([0.0, *depths], depths, strict=False):
    records += tfeti.LoadSteps(problem, press, [depth], begin=before).run()
    if arguments.plot:
        pictures.append(folder / f"rubber_pressed_3d_{len(pictures)}.png")
        looks = {"factor": 1.0, "view": (0.3, -1.0, -0.4), "highest": 0.4}
        tfeti.plot_deformed(pictures[-1], problem.solution, **looks)
# -

# ## Comparison with Hertz

# +
forces = np.array([record.contact_forces[0][2] for record in records])
depths = np.array([record.time for record in records])  # with those of halved steps
hertz = 4 / 3 * E / (1 - nu**2) * np.sqrt(R) * depths**1.5
problem.report.errors["force_of_the_first_step"] = float(forces[0] / hertz[0] - 1)
if comm.rank == 0:
    for record, force, closed in zip(records, forces, hertz, strict=True):
        done = record.figures
        print(
            f"d/R = {record.time / R:.3f}: force {force:.4f}, Hertz {closed:.4f}, "
            f"{done['assemblies']} tangents, {done['F_multiplications']} iterations"
        )
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "rubber_pressed_3d.bp", problem.solution)
if arguments.plot and comm.rank == 0:
    from matplotlib.figure import Figure
    from PIL import Image

    frames = [Image.open(path).resize((600, 450)) for path in pictures]
    path, more = folder / "rubber_pressed_3d.gif", frames[1:]
    frames[0].save(path, save_all=True, append_images=more, duration=250, loop=0)
    pictures[-1].replace(folder / "rubber_pressed_3d.png")
    for path in pictures[:-1]:
        path.unlink()

    figure = Figure(layout="constrained")
    axes = figure.subplots()
    axes.plot([0, *depths], [0, *forces], "o-", label="neo-Hooke")
    axes.plot([0, *depths], [0, *hertz], label="Hertz")
    axes.set(xlabel="displacement / R", ylabel="force / E R²")
    axes.legend()
    figure.savefig(folder / "rubber_pressed_3d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
