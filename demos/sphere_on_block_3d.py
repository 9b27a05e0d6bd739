# # A ball on a block
#
# A quarter of an elastic half ball on a quarter of an elastic block, both of tetrahedra that do
# not match. Radius and pressure of the contact are compared with Hertz's closed form.
#
#     ./run mpirun -n 2 python3 demos/sphere_on_block_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A ball on a block: Hertz contact of two elastic bodies in 3D, a quarter."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--unknowns", type=int, help="number of unknowns, about")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--exchange", action="store_true", help="let the ball be the secondary side")
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
unknowns = arguments.unknowns or (8_000 if arguments.quick else 60_000)
subdomains = arguments.subdomains or max(4, round(unknowns / 4000))
scale = (2400 / unknowns) ** (1 / 3)


def side(x, y, z, above):
    """Name of a side, from its centre of mass."""
    if min(abs(x), abs(y)) < 1e-6:
        return "x=0" if abs(x) < 1e-6 else "y=0"
    if above:
        return "load" if abs(z - R) < 1e-6 else "cap"
    return {0.0: "top", -R: "bottom"}.get(round(z, 6), "side")


gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model, field = gmsh.model, gmsh.model.mesh.field
if comm.rank == 0:
    ball = model.occ.addSphere(0, 0, R, R, angle1=-np.pi / 2, angle2=0, angle3=np.pi / 2)
    box = model.occ.addBox(0, 0, -R, R, R, R)
    model.occ.synchronize()
    names = {}
    for volume in (ball, box):
        for _, tag in model.getBoundary([(3, volume)], oriented=False):
            name = side(*model.occ.getCenterOfMass(2, tag), volume == ball)
            names.setdefault(name, []).append(tag)
    model.addPhysicalGroup(3, [ball], name="ball")
    model.addPhysicalGroup(3, [box], name="block")
    for name in ("cap", "load", "top", "bottom", "x=0", "y=0"):
        model.addPhysicalGroup(2, names[name], name=name)
    far, parts = f"(sqrt(x^2+y^2+z^2)-{1.3 * a})", []
    for size, body in ((0.2 * a * scale, ball), (0.26 * a * scale, box)):
        grown, part = field.add("MathEval"), field.add("Restrict")
        field.setString(grown, "F", f"{size}+{0.3 * scale}*0.5*({far}+fabs({far}))")
        field.setNumber(part, "InField", grown)
        field.setNumbers(part, "VolumesList", [body])
        parts.append(part)
    least = field.add("Min")
    field.setNumbers(least, "FieldsList", parts)
    field.setAsBackgroundMesh(least)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
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
# A quarter of the force that belongs to the radius a, and the pressure under it.

# +
load = 4 * E / (1 - nu**2) / 2 * a**3 / (3 * R) / 4
p0 = 3 * 4 * load / (2 * np.pi * a**2)


def hertz(r):
    return p0 * np.sqrt(np.maximum(1 - (r / a) ** 2, 0.0))


# -

# ## Load, conditions, contact
#
# A uniform pressure on the ball's flat top carries the load. The cuts are planes of symmetry;
# contact alone holds the ball in z. The block, whose mesh is the coarser one, is the secondary
# side.

# +
top = ds(decomposition.surface("load"))
area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * top)))
bottom = fem.locate_dofs_topological(V, 2, decomposition.facets("bottom"))
bcs = [fem.dirichletbc(np.zeros(3), bottom, V)]
for axis, cut in enumerate(("x=0", "y=0")):
    dofs = fem.locate_dofs_topological(V.sub(axis), 2, decomposition.facets(cut))
    bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
sides = ("cap", "top") if arguments.exchange else ("top", "cap")
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    -load / area * v[2] * top,
    bcs,
    [tfeti.Contact(*sides, secondary=sides[0], reach=a**2 / R)],
    decomposition,
    stress=elastic.stress,
)
problem.solve()
# -

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
#
# Nodal pressures on tetrahedra scatter about the closed form, in the mean by `pressure_l2`; their
# sum is the load.

if arguments.output:
    tfeti.write_vtx(arguments.output / "sphere_on_block_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    looks = {"view": (-1.0, -1.6, 0.5), "focus": (0.0, 0.0, 0.0), "zoom": 3.0}
    looks |= {"show_edges": False, "highest": 0.008}
    tfeti.plot_deformed(folder / "sphere_on_block_3d.png", problem.solution, factor=1.0, **looks)
    tfeti.plot_pressure(
        folder / "sphere_on_block_3d_pressure.png",
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
