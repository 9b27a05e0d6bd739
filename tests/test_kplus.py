"""The forms of K⁺: each a generalised inverse, on any kernel, with the same answers."""

import re

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, displacement, problem
from scipy.linalg import null_space, pinvh
from scipy.sparse import csr_array, diags_array
from test_blocks import RIGID, data, stiffness
from test_extensions import DensePinv

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import ConformanceError
from tfeti_dolfinx.subdomains.block import Counters, candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.factor import NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import KPLUS_TYPES, InverseFactory
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.testing import check_block, check_kind_of_block, check_kind_of_inverse

TYPES = list(KPLUS_TYPES)
PSEUDO = ["schur", "lu_svd"]
# springs along the last axis leave a translation in 2D, two and a turn in 3D
LEFT = {"all": RIGID, "some": {c: 1 if RIGID[c] == 3 else 3 for c in RIGID}}
SUBDOMAINS = [(cell, 1) for cell in RIGID] + [("triangle", 2), ("tetrahedron", 2)]


def subdomain(cell, degree=1, kernel="all", n=2):
    """K with springs that leave all, some or none of its kernel, its nodes and what is left."""
    K, x = stiffness(cell, n, degree)
    spring, axis = np.zeros(K.shape[0]), x.shape[1] - 1
    held = {"all": slice(0), "some": slice(axis, None, axis + 1), "none": slice(None)}
    spring[held[kernel]] = 1e-3
    return csr_array(K + diags_array(spring)), x, LEFT.get(kernel, {}).get(cell, 0)


def made(kind, K, x, counters=None, **changes):
    how = InverseFactory(counters or Counters(), KPLUS_TYPES[kind])
    return SparseBlock(data(K.copy(), x, **changes), how)


def check_generalised_inverse(kind, b, K):
    """K K⁺ K = K; symmetric, semidefinite; a pseudo-inverse has the rank of K: K⁺ K K⁺ = K⁺."""
    K = K.toarray()
    pinv = np.stack([b.solve(e) for e in np.eye(len(K))], axis=1)
    together = b.stiffness.solve(np.eye(len(K)))
    largest = np.abs(pinv).max()
    assert np.allclose(together, pinv, rtol=0, atol=1e-12 * largest)
    assert np.allclose(K @ pinv @ K, K, rtol=0, atol=1e-10 * np.abs(K).max())
    assert np.allclose(pinv, pinv.T, rtol=0, atol=1e-11 * largest)
    assert np.linalg.eigvalsh(pinv).min() >= -1e-11 * largest
    if kind in PSEUDO:
        assert np.allclose(pinv @ K @ pinv, pinv, rtol=0, atol=1e-9 * largest)
    free = np.eye(len(K)) - b.kernel @ b.kernel.T
    moore_penrose = pinvh(K, rtol=1e-12)
    assert np.allclose(free @ pinv @ free, moore_penrose, rtol=0, atol=1e-9 * largest)


@pytest.mark.parametrize("kernel", ["all", "some", "none"])
@pytest.mark.parametrize(("cell", "degree"), SUBDOMAINS)
@pytest.mark.parametrize("kind", TYPES)
def test_a_generalised_inverse(kind, cell, degree, kernel):
    K, x, left = subdomain(cell, degree, kernel)
    counters = Counters()
    b = made(kind, K, x, counters)
    assert b.kernel.shape[1] == left
    check_generalised_inverse(kind, b, K)
    assert counters.factorizations == counters.analyses == 1
    check_block(b, K)
    b.destroy()


@pytest.mark.parametrize("kind", TYPES)
def test_blocks_with_it_keep_their_promises(kind):
    check_kind_of_block(lambda data: SparseBlock(data, InverseFactory(kplus=KPLUS_TYPES[kind])))


@pytest.mark.parametrize("kind", TYPES)
def test_inverses_keep_their_promises(kind):
    check_kind_of_inverse(KPLUS_TYPES[kind])


def test_an_inverse_of_one_s_own_can_be_checked():
    check_kind_of_inverse(DensePinv)

    class Stale(DensePinv):
        def refactor(self, R):
            if not hasattr(self, "inverse"):
                super().refactor(R)

    class Crooked(DensePinv):
        def solve(self, b):
            return np.roll(super().solve(b), 1)

    for kind, promise in ((Stale, "K K⁺ K = K"), (Crooked, "K K⁺ K = K")):
        with pytest.raises(ConformanceError, match=f"does not hold: {re.escape(promise)}"):
            check_kind_of_inverse(kind)


