# # A cube on a curved obstacle
#
# The frictionless 3D model of the benchmark tables: a unit cube of N × N × N equal subdomains,
# fixed on one side, pressed from above on a curved rigid obstacle.
#
#     ./run mpirun -n 2 python3 demos/cube_3d.py --subdomains 64

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A cube of equal subdomains on a curved obstacle.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=8, help="their number, a cube: 8, 64")
parser.add_argument("--cells", type=int, help="hexahedra along an edge of a subdomain")
parser.add_argument("--springs", type=float, default=0.0, help="in each point, that hold it softly")
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
#
# A box made in DOLFINx. The subdomains are cubes, given by a function of the cells' midpoints.

# +
comm = MPI.COMM_WORLD
N = round(arguments.subdomains ** (1 / 3))
cells = arguments.cells or (5 if arguments.quick else 10)
box = dmesh.create_box(comm, [(0, 0, 0), (1, 1, 1)], [N * cells] * 3, dmesh.CellType.hexahedron)


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

# ## Elasticity
#
# Trilinear hexahedra need quadrature of degree 2, which `Elasticity` chooses.

elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = elastic.a(u, v)
if arguments.springs:
    a += fem.Constant(mesh, arguments.springs) * ufl.dot(u, v) * ufl.dx
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Load, conditions, obstacle
#
# The obstacle lies below z = 0, by 0.02 and more. Every node of the side may touch it.

# +
traction = fem.Constant(mesh, (0.0, 0.0, -0.05))
fixed = fem.locate_dofs_topological(V, 2, decomposition.facets("fixed"))
obstacle = tfeti.SignedDistance(
    lambda x: x[2] + 0.02 + 0.1 * ((x[0] - 0.8) ** 2 + (x[1] - 0.5) ** 2),
    lambda x: np.stack((np.zeros_like(x[0]), np.zeros_like(x[0]), np.ones_like(x[0]))),
)
problem = tfeti.ContactProblem(
    a,
    ufl.dot(traction, v) * ds(decomposition.surface("top")),
    [fem.dirichletbc(np.zeros(3), fixed, V)],
    [tfeti.Obstacle("bottom", obstacle, reach=np.inf)],
    decomposition,
    stress=elastic.stress,
)
problem.solve()
# -

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "cube_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    tfeti.plot_deformed(folder / "cube_3d.png", problem.solution, factor=1.0)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
