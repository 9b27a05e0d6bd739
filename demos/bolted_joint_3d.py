# # A bolted joint
#
# Two plates, a bolt and a nut: four bodies that touch with Coulomb's friction. The nut is tightened
# by a shortening: it stands on a shoulder of the bolt, instead of a thread, and overlaps it.
# Then one plate is pulled along the other. Up to the force μN, N the pretension, they stick; then
# they slide and bend the bolt, until that slides under its head, too. So the joint carries μN
# without sliding, and 2μN with both sides of a plate. The hole is so wide that the shank does not
# touch it. A half is modelled, y ≥ 0; lengths are in mm, forces in N.
#
#     ./run mpirun -n 2 python3 demos/bolted_joint_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A bolted joint: pretension by a shortening, then shear until it slides."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--size", type=float, help="element size at the shank, in mm")
parser.add_argument("--steps", type=int, default=12, help="load steps of the shear")
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
# Surfaces are known by the body and a plane.

# +
comm = MPI.COMM_WORLD
length, width, overlap, plate = 50.0, 16.0, 32.0, 12.0  # of each plate; half the width
shank, hole, head, high = 4.0, 4.6, 7.0, 5.0  # radii of shank, hole, head and nut; their height
size = arguments.size or (4.0 if arguments.quick else 1.4)
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model, occ = gmsh.model, gmsh.model.occ


def cylinder(radius, z, high):
    return occ.addCylinder(0.0, 0.0, z, 0.0, 0.0, high, radius, angle=np.pi)


def less(body, hole):
    return occ.cut([(3, body)], [(3, hole)])[0][0][1]


if comm.rank == 0:
    left = occ.addBox(overlap / 2 - length, 0.0, -plate, length, width, plate)
    right = occ.addBox(-overlap / 2, 0.0, 0.0, length, width, plate)
    low, top = -plate - 2 * high, plate + high
    ends = [(3, cylinder(head, z, high)) for z in (plate, low)]
    bodies = {
        "lower plate": less(left, cylinder(hole, -plate, plate)),
        "upper plate": less(right, cylinder(hole, 0.0, plate)),
        "nut": less(cylinder(head, -plate - high, high), cylinder(hole, -plate - high, high)),
        "bolt": occ.fuse([(3, cylinder(shank, low, top - low))], ends)[0][0][1],
    }
    occ.synchronize()
    planes = {
        "fixed": ("lower plate", 0, overlap / 2 - length),
        "pulled": ("upper plate", 0, length - overlap / 2),
        "lower inside": ("lower plate", 2, 0.0),
        "upper inside": ("upper plate", 2, 0.0),
        "lower outside": ("lower plate", 2, -plate),
        "upper outside": ("upper plate", 2, plate),
        "nut top": ("nut", 2, -plate),
        "nut bottom": ("nut", 2, -plate - high),
        "shoulder": ("bolt", 2, -plate - high),
        "head": ("bolt", 2, plate),
    }
    middle = []
    for name, tag in bodies.items():
        model.addPhysicalGroup(3, [tag], name=name)
        for _, face in model.getBoundary([(3, tag)], oriented=False):
            box = np.array(model.getBoundingBox(2, face)).reshape(2, 3)
            flat = np.ptp(box, axis=0) < 1e-5
            if flat[1] and abs(box[0, 1]) < 1e-5:
                middle.append(face)
            for surface, (body, axis, at) in planes.items():
                if body == name and flat[axis] and abs(box[0, axis] - at) < 1e-5:
                    model.addPhysicalGroup(2, [face], name=surface)
    model.addPhysicalGroup(2, middle, name="middle")
    field = model.mesh.field.add("MathEval")
    model.mesh.field.setString(field, "F", f"{size} + 0.25 * Fabs(Sqrt(x*x + y*y) - {shank})")
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
subdomains = 4 if arguments.quick else 16
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
# -

# ## Elasticity, of degree 2: tetrahedra of degree 1 are too stiff for a bolt that bends

