# # A rigid indenter in 3D
#
# A rigid ball is pressed into an elastic body, in load steps: first by its displacement, then by
# the forces that this took. Both give the same curve F(d), and Hertz' closed form has it for a
# half space. The body is half a ball, clamped on its cap, large compared with the contact.
#
#     ./run python3 demos/rigid_indenter_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A rigid ball pressed into an elastic body, by displacement and by force."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--unknowns", type=int, help="number of unknowns, about")
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
#
# The flat side is "top", at z = size; elements are finest where the ball touches it.

# +
comm = MPI.COMM_WORLD
R, E, nu = 1.0, 1.0, 0.3
modulus, deepest = E / (1 - nu**2), 0.01 * R
a = np.sqrt(R * deepest)
size = 40 * a  # of the body
unknowns = arguments.unknowns or (4_000 if arguments.quick else 60_000)
scale = (6000 / unknowns) ** (1 / 3)

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model = gmsh.model
if comm.rank == 0:
    ball = model.occ.addSphere(0, 0, size, size, angle1=-np.pi / 2, angle2=0)
    model.occ.synchronize()
    surfaces = [tag for _, tag in model.getBoundary([(3, ball)], oriented=False)]
    top = max(surfaces, key=lambda tag: model.occ.getCenterOfMass(2, tag)[2])
    model.addPhysicalGroup(3, [ball], name="body")
    model.addPhysicalGroup(2, [tag for tag in surfaces if tag != top], name="contact")
    model.addPhysicalGroup(2, [top], name="top")
    far = f"(sqrt(x^2+y^2+(z-{size})^2)-{1.3 * a})"
    field = model.mesh.field.add("MathEval")
    model.mesh.field.setString(
        field, "F", f"{0.2 * a * scale}+{0.35 * scale}*0.5*({far}+fabs({far}))"
    )
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
subdomains = max(2, round(unknowns / 4000))
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
# -

# ## Elasticity
#
# The indenter stands where an obstacle has its shape.

# +
elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
cap = fem.locate_dofs_topological(V, 2, decomposition.facets("contact"))
ball = tfeti.Sphere((0, 0, size + R), R)
steps = 4 if arguments.quick else 10
times = np.linspace(0, 1, steps + 1)[1:]


def pressed(tool):
    """Solve the load steps; the problem and its records."""
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.ZeroBaseForm((v,)),
        [fem.dirichletbc(np.zeros(3), cap, V)],
        [tfeti.Obstacle("top", tool, reach=deepest)],
        decomposition,
        stress=elastic.stress,
    )
    return problem, tfeti.LoadSteps(problem, lambda problem, t: None, times).run()


# -

# ## By displacement
#
# A law is a function of the time of the load steps.

tool = tfeti.RigidBody(ball, displacement=lambda t: (0, 0, -t * deepest), name="indenter")
problem, records = pressed(tool)
d = np.array([-record.tools["indenter displacement z"] for record in records])
force = np.array([record.tools["indenter force z"] for record in records])

# ## By force
#
# The ball is free along z. Forces of a step are those of the curve.

law = lambda t: (0, 0, -np.interp(t, times, force))  # noqa: E731
tool = tfeti.RigidBody(ball, force=law, free=("z",), name="indenter")
by_force, loaded = pressed(tool)
by_force.destroy()
way = np.array([-record.tools["indenter displacement z"] for record in loaded])

# ## Comparison with the closed form
#
# F = 4/3 E* √(R d³) at each depth; a and p₀ are those that belong to the force that was found.

# +
load = force[-1]
a = (3 * load * R / (4 * modulus)) ** (1 / 3)
p0 = 3 * load / (2 * np.pi * a**2)


def hertz(r):
    return p0 * np.sqrt(np.maximum(1 - (r / a) ** 2, 0.0))


half_space = 4 / 3 * modulus * np.sqrt(R) * d**1.5
if comm.rank == 0:
    print("d / R, F by displacement, d / R by the force, F of a half space (Hertz)")
    for row in zip(d, force, way, half_space, strict=True):
        print("  {:.4f}  {:.6f}  {:.4f}  {:.6f}".format(*row))
    counts = [sum(r.figures["F_multiplications"] for r in run) for run in (records, loaded)]
    print(f"iterations: {counts[0]} by displacement, {counts[1]} by force")
# -

# The squared pressures lie on a line, p² = p₀² − (p₀/a)² r², which is fitted where p > 0.3 p₀: the
# outermost touching node would give a only up to the element size.

# +
contact = problem.solution.contact()
r = np.hypot(contact.points[:, 0], contact.points[:, 1])
r, p, area = (np.concatenate(comm.allgather(part)) for part in (r, contact.pressure, contact.area))
slope, constant = np.polyfit(r[p > 0.3 * p0] ** 2, p[p > 0.3 * p0] ** 2, 1)
area *= np.abs(r) < 0.9 * a  # the edge apart
errors = problem.report.errors
errors["half_width"] = float(np.sqrt(-constant / slope) / a - 1)
errors["peak_pressure"] = float(np.sqrt(constant) / p0 - 1)
errors["force"] = float(abs(contact.resultant.force[-1]) / load - 1)
errors["pressure_l2"] = float(np.sqrt(area @ (p - hertz(r)) ** 2 / (area @ hertz(r) ** 2)))
errors["force"] = float(load / half_space[-1] - 1)  # at this depth
errors["depth_by_force"] = float(np.abs(way / d - 1).max())
# -

# ## Output
#
# Nodal pressures on tetrahedra scatter about the closed form, in the mean by `pressure_l2`; their
# sum is the load.

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "rigid_indenter_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    looks = {"view": (-1.0, -1.6, 0.8), "focus": (0.0, 0.0, size), "zoom": 9.0}
    path = folder / "rigid_indenter_3d.png"
    tfeti.plot_deformed(path, problem.solution, show="pressure", show_edges=False, **looks)
    tfeti.plot_pressure(
        folder / "rigid_indenter_3d_pressure.png",
        problem.solution,
        lambda x: np.hypot(x[0], x[1]),
        hertz,
        limit=2 * a,
        label="r",
    )
    if comm.rank == 0:
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        axes = figure.subplots()
        x = np.linspace(0, deepest, 100)
        axes.plot(x, 4 / 3 * modulus * np.sqrt(R) * x**1.5, "k-", label="Hertz, half space")
        axes.plot(d, force, "o", markersize=9, fillstyle="none", label="pressed by displacement")
        axes.plot(way, force, "x", label="pressed by force")
        axes.set(xlabel="depth d / R", ylabel="force F / (E R²)")
        axes.legend()
        figure.savefig(folder / "rigid_indenter_3d_curve.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
