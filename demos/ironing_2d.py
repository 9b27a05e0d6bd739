# # Ironing
#
# A half disc, ten times as stiff, is pressed into a slab and drawn along it, with Coulomb's
# friction 0.3: large sliding in finite strain, as in the shallow ironing of Fischer and Wriggers
# (Comput. Methods Appl. Mech. Engrg. 195, 2006). There is no closed form.
#
#     ./run mpirun -n 2 python3 demos/ironing_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A stiff half disc drawn along a soft slab with Coulomb's friction."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--size", type=float, help="element size")
parser.add_argument("--steps", type=int, default=10, help="load steps along the slab")
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
# The slab under y = 0, and a half disc on it at x = 2.

# +
comm = MPI.COMM_WORLD
length, height, R = 8.0, 2.0, 1.5
size = arguments.size or (0.35 if arguments.quick else 0.18)
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, geo = gmsh.model, gmsh.model.geo
if comm.rank == 0:
    corners = ((0, -height), (length, -height), (length, 0), (0, 0))
    points = [geo.addPoint(x, y, 0) for x, y in corners]
    sides = [geo.addLine(points[k], points[(k + 1) % 4]) for k in range(4)]
    slab = geo.addPlaneSurface([geo.addCurveLoop(sides)])
    ends = ((2 - R, R), (2, R), (2 + R, R), (2, 0))
    left, centre, right, low = (geo.addPoint(x, y, 0) for x, y in ends)
    arcs = [geo.addCircleArc(left, centre, low), geo.addCircleArc(low, centre, right)]
    grip = geo.addLine(right, left)
    die = geo.addPlaneSurface([geo.addCurveLoop([*arcs, grip])])
    geo.synchronize()
    model.addPhysicalGroup(2, [slab], name="slab")
    model.addPhysicalGroup(2, [die], name="die")
    curves = {"bottom": sides[:1], "surface": sides[2:3], "arc": arcs, "grip": [grip]}
    for name, tags in curves.items():
        model.addPhysicalGroup(1, tags, name=name)
    gmsh.option.setNumber("Mesh.MeshSizeMin", size)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    model.mesh.generate(2)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, 8)
gmsh.finalize()
# -

# ## Two bodies of one material, with moduli by their names

# +
V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
young = {"slab": 1.0, "die": 10.0}
elastic = tfeti.Elasticity(decomposition, E=young, nu=0.3, model="plane_strain")
rubber = tfeti.NeoHooke(elastic, u)
place = fem.Constant(decomposition.mesh, (0.0, 0.0))
bottom, grip = (
    fem.locate_dofs_topological(V, 1, decomposition.facets(name)) for name in ("bottom", "grip")
)
problem = tfeti.NonlinearContactProblem(
    rubber.residual(v),
    u,
    [fem.dirichletbc(np.zeros(2), bottom, V), fem.dirichletbc(place, grip, V)],
    [tfeti.Contact("surface", "arc", friction=tfeti.Coulomb(0.3), name="die")],
    decomposition,
    finite=True,
    stress=rubber.stress,
    petsc_options={"tfeti_rtol": 2e-5},
)
# -

# ## Down, then along
#
# In a load step friction acts on what slips since its begin, along tangents that turn with
# the surface. With `--plot` a picture is drawn after every step.

# +
down, along = (2, 1) if arguments.quick else (5, arguments.steps)
stride = 3.0 / (10 if arguments.quick else along)


def move(problem, t):
    place.value = (stride * max(t - down, 0.0), -0.5 * min(t / down, 1.0))


folder, records, pictures = arguments.output or Path("results"), [], []
for t in np.arange(1.0, down + along + 1):
    records += tfeti.LoadSteps(problem, move, [t], begin=t - 1.0).run()
    if arguments.plot:
        pictures.append(folder / f"ironing_2d_{len(pictures)}.png")
        tfeti.plot_deformed(pictures[-1], problem.solution, factor=1.0, highest=0.6)
# -

# ## Forces on the slab

# +
forces = np.array([record.contact_forces[0] for record in records])
problem.report.errors["force_along_over_force_down"] = float(-forces[-1, 0] / forces[-1, 1])
if comm.rank == 0:
    for record, force in zip(records, forces, strict=True):
        done = record.figures
        print(
            f"step {record.time:4.1f}: force down {-force[1]:.4f}, along {force[0]:.4f}, "
            f"{done['newton_steps']} tangents, {done['F_multiplications']} iterations"
        )
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "ironing_2d.bp", problem.solution)
if arguments.plot and comm.rank == 0:
    from matplotlib.figure import Figure
    from PIL import Image

    frames = [Image.open(path).resize((600, 450)) for path in pictures]
    path, more = folder / "ironing_2d.gif", frames[1:]
    frames[0].save(path, save_all=True, append_images=more, duration=250, loop=0)
    pictures[-1].replace(folder / "ironing_2d.png")
    for path in pictures[:-1]:
        path.unlink()

    figure = Figure(layout="constrained")
    axes = figure.subplots()
    axes.plot(-forces[:, 1], "o-", label="pressed down")
    axes.plot(forces[:, 0], "o-", label="drawn along")
    axes.set(xlabel="load step", ylabel="force on the slab")
    axes.legend()
    figure.savefig(folder / "ironing_2d_force.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
