"""Forms of K⁺: each a generalised inverse, on any kernel, with the same answers."""

import re

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, displacement, problem
from scipy.linalg import pinvh
from scipy.sparse import csr_array, diags_array
from test_blocks import data, stiffness
from test_extensions import DensePinv

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import ConformanceError
from tfeti_dolfinx.subdomains.block import candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.factor import NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import (
    InverseFactory,
    SchurPseudoinverse,
    regularised,
    trailing_pseudoinverse,
)
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.testing import check_block, check_kind_of_block, check_kind_of_inverse

PSEUDO = {"schur": SchurPseudoinverse, "lu_svd": trailing_pseudoinverse}
MAKE = {"regularized": regularised, **PSEUDO}
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
@pytest.mark.parametrize("kind", MAKE)
def test_a_generalised_inverse(kind, cell, degree, kernel, n):
    """K K⁺ K = K; symmetric, semidefinite; a pseudo-inverse has the rank of K: K⁺ K K⁺ = K⁺."""
    sparse, x = subdomain(cell, degree, kernel, n)
    b = SparseBlock(data(sparse.copy(), x, every=n), InverseFactory(kplus=MAKE[kind]))
    check_block(b, sparse)
    K, pinv = sparse.toarray(), b.stiffness.solve(np.eye(sparse.shape[0]))
    largest = np.abs(pinv).max()
    alone = b.stiffness.solve(np.eye(len(K))[:, :1])
    assert np.allclose(alone, pinv[:, :1], rtol=0, atol=1e-12 * largest)
    assert np.allclose(K @ pinv @ K, K, rtol=0, atol=1e-10 * np.abs(K).max())
    assert np.allclose(pinv, pinv.T, rtol=0, atol=1e-11 * largest)
    assert np.linalg.eigvalsh(pinv).min() >= -1e-11 * largest
    if kind in PSEUDO:
        assert np.allclose(pinv @ K @ pinv, pinv, rtol=0, atol=1e-9 * largest)
    free = np.eye(len(K)) - b.kernel @ b.kernel.T
    assert np.allclose(free @ pinv @ free, pinvh(K, rtol=1e-12), rtol=0, atol=1e-9 * largest)
    b.destroy()


@pytest.mark.parametrize("kind", MAKE)
def test_published_checks_hold(kind):
    check_kind_of_inverse(MAKE[kind])
    check_kind_of_block(lambda data: SparseBlock(data, InverseFactory(kplus=MAKE[kind])))


def test_an_inverse_of_one_s_own_can_be_checked():
    check_kind_of_inverse(DensePinv)

    class Crooked(DensePinv):
        def solve(self, b):
            return np.roll(super().solve(b), 1)

    with pytest.raises(ConformanceError, match=f"does not hold: {re.escape('K K⁺ K = K')}"):
        check_kind_of_inverse(Crooked)


@pytest.mark.parametrize("kind", MAKE)
def test_a_negative_energy_is_found(kind):
    """Also where it stands on the fixing nodes: K_rr has a factor then, S is indefinite."""
    K, x = subdomain("quadrilateral")
    R = kernel_of(K, candidate_modes(x, 2, x.mean(axis=0), 1.0))
    bad = K.toarray()
    values, vectors = np.linalg.eigh(bad)
    softest = vectors[:, R.shape[1]]
    bad -= 2.0 * values[R.shape[1]] * np.outer(softest, softest)
    with pytest.raises(NotPositiveDefiniteError):
        MAKE[kind](csr_array(bad), R, fixing_dofs(x, np.arange(K.shape[0]) // 2))


@pytest.mark.parametrize("kind", PSEUDO)
def test_the_same_contact_problem_with_each(kind):
    found = []
    for kplus_type in ("regularized", kind):
        p = problem(
            decomposed("hexahedron", 4, 6),
            contacts=[tfeti.Obstacle("bottom", curved_obstacle(3))],
            tfeti_rtol=1e-10,
            tfeti_kplus_type=kplus_type,
        )
        p.solve()
        found.append((displacement(p)[1], p.report))
        p.destroy()
    (u, report), (other, its) = found
    assert report.active_contacts == its.active_contacts > 0
    assert report.kernel_dim == its.kernel_dim
    assert np.allclose(u, other, rtol=0, atol=1e-8 * np.abs(u).max())
