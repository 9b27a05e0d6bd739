# # A bolted joint
#
# Two plates, a bolt and a nut: four bodies that touch with Coulomb's friction. The nut is tightened
# by a shortening: it stands on a shoulder of the bolt, in the place of a thread, and overlaps it.
# Then one plate is pulled along the other. Up to the force μN, N the pretension, they stick; then
# they slide and bend the bolt, until that slides under its head, too. So the joint carries μN
# without sliding, and 2μN with both sides of a plate. The hole is so wide that the shank does not
# touch it. A half is modelled, y ≥ 0; lengths are in mm, forces in N.
#
#     ./run mpirun -n 2 python3 demos/bolted_joint_3d.py --plot

"""A bolted joint: pretension by a shortening, then shear until it slides, beside μN."""

import sys
from pathlib import Path

import petsc4py

if __name__ == "__main__":
    petsc4py.init(sys.argv)  # before DOLFINx, which would initialise PETSc without options

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import tfeti_dolfinx as tfeti
from demos.demo_tools import Demo
from demos.partial_slip import draw
from meshes.tools import started_model

E, nu, MU = 2.1e5, 0.3, 0.2
LENGTH, WIDTH, OVERLAP, PLATE = 50.0, 16.0, 32.0, 12.0  # of each plate; half the width
SHANK, HOLE, HEAD, HIGH = 4.0, 4.6, 7.0, 5.0  # radii of shank, hole, head and nut; their height
SHORTENING = 0.045
WAY = 0.25  # of the plate's end


