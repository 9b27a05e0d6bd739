"""Mistakes with boundary elements."""

import numpy as np
import ufl
from dolfinx import fem
from scenes import box, clamp, forms

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock

ALL = tfeti.BoundaryElements()


def solved(s, elements=ALL, **changes):
    s.problem(boundary_elements=elements, **changes).solve()


def of_degree_two(s):
    V = s.space("Lagrange", 2, (2,))
    L = ufl.inner(s.f, ufl.TestFunction(V)) * s.dx
    bc = fem.dirichletbc(np.zeros(2), s.on(V=V), V)
    solved(s, a=s.a_on(V), L=L, bcs=[bc])


def prescribed_inside(s):
    """One subdomain, whose nodes in the middle are inside."""
    d = tfeti.decompose(s.mesh, 1, facet_tags=s.facet_tags, surfaces=s.box[2])
    V = fem.functionspace(d.mesh, s.vector)
    v = ufl.TestFunction(V)
    dofs = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[0], 0.5))
    bc = fem.dirichletbc(np.zeros(2), dofs, V)
    a, L = s.a_on(V, ufl.dx(domain=d.mesh)), ufl.ZeroBaseForm((v,))
    tfeti.ContactProblem(a, L, [bc], [], d, boundary_elements=ALL).solve()


def loaded_inside(s):
    """The middle of the body is a surface of the mesh that is no tear."""
    inner, v = s.inner, s.inner.v
    dS = ufl.Measure("dS", domain=inner.d.mesh, subdomain_data=inner.d.facet_tags)
    L = ufl.inner(inner.f, v("+")) * dS(1)
    tfeti.ContactProblem(inner.a, L, [], [], inner.d, boundary_elements=ALL).solve()


def of_bent_facets(s):
    """A cube of hexahedra, a node of whose upper side is lifted."""
    mesh, facet_tags, names = box("hexahedron", 2)
    x = mesh.geometry.x
    x[np.all(np.isclose(x, (0.5, 0.5, 1.0)), axis=1), 2] = 1.1
    d = tfeti.decompose(mesh, 1, facet_tags=facet_tags, surfaces=names)
    V, a, L = forms(d.mesh, d.facet_tags, (0.0, 0.0, -0.1), d.surface("top"))
    bc = clamp(V, d.facets("left"))
    tfeti.ContactProblem(a, L, [bc], [], d, boundary_elements=ALL).solve()


LAW = r"body 0 \(volume 'steel'\), subdomain \d: boundary elements need one homogeneous, isotropic"

GIVEN = {
    r"boundary_elements is 'steel'; expected tfeti_dolfinx.BoundaryElements": lambda s: s.problem(
        boundary_elements="steel"
    ),
    r"boundary_elements: extensions have a block, too; expected one of them": lambda s: s.problem(
        boundary_elements=ALL, extensions=Extensions(block=SparseBlock)
    ),
}
SOLVED = {
    LAW: lambda s: solved(
        s, a=tfeti.Elasticity(s.d, E=1.0, nu=0.3, model="axisymmetric").a(s.u, s.v)
    ),
    LAW + " law": lambda s: solved(s, a=s.a + 1e-6 * ufl.dot(s.u, s.v) * s.dx),
    r"boundary elements for 2 components of degree 2; expected displacements of": of_degree_two,
    r"subdomain \d: a load per volume varies there; boundary elements take a constant": lambda s: (
        solved(s, L=ufl.SpatialCoordinate(s.d.mesh)[0] * s.v[1] * s.dx)
    ),
    r"body 0, subdomain 0: a load acts on facets inside boundary elements;": loaded_inside,
    r"boundary elements take the law of a body from the bilinear form, which has no": lambda s: (
        solved(s, a=fem.Constant(s.d.mesh, 0.0) * s.a.integrals()[0].integrand() * s.dx)
    ),
    r"boundary elements: \d+ facets are not flat; expected flat facets, say": of_bent_facets,
    r"body 0, subdomain 0: a value is prescribed inside boundary elements;": prescribed_inside,
    r"points of shape \(1, 3\); expected finite numbers of shape \(k, 2\)": lambda s: s.solved.at(
        [(0.0, 0.0, 0.0)]
    ),
}

TABLES = ("GIVEN", "SOLVED")
