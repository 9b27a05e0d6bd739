"""The estimate of ‖PFP‖: the fixed step of MPRGP diverges where it is too small."""

import numpy as np
import pytest
from test_qp import matrix

from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.coarse import DenseCoarse
from tfeti_dolfinx.qp.krylov import estimate_norm

# with the step ᾱ = 1.95/‖·‖ of the default options ‖A‖ᾱ ≤ 2 needs 0.975 of the norm
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


def operator(values, seed):
    """A symmetric matrix of these eigenvalues in a random basis."""
    basis, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((SIZE, SIZE)))
    return (basis * values) @ basis.T


def holds(estimate, exact):
    assert LEAST * exact <= estimate <= MOST * exact, estimate / exact


@pytest.mark.parametrize("kind", list(SPECTRA))
def test_norm_of_any_spectrum(kind):
    F = operator(SPECTRA[kind], 0)
    estimate = estimate_norm(
        matrix(F),
        DenseCoarse(np.zeros((0, SIZE)), np.zeros(0)),
        Options().norm_steps,
    )
    holds(estimate, np.linalg.norm(F, 2))
