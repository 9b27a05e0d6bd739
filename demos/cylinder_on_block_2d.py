# # A cylinder on a block
#
# Two elastic bodies in plane strain, meshed independently: NAFEMS' benchmark CB1, a steel
# cylinder on an aluminium block. Here the load is spread over the flat top of a half cylinder.
#
#     ./run mpirun -n 2 python3 demos/cylinder_on_block_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Hertz contact of two elastic bodies in plane strain, NAFEMS CB1."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=12, help="gmsh partitions")
parser.add_argument("--elements", type=int, help="elements along the half width a")
parser.add_argument("--exchange", action="store_true", help="let the block be the secondary side")
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

# ## Data and closed form
#
# Lengths in mm, stresses in MPa, the load in N per mm.

# +
comm = MPI.COMM_WORLD
R, load, nu = 50.0, 35e3, 0.3
young = {"cylinder": 2.1e5, "block": 7e4}
modulus = 1 / sum((1 - nu**2) / E for E in young.values())
a = np.sqrt(4 * load * R / (np.pi * modulus))
p0 = 2 * load / (np.pi * a)


def hertz(x):
    return p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0.0))


# -

# ## Mesh
#
# Near the contact the block's elements are 1.3 times as large as the cylinder's.


# +
def half_disc(geo):
    """Surfaces, arcs, flat top and axis of the half cylinder."""
    lowest, centre, right, left = (
        geo.addPoint(x, y, 0) for x, y in ((0, 0), (0, R), (R, R), (-R, R))
    )
    axis = geo.addLine(lowest, centre)
    arcs = [geo.addCircleArc(lowest, centre, right), geo.addCircleArc(left, centre, lowest)]
    top = [geo.addLine(right, centre), geo.addLine(centre, left)]
    loops = [[arcs[0], top[0], -axis], [axis, top[1], arcs[1]]]
    return [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops], arcs, top, axis


def block(geo, b=4 * R):
    """Surfaces, top, bottom and axis of the block."""
    left, middle, right = ([geo.addPoint(x, y, 0) for y in (-b, 0)] for x in (-b / 2, 0, b / 2))
    axis = geo.addLine(*middle)
    halves, top, bottom = [], [], []
    for side in (left, right):
        bottom.append(geo.addLine(middle[0], side[0]))
        top.append(geo.addLine(side[1], middle[1]))
        up = geo.addLine(*side)
        halves.append(geo.addPlaneSurface([geo.addCurveLoop([bottom[-1], up, top[-1], -axis])]))
    return halves, top, bottom, axis


fine = a / (arguments.elements or (10 if arguments.quick else 30))
growth = 0.3 if arguments.quick else 0.12
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, field = gmsh.model, gmsh.model.mesh.field
if comm.rank == 0:
    cylinder, arcs, flat, upper_axis = half_disc(model.geo)
    blocks, top, bottom, lower_axis = block(model.geo)
    model.geo.synchronize()
    groups = {"arc": arcs, "load": flat, "top": top, "bottom": bottom}
    groups["axis"] = [upper_axis, lower_axis]
    model.addPhysicalGroup(2, cylinder, name="cylinder")
    model.addPhysicalGroup(2, blocks, name="block")
    for name, curves in groups.items():
        model.addPhysicalGroup(1, curves, name=name)
    far, parts = f"(sqrt(x^2+y^2)-{1.5 * a})", []
    for size, body in ((fine, cylinder), (1.3 * fine, blocks)):
        grown, part = field.add("MathEval"), field.add("Restrict")
        field.setString(grown, "F", f"{size}+{growth}*0.5*({far}+fabs({far}))")
        field.setNumber(part, "InField", grown)
        field.setNumbers(part, "SurfacesList", body)
        parts.append(part)
    least = field.add("Min")
    field.setNumbers(least, "FieldsList", parts)
    field.setAsBackgroundMesh(least)
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
# Young's modulus by the names of the bodies.

elastic = tfeti.Elasticity(decomposition, E=young, nu=nu, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, contact
#
# The axis stays on x = 0 and the block's bottom where it is. Contact alone holds the
# cylinder in y. The surfaces are 1.5 a²/2R apart at x = 1.2 a: farther ones are not looked at.
# Here the cylinder is the secondary side; a warning says that the softer block, whose mesh is
# the coarser one, would be the better one (`--exchange`).

traction = fem.Constant(mesh, (0.0, -load / (2 * R)))
axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))
bottom = fem.locate_dofs_topological(V, 1, decomposition.facets("bottom"))
sides = ("top", "arc") if arguments.exchange else ("arc", "top")
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("load")),
    [fem.dirichletbc(0.0, axis, V.sub(0)), fem.dirichletbc(np.zeros(2), bottom, V)],
    [tfeti.Contact(*sides, secondary=sides[0], reach=0.75 * a**2 / R)],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## Comparison with the closed form
#
# With a/R = 0.12 the bodies are no half planes: a finer mesh of the same bodies is the better
# reference.
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
    tfeti.write_vtx(arguments.output / "cylinder_on_block_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 5.0, "show_edges": True}
    tfeti.plot_deformed(
        folder / "cylinder_on_block_2d.png", problem.solution, unit="MPa", factor=1.0, **zoom
    )
    path = folder / "cylinder_on_block_2d_pressure.png"
    units = {"label": "x [mm]", "unit": "MPa"}
    tfeti.plot_pressure(path, problem.solution, lambda x: x[0], hertz, limit=2 * a, **units)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
