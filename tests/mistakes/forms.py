"""Mistakes in the forms a and L."""

import numpy as np
import ufl
from basix.ufl import element, mixed_element
from dolfinx import fem
from dolfinx import mesh as dmesh

NO_ENTITIES = np.empty(0, dtype=np.int32)


def mixed(s):
    cell = s.d.mesh.basix_cell()
    return fem.functionspace(
        s.d.mesh, mixed_element([element("P", cell, 1, shape=(2,)), element("P", cell, 1)])
    )


def laplacian(V, s):
    return ufl.inner(ufl.grad(ufl.TrialFunction(V)), ufl.grad(ufl.TestFunction(V))) * s.dx


def untorn_forms(s):
    V = s.untorn_space(*s.vector)
    return s.a_on(V, ufl.dx), ufl.TestFunction(V)[0] * ufl.dx


def modulus(s, space, name="E"):
    """The form with a modulus that is a function."""
    E = fem.Function(space, name=name)
    E.x.array[:] = 1.0
    return E * ufl.inner(s.u, s.v) * s.dx


def load(s, measure, tag):
    return {"L": ufl.inner(s.f, s.v) * measure(tag)}


def other_ds(s):
    """Facet tags that are equal, but other ones."""
    tags = s.d.facet_tags
    copy = dmesh.meshtags(s.d.mesh, tags.dim, tags.indices, tags.values)
    return s.ds(copy)


ARGUMENTS = {
    r"a is None; expected a bilinear form of UFL": lambda s: s.problem(a=None),
    r"a is a compiled form": lambda s: s.problem(a=fem.form(s.mass)),
    r"a has 1 argument.*; expected a bilinear form, of a residual Nonl": lambda s: s.problem(a=s.L),
    r"L is None; expected a linear form.*ZeroBaseForm": lambda s: s.problem(L=None),
    r"a: an integral has no test function; expected a bilinear form": lambda s: s.problem(
        a=s.a + s.u[0] * s.dx
    ),
    r"a is not a bilinear form: .*overlapping form argument": lambda s: s.problem(
        a=ufl.inner(s.u, s.u) * s.v[0] * s.dx
    ),
    r"the trial function of a is from a space of degree 2 .*; expected that of its": lambda s: (
        s.problem(a=ufl.inner(ufl.TrialFunction(s.space("Lagrange", 2, (2,))), s.v) * s.dx)
    ),
}

SPACES = {
    r"the space is on another mesh \(the one before decompose\?\); expected .*the": lambda s: (
        s.problem(a=untorn_forms(s)[0], L=untorn_forms(s)[1])
    ),
    r"expected a continuous Lagrange space": lambda s: s.problem(a=s.a_on(s.space("DG", 1, (2,)))),
    r"mixed spaces are not supported, expected a Lagrange space": lambda s: s.problem(
        a=ufl.inner(ufl.TrialFunction(mixed(s)), ufl.TestFunction(mixed(s))) * s.dx
    ),
    r"values of shape \(2,\); expected displacements of 3 components in 3D": lambda s: s.problem(
        decomposition=s.cube.d, a=laplacian(s.cube.space("Lagrange", 1, (2,)), s.cube)
    ),
    r"the space is a FunctionSpace; expected a dolfinx.fem.FunctionSpace": lambda s: s.problem(
        a=laplacian(ufl.FunctionSpace(s.d.mesh.ufl_domain(), s.V.ufl_element()), s)
    ),
}

COEFFICIENTS = {
    r"a: the function 'E' is on another mesh \(the one before decompose\?\); expected "
    r"decomposition.mesh, the torn mesh, where decomposition.from_original takes": lambda s: (
        s.problem(a=modulus(s, s.untorn_space("DG", 0)))
    ),
    r"a: .* is a ufl.Coefficient, which has no values; expected a dolfinx.fem.Function": lambda s: (
        s.problem(a=ufl.Coefficient(s.space("DG", 0)) * ufl.inner(s.u, s.v) * s.dx)
    ),
}

MEASURES = {
    r"L: dx is on another mesh": lambda s: s.problem(L=s.v[0] * ufl.dx(domain=s.mesh)),
    r"L: an untagged ds would integrate over the tears": lambda s: s.problem(
        L=s.v[0] * ufl.ds(domain=s.d.mesh)
    ),
    r"L: .*SpatialCoordinate.* is on another mesh": lambda s: s.problem(
        L=ufl.SpatialCoordinate(s.mesh)[0] * s.v[0] * ufl.dx(domain=s.d.mesh)
    ),
    r"dS has no meaning across the tears": lambda s: s.problem(
        L=ufl.avg(s.v[0]) * ufl.dS(domain=s.d.mesh)
    ),
    r"L: ds\(4\) without subdomain_data: expected": lambda s: s.problem(
        **load(s, ufl.ds(domain=s.d.mesh), 4)
    ),
    r"L: ds\(77\): nothing has this tag; .*'top' \(4\)": lambda s: s.problem(**load(s, s.ds(), 77)),
    r"L: dx\(4\): subdomain_data are tags of entities of dimension 1, not 2": lambda s: s.problem(
        **load(s, s.dx(subdomain_data=s.d.facet_tags), 4)
    ),
    r"L: ds\(4\): subdomain_data are tags of another mesh": lambda s: s.problem(
        **load(s, s.ds(s.facet_tags), 4)
    ),
    r"L: ds\(4\): subdomain_data has 3; expected tuples of a tag and an array": lambda s: s.problem(
        **load(s, s.ds([3, 4]), 4)
    ),
    r"L: ds\(4\): subdomain_data has the tags \[4, 2\]; expected each once, in": lambda s: (
        s.problem(**load(s, s.ds([(4, NO_ENTITIES), (2, NO_ENTITIES)]), 4))
    ),
    r"L: ds with different subdomain_data; expected one measure ds in a form": lambda s: s.problem(
        L=s.v[0] * s.ds()(4) + s.v[1] * other_ds(s)(3)
    ),
    r"a: \d cells are in no dx; .* volumes without it are: 'steel' \(5\)": lambda s: s.problem(
        a=ufl.inner(s.u, s.v) * s.dx(subdomain_data=[(1, np.arange(1, len(s.d.cell_subdomain)))])(1)
    ),
    r"L: ds\(1\): \d+ of its facets lie inside a body; expected facets of the boundary only, "
    r"such as of decomposition.facets\(name\) or decomposition.locate_facets": lambda s: (
        s.inner.problem(bcs=[], **load(s.inner, s.inner.ds(), 1))
    ),
}

TABLES = ("ARGUMENTS", "SPACES", "COEFFICIENTS", "MEASURES")
