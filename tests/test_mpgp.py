"""MPGP with discs, ellipses and intervals: optimal by an independent projection."""

import numpy as np
from mpi4py import MPI
from reference.untorn import check_optimal
from test_discs import discs
from test_qp import matrix

from tfeti_dolfinx.qp.mprgp import MprgpIterate, MprgpParameters, mprgp
from tfeti_dolfinx.qp.problem import Steps
from tfeti_dolfinx.qp.sets import Bounds, Ellipses, Product, Status


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
    sets = Ellipses(np.repeat(a[:, :1], a.shape[1], axis=1) if isotropic else a)
    return Product([(bounded, Bounds()), (pairs.ravel(), sets)])


def test_mpgp_slides_sticks_and_falls_off():
    """min ½‖Ax − b‖²-like with a disc pushed outwards, one that is not, and one of radius 0."""
    A = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    A[0, 1] = A[1, 0] = 0.5
    b = np.array([3.0, 1.0, 0.3, 0.4, 1.0, 1.0])
    around = discs([1.0, 1.0, 0.0])
    steps = Steps()
    state = MprgpIterate(matrix(A), np.zeros(6), -b, around, MPI.COMM_SELF)
    parameters = MprgpParameters(1.0 / 6.5)
    assert mprgp(state, parameters, lambda s: s.projected_gradient <= 1e-9, steps, 500) is None
    pairs, axes = np.arange(6).reshape(3, 2), np.repeat([[1.0], [1.0], [0.0]], 2, axis=1)
    check_optimal(A, b, np.zeros((0, 6)), np.zeros(0), [], state.x, pairs=pairs, axes=axes)
    slip, stick, fixed = Status.SLIP, Status.STICK, Status.OPEN
    assert around.face(state.x, state.g).status.tolist() == [slip, slip, stick, stick, fixed, fixed]
    assert np.allclose(state.g, A @ state.x - b, atol=1e-12)
    assert steps.proportioning > 0
    # from a point a little inside, pushed outwards, it comes onto its circle
    x, b = np.array([1.0 - 1e-11, 0.0]), np.array([3.0, 0.0])
    state = MprgpIterate(matrix(np.eye(2)), x, x - b, discs([1.0]), MPI.COMM_SELF)
    assert mprgp(state, parameters, lambda s: s.projected_gradient <= 1e-14, steps, 50) is None
    assert np.allclose(state.x, (1.0, 0.0), rtol=0, atol=1e-14)


def around_circles(seed, n=12):
    """F and d that push all of n discs outwards, in different directions."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((2 * n, 2 * n))
    F = X @ X.T / (2 * n) + 0.05 * np.eye(2 * n)
    return F, 30.0 * rng.standard_normal(2 * n), rng.uniform(0.1, 1.0, n)
