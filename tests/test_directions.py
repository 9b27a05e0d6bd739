"""Directions that conjugate gradients keep."""

from dataclasses import replace

import numpy as np
import pytest

from tfeti_dolfinx.qp.coarse import DenseCoarse
from tfeti_dolfinx.qp.krylov import Directions, pcpg
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Point, Steps, StoppingRule
from tfeti_dolfinx.qp.recycling import DirectionStore
from tfeti_dolfinx.qp.sets import Product

pytestmark = pytest.mark.usefixtures("serial_only")

n = 60


def program(spread):
    """A program whose F has eigenvalues from 1 to ``spread``, and its minimiser."""
    rng = np.random.default_rng(0)
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    F = V @ np.diag(np.geomspace(1.0, spread, n)) @ V.T
    F = 0.5 * (F + F.T)
    G = rng.standard_normal((3, n))
    N = np.linalg.svd(G)[2][3:].T
    d = F @ rng.standard_normal(n)
    known = N @ np.linalg.solve(N.T @ F @ N, N.T @ d)
    return QP(F.__matmul__, d, DenseCoarse(G, np.zeros(3)), Product()), F, known


def solved(qp, directions, target, most=1000):
    steps, point = Steps(), Point(np.zeros(n), -qp.d)
    target *= np.linalg.norm(point.g)
    reason = pcpg(qp, point, StoppingRule(target), steps, most, directions=directions)
    return reason, steps.cg, point.lam


@pytest.mark.parametrize(("spread", "times"), [(1e2, 1.0), (1e6, 1.1), (1e8, 3.0)])
def test_hardly_more_steps_than_dimensions(spread, times):
    """In exact arithmetic no more; with the last direction alone rounding makes it many more."""
    qp, F, known = program(spread)
    reason, steps, found = solved(qp, Directions(qp), 1e-9)
    assert reason == ConvergedReason.CONVERGED_RTOL
    assert steps <= times * n
    error = found - known
    assert error @ F @ error <= 1e-10 * (known @ F @ known)
    _, more, _ = solved(qp, Directions(replace(qp, keeps=False)), 1e-9, 5000)
    assert more >= (steps if spread < 1e6 else 4 * steps)


def test_directions_are_conjugate():
    qp, F, _ = program(1e6)
    directions = Directions(qp)
    _, steps, _ = solved(qp, directions, 0.0, 40)
    kept = directions.kept
    assert kept.count == steps == 40
    P = kept.directions
    assert np.abs(P @ F @ P.T - np.eye(40)).max() <= 1e-6
    kept.clear()
    assert kept.images.shape == (0, n)


def test_where_memory_does_not_last_the_oldest_goes():
    kept = DirectionStore(3, 2)
    for k in range(4):
        kept.put(np.full(2, k), np.full(2, -k))
    assert kept.count == 3
    assert sorted(kept.directions[:, 0]) == [1, 2, 3]
    assert np.array_equal(kept.images, -kept.directions)
