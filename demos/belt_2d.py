# # A belt on a drum
#
# An elastic belt lies on a drum over an angle θ. A weight pulls at one end, the other one is held.
# When the weight is hung on, all of the belt slips towards it; when the drum then turns the other
# way, all of it slips back. With Coulomb's friction the forces at the ends are related by the
# capstan equation (Euler, Eytelwein): first T₂ = T₁ exp(−μθ), then T₂ = T₁ exp(μθ).
#
#     ./run mpirun -n 2 python3 demos/belt_2d.py --plot

# +
import argparse
import sys
from math import cos, pi, sin
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A belt that slips on a drum: Coulomb's friction and the capstan equation."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--angle", type=float, default=180.0, help="on the drum, in degrees")
parser.add_argument("--friction", type=float, default=0.3, help="its coefficient")
parser.add_argument("--subdomains", type=int, help="of the belt; the drum has half as many")
parser.add_argument("--cells", type=int, help="quadrilaterals along the belt on the drum")
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
# Lengths are in mm, forces in N for each mm of width. Belt and drum have meshes of quadrilaterals
# that do not match.

# +
comm = MPI.COMM_WORLD
R, hub, thickness, leg = 100.0, 60.0, 2.0, 60.0  # drum; belt, and its straight parts
theta, mu = np.radians(arguments.angle), arguments.friction
away = (-sin(theta), cos(theta))  # how the belt leaves the drum on the left
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, geo = gmsh.model, gmsh.model.geo


def strip(low, high, cells, across, centre=None, straight=()):
    """Quadrilaterals on grids between stations (low, high): surfaces, low and high sides, ends."""
    points = [[geo.addPoint(x, y, 0) for x, y in side] for side in (low, high)]
    cross = [geo.addLine(a, b) for a, b in zip(*points, strict=True)]
    middle = centre and geo.addPoint(*centre, 0)
    sides, surfaces = [[], []], []
    for i, count in enumerate(cells):
        j = (i + 1) % len(cross)
        for side, at in zip(sides, points, strict=True):
            arc = middle and i not in straight
            side.append(
                geo.addCircleArc(at[i], middle, at[j]) if arc else geo.addLine(at[i], at[j])
            )
            geo.mesh.setTransfiniteCurve(side[-1], count + 1)
        loop = geo.addCurveLoop([sides[0][i], cross[j], -sides[1][i], -cross[i]])
        surfaces.append(geo.addPlaneSurface([loop]))
        geo.mesh.setTransfiniteSurface(surfaces[-1])
        geo.mesh.setRecombine(2, surfaces[-1])
    for line in cross:
        geo.mesh.setTransfiniteCurve(line, across + 1)
    return surfaces, *sides, (cross[0], cross[-1])


def stations(radius):
    """Points at a distance from the axis, along the belt from right to left."""
    arc = [(radius * cos(theta * i / 4), radius * sin(theta * i / 4)) for i in range(5)]
    return [(radius, -leg), *arc, tuple(x + leg * d for x, d in zip(arc[-1], away, strict=True))]


if comm.rank == 0:
    cells = arguments.cells or (40 if arguments.quick else 80)
    long = R * theta / cells
    along = [max(1, round(leg / long)), *[max(1, round(cells / 4))] * 4, max(1, round(leg / long))]
    belt = strip(stations(R), stations(R + thickness), along, 2, (0, 0), (0, 5))
    turns = [2.0 * pi * i / 4 for i in range(4)]
    rings = [[(r * cos(turn), r * sin(turn)) for turn in turns] for r in (hub, R)]
    around, inwards = (
        max(2, round(pi / 2 * R / (1.3 * long))),
        max(2, round((R - hub) / (2 * long))),
    )
    drum = strip(*rings, [around] * 4, inwards, (0, 0))
    geo.synchronize()
    model.addPhysicalGroup(2, belt[0], name="belt")
    model.addPhysicalGroup(2, drum[0], name="drum")
    curves = {"inside": belt[1][1:-1], "right end": belt[3][:1], "left end": belt[3][1:]}
    for name, tags in {**curves, "rim": drum[2], "hub": drum[1]}.items():
        model.addPhysicalGroup(1, tags, name=name)
    model.mesh.generate(2)
