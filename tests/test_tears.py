"""Tears are exterior facets to DOLFINx: conditions on them are named, and the boundary is found."""

import numpy as np
import pytest
from bodies import drawn, two_body_problem
from dolfinx import fem
from dolfinx import mesh as dmesh
from scenes import CELLS, clamp, decomposed, displacement, roller, solved

import tfeti_dolfinx as tfeti

SAYS = r"Dirichlet condition 0 prescribes (\d+) facets that lie on tears inside a body"


def broad(x):
    return x[0] < 0.6


def condition(V, facets, component=None):
    return clamp(V, facets) if component is None else roller(V, component, facets)


def problem(d, degree, conditions, **options):
    """The weight of a box, held by what is made from its space."""
    weight = drawn(d, None, -0.1 * np.eye(d.mesh.geometry.dim)[-1])
    return two_body_problem(d, weight, conditions, [], degree, **options)


def shared(mesh, facets):
    """Facets of one subdomain and of another: how many there are twice on all ranks."""
    x = dmesh.compute_midpoints(mesh, mesh.topology.dim - 1, facets)
    x = np.rint(1e8 * np.concatenate(mesh.comm.allgather(x)))
    return len(x) - len(np.unique(x, axis=0))


@pytest.mark.parametrize(
    ("cell", "degree", "component"), list(zip(CELLS, (1, 2, 2, 1), (None, 1, None, 1), strict=True))
)
def test_facets_on_tears_are_refused(cell, degree, component):
    d = decomposed(cell, 4, 4)
    tdim = d.mesh.topology.dim
    for facets in (
        dmesh.exterior_facet_indices(d.mesh.topology),
        dmesh.locate_entities_boundary(d.mesh, tdim - 1, broad),
    ):
        with pytest.raises(tfeti.InputError, match=SAYS) as error:
            problem(d, degree, lambda V, f=facets: [condition(V, f, component)])
        count = int(str(error.value).split()[4])
        # of degree 1 those in corners have all their nodes on the boundary
        assert 0 < count <= shared(d.mesh, facets) <= count + 4 * (degree == 1)


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("hexahedron", 1)])
def test_a_marker_finds_the_boundary_alone(cell, degree):
    """As on a mesh without tears."""
    found = []
    for subdomains in (1, 5):
        d = decomposed(cell, 4, subdomains)
        facets = d.locate_facets(broad)
        assert np.all(np.isin(facets, d.boundary))
        everything = dmesh.locate_entities_boundary(d.mesh, d.mesh.topology.dim - 1, broad)
        assert np.array_equal(facets, np.intersect1d(everything, d.boundary))
        p = solved(problem(d, degree, lambda V, f=facets: [condition(V, f)], rtol=1e-10))
        found.append(displacement(p)[1])
    assert np.abs(found[0]).max() > 1e-3
    assert np.allclose(*found, rtol=0.0, atol=1e-8 * np.abs(found[0]).max())


@pytest.mark.parametrize(("cell", "subdomains"), [("quadrilateral", 5), ("tetrahedron", 2)])
def test_nodes_inside_a_body_may_be_held(cell, subdomains):
    """A region, or a plane by itself, wherever the tears are."""
    d = decomposed(cell, 4, subdomains)

    def of(*markers):
        def conditions(V):
            dofs = (fem.locate_dofs_geometrical(V, marker) for marker in markers)
            return [fem.dirichletbc(np.zeros(V.dofmap.bs), nodes, V) for nodes in dofs]

        return conditions

    for i in range(d.mesh.geometry.dim):
        problem(d, 1, of(lambda x, i=i: x[i] < 0.3))
        problem(d, 1, of(lambda x: x[0] < 0.1, lambda x, i=i: np.isclose(x[i], 0.5)))


@pytest.mark.parametrize(
    ("cell", "n", "subdomains"), [("quadrilateral", 2, 4), ("hexahedron", 3, 3)]
)
def test_a_region_without_nodes_inside_of_subdomains(cell, n, subdomains):
    """Its unknowns are those of exterior facets; the message tells how to hold it."""
    d = decomposed(cell, n, subdomains)

    def conditions(V, apart):
        nodes = fem.locate_dofs_geometrical(V, lambda x: x[0] < 0.51)
        outer = fem.locate_dofs_topological(V, d.mesh.topology.dim - 1, d.boundary)
        at_boundary = np.isin(nodes, outer)
        parts = [nodes[at_boundary], nodes[~at_boundary]] if apart else [nodes]
        return [fem.dirichletbc(np.zeros(V.dofmap.bs), part, V) for part in parts]

    with pytest.raises(tfeti.InputError, match=SAYS + ".* nodes of a region that are not on"):
        problem(d, 1, lambda V: conditions(V, False))
    problem(d, 1, lambda V: conditions(V, True))
