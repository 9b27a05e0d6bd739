# # A mesh that finds the contact
#
# The half cylinder of `hertz_2d.py`, without knowing where and how wide the contact is: from a
# coarse uniform mesh on, each solve says how large the elements of the next one should be.
#
#     ./run mpirun -n 2 python3 demos/adaptive_2d.py --error 0.05

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(description="A half cylinder on meshes that follow the error.")
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, default=8, help="subdomains")
parser.add_argument("--error", type=float, help="relative discretisation error in energy")
parser.add_argument("--plot", action="store_true", help="draw pictures in results/, or in DIR")
parser.add_argument("--output", type=Path, metavar="DIR", help="folder for fields")
parser.add_argument("--report", type=Path, metavar="FILE", help="write the report as JSON")
arguments, rest = parser.parse_known_args()
petsc4py.init([sys.argv[0], *rest])  # before DOLFINx: so PETSc's options reach the solver

import gmsh
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import entities_to_geometry
from mpi4py import MPI

import tfeti_dolfinx as tfeti

# -

# ## Data and closed form
#
# The closed form says which load; nothing else is taken from it.

# +
comm = MPI.COMM_WORLD
R, E, nu, a = 1.0, 1.0, 0.3, 0.04
load = np.pi * E / (1 - nu**2) * a**2 / (4 * R)
p0 = 2 * load / (np.pi * a)


def hertz(x):
    return p0 * np.sqrt(np.maximum(1 - (x / a) ** 2, 0.0))


# -

# ## Meshes
#
# gmsh makes them on rank 0, a coarse uniform one at first, then from the sizes that the last
# estimate wants.


# +
def half_cylinder(sizes):
    model, geo = gmsh.model, gmsh.model.geo
    model.add("half_cylinder")
    lowest, centre = geo.addPoint(0, 0, 0), geo.addPoint(0, R, 0)
    right, left = geo.addPoint(R, R, 0), geo.addPoint(-R, R, 0)
    axis = geo.addLine(lowest, centre)
    arcs = [geo.addCircleArc(lowest, centre, right), geo.addCircleArc(left, centre, lowest)]
    top = [geo.addLine(right, centre), geo.addLine(centre, left)]
    loops = [[arcs[0], top[0], -axis], [axis, top[1], arcs[1]]]
    halves = [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops]
    geo.synchronize()
    model.addPhysicalGroup(2, halves, name="body")
    for name, curves in (("contact", arcs), ("top", top), ("axis", [axis])):
        model.addPhysicalGroup(1, curves, name=name)
    if sizes is None:
        size = model.mesh.field.add("MathEval")
        model.mesh.field.setString(size, "F", f"{0.1 * R}")
    else:
        corners, h = sizes
        view, count = gmsh.view.add("sizes"), h.shape[1]
        table = np.concatenate((np.swapaxes(corners, 1, 2).reshape(-1, 3 * count), h), axis=1)
        gmsh.view.addListData(view, {3: "ST", 4: "SS"}[count], len(table), table.ravel())
        size = model.mesh.field.add("PostView")
        model.mesh.field.setNumber(size, "ViewTag", view)
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(2)
    return model


def new_sizes(solution, wanted):
    """Corners of all simplices, and the sizes that they ask of the next mesh, on rank 0.

    In d dimensions the square of the error of an element of size h is about C h^(d+2), and the
    fewest elements have equal errors √c: h' = h (c/η²)^(1/(d+2)), and all of them add up to wanted²
    for c^(2/(d+2)) = wanted²/Σ(η²)^(d/(d+2)). A coarse mesh says little of where a fine one should
    be: an element becomes at most four times smaller or twice as large at once.
    """
    field, mesh = solution.discretisation_error, solution.decomposition.mesh
    d, count = mesh.topology.dim, mesh.topology.index_map(mesh.topology.dim).size_local
    square = field.x.array[np.asarray(field.function_space.dofmap.list)[:count, 0]] ** 2
    cells = np.arange(count, dtype=np.int32)
    none = np.empty((0, d + 1), dtype=np.int32)  # DOLFINx divides by their number
    corners = mesh.geometry.x[entities_to_geometry(mesh, d, cells) if count else none]
    h = np.abs(np.linalg.det(corners[:, 1:, :d] - corners[:, :1, :d])) ** (1 / d)
    root = wanted**2 / comm.allreduce(float(np.sum(square ** (d / (d + 2)))))
    factor = np.sqrt(root) / np.maximum(square, 1e-300) ** (1 / (d + 2))
    size = h * np.clip(factor, 1 / 4, 2)
    parts = comm.gather((corners, np.repeat(size[:, None], d + 1, axis=1)), root=0)
    return None if parts is None else [np.concatenate(part) for part in zip(*parts, strict=True)]


# -

# ## Elasticity, load and contact
#
# As in `hertz_2d.py`.


# +
def contact_problem(decomposition):
    elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=decomposition.mesh, subdomain_data=decomposition.facet_tags)
    traction = fem.Constant(decomposition.mesh, (0.0, -load / (2 * R)))
    axis = fem.locate_dofs_topological(V.sub(0), 1, decomposition.facets("axis"))
    return tfeti.ContactProblem(
        elastic.a(u, v),
        ufl.dot(traction, v) * ds(decomposition.surface("top")),
        [fem.dirichletbc(0.0, axis, V.sub(0))],
        [tfeti.Obstacle("contact", tfeti.Plane((0, 0), normal=(0, 1)))],
        decomposition,
        stress=elastic.stress,
        petsc_options={"tfeti_rtol": "auto"},
    )


gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
# -

# ## Solve, estimate, mesh anew
#
# The error of all is halved at once. A mesh is coarser than what gmsh was asked for: so much more
# is asked for the last one.

# +
goal, sizes, asked = arguments.error or (0.2 if arguments.quick else 0.05), None, np.inf
while True:
    decomposition = tfeti.read_gmsh(
        half_cylinder(sizes) if comm.rank == 0 else None, comm, arguments.subdomains
    )
    problem = contact_problem(decomposition)
    problem.solve()
    found = problem.estimate()
    if comm.rank == 0:
        unknowns = problem.report.primal_dofs
        print(f"{unknowns} unknowns, error {found.relative_discretisation:.2%}", flush=True)
    if found.relative_discretisation <= goal:
        break
    missed = min(max(1.0, found.discretisation / asked), 1.25)
    asked = max(0.5 * found.discretisation, 0.95 * goal * found.energy / missed)
    sizes = new_sizes(problem.solution, asked)
    problem.destroy()
# -

gmsh.finalize()

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
    tfeti.write_vtx(arguments.output / "adaptive_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    view = {"focus": (0.0, 4 * a, 0.0), "zoom": 0.14 * R / a, "show_edges": True}
    tfeti.plot_deformed(folder / "adaptive_2d.png", problem.solution, factor=1.0, **view)
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
