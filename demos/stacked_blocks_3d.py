# # Stacked blocks
#
# A base, two blocks on it, and a beam across them: four bodies with meshes of hexahedra that do
# not match. Only the base is fixed. Contact alone holds the others, in z; nothing resists that
# they slide and turn on their flat sides, and no load drives them to: these are free motions.
#
#     ./run mpirun -n 2 python3 demos/stacked_blocks_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Four stacked blocks under a load, three of them held by contact alone."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=16, help="their number")
parser.add_argument("--cells", type=int, help="hexahedra along an edge of a block, about")
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
# Lowest corner, edge lengths and cells of each block.

# +
comm = MPI.COMM_WORLD
n = arguments.cells or (4 if arguments.quick else 12)
blocks = {
    "base": ((0.0, 0.0, 0.0), (2.0, 1.0, 0.5), (2 * n, n, n // 2)),
    "left": ((0.1, 0.1, 0.5), (0.7, 0.8, 0.8), (n, n + 1, n)),
    "right": ((1.2, 0.1, 0.5), (0.7, 0.8, 0.8), (n - 1, n - 1, n - 1)),
    "beam": ((0.0, 0.2, 1.3), (2.0, 0.6, 0.4), (3 * n, n, n // 2)),
}

gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model = gmsh.model
for name, (low, size, cells) in blocks.items() if comm.rank == 0 else ():
    volume = model.occ.addBox(*low, *size)
    model.occ.synchronize()
    faces = [tag for _, tag in model.getBoundary([(3, volume)], oriented=False)]
    for face in faces:
        for _, edge in model.getBoundary([(2, face)], oriented=False):
            box = np.array(model.getBoundingBox(1, edge))
            model.mesh.setTransfiniteCurve(edge, cells[np.argmax(box[3:] - box[:3])] + 1)
        model.mesh.setTransfiniteSurface(face)
        model.mesh.setRecombine(2, face)
    model.mesh.setTransfiniteVolume(volume)
    model.addPhysicalGroup(3, [volume], name=name)
    for side, z in (("bottom", low[2]), ("top", low[2] + size[2])):
        level = [face for face in faces if abs(model.occ.getCenterOfMass(2, face)[2] - z) < 1e-9]
        model.addPhysicalGroup(2, level, name=f"{name} {side}")
if comm.rank == 0:
    model.mesh.generate(3)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, arguments.subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=1.0, nu=0.3)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
degree = {"quadrature_degree": 2}
dx = ufl.Measure("dx", domain=mesh, subdomain_data=decomposition.cell_tags, metadata=degree)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags, metadata=degree)

# ## Load and contacts
#
# The weight of all blocks, and a pressure on the beam that is larger in the middle.

x = ufl.SpatialCoordinate(mesh)
weight = fem.Constant(mesh, (0.0, 0.0, -0.002))
pressure = 0.02 * x[0] * (2 - x[0])
top = ds(decomposition.surface("beam top"))
base = fem.locate_dofs_topological(V, 2, decomposition.facets("base bottom"))
pairs = [("left bottom", "base top"), ("right bottom", "base top")]
pairs += [("left top", "beam bottom"), ("right top", "beam bottom")]
problem = tfeti.ContactProblem(
    elastic.a(u, v),
    ufl.dot(weight, v) * dx - pressure * v[2] * top,
    [fem.dirichletbc(np.zeros(3), base, V)],
    [tfeti.Contact(*pair, secondary=pair[0], reach=0.05) for pair in pairs],
    decomposition,
    stress=elastic.stress,
)
problem.solve()

# ## Balance
#
# The base bears the pressure and the weight of what stands on it.

carried = tuple(decomposition.volume(name) for name in ("left", "right", "beam"))
load = fem.assemble_scalar(fem.form(pressure * top - weight[2] * dx(carried)))
force = sum(problem.solution.contact(i).resultant.force[2] for i in (0, 1))
problem.report.errors["force_base"] = float(force / comm.allreduce(load) - 1)

# ## Output

if arguments.output:
    tfeti.write_vtx(arguments.output / "stacked_blocks_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    looks = {"view": (-0.6, -1.5, 0.6), "highest": 0.05}
    tfeti.plot_deformed(folder / "stacked_blocks_3d.png", problem.solution, **looks)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
