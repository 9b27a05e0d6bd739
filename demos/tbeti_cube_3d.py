# # A cube of boundary elements on a curved obstacle
#
# The model of `cube_3d.py` with boundary elements in all subdomains, each a cube of 9 × 9 × 9
# cells: 1464 unknowns on its surface, as in Dostál's table of Total BETI. Boundary elements read
# their moduli from the bilinear form, and the mesh inside serves for pictures alone.
#
#     ./run mpirun -n 2 python3 demos/tbeti_cube_3d.py --subdomains 64

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Boundary elements: a cube of equal subdomains on a curved obstacle."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=8, help="their number: 8, 64, 216")
parser.add_argument("--cells", type=int, help="hexahedra along an edge of a subdomain")
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
N = round(arguments.subdomains ** (1 / 3))
n = N * (arguments.cells or (3 if arguments.quick else 9))
box = dmesh.create_box(comm, [(0, 0, 0), (1, 1, 1)], [n, n, n], dmesh.CellType.hexahedron)


def subdomain(x):
    i, j, k = np.minimum((x * N).astype(int), N - 1)
    return i + N * j + N * N * k


surfaces = {
    "fixed": lambda x: np.isclose(x[0], 0),
    "bottom": lambda x: np.isclose(x[2], 0),
    "top": lambda x: np.isclose(x[2], 1),
}
decomposition = tfeti.decompose(box, subdomain, surfaces=surfaces)
mesh = decomposition.mesh
# -

# ## Forms, load, obstacle
#
# Those of finite elements.

# +
elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)
traction = fem.Constant(mesh, (0.0, 0.0, -0.05))
fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("fixed"))
obstacle = tfeti.SignedDistance(
    lambda x: x[2] + 0.02 + 0.1 * ((x[0] - 0.8) ** 2 + (x[1] - 0.5) ** 2),
    lambda x: np.stack((np.zeros_like(x[0]), np.zeros_like(x[0]), np.ones_like(x[0]))),
)
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(traction, v) * ds(decomposition.surface("top")),
    [fem.dirichletbc(np.zeros(3), fixed, V)],
    [tfeti.Obstacle("bottom", obstacle, reach=np.inf)],
    decomposition,
    stress=elastic.stress,
    boundary_elements=tfeti.BoundaryElements(),
)
problem.solve()
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "tbeti_cube_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    tfeti.plot_deformed(folder / "tbeti_cube_3d.png", problem.solution, factor=1.0)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
