# # A body held only by contact
#
# A block lies in a corner of two rigid planes. No Dirichlet condition holds it: the load presses
# it into the corner, and contact alone finds the balance. Without the wall (`--no-wall`) it could
# slide along the floor; as long as no load drives it that way, the problem is solved and the
# motion reported as free.
#
#     ./run mpirun -n 2 python3 demos/semicoercive_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="A block in a corner of two rigid planes, held only by contact."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=16, help="their number")
parser.add_argument("--cells", type=int, help="cells along an edge of the block")
parser.add_argument("--no-wall", action="store_true", help="let the block slide freely")
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

comm = MPI.COMM_WORLD
n = arguments.cells or (16 if arguments.quick else 64)
square = dmesh.create_rectangle(comm, [(0, 0), (1, 1)], [n, n], dmesh.CellType.quadrilateral)
surfaces = {
    "wall": lambda x: np.isclose(x[0], 0),
    "floor": lambda x: np.isclose(x[1], 0),
    "top": lambda x: np.isclose(x[1], 1),
}
decomposition = tfeti.decompose(square, arguments.subdomains, surfaces=surfaces)
mesh = decomposition.mesh

# ## Elasticity in plane strain

elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2})
exact = {"quadrature_degree": 3}
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=exact)
top = ds(decomposition.surface("top"))

# ## Load and contacts
#
# Gravity, and a traction on the left part of the top, with a push towards the wall if there is
# one. The resultant is so far to the left that the block lifts off the floor on the right.
# Wall and floor are a small gap away: the block first has to get there.

push = 0.0 if arguments.no_wall else -0.003
x = ufl.SpatialCoordinate(mesh)
gravity = fem.Constant(mesh, (0.0, -0.003))
traction = ufl.as_vector((push, -0.045 * ufl.max_value(1 - 3 * x[0], 0)))
contacts = [tfeti.Obstacle("floor", tfeti.Plane((0, -0.01), normal=(0, 1)), name="floor")]
if not arguments.no_wall:
    contacts += [tfeti.Obstacle("wall", tfeti.Plane((-0.01, 0), normal=(1, 0)), name="wall")]
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(gravity, v) * dx + ufl.dot(traction, v) * top,
    [],
    contacts,
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## Balance
#
# Each contact carries the load that points at it.

down = comm.allreduce(fem.assemble_scalar(fem.form(traction[1] * top)))
force = problem.solution.contact("floor").resultant.force
problem.report.errors["force_floor"] = float(force[1] / (0.003 - down) - 1)
if not arguments.no_wall:
    force = problem.solution.contact("wall").resultant.force
    problem.report.errors["force_wall"] = float(force[0] / -push - 1)

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "semicoercive_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    tfeti.plot_deformed(folder / "semicoercive_2d.png", problem.solution, factor=1.0)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
