"""Segments against scipy's half-space intersections, and by their areas."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from tfeti_dolfinx.mortar.segments import common_parts

pytestmark = pytest.mark.usefixtures("serial_only")


def random_convex(rng, k, n):
    """n convex polygons of k vertices, in random orientation."""
    spread = np.sort(np.mod(2 * np.pi * np.arange(k) / k + 0.3 * rng.random((n, k)), 2 * np.pi))
    points = np.stack((np.cos(spread), np.sin(spread)), axis=2) * rng.uniform(0.2, 2, (n, 1, 1))
    points += rng.uniform(-1, 1, (n, 1, 2))
    flip = rng.random(n) < 0.5
    return np.where(flip[:, None, None], points[:, ::-1], points)


def exact_area(p, q):
    """Area of the common part of two convex polygons, from their half planes."""
    planes = np.concatenate((ConvexHull(p).equations, ConvexHull(q).equations))
    norms = np.linalg.norm(planes[:, :2], axis=1)
    result = linprog(
        [0, 0, -1],
        A_ub=np.column_stack((planes[:, :2], norms)),
        b_ub=-planes[:, 2],
        bounds=[(None, None), (None, None), (0, None)],
    )
    if not result.success or result.x[2] < 1e-9:
        return 0.0
    try:
        return ConvexHull(HalfspaceIntersection(planes, result.x[:2]).intersections).volume
    except QhullError:
        return 0.0


@settings(max_examples=60)
@given(st.integers(3, 4), st.integers(3, 4), st.integers(0, 10**6))
def test_areas_of_common_parts(k, m, seed):
    rng = np.random.default_rng(seed)
    p, q = random_convex(rng, k, 4), random_convex(rng, m, 4)
    parts = common_parts(p, q)
    owner, _, weight = parts.quadrature(1)
    area = np.bincount(owner, weight, minlength=4)
    assert np.allclose(parts.size, area, atol=1e-12)
    assert np.allclose(area, [exact_area(a, b) for a, b in zip(p, q, strict=True)], atol=1e-9)
    owner, _, weight = common_parts(q, p).quadrature(1)
    assert np.allclose(np.bincount(owner, weight, minlength=4), area, atol=1e-12)


def test_a_polygon_in_itself_and_apart():
    square = np.array([[[0, 0], [1, 0], [1, 1], [0, 1]]], dtype=float)
    parts = common_parts(square, square)
    assert parts.count.tolist() == [4]
    assert np.array_equal(np.sort(parts.vertices[0, :4], axis=0), np.sort(square[0], axis=0))
    for shift in ((1, 0), (0, -1), (3, 3)):  # side by side counts as apart
        apart = common_parts(square + np.array(shift), square)
        assert apart.count.tolist() == [0]
        assert apart.size.tolist() == [0.0]


def test_quadrature_is_exact_on_polygons():
    rng = np.random.default_rng(0)
    parts = common_parts(random_convex(rng, 4, 50), random_convex(rng, 3, 50))
    fine = parts.quadrature(8)
    for degree in (1, 2, 4):
        owner, x, w = parts.quadrature(degree)
        value = np.bincount(owner, w * (1 + x[:, 0]) ** degree, minlength=50)
        exact = np.bincount(fine[0], fine[2] * (1 + fine[1][:, 0]) ** degree, minlength=50)
        assert np.allclose(value, exact, atol=1e-12)


def test_intervals():
    first, second = np.array([[0, 1], [1, 0], [0, 1.0]]), np.array([[0.5, 2], [0.2, 0.4], [1, 2]])
    parts = common_parts(first[:, :, None], second[:, :, None])
    ends = parts.vertices[:2, :, 0]
    assert np.allclose(ends, [[0.5, 1], [0.2, 0.4]])
    assert parts.count.tolist() == [2, 2, 0]
    owner, x, w = parts.quadrature(3)
    assert np.allclose(
        np.bincount(owner, w * x[:, 0] ** 3), (ends[:, 1] ** 4 - ends[:, 0] ** 4) / 4
    )
