# # Falling balls
#
# Balls fall on a rough floor, one above the other; the lowest one also moves along the floor, and
# friction turns it. They hit the floor and each other, without anything that was tuned. Bodies move
# by several times the size of their contacts; but strains, turns and ways along the surfaces are
# small, since who meets whom is found where the balls begin.
#
# Until its first impact is over the lowest ball is alone with the floor: force and duration of
# that are near to Hertz', whose contact is smooth and small compared with the ball, as that of a
# stiffer one:
#
#     ./run mpirun -n 2 python3 demos/falling_balls_3d.py --plot
#     ./run python3 demos/falling_balls_3d.py --balls 1 --modulus 4e7 --fine 0.015 \
#         --gap 0.01 --end 0.01 --steps 30 --smooth

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="Balls that fall on a rough floor and on each other.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--balls", type=int, help="how many")
parser.add_argument("--modulus", type=float, default=2e4, help="Young's modulus")
parser.add_argument("--smooth", action="store_true", help="without friction")
parser.add_argument("--gap", type=float, default=0.3, help="what is left of the fall")
parser.add_argument("--fine", type=float, help="element size where balls touch")
parser.add_argument("--steps", type=float, help="steps in the first impact")
parser.add_argument("--end", type=float, help="time of the end")
parser.add_argument("--subdomains", type=int, default=6)
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

# ## Data, and Hertz' closed form of the first impact

# +
comm = MPI.COMM_WORLD
R, nu, rho, g, fall, apart = 1.0, 0.3, 1.0, 10.0, 0.3, 0.25
speed, mass = np.sqrt(2 * g * fall), 4 / 3 * np.pi * R**3 * rho
modulus = arguments.modulus / (1 - nu**2)
approach = (15 * mass * speed**2 / (16 * modulus * np.sqrt(R))) ** 0.4
hertz_force = 4 / 3 * modulus * np.sqrt(R) * approach**1.5
hertz_lasts = 2.94 * approach / speed

fine = arguments.fine or (0.4 if arguments.quick else 0.12)
count = arguments.balls or (2 if arguments.quick else 3)
end = arguments.end or (0.27 if arguments.quick else 0.8)
size = hertz_lasts / (arguments.steps or (6 if arguments.quick else 15))
gap = arguments.gap
# -

# ## Mesh
#
# Tetrahedra, finest at the lowest and highest points of the balls.

# +
lowest = gap + (2 * R + apart) * np.arange(count)
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model, field = gmsh.model, gmsh.model.mesh.field
if comm.rank == 0:
    fields, growth = [], (max(0.3, fine) - fine) / R
    for number, low in enumerate(lowest, start=1):
        middle = (0.0, 0.0, low + R)
        halves = [
            model.occ.addSphere(*middle, R, angle1=start, angle2=stop)
            for start, stop in ((-np.pi / 2, 0.0), (0.0, np.pi / 2))
        ]
        found, _ = model.occ.fragment([(3, halves[0])], [(3, halves[1])])
        model.occ.synchronize()
        model.addPhysicalGroup(3, [tag for _, tag in found], name=f"ball {number}")
        for dim, tag in model.getBoundary(found, combined=True, oriented=False):
            side = "lower" if model.occ.getCenterOfMass(dim, tag)[2] < middle[2] else "upper"
            model.addPhysicalGroup(2, [tag], name=f"ball {number} {side}")
        for pole in (low, low + 2 * R):
            far = f"(sqrt(x^2+y^2+(z-({pole}))^2)-{0.15 * R})"
            fields.append(field.add("MathEval"))
            field.setString(fields[-1], "F", f"{fine}+{growth}*0.5*({far}+fabs({far}))")
    least = field.add("Min")
    field.setNumbers(least, "FieldsList", fields)
    field.setAsBackgroundMesh(least)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, arguments.subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Balls with their weight and what they have fallen, contacts with Coulomb's friction

