# # A square with Tresca's friction
#
# The 2D model of Dostál's table with Tresca's friction: a unit square fixed on one side, pressed
# on a rough line and pulled along it. The subdomains are equal squares of 50 × 50 elements.
#
#     ./run mpirun -n 2 python3 demos/tresca_2d.py --subdomains 16

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A square on a rough line, Tresca friction.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=16, help="their number, a square")
parser.add_argument("--cells", type=int, help="quadrilaterals along an edge of a subdomain")
parser.add_argument("--bound", type=float, default=0.006, help="of the tangential traction")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Mesh

# +
comm = MPI.COMM_WORLD
N = round(arguments.subdomains**0.5)
n = N * (arguments.cells or (8 if arguments.quick else 50))
square = dmesh.create_rectangle(comm, [(0, 0), (1, 1)], [n, n], dmesh.CellType.quadrilateral)


def subdomain(x):
    i, j = np.minimum((x[:2] * N).astype(int), N - 1)
    return i + N * j


surfaces = {
    "fixed": lambda x: np.isclose(x[0], 0),
    "bottom": lambda x: np.isclose(x[1], 0),
    "top": lambda x: np.isclose(x[1], 1),
}
decomposition = tfeti.decompose(square, subdomain, surfaces=surfaces)
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, friction
#
# The bound is a traction: the same everywhere, whatever the pressure is.

traction = fem.Constant(mesh, (0.05, -0.05))
fixed = fem.locate_dofs_topological(V, 1, decomposition.facets("fixed"))
line, law = tfeti.Plane((0, 0), normal=(0, 1)), tfeti.Tresca(arguments.bound)
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("top")),
    [fem.dirichletbc(np.zeros(2), fixed, V)],
    [tfeti.Obstacle("bottom", line, friction=law, reach=np.inf, name="floor")],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## The bound is kept
#
# The report has the share by which the largest tangential traction is above it.

friction = problem.solution.contact("floor").tangential_traction
largest = comm.allreduce(float(np.abs(friction).max(initial=0.0)), op=MPI.MAX)
problem.report.errors["bound"] = max(largest / arguments.bound - 1.0, 0.0)

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "tresca_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    tfeti.plot_deformed(folder / "tresca_2d.png", problem.solution, factor=1.0)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
