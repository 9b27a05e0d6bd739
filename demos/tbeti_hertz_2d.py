# # Hertz contact of boundary elements in 2D
#
# A half cylinder on a block in plane strain, both with boundary elements, one subdomain each:
# only their surfaces have unknowns. Or one of them has finite elements: `--finite block`.
#
#     ./run mpirun -n 2 python3 demos/tbeti_hertz_2d.py --plot
#     ./run mpirun -n 2 python3 demos/tbeti_hertz_2d.py --finite block

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Hertz contact in 2D of two bodies with boundary elements."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--elements", type=int, help="elements along the half width a")
parser.add_argument(
    "--finite",
    nargs="+",
    choices=("cylinder", "block"),
    default=[],
    help="bodies of finite elements",
)
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

# +
comm = MPI.COMM_WORLD
R, a, nu = 1.0, 0.03, 0.3
young = {"cylinder": 1.0, "block": 0.5}
modulus = 1 / sum((1 - nu**2) / E for E in young.values())
load = np.pi * modulus * a**2 / (4 * R)
p0 = 2 * load / (np.pi * a)


def hertz(x):
    return p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0.0))


# -

# ## Mesh
#
# Each body is a subdomain. Boundary elements use nothing but the edges of its mesh.


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


fine = a / (arguments.elements or (8 if arguments.quick else 20))
growth = 0.3 if arguments.quick else 0.15
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
    for size, body in ((fine, cylinder), (1.1 * fine, blocks)):
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
decomposition = tfeti.read_gmsh(
    model if comm.rank == 0 else None, comm, subdomains=lambda x: (x[1] < 0).astype(int)
)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity
#
# The forms are those of all bodies; boundary elements read their moduli from them.

elastic = tfeti.Elasticity(decomposition, E=young, nu=nu, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, contact
#
# Inside boundary elements nothing can be prescribed: two nodes of the cylinder's axis, on
# its surface, stay on x = 0. By symmetry no force acts there.

traction = fem.Constant(mesh, (0.0, -load / (2 * R)))
surface = np.sort(np.concatenate([decomposition.facets(name) for name in ("arc", "load")]))
held = fem.locate_dofs_topological(V.sub(0), 1, surface)
held = held[np.abs(V.tabulate_dof_coordinates()[held // 2, 0]) < 1e-9 * R]
bottom = fem.locate_dofs_topological(V, 1, decomposition.facets("bottom"))
names = [name for name in young if name not in arguments.finite]
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("load")),
    [fem.dirichletbc(0.0, held, V.sub(0)), fem.dirichletbc(np.zeros(2), bottom, V)],
    [tfeti.Contact("arc", "top", reach=a**2 / R)],
    decomposition,
    stress=elastic.stress,
    boundary_elements=tfeti.BoundaryElements(*names) if names else None,
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

# on the axis of the block, a depth of z below the contact, σ_y = −p₀ / √(1 + z²/a²)
depth = a * np.array([0.5, 1.0, 2.0])
found = problem.solution.at(np.stack((0 * depth, -depth), axis=1)).stress[:, 1, 1]
below = found * np.sqrt(1 + (depth / a) ** 2) / -p0
errors["stress_below"] = float(np.abs(below - 1).max())
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "tbeti_hertz_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 25.0, "show_edges": False}
    tfeti.plot_deformed(folder / "tbeti_hertz_2d.png", problem.solution, factor=1.0, **zoom)
    path = folder / "tbeti_hertz_2d_pressure.png"
    tfeti.plot_pressure(path, problem.solution, lambda x: x[0], hertz, limit=2 * a)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
