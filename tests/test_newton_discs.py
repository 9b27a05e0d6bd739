"""Block Newton and SMALSE-M with discs and intervals: optimal by an independent projection."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.untorn import check_optimal
from test_discs import discs
from test_mpgp import around_circles, as_set, program
from test_qp import Counted, matrix, to, vector

from tfeti_dolfinx.qp.krylov import estimate_norm
from tfeti_dolfinx.qp.newton import feasible_start, first_point, newton
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, StoppingRule, homogenise, no_monitor
from tfeti_dolfinx.qp.projection import project_onto_feasible
from tfeti_dolfinx.qp.sets import Status
from tfeti_dolfinx.qp.smalse import smalse
from tfeti_dolfinx.testing import DenseCoarse


def solved(qp, tolerance, monitor=no_monitor, lam=None, mu=None):
    at = homogenise(qp, first_point(qp) if lam is None else feasible_start(qp, lam))
    start = replace(at, lam=lam, mu=mu)
    return newton(qp, start, StoppingRule(tolerance), max_it=3000, monitor=monitor)


@settings(max_examples=12)
@given(st.integers(0, 1000), st.sampled_from([1, 2]), st.booleans())
def test_random_programs(seed, k, isotropic):
    """By block Newton and by SMALSE-M."""
    F, d, G, e, bounded, pairs, a = program(seed, k, isotropic)
    feasible = as_set(bounded, pairs, a, isotropic)
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), feasible)
    start, norm = homogenise(qp), estimate_norm(qp.F, qp.coarse, 60)
    slow = smalse(replace(qp, norm=norm), start, to(1e-10, start), max_it=20_000)
    for result in (solved(qp, 1e-10 * np.linalg.norm(d)), slow):
        assert result.reason == ConvergedReason.CONVERGED_RTOL
        lam = result.lam
        check_optimal(F, d, G, e, bounded, lam, pairs=pairs, axes=a)
        assert np.allclose(feasible.project(lam), lam, rtol=0, atol=1e-13)


@pytest.mark.parametrize("isotropic", [True, False])
def test_the_cost_falls_and_iterates_are_feasible(isotropic):
    F, d, G, e, bounded, pairs, a = program(0, 2, isotropic)
    feasible, costs = as_set(bounded, pairs, a, isotropic), []

    def monitor(steps, step, x, projected_gradient, equality):
        if step in ("start", "outer"):
            lam = x
            assert np.allclose(feasible.project(lam), lam, rtol=0, atol=1e-12)
            assert np.allclose(G @ lam, e, atol=1e-9)
            costs.append(0.5 * lam @ F @ lam - d @ lam)

    solved(QP(matrix(F), vector(d), DenseCoarse(G, e), feasible), 1e-9, monitor)
    assert len(costs) > 3
    assert np.all(np.diff(costs) <= 1e-12 * np.abs(costs[-1]))


@settings(max_examples=8)
@given(st.integers(0, 1000))
def test_where_all_points_slide_the_end_is_superlinear(seed):
    F, d, radius = around_circles(seed)
    residuals = []

    def monitor(steps, step, x, projected_gradient, equality):
        if step == "outer":
            residuals.append(projected_gradient)

    qp = QP(matrix(F), vector(d), DenseCoarse(np.zeros((0, len(d))), np.zeros(0)), discs(radius))
    result = solved(qp, 1e-11 * np.linalg.norm(d), monitor)
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    assert np.all(result.face.status == Status.SLIP)
    pairs, axes = np.arange(24).reshape(12, 2), np.repeat(radius[:, None], 2, axis=1)
    check_optimal(F, d, np.zeros((0, 24)), np.zeros(0), [], result.lam, pairs=pairs, axes=axes)
    assert len(residuals) <= 12


def test_from_its_own_solution_it_multiplies_once():
    F, d, G, e, bounded, pairs, a = program(3, 2, True)
    F = Counted(matrix(F))
    qp = QP(F, vector(d), DenseCoarse(G, e), as_set(bounded, pairs, a, True))
    found, before = solved(qp, 1e-10), F.count
    again = solved(replace(qp, norm=found.norm), 1e-8, lam=found.lam, mu=found.mu)
    assert again.steps.cg == again.steps.outer == 0
    assert F.count == before + 1
    assert np.allclose(again.lam, found.lam, atol=1e-9)


@settings(max_examples=10)
@given(st.integers(0, 1000), st.booleans())
def test_the_nearest_feasible_point(seed, isotropic):
    _, _, G, e, bounded, pairs, a = program(seed, 2, isotropic)
    y = 2.0 * np.random.default_rng(seed).standard_normal(40)
    feasible = as_set(bounded, pairs, a, isotropic)
    found, _ = project_onto_feasible(DenseCoarse(G, e), feasible, vector(y))
    assert np.allclose(G @ found, e, rtol=0.0, atol=1e-11)
    check_optimal(np.eye(40), y, G, e, bounded, found, pairs=pairs, axes=a)


def test_what_nothing_in_the_set_balances_is_said():
    """Two discs of radius 1 cannot carry 3."""
    qp = QP(
        matrix(np.eye(4)),
        vector(np.ones(4)),
        DenseCoarse(np.array([[1.0, 0.0, 1.0, 0.0]]), np.array([3.0])),
        discs(np.ones(2)),
    )
    assert solved(qp, 1e-9).reason == ConvergedReason.DIVERGED_STALLED


@pytest.mark.parametrize("seed", range(2))
def test_a_slip_ends_where_its_boundary_bends_and_is_no_contradiction(seed):
    """F does not see a way along circles of two forces that are one; Ω bounds both."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((2, 4))
    A[:, 2:] = A[:, :2]
    F, d = A.T @ A, 3.0 * rng.standard_normal(4)
    feasible = discs(np.array([1.0, 0.5]))
    result = solved(
        QP(matrix(F), vector(d), DenseCoarse(np.zeros((0, len(d))), np.zeros(0)), feasible), 1e-8
    )
    lam = result.lam
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    assert np.allclose(feasible.project(lam - (F @ lam - d)), lam, atol=1e-6)
