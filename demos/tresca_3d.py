# # A cube with Tresca's friction
#
# The 3D model of Dostál's table with Tresca's friction: a unit cube fixed on one side, pressed on
# a rough plane and pushed along it. The subdomains are equal cubes of 10 × 10 × 10 elements. Four
# of them make the half next to the fixed side, which does not slide as far: its bound is lower.
# 1024 make a body of twice the length, which slides further: its bound is higher.
#
#     ./run mpirun -n 2 python3 demos/tresca_3d.py --subdomains 64

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A cube on a rough plane, Tresca friction.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, choices=(1, 4, 8, 64, 512, 1024), default=4)
parser.add_argument("--cells", type=int, help="hexahedra along an edge of a subdomain")
parser.add_argument("--bound", type=float, help="of the tangential traction")
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
# subdomains along the axes, length along x, and bound of the tangential traction
grid, length, bound = {
    1: ((1, 1, 1), 1.0, 0.015),
    4: ((1, 2, 2), 0.5, 0.006),
    8: ((2, 2, 2), 1.0, 0.015),
    64: ((4, 4, 4), 1.0, 0.015),
    512: ((8, 8, 8), 1.0, 0.015),
    1024: ((16, 8, 8), 2.0, 0.05),
}[arguments.subdomains]
bound = arguments.bound or bound
grid, size = np.array(grid), np.array((length, 1.0, 1.0))
cells = list(grid * (arguments.cells or (4 if arguments.quick else 10)))
box = dmesh.create_box(comm, [(0, 0, 0), size], cells, dmesh.CellType.hexahedron)


def subdomain(x):
    i, j, k = np.minimum((x.T / size * grid).astype(int), grid - 1).T
    return i + grid[0] * (j + grid[1] * k)


surfaces = {
    "fixed": lambda x: np.isclose(x[0], 0),
    "bottom": lambda x: np.isclose(x[2], 0),
    "top": lambda x: np.isclose(x[2], 1),
}
decomposition = tfeti.decompose(box, subdomain, surfaces=surfaces)
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, friction
#
# The bound is a traction: the same everywhere, whatever the pressure is.

traction = fem.Constant(mesh, (0.0, -0.035, -0.05))
fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("fixed"))
plane, law = tfeti.Plane((0, 0, 0), normal=(0, 0, 1)), tfeti.Tresca(bound)
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("top")),
    [fem.dirichletbc(np.zeros(3), fixed, V)],
    [tfeti.Obstacle("bottom", plane, friction=law, reach=np.inf, name="floor")],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## The bound is kept
#
# The report has the share by which the largest tangential traction is above it.

friction = np.linalg.norm(problem.solution.contact("floor").tangential_traction, axis=1)
largest = comm.allreduce(float(friction.max(initial=0.0)), op=MPI.MAX)
problem.report.errors["bound"] = max(largest / bound - 1.0, 0.0)

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "tresca_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    looks = {"view": (-0.5, -1.0, -0.8)}
    tfeti.plot_deformed(folder / "tresca_3d.png", problem.solution, show="status", **looks)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
