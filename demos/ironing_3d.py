# # Ironing in 3D
#
# A half ball, ten times as stiff, is pressed into a slab and drawn along it, with Coulomb's
# friction 0.3: large sliding in finite strain. There is no closed form. What holds the slab has to
# balance what the die does to it. And as in `ironing_2d.py` both forces stay what they are once the
# die slides, the force along somewhat more than μ times the force down, since the slab piles up
# before the die. A half is modelled, y ≥ 0.
#
#     ./run mpirun -n 2 python3 demos/ironing_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A stiff half ball drawn along a soft slab with Coulomb's friction."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--size", type=float, help="element size where the die passes")
parser.add_argument("--steps", type=int, default=9, help="load steps along the slab")
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
# Surfaces are known by the body and a plane; elements are finest where the die passes.

# +
comm = MPI.COMM_WORLD
length, width, height, R, begin = 4.8, 1.5, 1.2, 1.0, 1.4  # half the width; where the die begins
size = arguments.size or (0.4 if arguments.quick else 0.16)
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model, occ = gmsh.model, gmsh.model.occ
if comm.rank == 0:
    ball = occ.addSphere(begin, 0.0, R, R, angle1=-np.pi / 2, angle2=0.0, angle3=np.pi)
    bodies = {"slab": occ.addBox(0.0, 0.0, -height, length, width, height), "die": ball}
    occ.synchronize()
    planes = {"bottom": ("slab", 2, -height), "surface": ("slab", 2, 0.0), "grip": ("die", 2, R)}
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
    field = model.mesh.field.add("MathEval")
    model.mesh.field.setString(field, "F", f"{size} * (1 + 0.5 * Sqrt(y*y + z*z))")
    model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
subdomains = 4 if arguments.quick else 12
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
# -

# ## Two bodies of one material, with moduli by their names

# +
V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (3,)))
u, v = fem.Function(V), ufl.TestFunction(V)
young = {"slab": 1.0, "die": 10.0}
rubber = tfeti.NeoHooke(tfeti.Elasticity(decomposition, E=young, nu=0.3), u)
place = fem.Constant(decomposition.mesh, (0.0, 0.0, 0.0))
held, grip = (
    fem.locate_dofs_topological(V, 2, decomposition.facets(name)) for name in ("bottom", "grip")
)
side = fem.locate_dofs_topological(V.sub(1), 2, decomposition.facets("middle"))
bcs = [fem.dirichletbc(np.zeros(3), held, V), fem.dirichletbc(place, grip, V)]
bcs.append(fem.dirichletbc(0.0, side, V.sub(1)))
law = tfeti.Coulomb(0.3)
problem = tfeti.NonlinearContactProblem(
    rubber.residual(v),
    u,
    bcs,
    [tfeti.Contact("surface", "cap", secondary="surface", friction=law, name="die")],
    decomposition,
    finite=True,
    stress=rubber.stress,
    petsc_options={"tfeti_rtol": 1e-4},
)
# -

# ## Down, then along

# +
down, along = (1, 1) if arguments.quick else (3, arguments.steps)
stride = 1.8 / (9 if arguments.quick else along)


def move(problem, t):
    place.value = (stride * max(t - down, 0.0), 0.0, -0.3 * min(t / down, 1.0))


records = tfeti.LoadSteps(problem, move, np.arange(1.0, down + along + 1)).run()
# -

# ## Forces on both halves of the slab

# +
forces = 2 * np.array([record.contact_forces[0] for record in records])
ratio = -forces[-1, 0] / forces[-1, 2]
base = 2 * np.array(problem.solution.reaction("bottom").force)
errors = problem.report.errors
errors["force_along_over_force_down"] = float(ratio)
errors["balance"] = float(np.abs(forces[-1] + base)[[0, 2]].max() / -forces[-1, 2])
if comm.rank == 0:
    for record, force in zip(records, forces, strict=True):
        done = record.figures
        print(
            f"step {record.time:4.1f}: force down {-force[2]:.4f}, along {force[0]:.4f}, "
            f"{done['newton_steps']} tangents, {done['F_multiplications']} iterations"
        )
    print(f"along over down {ratio:.3f}, off balance {errors['balance']:.1e} of it")
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "ironing_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    look = {"view": (0.5, -1.0, 0.5), "factor": 1.0}
    tfeti.plot_deformed(folder / "ironing_3d.png", problem.solution, **look)
    if comm.rank == 0:
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        axes = figure.subplots()
        axes.plot(-forces[:, 2], "o-", label="pressed down")
        axes.plot(forces[:, 0], "o-", label="drawn along")
        axes.set(xlabel="load step", ylabel="force on the slab")
        axes.legend()
        figure.savefig(folder / "ironing_3d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
