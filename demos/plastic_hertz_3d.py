# # A ball pressed beyond its yield stress
#
# A half ball is pressed on a rigid plane, past the yield stress, and let go. Hertz' closed form
# holds up to the force at which it first yields, F_y = π³R²(1.6 σ_y)³/(6E*²) for ν = 0.3 (Johnson,
# Contact Mechanics, 1985, chapter 6). Unloaded, it keeps a flat imprint and stresses of its own.
#
#     ./run mpirun -n 2 python3 demos/plastic_hertz_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A half ball pressed beyond its yield stress and let go."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--size", type=float, help="element size near the contact")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--degree", type=int, default=2, help="of displacements")
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
R, E, nu, strength, hardening = 1.0, 1.0, 0.3, 0.005, 0.02
modulus = E / (1 - nu**2)
size = arguments.size or (0.12 if arguments.quick else 0.045)
growth = 0.5 if arguments.quick else 0.35

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
    far = f"(sqrt(x^2+y^2+(z)^2)-{0.15})"
    field = model.mesh.field.add("MathEval")
    model.mesh.field.setString(field, "F", f"{size}+{growth}*0.5*({far}+fabs({far}))")
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
subdomains = arguments.subdomains or (2 if arguments.quick else 12)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
# -

# ## Material and contact
#
# Plastic flow keeps the volume. Tetrahedra with displacements of degree 1 are too stiff for that.

V = fem.functionspace(decomposition.mesh, ("Lagrange", arguments.degree, (3,)))
u, v = fem.Function(V), ufl.TestFunction(V)
elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
steel = tfeti.J2Plasticity(elastic, u, yield_stress=strength, hardening=hardening)
down = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
top = fem.locate_dofs_topological(V, 2, decomposition.facets("top"))
problem = tfeti.NonlinearContactProblem(
    steel.residual(v),
    u,
    [fem.dirichletbc(down, top, V)],
    [tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), name="plane")],
    decomposition,
    stress=steel.stress,
    petsc_options={"tfeti_rtol": 1e-5},
)

# ## Loading and unloading
#
# In steps of time, down up to t = 1 and up again; after a third of the way the plane is free.

# +
most, up = 0.01 * R, 2 if arguments.quick else 6
times = np.append(np.arange(1, up + 1) / up, 1 + np.array([0.1, 0.2, 0.3, 1.0]))
depths = most * np.interp(times, [0.0, 1.0, 2.0], [0.0, 1.0, 0.0])


def press(problem, t):
    down.value[2] = -np.interp(t, times, depths)


records = tfeti.LoadSteps(problem, press, times).run()
# -

# ## Imprint, and comparison with Hertz
#
# What the lowest point does not come back is the imprint.

# +
x, moved = V.tabulate_dof_coordinates(), u.x.array.reshape(-1, 3)
lowest = moved[np.linalg.norm(x, axis=1) < 1e-8 * R, 2]
imprint = comm.allreduce(float(lowest.min(initial=np.inf)), op=MPI.MIN)
problem.report.errors["imprint"] = imprint / most
forces = np.array([record.contact_forces[0][2] for record in records])
depths = np.interp([record.time for record in records], times, depths)  # with halved steps
hertz = 4 / 3 * modulus * np.sqrt(R) * depths**1.5
if comm.rank == 0:
    first = np.pi**3 * R**2 * (1.6 * strength) ** 3 / (6 * modulus**2)
    print(f"first yield at a force of {first:.2e}")
    for record, depth, force, closed in zip(records, depths, forces, hertz, strict=True):
        done = record.figures
        print(
            f"d/R = {depth / R:.5f}: force {force:.3e}, elastic {closed:.3e}, "
            f"{done['newton_steps']} tangents, {done['F_multiplications']} iterations"
        )
    print(f"imprint {imprint:.2e}, of a displacement {most:.2e}")
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "plastic_hertz_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    look = {"cut": ((0, 0, 0), (0, -1, 0)), "view": (0.0, -1.0, -0.1)}
    look |= {"zoom": 4.0, "focus": (0.0, 0.0, 0.15), "show_edges": False}
    tfeti.plot_deformed(folder / "plastic_hertz_3d.png", problem.solution, factor=1.0, **look)
    if comm.rank == 0:
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        axes = figure.subplots()
        fine = np.linspace(0.0, most, 101)
        axes.plot([0, *depths], [0, *forces], "o-", label="plastic, J2")
        axes.plot(fine, 4 / 3 * modulus * np.sqrt(R) * fine**1.5, label="elastic, Hertz")
        axes.set(xlabel="displacement / R", ylabel="force / E R²")
        axes.legend()
        figure.savefig(folder / "plastic_hertz_3d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