# +
elastic = tfeti.Elasticity(decomposition, E=arguments.modulus, nu=nu)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
weight, thrown = fem.Constant(mesh, (0.0, 0.0, -rho * g)), fem.Function(V)
fallen, first = -np.sqrt(2 * g * (fall - gap)), gap + 2 * R + 0.5 * apart
thrown.interpolate(lambda x: np.stack((0.3 * (x[2] < first), 0 * x[0], np.full_like(x[0], fallen))))
rough = None if arguments.smooth else tfeti.Coulomb(0.3)
floor = tfeti.Plane((0, 0, 0), normal=(0, 0, 1))
contacts = [tfeti.Obstacle("ball 1 lower", floor, friction=rough, reach=gap + 0.15, name="floor")]
for n in range(1, count):
    pair = (f"ball {n + 1} lower", f"ball {n} upper")
    contacts.append(
        tfeti.Contact(*pair, friction=rough, reach=apart + 0.3, name=f"balls {n} and {n + 1}")
    )
problem = tfeti.ContactDynamics(
    elastic.a(u, v),
    ufl.dot(weight, v) * ufl.dx(domain=mesh),
    [],
    contacts,
    decomposition,
    mass=rho,
    velocity=thrown,
    stabilised=True,
    stress=elastic.stress,
)
# -

# ## Motion
#
# With `--plot` a picture is drawn after every fourth step.

# +
folder, records, pictures, begin = arguments.output or Path("results"), [], [], 0.0
times = size * np.arange(1, round(end / size) + 1)
for part in np.array_split(times, 2 if arguments.quick else max(len(times) // 4, 1)):
    series = tfeti.LoadSteps(problem, lambda problem, t: None, part, begin=begin)
    records += series.run()
    begin = part[-1]
    if arguments.plot:
        pictures.append(folder / f"falling_balls_3d_{len(pictures)}.png")
        looks = {"view": (0.3, -1.0, 0.15), "highest": 0.02 * modulus, "zoom": 0.9}
        looks["focus"] = (0.0, 0.0, 0.5 * lowest[-1] + R - 0.15)
        tfeti.plot_deformed(pictures[-1], problem.solution, show_edges=False, **looks)
# -

# ## The first impact, and what was done in all

# +
errors, t = {}, np.array([record.time for record in records])
force = np.array([record.contact_forces[0][2] for record in records])
touching = np.flatnonzero(force > 0.0)
if len(touching):
    start = touching[0]
    free = np.flatnonzero((force == 0.0) & (t > t[start]))
    last = free[0] if len(free) else len(t)
    errors["force"] = float(force[start:last].max() / hertz_force - 1)
    errors["duration"] = float((last - start) * size / hertz_lasts - 1)
problem.report.errors.update(errors)
if comm.rank == 0:
    F = [record.figures["F_multiplications"] for record in records]
    motion = [record.motion for record in records]
    print(f"{len(records)} steps of {size:.4g}, {sum(F)} iterations")
    print(f"median {np.median(F):g}, at most {max(F)} in a step")
    for name in ("load", "contact", "friction", "predictor"):
        print(f"work of {name:<10} {sum(m[name] for m in motion):.4g}")
    print(f"energy at the end {motion[-1]['energy']:.4g}")
    print(f"largest defect {max(abs(m['defect']) for m in motion):.1e}")
    print(f"a/R of Hertz {np.sqrt(approach / R):.3f}, which ought to be small")
    for name, value in errors.items():
        print(f"first impact, {name}: {value:+.3f} of Hertz'", flush=True)
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "falling_balls_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    if comm.rank == 0:
        from PIL import Image

        narrow = (200, 0, 1200, 900)  # of 1200 × 900
        frames = [Image.open(path).crop(narrow).resize((500, 450)) for path in pictures]
        path = folder / "falling_balls_3d.gif"
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=80, loop=0)
        pictures[-1].replace(folder / "falling_balls_3d.png")
        for path in pictures[:-1]:
            path.unlink()
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
