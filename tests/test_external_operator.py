"""A law in numpy by dolfinx-external-operator, as docs/nonlinear.md says, beside itself in UFL."""

import basix.ufl
import numpy as np
import pytest
import ufl
from bodies import held, stacked
from dolfinx import fem
from scenes import accepted

import tfeti_dolfinx as tfeti

xo = pytest.importorskip("dolfinx_external_operator", reason="needs DOLFINx 0.11")
LAMBDA, MU, BETA = 0.6, 0.4, 40.0


def strain(w):
    """Components xx, yy, xy."""
    e = ufl.sym(ufl.grad(w))
    return ufl.as_vector([e[0, 0], e[1, 1], e[0, 1]])


def stress(e):
    """That of the energy λ/2 tr²ε + μ ε:ε + β/4 (ε:ε)², and its derivative, at points."""
    e = e.reshape(-1, 3)
    weighted = e * (1.0, 1.0, 2.0)
    square = np.sum(e * weighted, axis=1)[:, None]
    trace = LAMBDA * np.outer((1.0, 1.0, 0.0), (1.0, 1.0, 0.0))
    s = e @ trace.T + (2 * MU + BETA * square) * e
    ds = trace + (2 * MU + BETA * square)[:, :, None] * np.eye(3)
    ds = ds + 2 * BETA * e[:, :, None] * weighted[:, None, :]
    return s, ds


def by_operator(u, v, dx):
    """Residual, tangent, and what brings both to u."""
    mesh = u.function_space.mesh
    points = basix.ufl.quadrature_element(mesh.basix_cell(), value_shape=(3,), degree=2)

    def law(derivatives):
        return lambda e: stress(e)[sum(derivatives)].reshape(-1)

    space = fem.functionspace(mesh, points)
    sigma = xo.FEMExternalOperator(strain(u), function_space=space, external_function=law)
    e = strain(v)
    F = ufl.inner(sigma, ufl.as_vector([e[0], e[1], 2 * e[2]])) * dx
    J = ufl.algorithms.expand_derivatives(ufl.derivative(F, u, ufl.TrialFunction(u.function_space)))
    (F, of_F), (J, of_J) = (xo.replace_external_operators(form) for form in (F, J))

    def update():
        operands = xo.evaluate_operands(of_F)
        xo.evaluate_external_operators(of_F, operands)
        xo.evaluate_external_operators(of_J, operands)

    return F, {"J": J, "update": update}


def in_ufl(u, v, dx):
    """The residual in UFL."""
    e = ufl.sym(ufl.grad(u))
    square = ufl.inner(e, e)
    energy = LAMBDA / 2 * ufl.tr(e) ** 2 + MU * square + BETA / 4 * square**2
    return ufl.derivative(energy * dx, u, v), {}


def test_a_law_by_an_external_operator_is_that_in_ufl(comm):
    """Two blocks pressed on each other with friction, in two steps."""
    found = []
    for make in (by_operator, in_ufl):
        cut = stacked("triangle", 3, 4, 3)
        V = fem.functionspace(cut.mesh, ("Lagrange", 2, (2,)))
        u, v = fem.Function(V), ufl.TestFunction(V)
        F, given = make(u, v, ufl.dx(domain=cut.mesh, metadata={"quadrature_degree": 2}))
        down = fem.Constant(cut.mesh, 0.0)
        bcs = held(cut, ("upper top", down), "lower bottom", "lower left", "upper left")(V)
        contact = tfeti.Contact("upper bottom", "lower top", friction=tfeti.Coulomb(0.3))
        problem = tfeti.NonlinearContactProblem(
            F, u, bcs, [contact], cut, petsc_options={"rtol": 1e-10}, **given
        )
        for down.value in (-0.1, -0.2):
            accepted(problem)
        found.append(np.array(u.x.array))
    assert np.abs(found[0] - found[1]).max(initial=0.0) < 1e-9
