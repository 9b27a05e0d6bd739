"""Ellipses and discs: nearest points, gradients, steps and faces, against what they must fulfil."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tfeti_dolfinx.qp.sets import Bounds, Ellipses, Product, Status
from tfeti_dolfinx.testing import check_feasible_set

pytestmark = pytest.mark.usefixtures("serial_only")

SEEDS = st.integers(0, 10_000)


def discs(radius, k=2):
    """Of one entry each, intervals."""
    return Ellipses(np.repeat(np.asarray(radius, dtype=float)[:, None], k, axis=1))


def semi_axes(seed, n=8, k=2, smallest=1e-3):
    """Of all sizes, some of them 0."""
    rng = np.random.default_rng(seed)
    return smallest ** rng.random((n, k)) * 3.0 * (rng.random((n, k)) < 0.85)


def level(a, x):
    """Σ(x_j/a_j)² of points; entries that are fixed must be 0."""
    x = x.reshape(a.shape)
    assert np.all(x[a == 0.0] == 0.0)
    return np.sum(np.divide(x, a, out=np.zeros_like(x), where=a > 0.0) ** 2, axis=1)


@settings(max_examples=30)
@given(SEEDS, st.sampled_from([1.0, 1e-3, 1e-6]))
def test_discs_ellipses_intervals_and_their_product_fulfil_the_contract(seed, size):
    rng = np.random.default_rng(seed)
    radius, axes = rng.uniform(0.1, 3.0, 3) * (rng.random(3) < 0.8), semi_axes(seed, 4, 2, 0.05)
    order = rng.permutation(26)
    sets = [
        (order[:5], Bounds()),
        (order[5:11], discs(radius)),
        (order[11:19], Ellipses(axes)),
        (order[19:23], Ellipses(axes[:, :1])),
    ]
    check_feasible_set(Product(sets), 26, seed)
    for one, rows in ((discs(size * radius), 6), (discs(size * radius, 1), 3), (sets[2][1], 8)):
        check_feasible_set(one, rows, seed)
    far = Ellipses(np.array([[1.0, 2.0]])).project(np.array([1e200, 1e200]))
    assert far == pytest.approx(np.array([1.0, 4.0]) / 5**0.5)


@given(SEEDS, st.floats(-6, 6))
def test_projections_fulfil_the_variational_inequality(seed, exponent):
    """(z − P z)·(y − P z) ≤ 0 for all y of the set, and P z is in it."""
    rng = np.random.default_rng(seed)
    a = semi_axes(seed, smallest=1e-6)
    z = 10.0**exponent * rng.standard_normal(a.size)
    ellipses = Ellipses(a)
    x = ellipses.project(z)
    assert np.all(level(a, x) <= 1.0 + 1e-12)
    angle = rng.uniform(0.0, 2.0 * np.pi, (50, len(a)))
    y = a * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    away, inside = (z - x).reshape(a.shape), y - x.reshape(a.shape)
    products = np.sum(away * inside, axis=-1)
    sizes = np.linalg.norm(away, axis=-1) * np.maximum(np.linalg.norm(inside, axis=-1), 1e-300)
    assert np.all(products <= 1e-9 * sizes)
    assert np.allclose(ellipses.project(x), x, rtol=1e-12, atol=1e-15)


@given(SEEDS)
def test_discs_by_their_formulas(seed):
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.0, 2.0, 10) * (rng.random(10) < 0.9)
    z = 2.0 * rng.standard_normal(20)
    x, size = discs(radius).project(z), np.linalg.norm(z.reshape(-1, 2), axis=1)
    share = np.minimum(1.0, radius / size)[:, None]
    assert np.allclose(x.reshape(-1, 2), share * z.reshape(-1, 2), rtol=0, atol=1e-14)
    curvature = discs(radius).face(x, x - z).curvature
    slides = (size > radius) & (radius > 0.0)
    bent = curvature[len(curvature) - slides.sum() :]
    assert np.allclose(bent, size[slides] / radius[slides] - 1.0)


def test_intervals_are_bounds_from_both_sides():
    x = np.array([-3.0, -0.5, 0.5, 3.0, 1.0])
    intervals = discs(np.array([1.0, 1.0, 1.0, 1.0, 0.0]), 1)
    assert np.array_equal(intervals.project(x), [-1.0, -0.5, 0.5, 1.0, 0.0])
    y, g = intervals.project(x), np.array([1.0, 1.0, 1.0, 1.0, 1.0])
    face = intervals.face(y, g)
    assert np.array_equal(face.free, [0.0, 1.0, 1.0, 0.0, 0.0])
    assert np.array_equal(face.beta, [0.0, 0.0, 0.0, 1.0, 0.0])  # at −1 it pushes outwards
    slip, stick, fixed = Status.SLIP, Status.STICK, Status.OPEN
    assert face.status.tolist() == [slip, stick, stick, slip, fixed]
    assert face.Z.toarray().tolist() == [[0, 0], [1, 0], [0, 1], [0, 0], [0, 0]]
    assert intervals.max_step(
        np.array([0.0, 0.5, -0.5, 0.0, 0.0]), np.array([0, -2.0, 2, 0, 0])
    ) == (pytest.approx(0.25))


@given(SEEDS)
def test_what_is_projected_is_on_the_boundary(seed):
    rng = np.random.default_rng(seed)
    a = rng.uniform(0.1, 2.0, (10, 2))
    z = 5.0 * a * rng.standard_normal((10, 2))
    outside = level(a, z) > 1.0
    ellipses = Ellipses(a)
    x = ellipses.project(z.ravel())
    face = ellipses.face(x, np.ones(20))
    assert np.all((face.status.reshape(-1, 2) == Status.SLIP) == outside[:, None])
    assert np.array_equal(face.free, np.repeat(~outside, 2))


@given(SEEDS)
def test_the_longest_step_ends_on_the_boundary(seed):
    rng = np.random.default_rng(seed)
    a = rng.uniform(0.01, 2.0, (1, 2))
    x, p = Ellipses(a).project(rng.standard_normal(2)), rng.standard_normal(2)
    step = Ellipses(a).max_step(x, p)
    assert level(a, x - step * p)[0] == pytest.approx(1.0, abs=1e-9)


def test_a_point_that_cannot_move_has_no_step():
    fixed = Ellipses(np.array([[1.0, 0.0]]))
    assert fixed.max_step(np.zeros(2), np.array([1.0, 1.0])) == 0.0
    assert fixed.max_step(np.zeros(2), np.array([1.0, 0.0])) == 1.0
    assert fixed.max_step(np.zeros(2), np.zeros(2)) == np.inf
