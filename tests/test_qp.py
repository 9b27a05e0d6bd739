"""QP solvers on small programs, without meshes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from reference.untorn import check_optimal
from scipy.sparse import diags_array

from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.krylov import estimate_norm, solve_by_pcpg
from tfeti_dolfinx.qp.mprgp import MprgpIterate, MprgpParameters, mprgp
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Steps, StoppingRule, homogenise
from tfeti_dolfinx.qp.sets import Bounds, Product
from tfeti_dolfinx.qp.smalse import SmalseParameters, smalse
from tfeti_dolfinx.testing import DenseCoarse

SELF = MPI.COMM_SELF


class Counted:
    """An operator that counts."""

    def __init__(self, A):
        self.A, self.count = A, 0

    def __call__(self, x):
        self.count += 1
        return self.A(x)


def matrix(A):
    """x ↦ A x."""
    return np.asarray(A, dtype=float).__matmul__


def vector(values):
    return np.array(values, dtype=float)


def bounds_on(rows):
    """λ ≥ 0 on some rows."""
    return Product([(rows, Bounds())])


def to(rtol, homogenised):
    """Residuals down to rtol·b₀."""
    return StoppingRule(rtol * homogenised.reference)


def random_program(seed, m=40, r=5, n_bounded=20):
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((m, m))
    F = X @ X.T / m + 0.05 * np.eye(m)
    G = rng.standard_normal((r, m))
    bounded = np.arange(m - n_bounded, m)
    feasible = rng.standard_normal(m)
    feasible[bounded] = np.abs(feasible[bounded])
    return F, rng.standard_normal(m), G, G @ feasible, bounded


def string(n=100):
    """−u″ = −15 on (0, 1) over the obstacle of a well-known test of MPRGP, and its bounds."""
    h = 1 / (n - 1)
    A = diags_array([-np.ones(n - 1), 2 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
    A = A.toarray()
    A[0, :], A[-1, :], A[:, 0], A[:, -1] = 0, 0, 0, 0
    A[0, 0] = A[-1, -1] = 1
    b = np.full(n, -30 * h * h)
    b[0] = b[-1] = 0
    lower = np.sin(4 * np.pi * np.linspace(0, 1, n) - np.pi / 6) / 2 - 2
    lower[0] = lower[-1] = 0
    return A, b, lower


# steps of PERMON's MPGP on its tutorial ex1 with -n 100, whose step length comes from an estimate
# of ‖A‖
def test_mprgp_on_a_string_over_an_obstacle():
    A, b, lower = string()
    bounds = Bounds(lower)
    state, steps = MprgpIterate(matrix(A), vector(np.zeros(100)), vector(-b), bounds, SELF), Steps()
    parameters = MprgpParameters(1.95 / 4)
    tol = 1e-5 * np.linalg.norm(b)
    reason = mprgp(state, parameters, lambda s: s.projected_gradient <= tol, steps, 1000)
    assert reason is None
    found = np.array([steps.cg, steps.expansion, steps.proportioning])
    assert np.all(np.abs(found - (156, 18, 7)) <= (10, 3, 3))
    x, g = state.x, state.g
    assert np.all(x >= lower)
    assert np.allclose(g, A @ x - b, atol=1e-12)
    touching = x <= lower
    assert 5 <= touching.sum() <= 20
    assert np.all(g[touching] >= -1e-4 * tol)


def test_mprgp_reports_an_indefinite_operator():
    A = np.diag([1.0, -1.0])
    state = MprgpIterate(matrix(A), vector([1.0, 1.0]), vector([0.0, -2.0]), Product(), SELF)
    reason = mprgp(state, MprgpParameters(0.5), lambda s: False, Steps(), 10)
    assert reason == ConvergedReason.DIVERGED_INDEFINITE_MAT


@given(st.integers(0, 1000))
def test_pcpg_solves_the_saddle_point_system(seed):
    F, d, G, e, _ = random_program(seed, n_bounded=0)
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), Product())
    homogenised = homogenise(qp)
    result = solve_by_pcpg(qp, homogenised, to(1e-12, homogenised))
    check_optimal(F, d, G, e, [], result.lam, 1e-10)


@pytest.mark.parametrize("M", [1e6, 1e-6])
def test_smalse_says_that_nothing_fulfils_the_equality(M):
    """λ ≥ 0 and λ_1 + λ_2 = −√2 exclude each other."""
    coarse = DenseCoarse(np.ones((1, 2)) / np.sqrt(2), np.array([-1.0]))
    qp = QP(matrix(np.eye(2)), vector([0.0, 0.0]), coarse, Bounds(), norm=1.0)
    result = smalse(qp, homogenise(qp), StoppingRule(1e-6), SmalseParameters(M=M), max_it=5000)
    assert result.reason == ConvergedReason.DIVERGED_STALLED
    assert result.steps.outer < 2000


@given(st.integers(0, 1000), st.floats(0.05, 0.95), st.floats(-6, 6))
def test_smalse_converges_whatever_M_and_beta_are(seed, beta, exponent):
    F, d, G, e, bounded = random_program(seed)
    coarse = DenseCoarse(G, e)
    qp = QP(matrix(F), vector(d), coarse, bounds_on(bounded))
    homogenised = homogenise(qp)
    parameters = SmalseParameters(M=10.0**exponent, beta=beta)
    qp = replace(qp, norm=estimate_norm(qp.F, coarse, 40))
    result = smalse(qp, homogenised, to(1e-8, homogenised), parameters)
    assert result.reason == ConvergedReason.CONVERGED_RTOL
    check_optimal(F, d, G, e, bounded, result.lam, 1e-6)
    assert np.all(result.lam[bounded] >= -1e-15)
    stopped = smalse(qp, homogenised, to(1e-12, homogenised), parameters, max_it=3)
    assert stopped.reason == ConvergedReason.DIVERGED_ITS
    assert stopped.steps.inner == 3


# the fixed step of MPRGP, ᾱ = 1.95/‖·‖ in the default options, diverges where the estimate of ‖PFP‖
# is too small: ‖A‖ᾱ ≤ 2 needs 0.975 of the norm
LEAST, MOST = 0.975, 1.1
SIZE = 60
SPECTRA = {
    "one eigenvalue apart": np.append(np.linspace(0.1, 1.0, SIZE - 1), 5.0),
    "evenly spread": np.linspace(0.01, 1.0, SIZE),
    "two close at the top": np.append(np.linspace(0.0, 0.5, SIZE - 2), [0.99, 1.0]),
    "crowded at the top": 1.0 - np.linspace(0.0, 1.0, SIZE) ** 2,
    "all the same": np.ones(SIZE),
    "a single one": np.append(np.zeros(SIZE - 1), 3.0),
    "fourteen orders": np.logspace(-14, 0, SIZE),
    "tiny": 1e-12 * np.linspace(0.01, 1.0, SIZE),
}


@pytest.mark.parametrize("kind", list(SPECTRA))
def test_norm_of_any_spectrum(kind):
    """A symmetric matrix of these eigenvalues in a random basis."""
    basis, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((SIZE, SIZE)))
    F = (basis * SPECTRA[kind]) @ basis.T
    coarse = DenseCoarse(np.zeros((0, SIZE)), np.zeros(0))
    estimate = estimate_norm(matrix(F), coarse, Options().norm_steps)
    exact = np.linalg.norm(F, 2)
    assert LEAST * exact <= estimate <= MOST * exact, estimate / exact
