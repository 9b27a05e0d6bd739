"""Block Newton with discs, ellipses and intervals, against an interior point method."""

import numpy as np
import pytest
from conic import constrained_qp
from hypothesis import given, settings
from hypothesis import strategies as st
from test_mpgp import around_circles, as_set, program
from test_qp import matrix, vector

from tfeti_dolfinx.qp.coarse import DenseCoarse, NoCoarse, imbalance
from tfeti_dolfinx.qp.homogenised import homogenise, operator_product
from tfeti_dolfinx.qp.newton import feasible_start, first_point, newton
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, ResidualRule, Start, no_monitor
from tfeti_dolfinx.qp.projection import (
    UNBALANCED,
    OnBoundary,
    project_onto_feasible,
)
from tfeti_dolfinx.qp.sets import Bounds, Discs, Ellipses, Product, Status


def solved(qp, tolerance, monitor=no_monitor, start=None):
    at = operator_product(qp.F, feasible_start(qp, start) if start else first_point(qp))
    rule = ResidualRule(tolerance)
    return newton(qp, homogenise(qp, at), rule, max_it=2000, start=start, monitor=monitor)


def agrees_with_an_interior_point_method(seed, k, isotropic):
    F, d, G, e, bounded, pairs, a = program(seed, k, isotropic)
    feasible = as_set(bounded, pairs, a, isotropic)
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), feasible)
    result = solved(qp, 1e-10 * np.linalg.norm(d))
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    lam = result.lam.array
    exact = constrained_qp(F, d, G, e, bounded, pairs, a)
    assert np.linalg.norm(lam - exact) <= 1e-7 * np.linalg.norm(exact)
    assert np.allclose(feasible.project(lam), lam, rtol=0, atol=1e-13)
    assert np.allclose(G @ lam, e, atol=1e-10)


PROGRAMS = given(st.integers(0, 1000), st.sampled_from([1, 2]), st.booleans())


@settings(max_examples=25)
@PROGRAMS
def test_it_agrees_with_an_interior_point_method(seed, k, isotropic):
    agrees_with_an_interior_point_method(seed, k, isotropic)


@pytest.mark.slow
@PROGRAMS
def test_it_agrees_for_many_programs(seed, k, isotropic):
    agrees_with_an_interior_point_method(seed, k, isotropic)


@pytest.mark.parametrize("isotropic", [True, False])
@pytest.mark.parametrize("seed", range(5))
def test_the_cost_falls_and_iterates_are_feasible(seed, isotropic):
    F, d, G, e, bounded, pairs, a = program(seed, 2, isotropic)
    feasible, costs = as_set(bounded, pairs, a, isotropic), []

    def monitor(steps, step, x, projected_gradient, equality):
        if step in ("start", "outer"):
            lam = np.array(x.array_r)
            assert np.allclose(feasible.project(lam), lam, rtol=0, atol=1e-12)
            assert np.allclose(G @ lam, e, atol=1e-9)
            costs.append(0.5 * lam @ F @ lam - d @ lam)

    solved(QP(matrix(F), vector(d), DenseCoarse(G, e), feasible), 1e-9, monitor)
    assert len(costs) > 3
    assert np.all(np.diff(costs) <= 1e-12 * np.abs(costs[-1]))


@given(st.integers(0, 1000))
def test_where_all_points_slide_the_end_is_superlinear(seed):
    F, d, radius = around_circles(seed)
    residuals = []

    def monitor(steps, step, x, projected_gradient, equality):
        if step == "outer":
            residuals.append(projected_gradient)

    qp = QP(matrix(F), vector(d), NoCoarse(), Discs(radius))
    result = solved(qp, 1e-11 * np.linalg.norm(d), monitor)
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    assert np.all(result.face.status == Status.SLIP)
    exact = constrained_qp(
        F,
        d,
        np.zeros((0, 24)),
        np.zeros(0),
        [],
        np.arange(24).reshape(12, 2),
        np.repeat(radius[:, None], 2, axis=1),
    )
    assert np.linalg.norm(result.lam.array - exact) <= 1e-8 * np.linalg.norm(exact)
    assert len(residuals) <= 12


def test_from_its_own_solution_it_multiplies_once():
    F, d, G, e, bounded, pairs, a = program(3, 2, True)
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), as_set(bounded, pairs, a, True))
    found = solved(qp, 1e-10)
    again = solved(qp, 1e-8, start=Start(found.lam, found.mu))
    assert again.steps.cg == again.steps.outer == 0
    assert np.allclose(again.lam.array, found.lam.array, atol=1e-9)


@given(st.integers(0, 1000), st.booleans())
def test_the_nearest_feasible_point(seed, isotropic):
    _, _, G, e, bounded, pairs, a = program(seed, 2, isotropic)
    y = 2.0 * np.random.default_rng(seed).standard_normal(40)
    feasible = as_set(bounded, pairs, a, isotropic)
    found = project_onto_feasible(DenseCoarse(G, e), feasible, vector(y))
    assert found.missing <= 1e-12
    exact = constrained_qp(np.eye(40), y, G, e, bounded, pairs, a)
    assert np.linalg.norm(found.lam.array - exact) <= 1e-7 * np.linalg.norm(exact)


