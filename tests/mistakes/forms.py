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


def energy(form, cube=False):
    """Solve with a form of u and v that is no elastic one."""

    def do(s):
        s = s.cube if cube else s
        s.problem(a=form(s.u, s.v, s.dx)).solve()

    return do


def stress(u):
    return 2.0 * ufl.sym(ufl.grad(u)) + ufl.div(u) * ufl.Identity(len(u))


def load(s, measure, tag):
    return {"L": ufl.inner(s.f, s.v) * measure(tag)}


def pure(s):
    return ufl.FunctionSpace(s.d.mesh.ufl_domain(), s.V.ufl_element())


def other_ds(s):
    """Facet tags that are equal, but other ones."""
    tags = s.d.facet_tags
    copy = dmesh.meshtags(s.d.mesh, tags.dim, tags.indices, tags.values)
    return s.ds(copy)


ARGUMENTS = {
    "a is None": (lambda s: s.problem(a=None), r"a is None; expected a bilinear form of UFL"),
    "a is 0": (lambda s: s.problem(a=0), r"a is 0; expected a bilinear form"),
    "a is text": (lambda s: s.problem(a="stiffness"), r"a is 'stiffness'; expected a bilinear"),
    "a is compiled": (lambda s: s.problem(a=fem.form(s.mass)), r"a is a compiled form"),
    "a is linear": (lambda s: s.problem(a=s.L), r"a has 1 arguments; expected a bilinear form"),
    "a and L are exchanged": (lambda s: s.problem(a=s.L, L=s.a), r"a has 1 arguments"),
    "a is a number that is integrated": (
        lambda s: s.problem(a=fem.Constant(s.d.mesh, 1.0) * s.dx),
        r"a has 0 arguments; expected a bilinear form",
    ),
    "a is empty": (lambda s: s.problem(a=ufl.Form([])), r"a has 0 arguments"),
    "a is not integrated": (lambda s: s.problem(a=ufl.inner(s.u, s.v)), r"a is a .*; expected"),
    "a is an equation": (lambda s: s.problem(a=s.a == s.L), r"a is a Equation; expected"),
    "a is a list of forms": (lambda s: s.problem(a=[s.a]), r"a is \[.*; expected a bilinear"),
    "a has a part without the test function": (
        lambda s: s.problem(a=s.a + s.u[0] * s.dx),
        r"a: an integral has no test function; expected a bilinear form",
    ),
    "a has a part without the trial function": (
        lambda s: s.problem(a=s.mass + s.L),
        r"a: an integral has no trial function; expected a bilinear form",
    ),
    "a is not linear in the trial function": (
        lambda s: s.problem(a=ufl.inner(s.u, s.u) * s.v[0] * s.dx),
        r"a is not a bilinear form: .*overlapping form argument",
    ),
    "a has a constant part": (
        lambda s: s.problem(a=(ufl.inner(s.u, s.v) + s.v[0]) * s.dx),
        r"a is not a bilinear form: ",
    ),
    "trial and test functions of different spaces": (
        lambda s: s.problem(
            a=ufl.inner(ufl.TrialFunction(s.space("Lagrange", 2, (2,))), s.v) * s.dx
        ),
        r"the trial function of a is from a space of degree 2 .*; expected that of its test",
    ),
    "a without a trial function but with two test functions": (
        lambda s: s.problem(a=ufl.inner(s.v, s.v) * s.dx),
        r"a has 1 arguments",
    ),
    "L is None": (lambda s: s.problem(L=None), r"L is None; expected a linear form.*ZeroBaseForm"),
    "L is 0": (lambda s: s.problem(L=0), r"L is 0; expected a linear form.*ZeroBaseForm"),
    "L is 0.0": (lambda s: s.problem(L=0.0), r"L is 0.0; expected a linear form"),
    "L is compiled": (lambda s: s.problem(L=fem.form(s.L)), r"L is a compiled form"),
    "L is bilinear": (lambda s: s.problem(L=s.a), r"L has 2 arguments; expected a linear form"),
    "L is a number that is integrated": (
        lambda s: s.problem(L=fem.Constant(s.d.mesh, 1.0) * s.dx),
        r"L has 0 arguments; expected a linear form",
    ),
    "L is an assembled vector": (
        lambda s: s.problem(L=np.zeros(8)),
        r"L is an array of shape \(8,\); expected a linear form",
    ),
    "L is assembled": (lambda s: s.problem(L=fem.assemble_vector(fem.form(s.L))), r"L is a Vector"),
    "L is not integrated": (lambda s: s.problem(L=s.v[0]), r"L is a Indexed; expected a linear"),
    "L is a force": (lambda s: s.problem(L=s.f), r"L is a Constant; expected a linear form"),
    "L is a list": (lambda s: s.problem(L=[s.L]), r"L is \[.*; expected a linear form"),
    "L is a zero of two arguments": (
        lambda s: s.problem(L=ufl.ZeroBaseForm((s.v, s.u))),
        r"L is a ZeroBaseForm; expected a linear form",
    ),
    "L is not linear": (
        lambda s: s.problem(L=s.v[0] * s.v[0] * s.dx),
        r"L is not a linear form: .*overlapping form argument",
    ),
    "L is of the trial function": (
        lambda s: s.problem(L=s.u[0] * s.dx),
        r"L: an integral has no test function; expected a linear form",
    ),
}

