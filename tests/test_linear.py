"""Scenes without contact: PCPG against direct solves on the untorn mesh."""

import numpy as np
import pytest
import ufl
from dolfinx import fem
from petsc4py import PETSc
from reference import UntornElasticity
from scenes import decomposed, displacement, hooke, problem, relative, strain

import tfeti_dolfinx as tfeti


def traction_of(cell):
    return (0.01, -0.05) if cell in ("triangle", "quadrilateral") else (0.01, 0.02, -0.05)


@pytest.mark.parametrize(
    ("cell", "degree"),
    [("triangle", 2), ("quadrilateral", 1), ("tetrahedron", 1), ("hexahedron", 2)],
)
def test_agrees_with_a_direct_solver(cell, degree):
    n = 6 if degree == 1 else 3
    p = problem(decomposed(cell, n, 5), traction_of(cell), degree=degree, tfeti_rtol=1e-11)
    p.solve()
    _, u = displacement(p)
    exact = UntornElasticity(cell, n, traction_of(cell), degree=degree).solve_linear()
    assert relative(u, exact) <= 1e-9
    assert p.report.residuals["gluing_jump"] <= p.report.tolerances["gluing_jump"]


@pytest.mark.parametrize(
    ("qp_type", "pc_type", "scaling"),
    [
        ("pcpg", "none", "stiffness"),
        ("pcpg", "lumped", "multiplicity"),
        ("pcpg", "dirichlet", "multiplicity"),
        ("smalse", "none", "stiffness"),
    ],
)
def test_every_solver_gives_the_same(pc_type, scaling, qp_type):
    options = dict(tfeti_pc_type=pc_type, tfeti_scaling=scaling, tfeti_qp_type=qp_type)
    p = problem(
        decomposed("hexahedron", 4, 8), traction_of("hexahedron"), tfeti_rtol=1e-10, **options
    )
    p.solve()
    exact = UntornElasticity("hexahedron", 4, traction_of("hexahedron")).solve_linear()
    assert relative(displacement(p)[1], exact) <= 1e-8


@pytest.mark.parametrize("subdomains", [1, 17])
def test_any_number_of_subdomains(subdomains):
    p = problem(decomposed("tetrahedron", 4, subdomains), (0, 0, -0.05), tfeti_rtol=1e-11)
    p.solve()
    exact = UntornElasticity("tetrahedron", 4, (0, 0, -0.05)).solve_linear()
    assert relative(displacement(p)[1], exact) <= 1e-9


def test_patch_test():
    """Prescribed linear displacements on all sides give it everywhere, to solver tolerance."""
    d = decomposed("hexahedron", 4, 6)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (3,)))
    A = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 10]])
    linear = fem.Function(V)
    linear.interpolate(lambda x: A @ x)
    dofs = fem.locate_dofs_topological(V, 2, d.boundary.astype(np.int32))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(hooke()(u), strain(v)) * ufl.dx
    L = ufl.inner(fem.Constant(d.mesh, np.zeros(3)), v) * ufl.dx
    p = tfeti.ContactProblem(
        a, L, [fem.dirichletbc(linear, dofs)], [], d, petsc_options={"tfeti_rtol": 1e-11}
    )
    uh = p.solve()
    assert np.allclose(uh.x.array, linear.x.array, atol=1e-9)


def test_a_scalar_problem():
    d = decomposed("quadrilateral", 8, 7)
    V = fem.functionspace(d.mesh, ("Lagrange", 1))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    left = fem.locate_dofs_topological(V, 1, d.facets("left"))
    one = fem.Constant(d.mesh, PETSc.ScalarType(1.0))
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    p = tfeti.ContactProblem(
        ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx,
        one * v * ds(d.surface("right")),
        [fem.dirichletbc(PETSc.ScalarType(0.0), left, V)],
        [],
        d,
        petsc_options={"tfeti_rtol": 1e-11},
    )
    uh = p.solve()
    x = V.tabulate_dof_coordinates()
    assert np.allclose(uh.x.array, x[:, 0], atol=1e-10)
    assert p.report.kernel_dim == 7


def test_springs_leave_no_coarse_problem():
    d = decomposed("hexahedron", 3, 4)
    V = fem.functionspace(d.mesh, ("Lagrange", 1, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(hooke()(u), strain(v)) * ufl.dx + 0.1 * ufl.inner(u, v) * ufl.dx
    L = ufl.inner(fem.Constant(d.mesh, (0.0, 0.0, -0.1)), v) * ufl.dx
    p = tfeti.ContactProblem(a, L, [], [], d, petsc_options={"tfeti_rtol": 1e-11})
    uh = p.solve()
    assert p.report.kernel_dim == 0
    assert np.allclose(uh.x.array.reshape(-1, 3), (0, 0, -1), atol=1e-9)


def test_jumps_of_stiffness_cost_little():
    """Stiffness scaling, against one weight per copy: the number of iterations stays flat."""

    def iterations(ratio, scaling):
        d = decomposed("hexahedron", 8, lambda x: np.floor(4 * x[0]) + 4 * (x[2] > 0.5))
        V = fem.functionspace(d.mesh, ("Lagrange", 1, (3,)))
        E = fem.Function(fem.functionspace(d.mesh, ("DG", 0)))
        E.x.array[:] = np.where(d.cell_subdomain % 2, ratio, 1.0)
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        left = fem.locate_dofs_topological(V, 2, d.facets("left"))
        ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        p = tfeti.ContactProblem(
            E * ufl.inner(hooke()(u), strain(v)) * ufl.dx(metadata={"quadrature_degree": 2}),
            ufl.dot(fem.Constant(d.mesh, (0.0, 0.0, -1.0)), v) * ds(d.surface("right")),
            [fem.dirichletbc(np.zeros(3), left, V)],
            [],
            d,
            petsc_options={"tfeti_scaling": scaling},
        )
        p.solve()
        return p.report.cg_steps

    flat = iterations(1.0, "stiffness")
    assert iterations(1e4, "stiffness") <= flat + 5
    assert iterations(1e4, "multiplicity") >= 2 * flat