@given(st.integers(0, 1000))
def test_within_a_face_what_slips_stays_on_its_boundary(seed):
    rng = np.random.default_rng(seed)
    a = rng.uniform(0.2, 2.0, (30, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, 30)
    x = (a * np.stack((np.cos(angle), np.sin(angle)), axis=1)).ravel()
    for feasible in (Ellipses(a), Discs(a[:, 0])):
        on = feasible.project(10.0 * x)
        face = feasible.face(on, np.zeros(60))
        normal = feasible.project(2.0 * on) - 2.0 * on
        near = on + 0.05 * np.repeat(a.min(axis=1), 2) * rng.uniform(-1.0, 1.0, 60)
        y = OnBoundary(feasible, face).project(near)
        assert np.all(feasible.face(y, np.zeros(60)).status == Status.SLIP)
        # the way to the nearest point of a boundary is normal to it
        tangents = feasible.face(y, normal).Z
        assert np.allclose(tangents.T @ (near - y), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", [91, 356, 449])
def test_a_solve_that_begins_elsewhere_begins_anew(seed):
    """On the face that PCPG has stopped on; with its last direction it took 146 to 2000 steps."""
    F, d, G, e, bounded, pairs, a = program(seed, 1, True)
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), as_set(bounded, pairs, a, True))
    result = solved(qp, 1e-10 * np.linalg.norm(d))
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    assert result.steps.cg <= 50


def test_forces_far_beyond_small_discs_do_not_hide_what_balances():
    """As from a step in which all sticks to bounds that are a millionth of its forces."""
    missed, small, n = [], 1e-6, 6
    for seed in range(20):
        rng = np.random.default_rng(seed)
        G, radius = rng.normal(size=(4, 2 * n)), small * 10.0 ** rng.uniform(-2.0, 2.0, n)
        feasible = Product(
            [(np.arange(n), Bounds()), (np.arange(n, 2 * n), Ellipses(radius[:, None]))]
        )
        balanced = np.concatenate((small * rng.uniform(size=n), radius * rng.uniform(-1.0, 1.0, n)))
        coarse, y = DenseCoarse(G, G @ balanced), vector(rng.normal(size=2 * n))
        missed.append(project_onto_feasible(coarse, feasible, y).missing)
        qp = QP(matrix(np.eye(2 * n)), y, coarse, feasible)
        lam = feasible_start(qp, Start(y, np.zeros(4)))
        assert imbalance(coarse, lam) <= UNBALANCED
        assert np.array_equal(feasible.project(lam.array_r), lam.array_r)
    assert max(missed) > 0.1


@pytest.mark.parametrize("scale", [1.0, 1e2])
def test_small_discs_balance_beside_large_forces(scale):
    """What steps miss near by may be kinks of small discs, and no rounding of large forces."""
    for seed in range(20):
        rng, n = np.random.default_rng(seed), 40
        radius, G = 10.0 ** rng.uniform(-3.0, 0.0, n), np.zeros((3, 2 * n + 1))
        G[:2, :-1], G[2, -1] = rng.normal(size=(2, 2 * n)), 1.0
        within = np.repeat(radius, 2) * rng.uniform(-0.7, 0.7, 2 * n)
        balanced = np.append(within, 1e8)
        y = balanced + np.append(scale * np.repeat(radius, 2) * rng.normal(size=2 * n), 0.0)
        feasible = Product([(np.arange(2 * n), Discs(radius))])
        found = project_onto_feasible(DenseCoarse(G, G @ balanced), feasible, vector(y))
        assert np.linalg.norm(G @ (found.lam.array - balanced)) <= 1e-12 * 1e8


def test_what_nothing_in_the_set_balances_is_said():
    """Two discs of radius 1 cannot carry 3."""
    qp = QP(
        matrix(np.eye(4)),
        vector(np.ones(4)),
        DenseCoarse(np.array([[1.0, 0.0, 1.0, 0.0]]), np.array([3.0])),
        Discs(np.ones(2)),
    )
    assert solved(qp, 1e-9).reason == ConvergedReason.DIVERGED_STALLED


@pytest.mark.parametrize("seed", range(4))
def test_a_slip_ends_where_its_boundary_bends_and_is_no_contradiction(seed):
    """F does not see a way along circles of two forces that are one; Ω bounds both."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((2, 4))
    A[:, 2:] = A[:, :2]
    F, d = A.T @ A, 3.0 * rng.standard_normal(4)
    feasible = Discs(np.array([1.0, 0.5]))
    result = solved(QP(matrix(F), vector(d), NoCoarse(), feasible), 1e-8)
    lam = result.lam.array
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    assert np.allclose(feasible.project(lam - (F @ lam - d)), lam, atol=1e-6)