SPACES = {
    "forms on the mesh before it is torn": (
        lambda s: s.problem(a=untorn_forms(s)[0], L=untorn_forms(s)[1]),
        r"the space is on another mesh \(the one before decompose\?\); expected .*the torn mesh",
    ),
    "L on the mesh before it is torn": (
        lambda s: s.problem(L=untorn_forms(s)[1]),
        r"the test function of L is from .* on another mesh; expected that of a",
    ),
    "a discontinuous space": (
        lambda s: s.problem(a=s.a_on(s.space("DG", 1, (2,)))),
        r"expected a continuous Lagrange space",
    ),
    "a space of constants": (
        lambda s: s.problem(a=s.a_on(s.space("DG", 0, (2,)))),
        r"expected a continuous Lagrange space of degree 1 or more",
    ),
    "a Raviart-Thomas space": (
        lambda s: s.problem(a=s.a_on(s.space("RTCF", 1))),
        r"expected a continuous Lagrange space",
    ),
    "a mixed space": (
        lambda s: s.problem(
            a=ufl.inner(ufl.TrialFunction(mixed(s)), ufl.TestFunction(mixed(s))) * s.dx
        ),
        r"mixed spaces are not supported, expected a Lagrange space",
    ),
    "vectors of two components in 3D": (
        lambda s: s.problem(
            decomposition=s.cube.d, a=laplacian(s.cube.space("Lagrange", 1, (2,)), s.cube)
        ),
        r"values of shape \(2,\); expected displacements of 3 components in 3D",
    ),
    "vectors of three components in 2D": (
        lambda s: s.problem(a=laplacian(s.space("Lagrange", 1, (3,)), s)),
        r"values of shape \(3,\); expected displacements of 2 components in 2D",
    ),
    "vectors of four components": (
        lambda s: s.problem(a=laplacian(s.space("Lagrange", 1, (4,)), s)),
        r"values of shape \(4,\); expected displacements of 2 components",
    ),
    "tensors": (
        lambda s: s.problem(a=laplacian(s.space("Lagrange", 1, (2, 2)), s)),
        r"values of shape \(2, 2\); expected displacements of 2 components",
    ),
    "a space of UFL alone": (
        lambda s: s.problem(a=laplacian(pure(s), s)),
        r"the space is a FunctionSpace; expected a dolfinx.fem.FunctionSpace",
    ),
    "L on a space of degree 2": (
        lambda s: s.problem(L=ufl.TestFunction(s.space("Lagrange", 2, (2,)))[0] * s.dx),
        r"test function of L is from a space of degree 2 with 2 unknowns.*expected that of a, a "
        r"space of degree 1 with 2 unknowns",
    ),
    "L on a scalar space": (
        lambda s: s.problem(L=ufl.TestFunction(s.space("Lagrange", 1)) * s.dx),
        r"test function of L is from a space of degree 1 with 1 unknowns.*expected that of a",
    ),
    "L on a collapsed space": (
        lambda s: s.problem(L=ufl.TestFunction(s.V.sub(0).collapse()[0]) * s.dx),
        r"test function of L is from a space of degree 1 with 1 unknowns",
    ),
    "L on a space of UFL alone": (
        lambda s: s.problem(L=ufl.TestFunction(pure(s))[0] * s.dx),
        r"test function of L is from a FunctionSpace; expected a dolfinx.fem.FunctionSpace",
    ),
}