# +
E, mu = 2.1e5, 0.2
elastic = tfeti.Elasticity(decomposition, E=E, nu=0.3)
V = fem.functionspace(decomposition.mesh, ("Lagrange", 2, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
way = fem.Constant(decomposition.mesh, 0.0)


def held(name, component, value=0.0):
    W = V.sub(component)
    dofs = fem.locate_dofs_topological(W, 2, decomposition.facets(name))
    return fem.dirichletbc(value, dofs, W)


bcs = [held("middle", 1), held("pulled", 0, way), held("fixed", 0), held("fixed", 2)]
# -

# ## Contact
#
# The nut is tightened by so much as it overlaps the bolt's shoulder. Nothing but friction holds
# bolt and nut along x.

# +
shortening = 0.045
pairs = {
    "plates": ("upper inside", "lower inside", "geometry"),
    "head": ("upper outside", "head", "geometry"),
    "nut": ("lower outside", "nut top", "geometry"),
    "thread": ("nut bottom", "shoulder", -shortening),
}
contacts = [
    tfeti.Contact(a, b, secondary=a, friction=tfeti.Coulomb(mu), name=name, gap=gap)
    for name, (a, b, gap) in pairs.items()
]
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.ZeroBaseForm((v,)),
    bcs,
    contacts,
    decomposition,
    stress=elastic.stress,
    petsc_options={"tfeti_rtol": 1e-4},
)
# -

# ## Pretension, then shear
#
# Step 0 tightens the nut; plates that widen under it push against their ends. In all others the
# upper plate is pulled, at first by little.

# +
most, steps = 0.25, 4 if arguments.quick else arguments.steps


def pull(problem, t):
    way.value = most * t


times = [0.0, *(np.arange(1, steps + 1) / steps) ** 2]
records = tfeti.LoadSteps(problem, pull, times, begin=-1.0).run()
d = most * np.array([record.time for record in records])
forces = 2 * np.array([record.contact_forces for record in records])  # on both halves
N, plates, under_head = forces[:, 3, 2], -forces[:, 0, 0], -forces[:, 1, 0]
# -

# ## Comparison
#
# Once all slides, friction is μN on each side of the plate. The pretension is that of springs in
# series, as handbooks have it (Shigley's Mechanical Engineering Design): the shank, longer by
# half a diameter at each end, and two cones of 30° in what it clamps.

# +
grip, D, bore = 2 * plate + high, 2 * head, 2 * hole
wide = 1.155 * grip / 2 + D
ratio = (wide - bore) * (D + bore) / ((wide + bore) * (D - bore))
bolt = E * np.pi * shank**2 / (grip + 2 * shank)
cone = 0.5774 * np.pi * E * bore / np.log(ratio)
springs = shortening / (1 / bolt + 2 / cone)
errors = problem.report.errors
errors["pretension_of_springs"] = float(N[0] / springs - 1)
errors["slip_of_plates"] = float(plates[-1] / (mu * N[-1]) - 1)
errors["slip_of_joint"] = float((plates + under_head)[-1] / (2 * mu * N[-1]) - 1)
if comm.rank == 0:
    print(f"pretension {N[0]:.0f}, of springs {springs:.0f}")
    for record, at, n, a, b in zip(records, d, N, plates, under_head, strict=True):
        print(
            f"pulled {at:.4f}: shear {a + b:5.0f}, plates {a / (mu * n):.3f} μN, "
            f"head {b / (mu * n):.3f} μN, N {n:.0f}, "
            f"{record.figures['F_multiplications']} iterations"
        )
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "bolted_joint_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    look = {"view": (0.35, -1.0, 0.4), "zoom": 1.15, "highest": 500.0, "unit": "MPa"}
    path = folder / "bolted_joint_3d.png"
    tfeti.plot_deformed(path, problem.solution, factor=2.0, **look)
    if comm.rank == 0:
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        axes = figure.subplots()
        axes.plot(d, plates + under_head, "o-", label="shear")
        axes.plot(d, plates, "o", label="friction of the plates")
        axes.plot(d, mu * N, label="μN")
        axes.plot(d, 2 * mu * N, label="2μN")
        axes.set(xlabel="displacement of the pulled end in mm", ylabel="force in N")
        axes.legend()
        figure.savefig(folder / "bolted_joint_3d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
