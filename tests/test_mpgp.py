"""MPGP and SMALSE-M with discs, ellipses and intervals, against an interior point method."""

from dataclasses import replace

import numpy as np
import pytest
from conic import constrained_qp
from hypothesis import given, settings
from hypothesis import strategies as st
from test_qp import matrix, to, vector

from tfeti_dolfinx.qp.coarse import DenseCoarse
from tfeti_dolfinx.qp.homogenised import homogenise
from tfeti_dolfinx.qp.krylov import estimate_norm
from tfeti_dolfinx.qp.mprgp import MprgpIterate, MprgpParameters, mprgp, step_on_face
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Steps
from tfeti_dolfinx.qp.sets import Bounds, Discs, Ellipses, Product, Status
from tfeti_dolfinx.qp.smalse import smalse


def program(seed, k, isotropic, m=40, r=4):
    """F, d, G, e, rows λ ≥ 0, rows of ellipses and their semi-axes; a point fulfils it all."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((m, m))
    F = X @ X.T / m + 0.05 * np.eye(m)
    order = rng.permutation(m)
    bounded, pairs = order[:10], order[10 : 10 + 10 * k].reshape(10, k)
    a = 0.3 * rng.uniform(0.2, 2.0, (10, k)) * (rng.random((10, k)) < 0.9)
    if isotropic:
        a = np.repeat(a[:, :1], k, axis=1)
    inside = rng.standard_normal(m)
    inside[bounded] = np.abs(inside[bounded])
    inside[pairs] = 0.5 * a * rng.uniform(-1.0, 1.0, (10, k))
    G = rng.standard_normal((r, m))
    return F, rng.standard_normal(m), G, G @ inside, bounded, pairs, a


def as_set(bounded, pairs, a, isotropic):
    discs = Discs(a[:, 0], a.shape[1]) if isotropic else Ellipses(a)
    return Product([(bounded, Bounds()), (pairs.ravel(), discs)])


def smalse_agrees(seed, k, isotropic):
    """With an interior point method."""
    F, d, G, e, bounded, pairs, a = program(seed, k, isotropic)
    coarse, feasible = DenseCoarse(G, e), as_set(bounded, pairs, a, isotropic)
    qp = QP(matrix(F), vector(d), coarse, feasible)
    qp = replace(qp, norm=estimate_norm(qp.F, coarse, qp.d, 60))
    homogenised = homogenise(qp)
    result = smalse(qp, homogenised, to(1e-10, homogenised), max_it=20_000)
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    lam = result.lam.array
    exact = constrained_qp(F, d, G, e, bounded, pairs, a)
    assert np.linalg.norm(lam - exact) <= 1e-7 * np.linalg.norm(exact)
    assert np.allclose(feasible.project(lam), lam, rtol=0, atol=1e-13)


PROGRAMS = given(st.integers(0, 1000), st.sampled_from([1, 2]), st.booleans())


@settings(max_examples=25)
@PROGRAMS
def test_smalse_agrees_with_an_interior_point_method(seed, k, isotropic):
    smalse_agrees(seed, k, isotropic)


@pytest.mark.slow
@PROGRAMS
def test_smalse_agrees_for_many_programs(seed, k, isotropic):
    smalse_agrees(seed, k, isotropic)


def test_mpgp_slides_sticks_and_falls_off():
    """min ½‖Ax − b‖²-like with a disc pushed outwards, one that is not, and one of radius 0."""
    A = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    A[0, 1] = A[1, 0] = 0.5
    b = np.array([3.0, 1.0, 0.3, 0.4, 1.0, 1.0])
    discs = Discs(np.array([1.0, 1.0, 0.0]))
    x, g, steps = vector(np.zeros(6)), vector(-b), Steps()
    state = MprgpIterate(matrix(A), x, g, discs)
    parameters = MprgpParameters(1.0 / 6.5)
    assert mprgp(state, parameters, lambda s: s.projected_gradient <= 1e-9, steps, 500) is None
    exact = constrained_qp(
        A,
        b,
        np.zeros((0, 6)),
        np.zeros(0),
        [],
        np.arange(6).reshape(3, 2),
        np.array([[1.0] * 2] * 2 + [[0.0] * 2]),
    )
    assert np.allclose(x.array, exact, atol=1e-9)
    slip, stick, fixed = Status.SLIP, Status.STICK, Status.OPEN
    assert state.face().status.tolist() == [slip, slip, stick, stick, fixed, fixed]
    assert np.allclose(g.array, A @ x.array - b, atol=1e-12)
    assert steps.proportioning > 0


def test_the_cost_falls_in_each_step():
    F, d, _, _, bounded, pairs, a = program(3, 2, True)
    x, costs = vector(np.zeros(40)), []
    state = MprgpIterate(matrix(F), x, vector(-d), as_set(bounded, pairs, a, True))

    def stop(s):
        costs.append(0.5 * float(s.x.array @ (s.g.array - d)))
        return s.projected_gradient <= 1e-10

    assert mprgp(state, MprgpParameters(1.0 / np.linalg.norm(F, 2)), stop, Steps(), 2000) is None
    assert np.all(np.diff(costs) <= 1e-13 * np.abs(costs).max())


def around_circles(seed, n=12):
    """F and d that push all of n discs outwards, in different directions."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((2 * n, 2 * n))
    F = X @ X.T / (2 * n) + 0.05 * np.eye(2 * n)
    return F, 30.0 * rng.standard_normal(2 * n), rng.uniform(0.1, 1.0, n)


@given(st.integers(0, 1000))
def test_steps_on_faces_find_the_minimum(seed):
    """All points slide: tangents and the boundary's curvature are all that there is."""
    F, d, radius = around_circles(seed)
    discs, pairs = Discs(radius), np.arange(24).reshape(12, 2)
    a = np.repeat(radius[:, None], 2, axis=1)
    exact = constrained_qp(F, d, np.zeros((0, 24)), np.zeros(0), [], pairs, a)
    x = vector(discs.project(exact + 1e-3 * np.sin(np.arange(24.0))))
    start = np.linalg.norm(x.array - exact)
    state = MprgpIterate(matrix(F), x, vector(F @ x.array - d), discs)
    for _ in range(60):
        if step_on_face(state, MprgpParameters(1.0 / np.linalg.norm(F, 2))) == 0:
            break
        state.split()
    assert np.linalg.norm(x.array - exact) <= 1e-5 * start
    assert np.allclose(state.g.array, F @ x.array - d, atol=1e-9)


@given(st.integers(0, 1000))
def test_each_step_on_a_curved_set_lowers_the_cost(seed):
    F, d, _, _, bounded, pairs, a = program(seed, 2, True)
    feasible, norm = as_set(bounded, pairs, a, True), np.linalg.norm(F, 2)
    rng = np.random.default_rng(seed)
    x = vector(feasible.project(3.0 * rng.standard_normal(40)))
    state = MprgpIterate(matrix(F), x, vector(F @ x.array - d), feasible)
    costs = [0.5 * float(x.array @ (state.g.array - d))]
    for on_face in (True, False) * 4:
        if on_face:
            step_on_face(state, MprgpParameters(1.0 / norm))
        else:
            state.move_to(x.array - state.g.array / norm)
        state.split()
        costs.append(0.5 * float(x.array @ (state.g.array - d)))
        assert np.allclose(state.g.array, F @ x.array - d, atol=1e-10)
        assert np.allclose(feasible.project(x.array), x.array, rtol=0, atol=1e-12)
    assert np.all(np.diff(costs) <= 1e-13 * np.abs(costs).max())
    assert costs[-1] < costs[0]