COEFFICIENTS = {
    "E on the mesh before it is torn": (
        lambda s: s.problem(a=modulus(s, s.untorn_space("DG", 0))),
        r"a: the function 'E' is on another mesh \(the one before decompose\?\); expected "
        r"decomposition.mesh, the torn mesh, where decomposition.from_original takes functions",
    ),
    "a load on the mesh before it is torn": (
        lambda s: s.problem(L=load_of(s)),
        r"L: the function 'g' is on another mesh",
    ),
    "coordinates of the mesh before it is torn": (
        lambda s: s.problem(L=ufl.SpatialCoordinate(s.mesh)[0] * s.v[0] * s.dx),
        r"L: the SpatialCoordinate x is on another mesh",
    ),
    "normals of the mesh before it is torn": (
        lambda s: s.problem(L=ufl.inner(ufl.FacetNormal(s.mesh), s.v) * s.ds()(4)),
        # newer UFL says first that it is no form
        r"L: the FacetNormal n is on another mesh|L is not a linear form",
    ),
    "a coefficient of UFL alone": (
        lambda s: s.problem(a=ufl.Coefficient(s.space("DG", 0)) * ufl.inner(s.u, s.v) * s.dx),
        r"a: .* is a ufl.Coefficient, which has no values; expected a dolfinx.fem.Function",
    ),
    "a constant of UFL alone": (
        lambda s: s.problem(a=ufl.Constant(s.d.mesh) * ufl.inner(s.u, s.v) * s.dx),
        r"a: .* is a ufl.Constant, which has no values; expected a dolfinx.fem.Constant",
    ),
    "a modulus of complex numbers": (
        lambda s: s.problem(a=fem.Constant(s.d.mesh, 1.0 + 1.0j) * ufl.inner(s.u, s.v) * s.dx),
        r"a .*",
    ),
}

MEASURES = {
    "dx on the mesh before it is torn": (
        lambda s: s.problem(L=s.v[0] * ufl.dx(domain=s.mesh)),
        r"L: dx is on another mesh",
    ),
    "ds on the mesh before it is torn": (
        lambda s: s.problem(L=s.v[0] * ufl.ds(domain=s.mesh, subdomain_data=s.facet_tags)(4)),
        r"L: ds is on another mesh",
    ),
    "an untagged ds": (
        lambda s: s.problem(L=s.v[0] * ufl.ds(domain=s.d.mesh)),
        r"L: an untagged ds would integrate over the tears",
    ),
    "dS": (
        lambda s: s.problem(L=ufl.avg(s.v[0]) * ufl.dS(domain=s.d.mesh)),
        r"dS has no meaning across the tears",
    ),
    "dP": (
        lambda s: s.problem(L=s.v[0] * ufl.dP(domain=s.d.mesh)),
        r"L: integrals of type vertex are not supported; expected dx, ds",
    ),
    "ds(tag) without data": (
        lambda s: s.problem(**load(s, ufl.ds(domain=s.d.mesh), 4)),
        r"L: ds\(4\) without subdomain_data: expected subdomain_data=decomposition.facet_tags",
    ),
    "ds of tags without data": (
        lambda s: s.problem(**load(s, ufl.ds(domain=s.d.mesh), (3, 4))),
        r"L: ds\(3\) without subdomain_data",
    ),
    "dx(tag) without data": (
        lambda s: s.problem(**load(s, s.dx, 5)),
        r"L: dx\(5\) without subdomain_data: expected subdomain_data=decomposition.cell_tags",
    ),
    "ds of an unknown tag": (
        lambda s: s.problem(**load(s, s.ds(), 77)),
        r"L: ds\(77\): nothing has this tag; .*'top' \(4\)",
    ),
    "ds of tags of which one is unknown": (
        lambda s: s.problem(**load(s, s.ds(), (4, 77))),
        r"L: ds\(77\): nothing has this tag",
    ),
    "ds of a name without facets": (
        lambda s: s.problem(**load(s, s.ds(), s.d.surface("nothing"))),
        r"L: ds\(99\): nothing has this tag",
    ),
    "dx of an unknown tag": (
        lambda s: s.problem(**load(s, s.dx(subdomain_data=s.d.cell_tags), 6)),
        r"L: dx\(6\): nothing has this tag; .*'steel' \(5\)",
    ),
    "dx of a facet tag": (
        lambda s: s.problem(**load(s, s.dx(subdomain_data=s.d.facet_tags), 4)),
        r"L: dx\(4\): subdomain_data are tags of entities of dimension 1, not 2",
    ),
    "ds of a cell tag": (
        lambda s: s.problem(**load(s, s.ds(s.d.cell_tags), 5)),
        r"L: ds\(5\): subdomain_data are tags of entities of dimension 2, not 1",
    ),
    "a with dx of a facet tag": (
        lambda s: s.problem(a=s.a_on(s.V, s.dx(4, subdomain_data=s.d.facet_tags))),
        r"a: dx\(4\): subdomain_data are tags of entities of dimension 1",
    ),
    "ds with the facet tags before the mesh is torn": (
        lambda s: s.problem(**load(s, s.ds(s.facet_tags), 4)),
        r"L: ds\(4\): subdomain_data are tags of another mesh",
    ),
    "dx with the cell tags before the mesh is torn": (
        lambda s: s.problem(**load(s, s.dx(subdomain_data=s.cell_tags), 5)),
        r"L: dx\(5\): subdomain_data are tags of another mesh",
    ),
    "ds with facets for data": (
        lambda s: s.problem(**load(s, s.ds(s.d.facets("top")), 4)),
        r"L: ds\(4\): subdomain_data is an array",
    ),
    "ds with names for data": (
        lambda s: s.problem(**load(s, s.ds({"top": 4}), 4)),
        r"L: ds\(4\): subdomain_data is {'top': 4}; expected subdomain_data=decomposition",
    ),
    "ds with a list of facets for data": (
        lambda s: s.problem(**load(s, s.ds([3, 4]), 4)),
        r"L: ds\(4\): subdomain_data has 3; expected tuples of a tag and an array",
    ),
    "ds with a list of cells that are not there": (
        lambda s: s.problem(**load(s, s.ds([(4, np.array([1000, 0], dtype=np.int32))]), 4)),
        r"L: ds\(4\): subdomain_data of tag 4 has entities that this rank has not",
    ),
    "ds with a list of names": (
        lambda s: s.problem(**load(s, s.ds([(4, ["top"])]), 4)),
        r"L: ds\(4\): ValueError: ",
    ),
    "ds with a list of half pairs": (
        lambda s: s.problem(**load(s, s.ds([(4, np.array([0], dtype=np.int32))]), 4)),
        r"L: ds\(4\): subdomain_data of tag 4 has entities that this rank has not",
    ),
    "ds with a list that is not in order": (
        lambda s: s.problem(**load(s, s.ds([(4, NO_ENTITIES), (2, NO_ENTITIES)]), 4)),
        r"L: ds\(4\): subdomain_data has the tags \[4, 2\]; expected each once, in ascending order",
    ),
    "ds with a list that has a tag twice": (
        lambda s: s.problem(**load(s, s.ds([(4, NO_ENTITIES), (4, NO_ENTITIES)]), 4)),
        r"L: ds\(4\): subdomain_data has the tags \[4, 4\]; expected each once",
    ),
    "ds with two kinds of tags in a form": (
        lambda s: s.problem(L=s.v[0] * s.ds()(4) + s.v[1] * other_ds(s)(3)),
        r"L: ds with different subdomain_data; expected one measure ds in a form",
    ),
    "ds of facets inside a body": (
        lambda s: s.inner.problem(bcs=[], **load(s.inner, s.inner.ds(), 1)),
        r"L: ds\(1\): \d+ of its facets lie inside a body; expected facets of the boundary only, "
        r"such as of decomposition.facets\(name\) or decomposition.locate_facets",
    ),
    "ds of one's own tags, from a broad marker": (
        lambda s: s.problem(**load(s, s.ds(all_exterior(s)), 7)),
        r"L: ds\(7\): 4 of its facets lie inside a body; .*decomposition.locate_facets",
    ),
}


