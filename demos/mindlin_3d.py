# # Partial slip of a point contact
#
# Two equal elastic bodies, shaped like spheres where they touch, are pressed together, then pushed
# along each other in load steps; the half where y ≥ 0. By Coulomb's law the contact slips from its
# edge on, and sticks on r < c. c and friction are compared with Mindlin's closed form,
# c = a(1 − Q/(μP))^(1/3), which lets friction be along x everywhere. Coulomb's law wants it against
# the slip, which for ν > 0 is not quite along x.
#
#     ./run mpirun -n 2 python3 demos/mindlin_3d.py --plot

# +
import argparse
import sys
from pathlib import Path

import petsc4py

parser = argparse.ArgumentParser(
    description="Partial slip of a point contact in 3D, and its closed form."
)
parser.add_argument("--quick", action="store_true", help="a size of a few seconds")
parser.add_argument("--subdomains", type=int, help="their number")
parser.add_argument("--elements", type=int, help="elements along the radius a")
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
# Two boxes that are mirror images, at first flat on each other: so pressing alone makes no
# friction.

# +
comm = MPI.COMM_WORLD
R, L, E, nu, mu, a = 1.0, 1.0, 1.0, 0.3, 0.3, 0.05
elements = arguments.elements or (4 if arguments.quick else 10)
gmsh.initialize()
gmsh.option.setNumber("General.Terminal", 0)
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
model = gmsh.model


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
    box = model.occ.addBox(-L, 0, 0, 2 * L, L, L)
    model.occ.synchronize()
    beyond = f"(sqrt(x^2+y^2+z^2)-{1.2 * a})"
    size = model.mesh.field.add("MathEval")
    sizes = f"{a / elements}+{3 / elements}*0.5*({beyond}+fabs({beyond}))"
    model.mesh.field.setString(size, "F", sizes)
    model.mesh.field.setAsBackgroundMesh(size)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)
    model.mesh.generate(3)
    middles = {tag: model.occ.getCenterOfMass(2, tag) for _, tag in model.getEntities(2)}
    (cut,) = (tag for tag, x in middles.items() if abs(x[1]) < 1e-6 * L)
    (face,) = (tag for tag, x in middles.items() if abs(x[2]) < 1e-6 * L)
    (far,) = (tag for tag, x in middles.items() if abs(x[2] - L) < 1e-6 * L)
    image = mirror(axis=2)
    model.addPhysicalGroup(3, [box], name="upper")
    model.addPhysicalGroup(3, [image[3, box]], name="lower")
    for upper, lower, tag in (("upper face", "lower face", face), ("top", "bottom", far)):
        model.addPhysicalGroup(2, [tag], name=upper)
        model.addPhysicalGroup(2, [image[2, tag]], name=lower)
    model.addPhysicalGroup(2, [cut, image[2, cut]], name="y=0")
subdomains = arguments.subdomains or (2 if arguments.quick else 10)
decomposition = tfeti.read_gmsh(model if comm.rank == 0 else None, comm, subdomains)
gmsh.finalize()
mesh = decomposition.mesh
# -

# ## Elasticity

elastic = tfeti.Elasticity(decomposition, E=E, nu=nu)
V = fem.functionspace(mesh, ("Lagrange", 1, (3,)))
u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=mesh, subdomain_data=decomposition.facet_tags)

# ## Loads and conditions
#
# P is a uniform pressure on both flat sides. Q is a uniform traction on them, along x above and
# against it below, with a pressure linear in x that takes its moment: each body is in balance.
# What holds the lower one, two corners, carries nothing; contact and friction alone hold the
# upper one.

# +
top, bottom = (ds(decomposition.surface(name)) for name in ("top", "bottom"))
area, moment, X = 2 * L**2, 2 * L**4 / 3, ufl.SpatialCoordinate(mesh)
P, Q = fem.Constant(mesh, 0.0), fem.Constant(mesh, 0.0)
side = Q / area * v[0] - P / area * v[2]
loads = side * top - side * bottom + Q * L / moment * X[0] * v[2] * (top + bottom)
cut = fem.locate_dofs_topological(V.sub(1), 2, decomposition.facets("y=0"))
bcs = [fem.dirichletbc(0.0, cut, V.sub(1))]
for side, axis in ((-1, 0), (-1, 2), (1, 2)):
    corner, _ = fem.locate_dofs_geometrical(
        (V.sub(axis), V.sub(axis).collapse()[0]),
        lambda x, side=side: np.all(np.isclose(x.T, (side * L, 0.0, -L)), axis=1),
    )
    bcs.append(fem.dirichletbc(0.0, corner, V.sub(axis)))
# -

# ## Contact with friction
#
# The bodies' shape is in the gap, r²/(2R), as in Hertz's theory.

contact = tfeti.Contact(
    "upper face",
    "lower face",
    secondary="upper face",
    gap=lambda x: (x[0] ** 2 + x[1] ** 2) / (2 * R),
    friction=tfeti.Coulomb(mu),
    reach=a**2 / R,
    name="contact",
)
problem = tfeti.ContactProblem(
    elastic.a(u, v), loads, bcs, [contact], decomposition, stress=elastic.stress
)

# ## Closed form
#
# Hertz's pressure, and friction, which is μp less what a contact of half width c would have.

# +
load = 4 * E / (1 - nu**2) / 2 * a**3 / (3 * R) / 2  # on half of the bodies
p0 = 3 * 2 * load / (2 * np.pi * a**2)


def ellipse(r, b):
    return np.sqrt(np.maximum(1 - (r / b) ** 2, 0.0))


def stick(share):
    """Half width c of what sticks under Q, a share of μP."""
    return a * (1 - share) ** (1 / 3)


def friction(r, share):
    c = stick(share)
    return mu * p0 * (ellipse(r, a) - c / a * ellipse(r, c))


def half_width(r, force):
    """That of a pressure of Hertz's, by its second moment."""
    return float(np.sqrt(2.5 * (force @ r**2) / np.sum(force)))


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
    parts = (contact.points, contact.pressure, contact.area, contact.status)
    parts += (
        -contact.tangential_traction[:, 0],
        np.linalg.norm(contact.tangential_traction, axis=1),
    )
    points, p, area, status, q, size = (np.concatenate(comm.allgather(part)) for part in parts)
    r, on_cut = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 1]) < 1e-6 * a
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
    curves[share] = (points[on_cut, 0], q[on_cut])
    if comm.rank == 0:
        report = problem.report
        print(f"Q = {share:.2f} μP: c/a {c / a:.4f}, closed form {stick(share) / a:.4f};", end=" ")
        print(f"{report.F_multiplications} iterations", flush=True)
problem.report.errors.update(errors)
# -

# ## Output
#
# Friction is drawn at the nodes of the cut y = 0. Nodal values on tetrahedra scatter about the
# closed form, most where sticking ends: that has a kink there, and elements are a tenth of a.

# +
if arguments.output:
    tfeti.write_vtx(arguments.output / "mindlin_3d.bp", problem.solution)
if arguments.plot:
    folder = arguments.output or Path("results")
    zoom = {"focus": (0.0, 0.0, 0.0), "zoom": 0.4 * L / a, "view": (0.0, -1.0, 0.0)}
    tfeti.plot_deformed(folder / "mindlin_3d.png", problem.solution, show_edges=False, **zoom)
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
        figure.savefig(folder / "mindlin_3d_friction.png")
if arguments.report:
    problem.report.write(arguments.report, comm)
if comm.rank == 0:
    print(problem.report)
# -