@pytest.mark.parametrize("kind", TYPES)
def test_a_scalar_field(kind):
    K, x = stiffness("hexahedron", 2, scalar=True)
    b = made(kind, K, x)
    assert b.kernel.shape[1] == 1
    check_generalised_inverse(kind, b, K)
    b.destroy()


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("cell", list(RIGID))
def test_a_subdomain_all_of_whose_nodes_fix_it(kind, cell):
    """One cell: K_rr has no rows, and S is K."""
    K, x, _ = subdomain(cell, n=1)
    b = made(kind, K, x)
    check_generalised_inverse(kind, b, K)
    b.destroy()


@pytest.mark.parametrize("kind", TYPES)
def test_new_values_need_no_analysis_though_the_kernel_comes_and_goes(kind):
    full, x, _ = subdomain("hexahedron")
    some, none = (subdomain("hexahedron", kernel=kernel)[0] for kernel in ("some", "none"))
    counters = Counters()
    b = made(kind, full, x, counters)
    for K in (none, 2.0 * full, some, full):
        b.update(K=csr_array(K))
        check_generalised_inverse(kind, b, csr_array(K))
    assert (counters.factorizations, counters.analyses) == (5, 1)
    b.destroy()


@pytest.mark.parametrize("kind", TYPES)
def test_the_stiffness_comes_back_to_the_last_bit(kind):
    K, x, _ = subdomain("tetrahedron")
    b = made(kind, K, x)
    difference = abs(b.stiffness.K - K)
    assert difference.nnz == 0 or difference.max() == 0.0
    b.destroy()


def test_the_pseudoinverse_fixes_what_it_is_told():
    """With any three nodes that are not on a line; K⁺ of the other forces does not depend on them.

    Forces in balance deform alike; what differs is a rigid motion.
    """
    K, x, _ = subdomain("hexahedron", n=3)
    R = kernel_of(K, candidate_modes(x, 3, x.mean(axis=0), 1.0))
    f = K @ np.random.default_rng(0).standard_normal(K.shape[0])
    found = []
    for nodes in ([0, 1, 5], [0, 20, 40, 63], range(8)):
        s = np.flatnonzero(np.isin(np.arange(K.shape[0]) // 3, list(nodes)))
        pinv = KPLUS_TYPES["schur"](K, R, s, "tfeti_sub_")
        u = pinv.solve(f)
        assert np.allclose(K @ u, f, rtol=0, atol=1e-9 * np.abs(f).max())
        found.append(u - R @ (R.T @ u))
        pinv.destroy()
    for u in found[1:]:
        assert np.allclose(u, found[0], rtol=0, atol=1e-8 * np.abs(found[0]).max())


def test_the_last_unknowns_of_an_elimination_hold_the_kernel():
    """As few as do: fewer than the kernel's dimension never do, and S has their number of rows."""
    K, x, left = subdomain("tetrahedron", n=3)
    b = made("lu_svd", K, x)
    s = b.stiffness._pinv.unknowns
    assert left <= len(s) < K.shape[0] // 4
    assert null_space(b.kernel[s], rcond=1e-8).shape[1] == 0
    b.destroy()


@pytest.mark.parametrize("kind", TYPES)
def test_a_negative_energy_is_found(kind):
    """Also where it stands on the fixing nodes: K_rr has a factor then, S is indefinite."""
    K, x, _ = subdomain("quadrilateral")
    R = kernel_of(K, candidate_modes(x, 2, x.mean(axis=0), 1.0))
    fixing = fixing_dofs(x, np.arange(K.shape[0]) // 2)
    bad = K.toarray()
    values, vectors = np.linalg.eigh(bad)
    softest = vectors[:, R.shape[1]]
    bad -= 2.0 * values[R.shape[1]] * np.outer(softest, softest)
    with pytest.raises(NotPositiveDefiniteError):
        KPLUS_TYPES[kind](csr_array(bad), R, fixing, "tfeti_sub_")


@pytest.mark.parametrize("local_type", ["implicit", "explicit", "shared"])
@pytest.mark.parametrize("kind", PSEUDO)
def test_the_same_contact_problem_with_each(kind, local_type):
    found = []
    for kplus_type in ("regularized", kind):
        p = problem(
            decomposed("hexahedron", 4, 6),
            contacts=[tfeti.Obstacle("bottom", curved_obstacle(3))],
            tfeti_rtol=1e-10,
            tfeti_kplus_type=kplus_type,
            tfeti_local_type=local_type,
        )
        p.solve()
        found.append((displacement(p)[1], p.report))
        p.destroy()
    (u, report), (other, its) = found
    assert report.active_contacts == its.active_contacts > 0
    assert report.kernel_dim == its.kernel_dim
    assert np.allclose(u, other, rtol=0, atol=1e-8 * np.abs(u).max())
