"""Patch tests: uniform pressure between bodies with meshes that do not match."""

import numpy as np
import pytest
from bodies import (
    ORDERS,
    TO_ROUNDING,
    gathered,
    held,
    jagged,
    pressed,
    sided,
    sides_of,
    stacked,
    torn_boxes,
    two_body_problem,
)
from dolfinx import fem
from scenes import clamp, largest, solved

PRESSURE = 0.1


def linear_displacement(x, gdim, E=1.0, nu=0.3):
    """Uniaxial compression, exact for both boxes (plane strain in 2D)."""
    if gdim == 2:
        vertical, lateral = -(1 - nu**2) / E, nu * (1 + nu) / E
    else:
        vertical, lateral = -1 / E, nu / E
    u = PRESSURE * lateral * x[:, :gdim]
    u[:, -1] = PRESSURE * vertical * (x[:, gdim - 1] + 1.0)
    return u


def error_of_displacement(problem):
    V = problem.u.function_space
    gdim = V.mesh.geometry.dim
    x = V.tabulate_dof_coordinates()
    u = problem.u.x.array.reshape(-1, gdim)[: len(x)]
    return largest(u - linear_displacement(x, gdim))


def pressures(problem):
    return gathered(problem.solution.contact().pressure)


def wavy(d):
    """Facets that are no parallelograms."""
    x = d.mesh.geometry.x
    inside = np.all((x[:, :2] > 1e-9) & (x[:, :2] < 1 - 1e-9), axis=1)
    wave = 0.06 * np.sin(7 * x[:, 0] + 5 * x[:, 1] + (x[:, 2] > -1e-9))
    x[inside, 0] += wave[inside]
    x[inside, 1] -= 0.7 * wave[inside]


@pytest.mark.parametrize(
    ("cell", "degree", "subdomains", "order", "moved"),
    [
        ("triangle", 1, 4, ORDERS[0], False),
        ("triangle", 2, jagged, ORDERS[1], False),
        ("triangle", 3, 4, ORDERS[1], False),
        ("quadrilateral", 1, jagged, ORDERS[1], False),
        ("quadrilateral", 2, 4, ORDERS[0], False),
        ("tetrahedron", 1, jagged, ORDERS[0], False),
        ("tetrahedron", 3, 4, ORDERS[1], False),
        ("hexahedron", 1, 4, ORDERS[1], True),
        ("hexahedron", 2, jagged, ORDERS[0], False),
    ],
)
def test_uniform_pressure_and_linear_displacement(cell, degree, subdomains, order, moved):
    d = stacked(cell, 3, 4, subdomains)
    if moved:
        wavy(d)
    given = pressed(d, PRESSURE), held(d, *sides_of(cell)), [sided(*order)], degree
    problem = solved(two_body_problem(d, *given, **TO_ROUNDING))
    assert np.allclose(pressures(problem), PRESSURE, rtol=0, atol=1e-9)
    assert error_of_displacement(problem) < 1e-9
    if degree < 3:
        check_tractions(problem, order[0] == "upper bottom")


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("hexahedron", 1)])
def test_uniform_pressure_between_bodies_that_are_held_all_around(cell, degree):
    d = stacked(cell, 3, 4, jagged)
    gdim = d.mesh.geometry.dim
    sides = ["left", "right", "front", "back"][: 2 * gdim - 2]

    def bcs(V):
        exact = fem.Function(V)
        exact.interpolate(lambda x: linear_displacement(x.T, gdim).T)
        names = [f"{body} {side}" for body in ("lower", "upper") for side in sides]
        return [clamp(V, d.facets(name), exact) for name in ["lower bottom", *names]]

    for order in ORDERS:
        given = pressed(d, PRESSURE), bcs, [sided(*order)], degree
        problem = solved(two_body_problem(d, *given, **TO_ROUNDING))
        assert np.allclose(pressures(problem), PRESSURE, rtol=0, atol=1e-9)
        assert np.isclose(np.abs(problem.solution.contact().resultant.force[-1]), PRESSURE)
        assert error_of_displacement(problem) < 1e-9


