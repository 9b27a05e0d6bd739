"""Scenes of several boxes, meshed independently."""

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import clamp, hooke, roller, strain, tagged, vectors

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.contact.search import ContactSearch
from tfeti_dolfinx.mesh.dofs import TornDofs

# as exact as this processor can: the assertion of the test says what that must be
TO_ROUNDING = {"rtol": 1e-12, "error_if_not_converged": False}
# of ``stacked``: the secondary side first
ORDERS = [("upper bottom", "lower top"), ("lower top", "upper bottom")]


def boxes(cell, parts, comm=MPI.COMM_WORLD):
    """One mesh of several boxes that share no node, its facet tags, and names as ``tagged`` says.

    ``parts``: for each box its name, lowest corner, highest corner, cells along the axes.
    """
    cell_type, gdim = dmesh.to_type(cell), len(parts[0][1])
    make = dmesh.create_rectangle if gdim == 2 else dmesh.create_box
    alone = [make(MPI.COMM_SELF, [low, high], list(n), cell_type) for _, low, high, n in parts]
    bodies = [(box.geometry.x[:, :gdim], geometry_dofmap(box)) for box in alone]
    mesh = joined(bodies, alone[0].ufl_domain().ufl_coordinate_element(), comm)
    return mesh, *tagged(mesh, parts)


def joined(bodies, element, comm=MPI.COMM_WORLD):
    """One mesh of bodies that share no node, of points and cells each, from rank 0."""
    points, cells = zip(*bodies, strict=True)
    starts = np.cumsum([0, *map(len, points)])
    cells = np.concatenate([start + c for start, c in zip(starts, cells, strict=False)])
    own = slice(0 if comm.rank else None)
    x = np.concatenate(points)[own]
    return dmesh.create_mesh(comm, cells=cells.astype(np.int64)[own], x=x, e=element)


def torn_boxes(cell, parts, subdomains, **given):
    """The same boxes, torn."""
    mesh, tags, names = boxes(cell, parts)
    return tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=names, **given)


def sides_of(cell):
    """Sides that hold a box on a box along their normals, so that it is pressed uniformly."""
    flat = cell in ("triangle", "quadrilateral")
    sides = ["lower bottom", "lower left", "upper left"]
    return sides if flat else [*sides, "lower front", "upper front"]


def stacked(cell, n_lower=3, n_upper=4, subdomains=4, upper=(0.0, 1.0), gap=0.0):
    """A box on a box: lower [0, 1]^d−1 × [−1, 0], upper from ``upper`` in x (and y), above it."""
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    a, b = upper
    parts = [
        ("lower", (0.0,) * (gdim - 1) + (-1.0,), (1.0,) * (gdim - 1) + (0.0,), (n_lower,) * gdim),
        ("upper", (a,) * (gdim - 1) + (gap,), (b,) * (gdim - 1) + (1.0 + gap,), (n_upper,) * gdim),
    ]
    return torn_boxes(cell, parts, subdomains)


def jagged(x):
    """Four subdomains whose interfaces zigzag through the contact zone."""
    zigzag = 0.5 + 0.12 * np.sign(np.sin(23 * x[1] + 17 * x[2] + 9 * x[0]))
    return (x[0] > zigzag) + 2 * (x[2 if np.ptp(x[2]) else 1] > 0)


def two_body_problem(d, load, bcs, contacts, degree=1, stress=None, elements=None, **options):
    """Elasticity with a load given as a linear form of the test function."""
    V, u, v = vectors(d, degree)
    stress = stress or hooke()
    exact = {"domain": d.mesh, "metadata": {"quadrature_degree": 2 * degree}}
    ds = ufl.Measure("ds", subdomain_data=d.facet_tags, **exact)
    a = ufl.inner(stress(u), strain(v)) * ufl.Measure("dx", **exact)
    more = {"stress": stress, "petsc_options": options, "boundary_elements": elements}
    return tfeti.ContactProblem(a, load(v, ds), bcs(V), contacts, d, **more)


def stiffer_above(d, ratio, nu=0.3):
    """Stress of bodies that are stiffer above 0 by a ratio; one form for all of them."""
    ratio, nu = (fem.Constant(d.mesh, float(value)) for value in (ratio, nu))
    height = ufl.SpatialCoordinate(d.mesh)[d.mesh.geometry.dim - 1]
    return hooke(ufl.conditional(ufl.gt(height, 0.0), ratio, 1.0), nu)


def pressed(d, pressure=0.1, on="upper top"):
    """Load: a uniform pressure from above."""
    return drawn(d, on, -pressure * np.eye(d.mesh.geometry.dim)[-1])


def drawn(d, on, force):
    """Load: a traction on a surface, or a force per volume on None; numbers or a constant."""
    if not isinstance(force, fem.Constant):
        force = fem.Constant(d.mesh, np.array(force, dtype=float))
    return lambda v, ds: ufl.dot(force, v) * (ufl.dx if on is None else ds(d.surface(on)))


def sided(secondary, primary, **changes):
    """A pair whose secondary side is the first."""
    return tfeti.Contact(secondary, primary, secondary=secondary, **changes)


def searched(contacts, dofs):
    """The conditions of contacts, as if all elements were equally stiff."""
    return ContactSearch(contacts, dofs, unit_blocks(dofs)).records


def dofs_on(d, degree=1):
    """Unknowns of displacements."""
    return TornDofs(fem.functionspace(d.mesh, ("Lagrange", degree, (d.mesh.geometry.dim,))), d)


def nodal(dofs, function):
    """Values at the nodes of a function from (n, gdim) to (n, gdim), in primal order."""
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node]
    return function(x[:, : dofs.bs]).ravel()


def unit_blocks(dofs):
    """Blocks of K of the nodes if all elements are equally stiff."""
    return np.tile(np.eye(dofs.bs), (dofs.num_nodes, 1, 1))


def held(d, *sides):
    """Conditions on the sides named: no normal displacement, or in a pair with a side its value."""
    gdim = d.mesh.geometry.dim
    axis_of = {"front": 1, "back": 1, "bottom": gdim - 1, "top": gdim - 1}  # others: 0
    pairs = [given if isinstance(given, tuple) else (given, 0.0) for given in sides]
    of = [(axis_of.get(side.split()[-1], 0), d.facets(side), value) for side, value in pairs]
    return lambda V: [roller(V, *given) for given in of]


def clamped(d, *sides):
    """Conditions on the sides named: no displacement, or in a pair with a side its value."""
    pairs = [given if isinstance(given, tuple) else (given, 0.0) for given in sides]
    return lambda V: [clamp(V, d.facets(side), value) for side, value in pairs]


def no_load(v, ds):
    return ufl.ZeroBaseForm((v,))


def gathered(values):
    """Rows of all ranks."""
    return np.concatenate(MPI.COMM_WORLD.allgather(values))
