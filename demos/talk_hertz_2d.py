# # Two elastic bodies of equal subdomains in contact
#
# The Hertz table of Dostál's talk, in plane strain: a body with a curved lower side is pressed
# on a block. Both are squares of N × N subdomains, and a subdomain has 100 × 100 nodes.
#
#     ./run mpirun -n 2 python3 demos/talk_hertz_2d.py --subdomains 32

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Hertz contact of two squares of equal subdomains in 2D."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=2, help="twice a square: 2, 32, 512")
parser.add_argument("--cells", type=int, help="quadrilaterals along an edge of a subdomain")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Mesh
#
# Each rank makes a share of two flat unit squares, around y = 0.5 and y = 2.5. Surfaces and
# subdomains are found on these, which are then bent. `decompose` moves the cells to their ranks.

# +
comm = MPI.COMM_WORLD
N = round((arguments.subdomains / 2) ** 0.5)
n = N * (arguments.cells or (12 if arguments.quick else 99))
R, E, nu, a = 2.0, 1.0, 0.3, 0.15


def share(shape):
    """Indices of this rank's share of a grid's entries."""
    size = np.prod(shape)
    own = np.arange(size * comm.rank // comm.size, size * (comm.rank + 1) // comm.size)
    return np.unravel_index(own, shape)


body, row, column = share((2, n, n))
first = column + (n + 1) * (row + (n + 1) * body)
cells = np.stack((first, first + 1, first + n + 1, first + n + 2), axis=1)
body, row, column = share((2, n + 1, n + 1))
points = np.stack((column / n - 0.5, row / n + 2 * body), axis=1)
element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
squares = dmesh.create_mesh(comm, cells=cells, x=points, e=element)
sides = ("lower bottom", "lower top", "upper bottom", "upper top")
facets = [
    dmesh.locate_entities_boundary(squares, 1, lambda x, y=y: np.isclose(x[1], y)) for y in range(4)
]
tags = np.repeat(np.arange(1, 5, dtype=np.int32), [len(side) for side in facets])
order = np.argsort(np.concatenate(facets))
facet_tags = dmesh.meshtags(squares, 1, np.concatenate(facets)[order], tags[order])
own = np.arange(squares.topology.index_map(2).size_local, dtype=np.int32)
x, y, _ = dmesh.compute_midpoints(squares, 2, own).T
subdomains = ((x + 0.5) * N).astype(int) + N * (y * N).astype(int)

x, y, _ = squares.geometry.x.T  # views: the lower side of the upper body becomes y = x²/2R
upper = y > 1.5
y -= np.where(upper, 2, 1)
y[upper] += (1 - y[upper]) * x[upper] ** 2 / (2 * R)
names = {name: tag for tag, name in enumerate(sides, 1)}
decomposition = tfeti.decompose(squares, subdomains, facet_tags=facet_tags, surfaces=names)
mesh = decomposition.mesh
# -

# ## Elasticity in plane strain
#
# Its stress is a 3×3 tensor, so that σ_zz is in von Mises' stress.

elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, contact
#
# The load on the top is the one that presses half planes together over the half width a. The
# top stays on its place in x; in y the contact alone holds the upper body.

# +
load = np.pi * E / (1 - nu**2) / 2 * a**2 / (4 * R)
p0 = 2 * load / (np.pi * a)


def hertz(x):
    return p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0.0))


traction = fem.Constant(mesh, (0.0, -load))
fixed = fem.locate_dofs_topological(V, 1, decomposition.facets("lower bottom"))
guided = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("upper top"))
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("upper top")),
    [fem.dirichletbc(np.zeros(2), fixed, V), fem.dirichletbc(0.0, guided, V.sub(0))],
    [tfeti.Contact("upper bottom", "lower top", secondary="upper bottom", reach=a / 3)],
    decomposition,
    stress=elastic.stress,
)
problem.solve()
# -

# ## Comparison with the closed form
#
# The squared pressures lie on a line, p² = p₀² − (p₀/a)² x², which is fitted where p > 0.3 p₀: the
# outermost touching node would give a only up to the element size.

# +
contact = problem.solution.contact()
x = contact.points[:, 0]
x, p, area = (np.concatenate(comm.allgather(part)) for part in (x, contact.pressure, contact.area))
slope, constant = np.polyfit(x[p > 0.3 * p0] ** 2, p[p > 0.3 * p0] ** 2, 1)
area *= np.abs(x) < 0.9 * a  # the edge apart
errors = problem.report.errors
errors["half_width"] = float(np.sqrt(-constant / slope) / a - 1)
errors["peak_pressure"] = float(np.sqrt(constant) / p0 - 1)
errors["force"] = float(abs(contact.resultant.force[-1]) / load - 1)
errors["pressure_l2"] = float(np.sqrt(area @ (p - hertz(x)) ** 2 / (area @ hertz(x) ** 2)))
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "talk_hertz_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    view = {"focus": (0.0, -0.15, 0.0), "zoom": 0.9, "show_edges": False}
    tfeti.plot_deformed(folder / "talk_hertz_2d.png", problem.solution, factor=1.0, **view)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
