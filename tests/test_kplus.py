"""K⁺ is a generalised inverse, on any kernel."""

import re

import numpy as np
import pytest
from scipy.linalg import pinvh
from scipy.sparse import csr_array, diags_array
from test_blocks import data, stiffness
from test_extensions import DensePinv

from tfeti_dolfinx.errors import ConformanceError
from tfeti_dolfinx.subdomains.block import candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.factor import NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import regularised
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.testing import check_block, check_kind_of_block, check_kind_of_inverse

CASES = [("triangle", 1, "none", 2), ("hexahedron", 1, "some", 2), ("tetrahedron", 2, "all", 2)]
CASES += [("quadrilateral", 1, "all", 1)]  # one cell: K_rr is empty


def subdomain(cell, degree=1, kernel="all", n=2):
    """K with springs that leave all, some or none of its kernel, and its nodes."""
    K, x = stiffness(cell, n, degree)
    spring, axis = np.zeros(K.shape[0]), x.shape[1] - 1
    held = {"all": slice(0), "some": slice(axis, None, axis + 1), "none": slice(None)}
    spring[held[kernel]] = 1e-3
    return csr_array(K + diags_array(spring)), x


@pytest.mark.parametrize(("cell", "degree", "kernel", "n"), CASES)
def test_a_generalised_inverse(cell, degree, kernel, n):
    """K K⁺ K = K; symmetric, semidefinite; beside the kernel it is the pseudo-inverse."""
    sparse, x = subdomain(cell, degree, kernel, n)
    b = SparseBlock(data(sparse.copy(), x, every=n))
    check_block(b, sparse)
    K, pinv = sparse.toarray(), b.stiffness.solve(np.eye(sparse.shape[0]))
    if kernel != "all":
        K = K - b.springs.stretches @ np.diag(b.springs.stiffness) @ b.springs.stretches.T
    largest = np.abs(pinv).max()
    alone = b.stiffness.solve(np.eye(len(K))[:, :1])
    assert np.allclose(alone, pinv[:, :1], rtol=0, atol=1e-12 * largest)
    assert np.allclose(K @ pinv @ K, K, rtol=0, atol=1e-10 * np.abs(K).max())
    assert np.allclose(pinv, pinv.T, rtol=0, atol=1e-11 * largest)
    assert np.linalg.eigvalsh(pinv).min() >= -1e-11 * largest
    free = np.eye(len(K)) - b.kernel @ b.kernel.T
    assert np.allclose(free @ pinv @ free, pinvh(K, rtol=1e-12), rtol=0, atol=1e-9 * largest)


def test_published_checks_hold_and_find_what_is_wrong():
    check_kind_of_inverse(regularised)
    check_kind_of_block(SparseBlock)
    check_kind_of_inverse(DensePinv)

    class Crooked(DensePinv):
        def solve(self, b):
            return np.roll(super().solve(b), 1)

    with pytest.raises(ConformanceError, match=f"does not hold: {re.escape('K K⁺ K = K')}"):
        check_kind_of_inverse(Crooked)


def test_a_negative_energy_is_found_in_a_matrix_of_symmetric_pattern():
    K, x = stiffness("quadrilateral")
    R = kernel_of(K, candidate_modes(x, 2, x.mean(axis=0), 1.0))
    fixing = fixing_dofs(x, np.arange(K.shape[0]) // 2)
    values, vectors = np.linalg.eigh(bad := K.toarray())
    softest = vectors[:, R.shape[1]]
    bad -= 2.0 * values[R.shape[1]] * np.outer(softest, softest)
    with pytest.raises(NotPositiveDefiniteError):
        regularised(csr_array(bad), R, fixing)
    # rounding that leaves 0 in one triangle alone: a factor of PETSc's own would hang
    K[0, 2] = 0.0
    (made := regularised(K, R, fixing, factor=lambda A, _: A.csr())).data[:] = 1.0
    assert abs(made - made.T).max() == 0.0
