# # A yielding clamped connection
#
# A mine support yields: two U-profiles overlap, and two bolted clamps press them on each other,
# so that they slide before they bend. Here the load along the support is below what friction can
# take: a part of the contact slips, the rest sticks. Six bodies, five contacts with Coulomb's
# friction, which alone holds the upper profile along its axis. Dostál's talk has such a model of
# 1.6 million unknowns in 250 subdomains (`--large`); it does not say its measures.
#
#     ./run mpirun -n 2 python3 demos/clamped_connection_3d.py --plot

# +
import argparse
import sys
from itertools import pairwise
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="The clamped connection of a mine support: U-profiles, clamps, friction."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--size", type=float, help="of the hexahedra, in mm")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--friction", type=float, default=0.3, help="its coefficient")
parser.add_argument("--load", type=float, default=12e3, help="along the support, in N")
parser.add_argument("--large", action="store_true", help="250 subdomains, 1.6 M unknowns")
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
# Sections of quadrilaterals on grids are drawn along z. A profile is a U with lips; the upper one
# is narrower and lies in the lower one, bottom on bottom. A clamp is two bars: one under the
# lower profile, one on the lips of the upper one; the bolts pull on the ends of the bars. Lengths
# are in mm, forces in N.

# +
comm = MPI.COMM_WORLD
size = arguments.size or (24.0 if arguments.quick else 2.3 if arguments.large else 12.0)
subdomains = 12 if arguments.quick else 250 if arguments.large else 24
plate, length, overlap, width, height, bolt_end = 15.0, 300.0, 200.0, 50.0, 40.0, 30.0
bars = ("lower bar 1", "upper bar 1", "lower bar 2", "upper bar 2")
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, geo = gmsh.model, gmsh.model.geo


def middle(half, rise, flank):
    """The line through the middle of a profile's plate, from left to right."""
    angle = 70.0 * np.pi / 180.0
    x, y = half + flank * np.cos(angle), rise + flank * np.sin(angle)
    right = [(half, rise), (x, y), (x + 30.0, y)]
    return [*((-x, y) for x, y in reversed(right)), *right]


def drawn(low, high, cells, across, start, long, size):
    """Hexahedra between stations (low, high): volumes, near and far ends, low and high sides."""
    points = [[geo.addPoint(x, y, start) for x, y in side] for side in (low, high)]
    cross = [geo.addLine(a, b) for a, b in zip(*points, strict=True)]
    surfaces, lines = [], [[], []]
    for i, count in enumerate(cells):
        for side, at in zip(lines, points, strict=True):
            side.append(geo.addLine(at[i], at[i + 1]))
            geo.mesh.setTransfiniteCurve(side[-1], count + 1)
        loop = geo.addCurveLoop([lines[0][i], cross[i + 1], -lines[1][i], -cross[i]])
        surfaces.append(geo.addPlaneSurface([loop]))
        geo.mesh.setTransfiniteSurface(surfaces[-1])
        geo.mesh.setRecombine(2, surfaces[-1])
    for line in cross:
        geo.mesh.setTransfiniteCurve(line, across + 1)
    layers, sections = [max(2, round(long / size))], [(2, surface) for surface in surfaces]
    tags = [tag for _, tag in geo.extrude(sections, 0, 0, long, layers, recombine=True)]
    # of each piece: far end, volume, and the sides in the order of its loop
    return tags[1::6], surfaces, tags[0::6], tags[2::6], tags[4::6]


def profile(line, start, size):
    """A plate along a line, with mitred corners."""
    line = np.array(line)
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    ways = np.diff(line, axis=0) / steps[:, None]
    before, after = np.vstack((ways[:1], ways)), np.vstack((ways, ways[-1:]))
    share = 0.5 * plate / (1.0 + np.sum(before * after, axis=1))
    across = share[:, None] * ((before + after) @ [[0.0, 1.0], [-1.0, 0.0]])
    cells = [max(2, round(step / size)) for step in steps]
    through = max(2, round(plate / size))
    return drawn(line - across, line + across, cells, through, start, length, size)


def bar(y, start):
    """A bar above y: its middle, and its ends on which the bolts pull."""
    inner = middle(45.0, 0.0, 60.0)[-1][0]
    x = [-inner - bolt_end, -inner, inner, inner + bolt_end]
    low, high = ([(at, y + up) for at in x] for up in (0.0, height))
    cells = [max(2, round((b - a) / size)) for a, b in pairwise(x)]
    return drawn(low, high, cells, max(2, round(height / size)), start, width, size)


