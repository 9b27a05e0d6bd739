# # Partial slip of a line contact
#
# Two equal elastic bodies in plane strain are pressed together, then pushed along each other in
# load steps. By Coulomb's law the contact slips from its edges on, and sticks on |x| < c. Contact
# half width a, stick half width c and friction are compared with the closed form of
# Cattaneo and Mindlin, c = a√(1 − Q/(μP)).
#
#     ./run mpirun -n 2 python3 demos/cattaneo_mindlin_2d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Partial slip of a line contact: Coulomb's friction and Cattaneo's closed form."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--refine", type=int, default=0, help="how often elements are halved")
parser.add_argument("--steps", type=int, help="load steps of Q, up to 0.8 μP")
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
# Two rectangles that are mirror images, at first flat on each other: so pressing alone makes no
# friction. A refinement halves the elements.

# +
comm = MPI.COMM_WORLD
R, L, E, nu, mu, a = 1.0, 1.0, 1.0, 0.3, 0.3, 0.04
fine = (0.1 if arguments.quick else 0.05) * a / 2**arguments.refine
growth = (0.3 if arguments.quick else 0.2) / 2**arguments.refine
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
model, geo = gmsh.model, gmsh.model.geo


def mirror(axis):
    """Add the mirror image of a mesh, a body of its own; its tags by dimension and tag."""
    mesh, images = model.mesh, {}
    node, element = mesh.getMaxNodeTag(), mesh.getMaxElementTag()
    flip = [-1.0 if k == axis else 1.0 for k in range(3)]
    meshed = [(e, mesh.getNodes(*e)[:2], mesh.getElements(*e)) for e in model.getEntities()]
    for (dim, tag), (nodes, x), _ in meshed:
        images[dim, tag] = model.addDiscreteEntity(dim)
        mesh.addNodes(dim, images[dim, tag], nodes + node, (x.reshape(-1, 3) * flip).ravel())
    for entity, _, (kinds, tags, corners) in meshed:
        for kind, of_kind, nodes in zip(kinds, tags, corners, strict=True):
            table = nodes.reshape(len(of_kind), -1) + node
            # the first two change places, so that cells stay right-handed
            order = [1, 0, *range(2, table.shape[1])] if entity[0] > 1 else slice(None)
            mesh.addElementsByType(images[entity], kind, of_kind + element, table[:, order].ravel())
    return images


if comm.rank == 0:
    near, far = ([geo.addPoint(x, y, 0) for x in (-L, 0, L)] for y in (0, L))
    left, axis, right = (geo.addLine(*ends) for ends in zip(near, far, strict=True))
    # from the middle on, so that elements of both halves are of the same sizes
    face, top = ([geo.addLine(side[1], side[k]) for k in (0, 2)] for side in (near, far))
    loops = [[face[k], up, -top[k], -axis] for k, up in enumerate((left, right))]
    halves = [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops]
    geo.synchronize()
    beyond = f"(sqrt(x^2+y^2)-{1.3 * a})"
    size = model.mesh.field.add("MathEval")
    model.mesh.field.setString(size, "F", f"{fine}+{growth}*0.5*({beyond}+fabs({beyond}))")
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(2)
    image = mirror(axis=1)
    model.addPhysicalGroup(2, halves, name="upper")
    model.addPhysicalGroup(2, [image[2, tag] for tag in halves], name="lower")
    for upper, lower, curves in (("upper face", "lower face", face), ("top", "bottom", top)):
        model.addPhysicalGroup(1, curves, name=upper)
        model.addPhysicalGroup(1, [image[1, tag] for tag in curves], name=lower)
subdomains = arguments.subdomains or (2 if arguments.quick else 8)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity in plane strain

elastic = tfeti.Elasticity(decomposition, E=E, nu=nu, model="plane_strain")
V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Loads and conditions
#
# P is a uniform pressure on both flat sides. Q is a uniform traction on them, along x above and
# against it below, with a pressure linear in x that takes its moment: each body is in balance.
# What holds the lower one, two points, carries nothing; contact and friction alone hold the upper
# one.

# +
top, bottom = (ds(decomposition.surface(name)) for name in ("top", "bottom"))
area, moment, X = 2 * L, 2 * L**3 / 3, ufl.SpatialCoordinate(mesh)


def loads(P, Q, w):
    side = Q / area * w[0] - P / area * w[1]
    return side * top - side * bottom + Q * L / moment * X[0] * w[1] * (top + bottom)


