# # Hertz contact in 3D
#
# An elastic half ball is pressed on a rigid plane. Nothing but the plane holds it: it could
# still slide and turn on the plane without resistance, motions that the load does not drive.
# They are found and reported as free motions.
#
#     ./run mpirun -n 2 python3 demos/hertz_3d.py --unknowns 60000 --subdomains 16

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="An elastic half ball on a rigid plane: Hertz contact in 3D."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--unknowns", type=int, help="number of unknowns, about")
parser.add_argument("--subdomains", type=int, help="their number")
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
# gmsh meshes on rank 0, `read_gmsh` makes subdomains. All element sizes are scaled by
# one factor to come near the number of unknowns that is asked for.

# +
comm = MPI.COMM_WORLD
R, E, nu = 1.0, 1.0, 0.3
a = 0.05 * R  # radius of the contact
unknowns = arguments.unknowns or (6_000 if arguments.quick else 60_000)
scale = (4500 / unknowns) ** (1 / 3)

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
    far = f"(sqrt(x^2+y^2+z^2)-{1.3 * a})"
    size = model.mesh.field.add("MathEval")
    sizes = f"{0.2 * a * scale}+{0.3 * scale}*0.5*({far}+fabs({far}))"
    model.mesh.field.setString(size, "F", sizes)
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
subdomains = arguments.subdomains or max(2, round(unknowns / 4000))
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Closed form
#
# The force F that belongs to the radius a, and the pressure under it.

# +
load = 4 * E / (1 - nu**2) * a**3 / (3 * R)
p0 = 3 * load / (2 * np.pi * a**2)


def hertz(r):
    return p0 * np.sqrt(np.maximum(1 - (r / a) ** 2, 0.0))


# -

# ## Load and contact
#
# A uniform pressure on the top carries F. The top is a polygon: its own area makes the total force
# exact.

top = ds(decomposition.surface("top"))
area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * top)))
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    -load / area * v[2] * top,
    [],
    [tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), reach=2 * a**2 / R)],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## Comparison with the closed form
#
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
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "hertz_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    looks = {"view": (0.3, -1.0, -0.8), "focus": (0.0, 0.0, 0.0), "zoom": 6.0}
    looks |= {"show": "pressure", "show_edges": True}
    tfeti.plot_deformed(folder / "hertz_3d.png", problem.solution, **looks)
    tfeti.plot_pressure(
        folder / "hertz_3d_pressure.png",
        problem.solution,
        lambda x: np.hypot(x[0], x[1]),
        hertz,
        limit=2 * a,
        label="r",
    )
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