def all_exterior(s):
    """Tags of one's own on all facets that are exterior to DOLFINx."""
    facets = dmesh.exterior_facet_indices(s.d.mesh.topology)
    return dmesh.meshtags(s.d.mesh, 1, facets, np.full_like(facets, 7))


def load_of(s):
    g = fem.Function(s.untorn_space("Lagrange", 1), name="g")
    return g * s.v[0] * s.dx


NO_ENERGY = r"subdomain \d: the form gives no energy to .*\d motions? beside the \d of a rigid body"
ENERGIES = {
    "a form of the divergence alone": (
        energy(lambda u, v, dx: ufl.div(u) * ufl.div(v) * dx),
        NO_ENERGY + ".*; expected a linear elastic form of the whole strain",
    ),
    "a form with one point in a cell": (
        energy(
            lambda u, v, dx: (
                ufl.inner(stress(u), ufl.grad(v)) * dx(metadata={"quadrature_degree": 0})
            )
        ),
        NO_ENERGY + ".*, with quadrature that is fine enough",
    ),
    "a form of the rotation": (
        energy(lambda u, v, dx: ufl.inner(ufl.skew(ufl.grad(u)), ufl.grad(v)) * dx),
        NO_ENERGY,
    ),
    "a form of the deviator in 3D": (
        energy(lambda u, v, dx: ufl.inner(ufl.dev(ufl.sym(ufl.grad(u))), ufl.grad(v)) * dx, True),
        NO_ENERGY,
    ),
}

TABLES = ("ARGUMENTS", "SPACES", "COEFFICIENTS", "MEASURES", "ENERGIES")
