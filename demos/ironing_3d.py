# # Ironing in 3D
#
# A half ball, ten times as stiff, is pressed into a slab and drawn along it, with Coulomb's
# friction 0.3: large sliding in finite strain. There is no closed form. What holds the slab has to
# balance what the die does to it. And as in `ironing_2d.py` both forces stay what they are once the
# die slides, the force along somewhat more than μ times the force down, since the slab piles up
# before the die. A half is modelled, y ≥ 0.
#
#     ./run mpirun -n 2 python3 demos/ironing_3d.py --plot

"""A stiff half ball drawn along a soft slab with Coulomb's friction: large sliding, forces."""

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

MU, nu = 0.3, 0.3
E = {"slab": 1.0, "die": 10.0}
LENGTH, WIDTH, HEIGHT, R, BEGIN = 4.8, 1.5, 1.2, 1.0, 1.4  # half the width; where the die begins
DEPTH, WAY = 0.3, 1.8


def build(size):
    """Mesh slab and die on this rank; gmsh's model."""
    model, occ = started_model("ironing in 3D"), gmsh.model.occ
    ball = occ.addSphere(BEGIN, 0.0, R, R, angle1=-np.pi / 2, angle2=0.0, angle3=np.pi)
    bodies = {"slab": occ.addBox(0.0, 0.0, -HEIGHT, LENGTH, WIDTH, HEIGHT), "die": ball}
    occ.synchronize()
    planes = {"bottom": ("slab", 2, -HEIGHT), "surface": ("slab", 2, 0.0), "grip": ("die", 2, R)}
    middle, cap = [], []
    for name, tag in bodies.items():
        model.addPhysicalGroup(3, [tag], name=name)
        for _, face in model.getBoundary([(3, tag)], oriented=False):
            box = np.array(model.getBoundingBox(2, face)).reshape(2, 3)
            flat = np.ptp(box, axis=0) < 1e-5
            if flat[1] and abs(box[0, 1]) < 1e-5:
                middle.append(face)
            elif name == "die" and not np.any(flat):
                cap.append(face)
            for surface, (body, axis, at) in planes.items():
                if body == name and flat[axis] and abs(box[0, axis] - at) < 1e-5:
                    model.addPhysicalGroup(2, [face], name=surface)
    model.addPhysicalGroup(2, middle, name="middle")
    model.addPhysicalGroup(2, cap, name="cap")
    field = model.mesh.field.add("MathEval")  # finest where the die passes
    model.mesh.field.setString(field, "F", f"{size} * (1 + 0.5 * Sqrt(y*y + z*z))")
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
    model.mesh.generate(3)
    return model


def run(argv):
    demo = Demo(__doc__, argv, configure)
    arguments, comm = demo.arguments, MPI.COMM_WORLD
    size = arguments.size or (0.4 if arguments.quick else 0.16)
    model = build(size) if comm.rank == 0 else None
    decomposition = tfeti.read_gmsh(model, comm, 4 if arguments.quick else 12)

    # ## Two bodies of one material, with moduli by their names
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    rubber = tfeti.NeoHooke(tfeti.Elasticity(decomposition, E=E, nu=nu), u)
    place = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
    held = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
    bcs = [
        fem.dirichletbc(value, fem.locate_dofs_topological(V, 2, decomposition.facets(name)), V)
        for name, value in (("bottom", held), ("grip", place))
    ]
    side = fem.locate_dofs_topological(V.sub(1), 2, decomposition.facets("middle"))
    bcs.append(fem.dirichletbc(0.0, side, V.sub(1)))
    pair = tfeti.Contact(
        "surface", "cap", secondary="surface", friction=tfeti.Coulomb(MU), name="die"
    )
    problem = tfeti.NonlinearContactProblem(
        rubber.residual(v),
        u,
        bcs,
        [pair],
        decomposition,
        finite=True,
        update=rubber.update,
        stress=rubber.stress,
        petsc_options={"tfeti_rtol": 1e-4, **demo.petsc_options},
    )

    # ## Down, then along
    down, along = (1, 1) if arguments.quick else (3, arguments.steps)
    stride = WAY / (9 if arguments.quick else along)

    def apply(_, t):
        place.value = (stride * max(t - down, 0.0), 0.0, -DEPTH * min(t / down, 1.0))

    records = tfeti.LoadSteps(problem, apply, np.arange(1.0, down + along + 1)).run()
    # on both halves of the slab: drawn along and pressed down
    forces = 2 * np.array([record.contact_forces[0] for record in records])
    ratio = -forces[:, 0] / forces[:, 2]
    base = 2 * np.array(problem.solution.reaction("bottom").force)
    errors = problem.report.errors
    errors["force_along_over_force_down"] = float(ratio[-1])
    errors["balance"] = float(np.abs(forces[-1] + base)[[0, 2]].max() / -forces[-1, 2])
    if comm.rank == 0:
        for record, force in zip(records, forces, strict=True):
            figures = record.figures
            print(
                f"step {record.time:4.1f}: force down {-force[2]:.4f}, along {force[0]:.4f}, "
                f"{figures['newton_steps']} tangents, {figures['F_multiplications']} F",
                flush=True,
            )
        print(f"along over down {ratio[-1]:.3f}, off balance {errors['balance']:.1e} of it")
    if arguments.plot:
        from tfeti_dolfinx.plot import plot_deformed

        look = {"view": (0.5, -1.0, 0.5), "factor": 1.0}
        plot_deformed(demo.folder / "ironing_3d.png", problem.solution, **look)
        if comm.rank == 0:
            t = np.array([record.time for record in records])
            curves = {"pressed down": (t, -forces[:, 2]), "drawn along": (t, forces[:, 0])}
            labels = ("load step", "force on the slab")
            draw(demo.folder / "ironing_3d_force.png", [(labels, {}, curves)])
    return demo.finish(problem, "ironing_3d")


def main(argv):
    """Run the demo and return its solution."""
    return run(argv)[0]


def configure(parser):
    parser.add_argument("--size", type=float, help="element size where the die passes")
    parser.add_argument("--steps", type=int, default=9, help="load steps along the slab")


if __name__ == "__main__":
    main(sys.argv[1:])
