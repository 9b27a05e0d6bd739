# # Hertz contact in 2D
#
# An elastic half cylinder in plane strain is pressed on a rigid plane. The pressure and the
# half width of the contact zone are compared with Hertz's closed form.
#
#     ./run mpirun -n 2 python3 demos/hertz_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="An elastic half cylinder on a rigid plane: Hertz contact in 2D."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=8, help="gmsh partitions")
parser.add_argument("--elements", type=int, help="elements along the half width a")
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
# gmsh meshes on rank 0 and partitions; its partitions become the subdomains. Elements are finest
# where the cylinder touches the plane.

# +
comm = MPI.COMM_WORLD
R, E, nu = 1.0, 1.0, 0.3
a = 0.04 * R  # half width of the contact
fine = a / (arguments.elements or (10 if arguments.quick else 30))
growth = 0.3 if arguments.quick else 0.12

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model = gmsh.model
if comm.rank == 0:
    geo = model.geo
    lowest, centre = geo.addPoint(0, 0, 0), geo.addPoint(0, R, 0)
    right, left = geo.addPoint(R, R, 0), geo.addPoint(-R, R, 0)
    axis = geo.addLine(lowest, centre)
    arcs = [geo.addCircleArc(lowest, centre, right), geo.addCircleArc(left, centre, lowest)]
    top = [geo.addLine(right, centre), geo.addLine(centre, left)]
    halves = [
        geo.addPlaneSurface([geo.addCurveLoop([arcs[0], top[0], -axis])]),
        geo.addPlaneSurface([geo.addCurveLoop([axis, top[1], arcs[1]])]),
    ]
    geo.synchronize()
    model.addPhysicalGroup(2, halves, name="body")
    for name, curves in (("contact", arcs), ("top", top), ("axis", [axis])):
        model.addPhysicalGroup(1, curves, name=name)
    far = f"(sqrt(x^2+y^2)-{1.5 * a})"
    size = model.mesh.field.add("MathEval")
    model.mesh.field.setString(size, "F", f"{fine}+{growth}*0.5*({far}+fabs({far}))")
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(2)
    model.mesh.partition(arguments.subdomains)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity in plane strain
#
# Its stress is a 3×3 tensor, so that σ_zz is in von Mises' stress.

elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Closed form
#
# The force P' per length that belongs to the half width a, and the pressure under it.

# +
load = np.pi * E / (1 - nu**2) * a**2 / (4 * R)
p0 = 2 * load / (np.pi * a)


def hertz(x):
    return p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0.0))


# -

# ## Load and conditions
#
# A uniform pressure on the top carries the load. The axis stays on x = 0; the plane alone holds the
# body in y.

traction = fem.Constant(mesh, (0.0, -load / (2 * R)))
axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("top")),
    [fem.dirichletbc(0.0, axis, V.sub(0))],
    [tfeti.Obstacle("contact", tfeti.Plane((0, 0), normal=(0, 1)), reach=2 * a**2 / R)],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## Comparison with the closed form
#
# The squared pressures lie on a line, p² = p₀² − (p₀/a)² x², which is fitted where p > 0.3 p₀: the
# outermost touching node would give a only up to the element size.

# +
contact = problem.solution.contact()
x = contact.points[:, 0]
x, p, area = (np.concatenate(comm.allgather(part)) for part in (x, contact.pressure, contact.area))
slope, constant = np.polyfit(x[p > 0.3 * p0] ** 2, p[p > 0.3 * p0] ** 2, 1)
area *= np.abs(x) < 0.9 * a  # the edge apart
errors = problem.report.errors
errors["half_width"] = float(np.sqrt(-constant / slope) / a - 1)
errors["peak_pressure"] = float(np.sqrt(constant) / p0 - 1)
errors["force"] = float(abs(contact.resultant.force[-1]) / load - 1)
errors["pressure_l2"] = float(np.sqrt(area @ (p - hertz(x)) ** 2 / (area @ hertz(x) ** 2)))
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "hertz_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    tfeti.plot_deformed(folder / "hertz_2d.png", problem.solution, factor=1.0)
    zoom = {"focus": (0.0, 1.5 * a, 0.0), "zoom": 0.3 * R / a, "show_edges": False}
    tfeti.plot_deformed(folder / "hertz_2d_contact.png", problem.solution, factor=1.0, **zoom)
    tfeti.plot_pressure(
        folder / "hertz_2d_pressure.png", problem.solution, lambda x: x[0], hertz, limit=2 * a
    )
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
