# # A ball bearing
#
# A deep groove ball bearing under a radial load, near to type 6205: two rings and the balls
# between them, all elastic, and two contacts for each ball, one with each ring. Nothing but
# contact carries the load from the inner ring through the balls to the outer ring.
#
#     ./run mpirun -n 2 python3 demos/ball_bearing_3d.py --plot

# +
import argparse
import sys
from math import cos, pi, sin
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A ball bearing: elastic rings and balls, in contact with each other."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument(
    "--balls", type=int, default=8, choices=range(3, 15), metavar="N", help="their number, 3 to 14"
)
parser.add_argument("--unknowns", type=int, help="number of unknowns, about")
parser.add_argument("--subdomains", type=int, help="gmsh partitions")
parser.add_argument("--large", action="store_true", help="700 subdomains, 1.7 M unknowns")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import compute_midpoints
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Mesh
#
# The bearing's axis is y, and load and bearing are symmetric about its mid plane y = 0, so
# half of it is enough. gmsh meshes on rank 0 and partitions with METIS; the partitions become
# the subdomains, and those that hold parts of several bodies are split. All element sizes are
# scaled by one factor to come near the number of unknowns that is asked for. Lengths are in
# mm, forces in N.

# +
comm = MPI.COMM_WORLD
count, ball, pitch, bore, outside, half = arguments.balls, 4.0, 19.5, 12.5, 26.0, 7.5
groove = 1.06 * ball  # radius of the grooves' section
clearance, shoulder = 0.004, 1.6
angles = 2.0 * pi * np.arange(count) / count - 0.5 * pi  # the first ball is the lowest
names = [f"ball {i + 1}" for i in range(count)]

default = 8_000 if arguments.quick else 1_310_000 if arguments.large else 80_000
unknowns = arguments.unknowns or default
scale = (44_400 / unknowns) ** 0.375
subdomains = 700 if arguments.large else max(8, round(unknowns / 2000))

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model, occ = gmsh.model, gmsh.model.occ


def half_ring(low, high, centre):
    """A half ring between two radii with a groove whose section is centred at a radius."""
    whole, hole = (occ.addCylinder(0, 0, 0, 0, -half, 0, radius) for radius in (high, low))
    torus = occ.addTorus(0, 0, 0, centre, groove, zAxis=(0, 1, 0))
    ring, _ = occ.cut([(3, whole)], [(3, hole), (3, torus)])
    return ring[0][1]


def half_ball(angle):
    """A half ball, y ≤ 0, its pole in the direction of the bearing's axis."""
    tag = occ.addSphere(0, 0, 0, ball, angle1=0, angle2=0.5 * pi)
    occ.rotate([(3, tag)], 0, 0, 0, 1, 0, 0, 0.5 * pi)
    occ.translate([(3, tag)], pitch * cos(angle), 0, pitch * sin(angle))
    return tag


def sides(volume, kind):
    """Surfaces of a volume that gmsh calls so, in the order of their radii."""
    found = [tag for _, tag in model.getBoundary([(3, volume)], oriented=False)]
    found = [tag for tag in found if model.getType(2, tag) == kind]
    return sorted(found, key=lambda tag: model.getBoundingBox(2, tag)[3])


if comm.rank == 0:
    bottom, top = pitch - ball - clearance, pitch + ball + clearance
    inner = half_ring(bore, bottom + shoulder, bottom + groove)
    outer = half_ring(top - shoulder, outside, top - groove)
    balls = [half_ball(angle) for angle in angles]
    occ.synchronize()
    bodies = {"inner ring": inner, "outer ring": outer, **dict(zip(names, balls, strict=True))}
    for name, volume in bodies.items():
        model.addPhysicalGroup(3, [volume], name=name)
    surfaces = {"inner groove": sides(inner, "Torus"), "bore": sides(inner, "Cylinder")[:1]}
    surfaces |= {"outer groove": sides(outer, "Torus"), "outside": sides(outer, "Cylinder")[-1:]}
    surfaces |= {name: sides(bodies[name], "Sphere") for name in names}
    plane = [tag for volume in bodies.values() for tag in sides(volume, "Plane")]
    plane = [tag for tag in plane if abs(occ.getCenterOfMass(2, tag)[1]) < 1e-6]
    for name, tags in {**surfaces, "mid plane": plane}.items():
        model.addPhysicalGroup(2, tags, name=name)
    # r from the axis, s the arc to the nearest ball's middle: contacts are on that ball at small s,
    # and long in y
    r = "sqrt(x^2+z^2+1e-12)"
    s = f"{r}*acos(0.999999999*cos({count}*acos(-0.999999999*z/{r})))/{count}"
    sphere = f"(sqrt(({s})^2+({r}-{pitch})^2+y^2)-{ball})"
    far = f"max(0,sqrt({sphere}^2+({s})^2+(y/4)^2)-{0.1 * ball})"
    grown = f"{0.14 * scale}*(1.5+0.5*z/{r})+{0.35 * scale}*{far}"
    size = model.mesh.field.add("MathEval")
    model.mesh.field.setString(size, "F", f"min({2.0 * scale},{grown})")
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
    model.mesh.partition(arguments.subdomains or subdomains)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