def check_tractions(problem, upper_is_secondary):
    """Both bodies bear the same force, and both sides the same traction."""
    solution, gdim = problem.solution, problem.dofs.bs
    forces = solution.body_forces
    assert np.allclose(np.sort(forces.force[:, -1]), [-PRESSURE, PRESSURE], rtol=0, atol=1e-9)
    assert np.allclose(forces.force.sum(axis=0), 0.0, atol=1e-12)
    assert np.allclose(forces.moment.sum(axis=0), 0.0, atol=1e-12)
    x = problem.u.function_space.tabulate_dof_coordinates()
    t = solution.traction.x.array.reshape(-1, gdim)[: len(x)]
    touching = np.isclose(x[:, gdim - 1], 0.0)
    assert np.allclose(np.abs(t[touching, -1]), PRESSURE, rtol=0, atol=1e-9)
    assert np.allclose(t[~touching], 0.0)
    assert np.allclose(t[:, :-1], 0.0)
    _, dof = problem.dofs.scalar
    p = solution.pressure.x.array[dof]
    assert np.allclose(p[p > 0], PRESSURE, rtol=0, atol=1e-9)
    assert np.all((t[problem.dofs.dolfinx_node, -1][p > 0] > 0) == upper_is_secondary)


def uncovered(d, pressure):
    """Traction on the cut facets of the upper bottom with the moments of what is not covered.

    Facets beyond x = 1 or left of x = 0 bear it whole. On a facet cut at s it is linear with
    ∫q φ_i = ∫ over the uncovered part of p φ_i, which is all that the load knows of it.
    """
    W = fem.functionspace(d.mesh, ("DG", 1))
    q = fem.Function(W)
    x = W.tabulate_dof_coordinates()
    cells = np.asarray(W.dofmap.list)
    at = x[cells][:, :, 0]
    low, high = at.min(axis=1, keepdims=True), at.max(axis=1, keepdims=True)
    t = (at - low) / (high - low)
    a, b = np.clip((0 - low) / (high - low), 0, 1), np.clip((1 - low) / (high - low), 0, 1)
    # moments of 1 over [0, a] and [b, 1] with 1 − t and t, then the inverse of their mass matrix
    right = 0.5 * (a**2 + 1 - b**2)
    left = a + 1 - b - right
    at_0, at_1 = 4 * left - 2 * right, 4 * right - 2 * left
    q.x.array[cells.ravel()] = (pressure * (at_0 * (1 - t) + at_1 * t)).ravel()
    return q


@pytest.mark.parametrize(
    ("cell", "subdomains", "share"), [("quadrilateral", 4, 0.03), ("hexahedron", jagged, 0.5)]
)
def test_overhanging_secondary_side(cell, subdomains, share):
    """The uncovered remainder carries the same traction: uniform pressure again."""
    n = 5
    # facets of length h with the last one covered by this share of it, to the right of x = 1
    h = 1.0 / (n - 1 + share)
    gdim = 2 if cell == "quadrilateral" else 3
    flat = (1.0,) * (gdim - 2)
    parts = [
        ("lower", (0.0,) * (gdim - 1) + (-1.0,), (1.0, *flat, 0.0), (3,) * gdim),
        ("upper", (0.0,) * gdim, (n * h, *flat, 1.0), (n,) * gdim),
    ]
    d = torn_boxes(cell, parts, subdomains)
    q = uncovered(d, PRESSURE)

    def load(v, ds):
        ends = pressed(d, PRESSURE)(v, ds)
        return ends + q * v[gdim - 1] * ds(d.surface("upper bottom"))

    pair = sided("upper bottom", "lower top")
    problem = solved(two_body_problem(d, load, held(d, *sides_of(cell)), [pair], **TO_ROUNDING))
    assert np.allclose(pressures(problem), PRESSURE, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("cell", "order"), [("triangle", ORDERS[0]), ("hexahedron", ORDERS[1])])
def test_force_and_moment_balance(cell, order):
    """Both sides overhang, nothing is uniform: still action equals reaction."""
    d = stacked(cell, 3, 4, jagged, upper=(0.3, 1.4))
    sides = ["lower bottom", "lower left", "upper left", "upper top"]
    given = pressed(d, 0.1, "upper right"), held(d, *sides), [sided(*order)]
    problem = solved(two_body_problem(d, *given, rtol=1e-10))
    forces = problem.solution.body_forces
    assert np.abs(forces.force).max() > 1e-3
    assert np.allclose(forces.force.sum(axis=0), 0.0, rtol=0, atol=1e-12)
    assert np.allclose(forces.moment.sum(axis=0), 0.0, rtol=0, atol=1e-12)


def test_hardly_covered_facets_cost_nothing():
    """Multiplications do not grow as the covered share of the last facets goes to nothing."""
    taken = []
    for share in (0.5, 1e-3, 1e-8):
        d = stacked("quadrilateral", 3, 4, 4, upper=(0.0, 4 / (3 + share)))
        bcs = held(d, *sides_of("quadrilateral"), "upper right")
        pair = sided("upper bottom", "lower top")
        problem = solved(two_body_problem(d, pressed(d), bcs, [pair]))
        taken.append(problem.report.F_multiplications)
    assert max(taken) <= 1.5 * taken[0]