# -

# Subdomains are sectors, half as many of the drum: long thin ones would bend easily, which costs
# iterations.

# +
count = arguments.subdomains or (16 if arguments.quick else 32)


def subdomain(x):
    radius, angle = np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])
    angle = np.where(angle < -0.5 * np.pi, angle + 2.0 * np.pi, angle)
    aside = np.arctan2(leg, R)
    belt = ((angle + aside) / (theta + 2 * aside) * count).astype(int)
    sectors = (count + 1) // 2
    drum = ((angle + 0.5 * np.pi) / (2.0 * np.pi) * sectors).astype(int)
    drum = count + np.clip(drum, 0, sectors - 1)
    return np.where(radius > R, np.clip(belt, 0, count - 1), drum)


decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomain)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

young, tension = {"belt": 5000.0, "drum": 2.1e5}, 5.0
elastic = tfeti.Elasticity(decomposition, E=young, nu=0.3, model="plane_stress")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, contact
#
# The left end is pulled; the right one is held along the belt, and free across it. The gap is
# given as 0: that between two polygons would not be.

rotation = fem.Function(V)
axle = fem.locate_dofs_topological(V, 1, decomposition.facets("hub"))
end = fem.locate_dofs_topological(V.sub(1), 1, decomposition.facets("right end"))
pull = fem.Constant(mesh, tension / thickness * np.array(away))
law = tfeti.Coulomb(mu)
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(pull, v) * ds(decomposition.surface("left end")),
    [fem.dirichletbc(rotation, axle), fem.dirichletbc(0.0, end, V.sub(1))],
    [tfeti.Contact("inside", "rim", secondary="inside", gap=0.0, friction=law, name="belt")],
    decomposition,
    stress=elastic.stress,
)

# ## Two load steps
#
# The tension acts in the middle of the belt and friction on its inside, so the moments about the
# axis give (R + t/2) dT = μ R T dθ. The drum turns, to the left on top, by half as much again as
# the belt stretches when all of it slips. That is by less than a hundredth of its radius, which
# small strains bear.

# +
exponent = mu * theta * R / (R + 0.5 * thickness)  # the logarithm of T₂/T₁
problem.solve()
hung = problem.solution.reaction("right end").force[1]
problem.accept()
arc, largest = theta * (R + 0.5 * thickness), np.exp(exponent)
stretch = tension * (largest * leg + (largest - 1.0) / exponent * arc) / (young["belt"] * thickness)
turn = 1.5 * stretch / R
rotation.interpolate(lambda x: turn * np.stack((-x[1], x[0])))
problem.solve()
turned = problem.solution.reaction("right end").force[1]
# -

# ## Comparison with the capstan equation
#
# `capstan` and `capstan_hung` allow for the belt's thickness, `capstan_thin` does not.

errors = problem.report.errors
errors["capstan"] = float(-turned / tension / np.exp(exponent) - 1)
errors["capstan_hung"] = float(-hung / tension / np.exp(-exponent) - 1)
errors["capstan_thin"] = float(-turned / tension / np.exp(mu * theta) - 1)

# ## Output
#
# Where the belt leaves the drum it bends back to a straight line: single nodes lift off there, and
# others are pressed harder. The capstan equation does not know of bending.

if arguments.output:
    tfeti.write_vtx(arguments.output / "belt_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    path = folder / "belt_2d.png"
    tfeti.plot_deformed(path, problem.solution, unit="MPa", factor=10.0, show_edges=False)
    tfeti.plot_pressure(
        folder / "belt_2d_pressure.png",
        problem.solution,
        lambda x: np.degrees(np.arctan2(x[1], x[0]) + 0.5 * np.pi) % 360.0 - 90.0,
        lambda angle: tension / R * np.exp(exponent * (1.0 - np.radians(angle) / theta)),
        label="angle from the held side, degrees",
        unit="MPa",
    )
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
