"""Block Newton against independent solutions and SMALSE-M, and what it costs."""

import numpy as np
import pytest
from petsc4py import PETSc
from reference import dense_qp
from scipy.optimize import minimize
from test_qp import bounds_on, matrix, vector

from tfeti_dolfinx.qp.coarse import DenseCoarse, NoCoarse
from tfeti_dolfinx.qp.homogenised import homogenise, image
from tfeti_dolfinx.qp.nearest import nearest
from tfeti_dolfinx.qp.newton import feasible_start, first_point, newton
from tfeti_dolfinx.qp.problem import QP, Start
from tfeti_dolfinx.qp.stopping import ResidualRule


def program(seed, kind="regular"):
    """A random program with a feasible point; r and the share of bounds vary with the seed."""
    rng = np.random.default_rng(seed)
    m, r = int(rng.integers(10, 50)), int(rng.integers(1, 6))
    bounded = np.sort(rng.permutation(m)[: rng.integers(1, m - r)])
    A = rng.standard_normal((m, m)) * 10.0 ** rng.uniform(-1, 1, m)
    F = A @ A.T / m + 0.01 * np.eye(m)
    G = rng.standard_normal((r, m))
    if kind == "held by bounds":  # without rows that carry, G has no rank
        G[:, np.setdiff1d(np.arange(m), bounded)] = 0.0
    if kind == "dependent":  # two rows that are the same, but for what they demand
        one, two = bounded[0], bounded[-1]
        F[two], F[:, two], G[:, two] = F[one], F[:, one], G[:, one]
        F[two, two] = F[one, one]
        F[one, two] = F[two, one] = F[one, one]
    feasible = rng.standard_normal(m)
    feasible[bounded] = np.maximum(feasible[bounded], 0.0)
    return F, 3.0 * rng.standard_normal(m), G, G @ feasible, bounded


class Counted:
    """An operator that counts."""

    def __init__(self, A):
        self.A, self.count = matrix(A), 0

    def mult(self, x, y):
        self.count += 1
        self.A.mult(x, y)


def qp_of(F, d, G, e, bounded):
    return QP(Counted(F), vector(d), DenseCoarse(G, e), bounds_on(bounded))


def solved(qp, tolerance, start=None):
    at = image(qp.F, feasible_start(qp, start) if start else first_point(qp))
    found = newton(qp, homogenise(qp, at), ResidualRule(tolerance), max_it=3000, warm=bool(start))
    assert found.reason > 0
    return found


def check_optimal(F, d, G, e, bounded, result, share):
    """The conditions of Karush, Kuhn and Tucker, with the solver's own μ."""
    lam, size = result.lam.array_r, np.linalg.norm(d)
    s = F @ lam - d - G.T @ result.mu
    free = np.ones(len(lam), dtype=bool)
    free[bounded] = lam[bounded] > 0.0
    assert np.all(lam[bounded] >= 0.0)
    assert np.linalg.norm(G @ lam - e) <= 1e-10 * (1.0 + np.linalg.norm(e))
    assert np.abs(s[free]).max() <= share * size
    assert np.all(s[~free] >= -share * size)


KINDS = ["regular", "held by bounds", "dependent"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(15))
def test_random_programs(kind, seed):
    F, d, G, e, bounded = program(seed, kind)
    result = solved(qp_of(F, d, G, e, bounded), 1e-9)
    check_optimal(F, d, G, e, bounded, result, 1e-8)
