"""Small scenes that many tests use."""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.mortar.facets import group_points

CELLS = ["triangle", "quadrilateral", "tetrahedron", "hexahedron"]
SIDES_2D = {"left": (0, 0.0), "right": (0, 1.0), "bottom": (1, 0.0), "top": (1, 1.0)}
SIDES_3D = {**SIDES_2D, "bottom": (2, 0.0), "top": (2, 1.0), "front": (1, 0.0), "back": (1, 1.0)}
SIDES = {2: SIDES_2D, 3: SIDES_3D}
# stages of a solve, as reports and -log_view name them
STAGES = ["mesh", "contact", "constraints", "assembly", "factors", "coarse", "solve", "recovery"]


def exterior(mesh):
    """Facets with a cell on one side alone, their midpoints, and those of the cells."""
    gdim = mesh.geometry.dim
    mesh.topology.create_connectivity(gdim - 1, gdim)
    facets = dmesh.exterior_facet_indices(mesh.topology)
    links = mesh.topology.connectivity(gdim - 1, gdim)
    cells = np.array([links.links(f)[0] for f in facets], dtype=np.int32)
    pairs = ((gdim - 1, facets), (gdim, cells))
    return facets, *(dmesh.compute_midpoints(mesh, *pair)[:, :gdim] for pair in pairs)


def tagged(mesh, parts):
    """Facet tags of boxes and their names: "<box> left", "right", "bottom", "top", "front", ..."""
    gdim, (facets, at, beside) = mesh.geometry.dim, exterior(mesh)
    values, names = np.zeros(len(facets), dtype=np.int32), {}
    for name, low, high, *_ in parts:
        own = np.all((beside > np.array(low)) & (beside < np.array(high)), axis=1)
        for side, (axis, end) in SIDES[gdim].items():
            tag = names[f"{name} {side}".strip()] = len(names) + 1
            values[own & np.isclose(at[:, axis], (low, high)[int(end)][axis], atol=1e-9)] = tag
    return dmesh.meshtags(mesh, gdim - 1, facets, values), names


def box(cell="hexahedron", n=3, comm=MPI.COMM_WORLD, degree_of_grading=1.0):
    """Unit square or cube, with its sides tagged 1, 2, ... in the order of SIDES."""
    cell_type = dmesh.to_type(cell)
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    low, high = (0.0,) * gdim, (1.0,) * gdim
    make = dmesh.create_rectangle if gdim == 2 else dmesh.create_box
    mesh = make(comm, [low, high], [n] * gdim, cell_type)
    tags, names = tagged(mesh, [("", low, high)])
    mesh.geometry.x[:] **= degree_of_grading
    return mesh, tags, names


def decomposed(cell="hexahedron", n=3, subdomains=4, comm=MPI.COMM_WORLD, grading=1.0):
    mesh, facet_tags, names = box(cell, n, comm, grading)
    return tfeti.decompose(mesh, subdomains, facet_tags=facet_tags, surfaces=names)


def grid(n):
    """Subdomains of a unit square or cube, n along each axis."""

    def subdomain(x):
        i, j, k = np.minimum((n * x).astype(int), n - 1)
        return i + n * j + n * n * k

    return subdomain


def strain(u):
    g = ufl.sym(ufl.grad(u))
    if g.ufl_shape == (3, 3):
        return g
    return ufl.as_tensor([[g[0, 0], g[0, 1], 0], [g[1, 0], g[1, 1], 0], [0, 0, 0]])


def hooke(E=1.0, nu=0.3):
    """u ↦ its stress, 3×3, in plane strain in 2D."""
    mu, lmbda = E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)

    def stress(u):
        return 2 * mu * strain(u) + lmbda * ufl.tr(strain(u)) * ufl.Identity(3)

    return stress


def elastic(u, v, E=1.0, nu=0.3):
    """The bilinear form of elasticity."""
    return ufl.inner(hooke(E, nu)(u), strain(v)) * ufl.dx


