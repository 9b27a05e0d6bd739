# # Linear elasticity, no contact
#
# A beam of two materials, clamped at one end and loaded at the other. Without contact the problem
# is solved by projected conjugate gradients with the Dirichlet preconditioner: it does not pay
# for inequalities that it does not have.
#
#     ./run mpirun -n 2 python3 demos/linear_3d.py --subdomains 32

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A beam of two materials without contact.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=16, help="their number")
parser.add_argument("--cells", type=int, help="cubes along the height of the beam")
parser.add_argument("--degree", type=int, default=1, help="of the displacement")
parser.add_argument("--ratio", type=float, default=10.0, help="modulus of the upper half")
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
# A box of tetrahedra, its upper half of another material. `decompose` makes the subdomains.

comm = MPI.COMM_WORLD
n = arguments.cells or (4 if arguments.quick else 12)
box = dmesh.create_box(comm, [(0, 0, 0), (4, 1, 1)], [4 * n, n, n])
surfaces = {"clamped": lambda x: np.isclose(x[0], 0), "loaded": lambda x: np.isclose(x[0], 4)}
volumes = {"lower": lambda x: x[2] < 0.5 + 1e-9, "upper": lambda x: x[2] > 0.5 - 1e-9}
decomposition = tfeti.decompose(box, arguments.subdomains, surfaces=surfaces, volumes=volumes)
mesh = decomposition.mesh

# ## Elasticity
#
# Young's modulus by the names of the volumes.

young = {"lower": 1.0, "upper": arguments.ratio}
elastic = tfeti.Elasticity(decomposition, E=young, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", arguments.degree, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
a = elastic.a(u, v)
if arguments.springs:
    a += fem.Constant(mesh, arguments.springs) * ufl.dot(u, v) * ufl.dx
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)
clamped = fem.locate_dofs_topological(V, 2, decomposition.facets("clamped"))
problem = tfeti.ContactProblem(
    a,
    ufl.dot(fem.Constant(mesh, (0.0, 0.0, -1e-3)), v) * ds(decomposition.surface("loaded")),
    [fem.dirichletbc(np.zeros(3), clamped, V)],
    [],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "linear_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    tfeti.plot_deformed(folder / "linear_3d.png", problem.solution)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