def build(size):
    """Mesh plates, bolt and nut on this rank; gmsh's model."""
    model, occ = started_model("bolted joint"), gmsh.model.occ

    def block(x, z, long, high):
        return occ.addBox(x, 0.0, z, long, WIDTH, high)

    def cylinder(radius, z, high):
        return occ.addCylinder(0.0, 0.0, z, 0.0, 0.0, high, radius, angle=np.pi)

    def less(body, hole):
        return occ.cut([(3, body)], [(3, hole)])[0][0][1]

    below, above = -PLATE - 2 * HIGH, PLATE + HIGH
    bodies = {
        "lower plate": less(
            block(OVERLAP / 2 - LENGTH, -PLATE, LENGTH, PLATE), cylinder(HOLE, -PLATE, PLATE)
        ),
        "upper plate": less(block(-OVERLAP / 2, 0.0, LENGTH, PLATE), cylinder(HOLE, 0.0, PLATE)),
        "nut": less(cylinder(HEAD, -PLATE - HIGH, HIGH), cylinder(HOLE, -PLATE - HIGH, HIGH)),
        "bolt": occ.fuse(
            [(3, cylinder(SHANK, below, above - below))],
            [(3, cylinder(HEAD, PLATE, HIGH)), (3, cylinder(HEAD, below, HIGH))],
        )[0][0][1],
    }
    occ.synchronize()

    # ## Surfaces, by the body and a plane
    planes = {
        "fixed": ("lower plate", 0, OVERLAP / 2 - LENGTH),
        "pulled": ("upper plate", 0, LENGTH - OVERLAP / 2),
        "lower inside": ("lower plate", 2, 0.0),
        "upper inside": ("upper plate", 2, 0.0),
        "lower outside": ("lower plate", 2, -PLATE),
        "upper outside": ("upper plate", 2, PLATE),
        "nut top": ("nut", 2, -PLATE),
        "nut bottom": ("nut", 2, -PLATE - HIGH),
        "shoulder": ("bolt", 2, -PLATE - HIGH),
        "head": ("bolt", 2, PLATE),
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
    model.mesh.field.setString(field, "F", f"{size} + 0.25 * Fabs(Sqrt(x*x + y*y) - {SHANK})")
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
    model.mesh.generate(3)
    return model


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    size = arguments.size or (4.0 if arguments.quick else 1.4)
    steps = 4 if arguments.quick else arguments.steps
    model = build(size) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, 4 if arguments.quick else 16)

    # ## Elasticity, of degree 2: tetrahedra of degree 1 are too stiff for a bolt that bends
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 2, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    way = fem.Constant(decomposition.mesh, 0.0)

    def held(name, component, value=0.0):
        W = V.sub(component)
        dofs = fem.locate_dofs_topological(W, 2, decomposition.facets(name))
        return fem.dirichletbc(value, dofs, W)

    bcs = [held("middle", 1), held("pulled", 0, way)]
    bcs += [held("fixed", i) for i in (0, 2)]

    # ## Contact
    #
    # The nut is tightened by so much as it overlaps the bolt's shoulder. Nothing but friction holds
    # bolt and nut along x.
    law = tfeti.Coulomb(MU)
    contacts = [
        tfeti.Contact(a, b, secondary=a, friction=law, name=name, gap=gap)
        for name, a, b, gap in (
            ("plates", "upper inside", "lower inside", "geometry"),
            ("head", "upper outside", "head", "geometry"),
            ("nut", "lower outside", "nut top", "geometry"),
            ("thread", "nut bottom", "shoulder", -SHORTENING),
        )
    ]
    problem = tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.ZeroBaseForm((v,)),
        bcs,
        contacts,
        decomposition,
        stress=elastic.stress,
        petsc_options={"tfeti_rtol": 1e-4, **demo.petsc_options},
    )

    # ## Pretension, then shear
    #
    # Step 0 tightens the nut; plates that widen under it push against their ends. In all others the
    # upper plate is pulled, at first by little.
    def apply(_, t):
        way.value = WAY * t

    times = [0.0, *(np.arange(1, steps + 1) / steps) ** 2]
    records = tfeti.LoadSteps(problem, apply, times, begin=-1.0).run()
    d = WAY * np.array([record.time for record in records])
    forces = 2 * np.array([record.contact_forces for record in records])  # on both halves
    N, plates, head = forces[:, 3, 2], -forces[:, 0, 0], -forces[:, 1, 0]

    # ## Comparison
    #
    # Once all slides, friction is μN on each side of the plate. The pretension is that of springs
    # in series, as handbooks have it: the shank, longer by half a diameter at each end, and
    # cones of 30° in what it clamps.
    problem.report.errors["pretension_of_springs"] = float(N[0] / springs() - 1)
    problem.report.errors["slip_of_plates"] = float(plates[-1] / (MU * N[-1]) - 1)
    problem.report.errors["slip_of_joint"] = float((plates + head)[-1] / (2 * MU * N[-1]) - 1)
    if comm.rank == 0:
        print(f"pretension {N[0]:.0f}, of springs {springs():.0f}")
        for record, way_now, n, a, b in zip(records, d, N, plates, head, strict=True):
            print(
                f"pulled {way_now:.4f}: shear {a + b:5.0f}, plates {a / (MU * n):.3f} μN, "
                f"head {b / (MU * n):.3f} μN, N {n:.0f}, {record.figures['F_multiplications']} F",
                flush=True,
            )
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        look = {"view": (0.35, -1.0, 0.4), "zoom": 1.15, "highest": 500.0}
        plot_deformed(demo.folder / "bolted_joint_3d.png", problem.solution, factor=2.0, **look)
        if comm.rank == 0:
            points = {"shear": (d, plates + head), "friction of the plates": (d, plates)}
            curves = {"μN": (d, MU * N), "2μN": (d, 2 * MU * N), "shear": points["shear"]}
            labels = ("displacement of the pulled end in mm", "force in N")
            draw(demo.folder / "bolted_joint_3d_force.png", [(labels, points, curves)])
    return demo.finish(problem, "bolted_joint_3d")


def springs():
    """Pretension by the shortening, of springs in series (Shigley's Mechanical Engineering Design).

    A cone of 30° of the height t, from the diameter D on, with the bore d, has the stiffness
    0.5774 π E d / ln((1.155 t + D − d)(D + d) / ((1.155 t + D + d)(D − d))).
    """
    grip, D, bore = 2 * PLATE + HIGH, 2 * HEAD, 2 * HOLE
    bolt = E * np.pi * SHANK**2 / (grip + 2 * SHANK)
    wide = 1.155 * grip / 2 + D
    ratio = (wide - bore) * (D + bore) / ((wide + bore) * (D - bore))
    cone = 0.5774 * np.pi * E * bore / np.log(ratio)
    return SHORTENING / (1 / bolt + 2 / cone)


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--size", type=float, help="element size at the shank, in mm")
    parser.add_argument("--steps", type=int, default=12, help="load steps of the shear")


if __name__ == "__main__":
    main(sys.argv[1:])
