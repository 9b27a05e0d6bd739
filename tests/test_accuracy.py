"""CONVERGED means a right displacement, whatever the stiffness, the units and the gaps."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import clamp, gathered, hooke, strain
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve

import tfeti_dolfinx as tfeti


def rectangle(cells, size, comm):
    """A rectangle of quadrilaterals with tags 1, 2 (left, right), 3, 4 (bottom, top)."""
    mesh = dmesh.create_rectangle(
        comm, [(0.0, 0.0), size], list(cells), dmesh.CellType.quadrilateral
    )
    sides = [(0, 0.0), (0, size[0]), (1, 0.0), (1, size[1])]
    facets = [
        dmesh.locate_entities_boundary(
            mesh, 1, lambda x, a=a, at=at, s=size[a]: np.isclose(x[a], at, atol=1e-9 * s)
        )
        for a, at in sides
    ]
    values = np.repeat(np.arange(1, 5, dtype=np.int32), [len(f) for f in facets])
    facets = np.concatenate(facets)
    order = np.argsort(facets)
    return mesh, dmesh.meshtags(mesh, 1, facets[order], values[order])


NAMES = {"left": 1, "right": 2, "bottom": 3, "top": 4}


def elasticity(mesh, tags, modulus, nu, traction):
    """V, a, L; the modulus is a function of the cells' midpoints."""
    E = fem.Function(fem.functionspace(mesh, ("DG", 0)))
    E.interpolate(lambda x: modulus(x) + 0.0 * x[0])
    V = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags)
    a = ufl.inner(hooke(E, nu)(u), strain(v)) * ufl.dx
    return V, a, ufl.dot(fem.Constant(mesh, np.array(traction, dtype=float)), v) * ds(4)


def direct(cells, size, modulus, nu, traction):
    """Points and displacements of the untorn body, clamped on the left, without contact."""
    mesh, tags = rectangle(cells, size, MPI.COMM_SELF)
    V, a, L = elasticity(mesh, tags, modulus, nu, traction)
    K = csr_matrix(fem.assemble_matrix(fem.form(a), block_mode=None).to_scipy())
    f = fem.assemble_vector(fem.form(L)).array.copy()
    free = np.setdiff1d(np.arange(len(f)), clamp(V, tags.find(1)).dof_indices()[0])
    u = np.zeros(len(f))
    u[free] = spsolve(K[free][:, free].tocsc(), f[free])
    x = V.tabulate_dof_coordinates()
    order = np.lexsort(np.rint(x.T / max(size) * 1e7))
    return u.reshape(-1, 2)[order]


def torn(cells, size, modulus, nu, traction, subdomains, contacts, **options):
    mesh, tags = rectangle(cells, size, MPI.COMM_WORLD)
    d = tfeti.decompose(mesh, subdomains, facet_tags=tags, surfaces=NAMES)
    V, a, L = elasticity(d.mesh, d.facet_tags, modulus, nu, traction)
    bcs = [clamp(V, d.facets("left"))]
    return tfeti.ContactProblem(a, L, bcs, contacts, d, petsc_options=options)


def error(p, exact, size):
    """Largest error of u over the largest u."""
    dofs = p.dofs
    points, u = gathered(dofs, dofs.to_primal(p.u.x.array).reshape(-1, 2))
    order = np.lexsort(np.rint(points.T / max(size) * 1e7))
    return np.abs(u[order] - exact).max() / np.abs(exact).max()


def floor(at, reach=np.inf):
    return tfeti.Obstacle("bottom", tfeti.Plane((0, -at), (0, 1)), reach=reach)


@pytest.mark.parametrize("away", [1.0, 1e6])
def test_an_obstacle_far_away_changes_nothing(away):
    """A steel block under 0.1 MPa that pulls it off an obstacle; every node has a row."""
    scene = (12, 6), (2.0, 1.0), lambda x: 2.1e5, 0.3, (0.0, 0.1)
    p = torn(*scene, 4, [floor(away)])
    try:
        p.solve()
    except tfeti.ConvergenceError as problem:
        assert away > 1e3
        assert "DIVERGED_ROUNDING" in str(problem)  # noqa: PT017
    else:
        assert p.report.active_contacts == 0
        assert error(p, direct(*scene), (2.0, 1.0)) <= 1e-4