if comm.rank == 0:
    lower = profile(middle(45.0, 0.0, 60.0), 0.0, size)
    # cells of the upper profile are a tenth smaller, so that the meshes do not match
    line = middle(25.0, plate, 68.0)
    upper = profile(line, length - overlap, 0.9 * size)
    heights = (-0.5 * plate - height, line[0][1] + 0.5 * plate)
    starts = [length - overlap + (i + 0.5) * 0.5 * overlap - 0.5 * width for i in range(2)]
    clamps = [bar(y, z) for z in starts for y in heights]
    geo.synchronize()
    bodies = {
        "lower profile": lower,
        "upper profile": upper,
        **dict(zip(bars, clamps, strict=True)),
    }
    for name, body in bodies.items():
        model.addPhysicalGroup(3, body[0], name=name)
    surfaces = {
        "lower end": lower[1],
        "upper end": upper[2],
        "lower inside": lower[4][2:3],
        "upper outside": upper[3][2:3],
        "bottom": lower[3][2:3],
        "lips": [upper[4][0], upper[4][4]],
        "bolts below": [tag for clamp in clamps[::2] for tag in clamp[3][::2]],
        "bolts above": [tag for clamp in clamps[1::2] for tag in clamp[4][::2]],
    }
    sides = [clamps[0][4], clamps[1][3], clamps[2][4], clamps[3][3]]
    surfaces |= {name: [side[1]] for name, side in zip(bars, sides, strict=True)}
    for name, tags in surfaces.items():
        model.addPhysicalGroup(2, tags, name=name)
    model.mesh.generate(3)
model, subdomains = model if comm.rank == 0 else None, arguments.subdomains or subdomains
decomposition = tfeti.read_gmsh(model, comm, subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=2.1e5, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load and conditions
#
# The bolts pull the bars of a clamp towards each other, and keep their ends where they are
# across that. One end of the support is fixed; the other one is guided, and pushed along the
# axis.

# +
L, bolts = 0, 4 * 30e3
for name, axis, force in (
    ("upper end", 2, -arguments.load),
    ("bolts below", 1, bolts),
    ("bolts above", 1, -bolts),
):
    surface = ds(decomposition.surface(name))
    area = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * surface)))
    L += force / area * v[axis] * surface
fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("lower end"))
bcs = [fem.dirichletbc(np.zeros(3), fixed, V)]
for name, across in (("upper end", (0, 1)), ("bolts below", (0, 2)), ("bolts above", (0, 2))):
    for i in across:
        guided = fem.locate_dofs_topological(V.sub(i), 2, decomposition.facets(name))
        bcs.append(fem.dirichletbc(0.0, guided, V.sub(i)))
# -

# ## Contact
#
# Nearly all nodes of the bars slip. Newton's method on Coulomb's law does not mind; problems
# with fixed bounds alone (`-tfeti_friction_type fixed_point`) take longer.

law = tfeti.Coulomb(arguments.friction)
pairs = {"upper outside": "lower inside"}
pairs |= {name: "bottom" if "lower" in name else "lips" for name in bars}
contacts = [
    tfeti.Contact(a, b, secondary=a, friction=law, reach=1.0, name=a) for a, b in pairs.items()
]
problem = tfeti.ContactProblem(
    elastic.a(u, v), L, bcs, contacts, decomposition, stress=elastic.stress
)
problem.solve()

# ## Balance
#
# Friction alone holds the upper profile along z: that of the lower one, and that of the bars
# on its lips.

along = {name: problem.solution.contact(name).resultant.force[2] for name in pairs}
held = along["upper outside"] - along["upper bar 1"] - along["upper bar 2"]
problem.report.errors["force"] = float(held / arguments.load - 1)

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "clamped_connection_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    path = folder / "clamped_connection_3d.png"
    looks = {"factor": 50.0, "highest": 80.0, "view": (0.9, 0.8, 0.6)}
    tfeti.plot_deformed(path, problem.solution, unit="MPa", **looks)
    path = folder / "clamped_connection_3d_friction.png"
    names = ["upper outside"]
    tfeti.plot_friction(path, problem.solution, names, axes=(2, 0), labels=("z", "x"))
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