def forms(mesh, facet_tags, traction, top, degree=1, stress=None):
    """V, a, L of elasticity with a traction on the surface of a tag."""
    V = fem.functionspace(mesh, ("Lagrange", degree, (mesh.geometry.dim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    exact = {"domain": mesh, "metadata": {"quadrature_degree": 2 * degree}}
    a = ufl.inner((stress or hooke())(u), strain(v)) * ufl.Measure("dx", **exact)
    ds = ufl.Measure("ds", subdomain_data=facet_tags, **exact)
    return V, a, ufl.dot(fem.Constant(mesh, np.array(traction, dtype=float)), v) * ds(top)


def clamp(V, facets, value=0.0):
    """A condition on facets: one value of all components, a vector, a constant or a function."""
    gdim = V.mesh.geometry.dim
    dofs = fem.locate_dofs_topological(V, gdim - 1, facets)
    if isinstance(value, fem.Function):
        return fem.dirichletbc(value, dofs)
    return fem.dirichletbc(np.full(gdim, value) if np.isscalar(value) else value, dofs, V)


def roller(V, axis, facets, value=0.0):
    """A condition on one component."""
    dofs = fem.locate_dofs_topological(V.sub(axis), V.mesh.geometry.dim - 1, facets)
    return fem.dirichletbc(value, dofs, V.sub(axis))


def problem(
    decomposition,
    traction=None,
    contacts=(),
    clamped=("left",),
    degree=1,
    loaded="top",
    extensions=None,
    springs=0.0,
    **options,
):
    """A box, some sides clamped, springs in each of its points, a traction on another side."""
    d = decomposition
    traction = traction or (0.0,) * (d.mesh.geometry.dim - 1) + (-0.05,)
    V, a, L = forms(d.mesh, d.facet_tags, traction, d.surface(loaded), degree)
    if springs:
        v, u = a.arguments()
        dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 2})
        a += fem.Constant(d.mesh, springs) * ufl.dot(u, v) * dx
    bcs = [clamp(V, d.facets(name)) for name in clamped]
    given = {"stress": hooke(), "petsc_options": options, "extensions": extensions}
    return tfeti.ContactProblem(a, L, bcs, list(contacts), d, **given)


def curved_obstacle(gdim, gap=0.02):
    """The obstacle below the cube of the design's section 6, or its plane section."""
    across = 0.5 if gdim == 3 else 0.0

    def distance(x):
        return x[gdim - 1] + gap + 0.1 * ((x[0] - 0.8) ** 2 + across * (x[1] - 0.5) ** 2)

    def gradient(x):
        direction = np.zeros((3, x.shape[1]))
        direction[gdim - 1] = 1.0
        return direction

    return tfeti.SignedDistance(distance, gradient)


def bumpy(height, below):
    """A wave in the plane, as distance and gradient, so far below y = 0 on the whole."""
    return tfeti.SignedDistance(
        lambda x: x[1] + height * np.cos(7.0 * x[0]) + below,
        lambda x: np.stack((-7.0 * height * np.sin(7.0 * x[0]), np.ones_like(x[0]))),
    )


def by_point(comm, points, *values):
    """Points and values of all ranks, sorted by point."""
    points, *values = (np.concatenate(comm.allgather(part)) for part in (points, *values))
    order = np.lexsort(np.rint(points.T * 1e7))
    return points[order], *(part[order] for part in values)


def gathered(dofs, node_values):
    """Points and values, one row per local primal node, of all groups of all ranks, by point."""
    total = dofs.reduce(node_values, np.add)
    mean = total / dofs.multiplicity.reshape(-1, *[1] * (total.ndim - 1))
    return by_point(dofs.comm, group_points(dofs), mean)


def displacement(problem):
    """Points and displacements of all nodes, sorted by point, on every rank."""
    dofs = problem.dofs
    u = dofs.to_primal(problem.u.x.array).reshape(-1, dofs.bs)
    return gathered(dofs, u)


def relative(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def largest(values):
    """The largest absolute value of all ranks."""
    return MPI.COMM_WORLD.allreduce(float(np.abs(values).max(initial=0.0)), op=MPI.MAX)


def apart(u, other):
    """Largest difference over the largest value, of all ranks."""
    return largest(u - other) / largest(other)


def integral(form):
    """A form without arguments over the parts of all ranks."""
    return MPI.COMM_WORLD.allreduce(fem.assemble_scalar(fem.form(form)))


def measures(d):
    """Measures of cells and facets with their tags."""
    return (
        ufl.Measure("dx", domain=d.mesh, subdomain_data=d.cell_tags),
        ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags),
    )


def vectors(d, degree=1):
    """A space of displacements, its trial and its test function."""
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (d.mesh.geometry.dim,)))
    return V, ufl.TrialFunction(V), ufl.TestFunction(V)


def unknowns(d, degree=1):
    """The same with a function that is to be found: space, function, test and trial function."""
    V, u, v = vectors(d, degree)
    return V, fem.Function(V), v, u


def solved(problem):
    """Solve; the problem."""
    problem.solve()
    return problem


def accepted(problem):
    """Solve and accept; the report."""
    solved(problem).accept()
    return problem.report