middle = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], 0))
vertical = (V.sub(1), V.sub(1).collapse()[0])
corner, _ = fem.locate_dofs_geometrical(
    vertical, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], L)
)
bcs = [fem.dirichletbc(np.zeros(2), middle, V), fem.dirichletbc(0.0, corner, V.sub(1))]
# -

# ## Contact with friction
#
# The bodies' shape is in the gap, x²/(2R), as in Hertz's theory: the normals of curved meshes
# would differ by x/R, and with them pressing alone would make some friction.

P, Q = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
contact = tfeti.Contact(
    "upper face",
    "lower face",
    secondary="upper face",
    gap=lambda x: x[0] ** 2 / (2 * R),
    friction=tfeti.Coulomb(mu),
    reach=1.3 * a**2 / R,
    name="contact",
)
problem = tfeti.ContactProblem(
    elastic.a(u, v), loads(P, Q, v), bcs, [contact], decomposition, stress=elastic.stress
)

# ## Closed form
#
# Hertz's pressure, and friction, which is μp less what a contact of half width c would have.

# +
load = np.pi * E / (1 - nu**2) / 2 * a**2 / (4 * R)
p0 = 2 * load / (np.pi * a)


def ellipse(r, b):
    return np.sqrt(np.maximum(1 - (r / b) ** 2, 0.0))


def stick(share):
    """Half width c of what sticks under Q, a share of μP."""
    return a * (1 - share) ** (1 / 2)


def friction(r, share):
    c = stick(share)
    return mu * p0 * (ellipse(r, a) - c / a * ellipse(r, c))


def half_width(r, force):
    """That of a pressure of Hertz's, by its second moment."""
    return float(np.sqrt(4 * (force @ r**2) / np.sum(force)))


# -

# ## P first, then Q in steps
#
# μp − |q| is a pressure of Hertz's on |x| < c: its second moment gives c, where nodes would give it
# up to the size of an element.

# +
errors, curves = {}, {}


def note(name, value):
    """Keep the worst of all steps."""
    errors[name] = float(max(errors.get(name, 0.0), value, key=abs))


steps = arguments.steps or (2 if arguments.quick else 4)
for share in 0.8 * np.arange(steps + 1) / steps:
    P.value, Q.value = load, share * mu * load
    problem.solve()
    problem.accept()
    contact = problem.solution.contact()
    parts = (contact.points[:, 0], contact.pressure, contact.area, contact.status)
    parts += (
        -contact.tangential_traction[:, 0],
        np.linalg.norm(contact.tangential_traction, axis=1),
    )
    x, p, area, status, q, size = (np.concatenate(comm.allgather(part)) for part in parts)
    r = np.abs(x)
    bound = np.where(status == tfeti.ContactStatus.SLIP, mu * p, np.minimum(size, mu * p))
    note("law", np.abs(size - bound).max() / (mu * p.max()))
    if share == 0.0:
        note("half_width", half_width(r, area * p) / a - 1)
        note("force", area @ p / load - 1)
        note("friction_without_force", size.max() / (mu * p0))
        continue
    c, exact = half_width(r, area * (mu * p - size)), friction(r, share)
    note("stick_half_width", c / stick(share) - 1)
    note("friction_force", area @ q / Q.value - 1)
    note("traction_l2", np.sqrt(area @ (q - exact) ** 2 / (area @ (mu * p) ** 2)))
    curves[share] = (x, q)
    if comm.rank == 0:
        report = problem.report
        print(f"Q = {share:.2f} μP: c/a {c / a:.4f}, closed form {stick(share) / a:.4f};", end=" ")
        print(f"{report.F_multiplications} iterations", flush=True)
problem.report.errors.update(errors)
# -

# ## Output

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "cattaneo_mindlin_2d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 0.3 * L / a, "show_edges": False}
    tfeti.plot_deformed(folder / "cattaneo_mindlin_2d.png", problem.solution, **zoom)
    if comm.rank == 0:
        from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        axes, fine = figure.subplots(), np.linspace(-1.2 * a, 1.2 * a, 961)
        for share, (at, q) in curves.items():
            near = np.abs(at) < 1.2 * a
            label = f"Q = {share:.2g} μP"
            (drawn,) = axes.plot(at[near] / a, q[near] / (mu * p0), "o", markersize=3, label=label)
            exact = friction(fine, share) / (mu * p0)
            axes.plot(fine / a, exact, linewidth=1, color=drawn.get_color())
        axes.set(xlabel="x / a", ylabel="friction / μp₀; lines: closed form")
        axes.legend()
        figure.savefig(folder / "cattaneo_mindlin_2d_friction.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
