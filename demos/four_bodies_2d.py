# # Four bodies with Tresca's friction
#
# A wedge is driven between two blocks that stand on a base: four bodies in eight subdomains, four
# contacts with Tresca's friction. Contact alone holds the wedge. Dostál's talk has a model of four
# bodies, 67 330 unknowns and 8 subdomains, and does not say what it looks like.
#
#     ./run mpirun -n 2 python3 demos/four_bodies_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A wedge between two blocks on a base: four bodies, Tresca friction."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--cells", type=int, help="quadrilaterals along a side of a subdomain")
parser.add_argument("--bound", type=float, default=0.008, help="of the tangential traction")
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
# Each body is two pieces of quadrilaterals. No meshes match where bodies meet.

# +
comm = MPI.COMM_WORLD
cells = arguments.cells or (12 if arguments.quick else 64)
fewer = max(2, round(0.95 * cells))
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, geo = gmsh.model, gmsh.model.geo


def strip(low, high, cells, across):
    """Quadrilaterals on grids between stations (low, high): surfaces, low and high sides, ends."""
    points = [[geo.addPoint(x, y, 0) for x, y in side] for side in (low, high)]
    cross = [geo.addLine(a, b) for a, b in zip(*points, strict=True)]
    sides, surfaces = [[], []], []
    for i, count in enumerate(cells):
        for side, at in zip(sides, points, strict=True):
            side.append(geo.addLine(at[i], at[i + 1]))
            geo.mesh.setTransfiniteCurve(side[-1], count + 1)
        loop = geo.addCurveLoop([sides[0][i], cross[i + 1], -sides[1][i], -cross[i]])
        surfaces.append(geo.addPlaneSurface([loop]))
        geo.mesh.setTransfiniteSurface(surfaces[-1])
        geo.mesh.setRecombine(2, surfaces[-1])
    for line in cross:
        geo.mesh.setTransfiniteCurve(line, across + 1)
    return surfaces, *sides, cross


if comm.rank == 0:
    low, high = [(-1.6, 0.0), (-1.6, 0.8), (-1.6, 1.6)], [(-0.4, 0.0), (-0.6, 0.8), (-0.8, 1.6)]
    mirrored = [[(-x, y) for x, y in side] for side in (low, high)]
    base = strip(
        [(x, -1.0) for x in (-2, 0, 2)], [(x, 0.0) for x in (-2, 0, 2)], [cells] * 2, cells
    )
    left = strip(low, high, [fewer] * 2, fewer)
    right = strip(*mirrored, [fewer] * 2, fewer)
    sides = [[(side * x, y) for x, y in ((0.55, 0.6), (0.7, 1.2), (0.85, 1.8))] for side in (-1, 1)]
    wedge = strip(*sides, [cells] * 2, cells)
    geo.synchronize()
    curves = {"base bottom": base[1], "base top": base[2]}
    curves |= {"left wall": left[1], "right wall": right[1]}
    curves |= {"left bottom": left[3][:1], "right bottom": right[3][:1]}
    curves |= {"left side": left[2], "right side": right[2]}
    curves |= {"wedge left": wedge[1], "wedge right": wedge[2], "wedge top": wedge[3][-1:]}
    for name, body in {"base": base, "left": left, "right": right, "wedge": wedge}.items():
        model.addPhysicalGroup(2, body[0], name=name)
    for name, tags in curves.items():
        model.addPhysicalGroup(1, tags, name=name)
    model.mesh.generate(2)


def subdomain(x):
    """Two of each body: left and right halves of the base, else lower and upper ones."""
    base = x[1] < 0.0
    wedge = np.abs(x[0]) < 0.4 + 0.25 * x[1]
    body = np.where(base, 0, np.where(wedge, 1, np.where(x[0] < 0.0, 2, 3)))
    upper = x[1] > np.where(wedge, 1.2, 0.8)
    return 2 * body + np.where(base, x[0] > 0.0, upper)


decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomain)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, contact
#
# The wedge is pressed down, the base fixed, and the blocks stand between walls on which they
# may slide.

# +
pressure, top = 0.01, ds(decomposition.surface("wedge top"))
bottom = fem.locate_dofs_topological(V, 1, decomposition.facets("base bottom"))
bcs = [fem.dirichletbc(np.zeros(2), bottom, V)]
for name in ("left wall", "right wall"):
    wall = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets(name))
    bcs.append(fem.dirichletbc(0.0, wall, V.sub(0)))
pairs = {"wedge left": "left side", "wedge right": "right side"}
pairs |= {"left bottom": "base top", "right bottom": "base top"}
law = tfeti.Tresca(arguments.bound)
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    -pressure * v[1] * top,
    bcs,
    [tfeti.Contact(*p, secondary=p[0], friction=law, reach=0.05, name=p[0]) for p in pairs.items()],
    decomposition,
    stress=elastic.stress,
)
problem.solve()
# -

# ## Balance
#
# The sides of the wedge bear the load, and the base bears it through the blocks.

width = comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(mesh, 1.0) * top)))
up = [problem.solution.contact(name).resultant.force[1] for name in pairs]
problem.report.errors["force_wedge"] = float((up[0] + up[1]) / (pressure * width) - 1)
problem.report.errors["force_base"] = float((up[2] + up[3]) / (pressure * width) - 1)

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "four_bodies_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    path = folder / "four_bodies_2d.png"
    tfeti.plot_deformed(path, problem.solution, factor=1.0, show_edges=False, highest=0.03)
    path = folder / "four_bodies_2d_friction.png"
    tfeti.plot_friction(path, problem.solution, list(pairs), normal=True)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