def checkerboard(jump):
    return lambda x: np.where((np.floor(6 * x[0]) + np.floor(6 * x[1])) % 2 > 0, jump, 1.0)


@pytest.mark.parametrize(
    ("jump", "contacts", "subdomains"), [(1e4, 1, 7), (1e6, 0, 4), (1e8, 1, 4), (1e8, 0, 7)]
)
def test_jumps_of_stiffness_inside_a_body(jump, contacts, subdomains):
    size, scene = (2.0, 1.0), ((24, 12), (2.0, 1.0), checkerboard(jump), 0.3, (0.0, 1e-3))
    p = torn(*scene, subdomains, [floor(0.02)] * contacts)
    p.solve()
    assert p.report.residuals["displacement_error"] <= 1e-6
    assert error(p, direct(*scene), size) <= 1e-4


@pytest.mark.parametrize(
    ("nu", "length", "contacts"),
    [(0.4999, 1.0, 1), (0.499, 10.0, 0), (0.4999, 100.0, 0), (0.3, 100.0, 1)],
)
def test_slender_and_nearly_incompressible_bodies(nu, length, contacts):
    size = (length, 1.0)
    scene = (int(8 * min(length, 5)), 4), size, lambda x: 1.0, nu, (1e-5, 1e-6)
    contacts = [floor(1.0)] * contacts
    p = torn(*scene, 6, contacts, tfeti_error_if_not_converged=False, tfeti_max_it=1000)
    p.solve()
    if p.report.converged_reason.startswith("CONVERGED"):
        assert error(p, direct(*scene), size) <= 1e-4
    else:
        assert contacts
        assert length > 50


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_units_do_not_matter(unit):
    size = (2.0 * unit, unit)
    scene = (12, 6), size, lambda x: 2.1e5, 0.3, (0.0, 0.1)
    p = torn(*scene, 4, [floor(0.01 * unit)])
    p.solve()
    assert error(p, direct(*scene), size) <= 1e-5


def test_atol_is_a_length():
    scene = (12, 6), (2.0, 1.0), lambda x: 1.0, 0.3, (0.0, 1e-3)
    p = torn(*scene, 4, [], tfeti_rtol=1e-14, tfeti_atol=1e-5)
    p.solve()
    assert p.report.converged_reason == "CONVERGED_ATOL"
    assert p.report.residuals["gluing_jump"] <= 2e-5


def test_rounding_is_called_so():
    scene = (12, 6), (2.0, 1.0), checkerboard(1e8), 0.3, (0.0, 1e-3)
    p = torn(*scene, 4, [], tfeti_rtol=1e-15)
    with pytest.raises(tfeti.ConvergenceError, match="DIVERGED_ROUNDING.*rounding does not let"):
        p.solve()
    assert p.report.converged_reason == "DIVERGED_ROUNDING"


def test_rtol_0_asks_for_all_digits():
    """Whether rounding is said to have ended it or not, it has them."""
    scene = (12, 6), (2.0, 1.0), checkerboard(1e3), 0.3, (0.0, 1e-3)
    p = torn(*scene, 4, [floor(1.0)], tfeti_rtol=0, tfeti_error_if_not_converged=False)
    p.solve()
    assert p.report.converged_reason in ("CONVERGED_RTOL", "DIVERGED_ROUNDING")
    assert error(p, direct(*scene), np.array([2.0, 1.0])) <= 1e-10


def test_an_error_says_what_is_hard():
    """What the report warns of is in the message of a solve that ends early, too."""
    scene = (12, 6), (4000.0, 1.0), lambda x: 1.0, 0.3, (0.0, 1e-3)
    p = torn(*scene, 4, [], tfeti_max_it=1)
    with pytest.raises(tfeti.ConvergenceError, match="DIVERGED_ITS") as caught:
        p.solve()
    assert "the flattest" in str(caught.value)
    assert all(warning in str(caught.value) for warning in p.report.warnings)