E = 2.1e5
elastic = tfeti.Elasticity(decomposition, E=E, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 0})
exact = {"quadrature_degree": 2}
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=exact)

# ## Load
#
# The shaft presses on the lower half of the bore; half of the load belongs to half of the
# bearing. The bearing turns: a small centrifugal force keeps the balls that carry no load on
# the outer ring, so that their place is defined.

# +
load, centrifugal = 0.5 * 5000.0, 0.5 * 7.0
on_bore, x = ds(decomposition.surface("bore")), ufl.SpatialCoordinate(mesh)
pressed = ufl.max_value(-x[2], 0) * ufl.as_vector((x[0], 0, x[2]))
whole = comm.allreduce(fem.assemble_scalar(fem.form(-pressed[2] * on_bore)))
outward = fem.Function(fem.functionspace(mesh, ("DG", 0, (3,))))
cells = [decomposition.cells(name) for name in names]
for own, angle in zip(cells, angles, strict=True):
    outward.x.array.reshape(-1, 3)[own] = cos(angle), 0.0, sin(angle)
push = centrifugal / (2 / 3 * pi * ball**3) * outward
L = load / whole * ufl.dot(pressed, v) * on_bore + ufl.dot(push, v) * dx
# -

# ## What holds the bodies
#
# The outer ring is fixed on its outside, and the mid plane stays in y = 0. Frictionless contact
# cannot keep a ball from spinning or from running along the grooves. The cage does: a spring
# in each point of a ball that acts around the bearing's axis only. Along the radius, where the
# rings press on it, the ball is free. Two keys in the bore, on top and at the bottom, keep
# the inner ring from moving across the load, and so from spinning; along the load it is free.

around = ufl.as_vector((-outward[2], 0, outward[0]))
cage = E / ball**2
a = elastic.a(u, v) + cage * ufl.dot(u, around) * ufl.dot(v, around) * dx
mesh.topology.create_connectivity(2, 3)
facets = decomposition.facets("bore")
keys = facets[np.abs(compute_midpoints(mesh, 2, facets)[:, 0]) < 0.2 * bore]
keys = fem.locate_dofs_topological(V.sub(0), 2, keys)
fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("outside"))
plane = fem.locate_dofs_topological(V.sub(1), 2, decomposition.facets("mid plane"))
bcs = [
    fem.dirichletbc(np.zeros(3), fixed, V),
    fem.dirichletbc(0.0, plane, V.sub(1)),
    fem.dirichletbc(0.0, keys, V.sub(0)),
]

# ## Contact
#
# A ball's whole sphere may meet both grooves; only what is near is searched.

pairs = [(name, groove) for name in names for groove in ("inner groove", "outer groove")]
contacts = [tfeti.Contact(*pair, secondary=pair[0], reach=0.006 * ball) for pair in pairs]
problem = tfeti.ContactProblem(a, L, bcs, contacts, decomposition, stress=elastic.stress)
uh = problem.solve()

# ## Balance
#
# For each ball the forces of both rings, of the cage and of the rotation must add up to zero,
# and the forces of the balls on the inner ring to the load. What is left, over the load, is
# the solver's error. (Forces along y are balanced by the other half of the bearing.) Across
# the load only the keys hold the inner ring: they take the small `side_force` that the mesh,
# which is not quite symmetric, leaves over.

# +
q = ufl.TestFunction(outward.function_space)


def on_balls(field):
    """Forces on the balls of a force per volume, shape (balls, 3)."""
    per_cell = fem.assemble_vector(fem.form(ufl.dot(field, q) * dx)).array.reshape(-1, 3)
    return comm.allreduce(np.array([per_cell[own].sum(axis=0) for own in cells]))


forces = [problem.solution.contact(i).resultant.force for i in range(2 * count)]
by_ring = np.array(forces).reshape(count, 2, 3)
by_cage = on_balls(-cage * ufl.dot(uh, around) * around)
sums = by_ring.sum(axis=1) + by_cage + on_balls(push)
on_inner_ring = -by_ring[:, 0].sum(axis=0)
errors = problem.report.errors
errors["ball_balance"] = float(np.linalg.norm(sums[:, [0, 2]], axis=1).max() / load)
errors["force"] = float(on_inner_ring[2] / load - 1)
errors["side_force"] = float(abs(on_inner_ring[0]) / load)
if comm.rank == 0:
    print("forces on the balls over the load: from the load line, inner ring, outer ring, cage")
    for name, angle, ring, held in zip(names, angles, by_ring, by_cage, strict=True):
        inner, outer, of_cage = np.linalg.norm([*ring, held], axis=1) / load
        print(f"{name:<8} {np.degrees(angle) + 90:6.1f}° {inner:.6f} {outer:.6f} {of_cage:.6f}")
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "ball_bearing_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    looks = {"factor": 25.0, "view": (0.35, 1.0, 0.25), "zoom": 1.15, "show_edges": False}
    path = folder / "ball_bearing_3d.png"
    tfeti.plot_deformed(path, problem.solution, unit="MPa", highest=600.0, **looks)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
