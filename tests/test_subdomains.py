"""The Blocks of a rank as one: identities against the assembled matrices, and what is made anew."""

import numpy as np
import pytest
from bodies import held, pressed, sided, stacked, two_body_problem
from petsc4py import PETSc
from test_local_operators import applied, random
from test_solvability import dual_of


@pytest.fixture(scope="module")
def scene():
    d = stacked("quadrilateral", subdomains=3)
    bcs = held(d, "lower bottom", "lower left")
    p = two_body_problem(d, pressed(d), bcs, [sided("upper bottom", "lower top")])
    dual = dual_of(p)
    yield p, dual.subdomains
    p.destroy()


def multiplied(p, u):
    """K u in primal order, with the K that DOLFINx has assembled."""
    return p.dofs.to_primal(p._system.forms.stiffness() @ p.dofs.to_dolfinx(u))


def num_dofs(p):
    return p.dofs.num_nodes * p.dofs.bs


def test_stiffnesses_are_on_the_arrays_of_petsc_and_hold_their_kernels_once(scene):
    _, subdomains = scene
    firsts = {id(block.stiffness): block for block in reversed(subdomains.elastic)}
    for block in firsts.values():
        K = block.stiffness.K
        assert K.indices.dtype == K.indptr.dtype == PETSc.IntType
        assert np.shares_memory(block.kernel, block.stiffness.kernel)


def test_energies_and_kernel_motions(scene):
    p, subdomains = scene
    u = random(num_dofs(p))
    assert np.sum(subdomains.energies(u)) == pytest.approx(u @ multiplied(p, u), rel=1e-12)
    alpha = random(subdomains.kernel_rows.shape[1])
    motion = subdomains.kernel_motion(alpha)
    assert np.abs(multiplied(p, motion)).max(initial=0.0) <= 1e-12
    assert np.allclose(subdomains.kernel_rows @ alpha, motion[subdomains.trace], atol=1e-14)
    f = p.dofs.to_primal(p._system.forms.load().values)
    assert subdomains.kernel_load @ alpha == pytest.approx(f @ motion, abs=1e-13)


def test_the_local_operator_and_recovery_are_one_generalised_inverse(scene):
    _, subdomains = scene
    w = random(len(subdomains.trace))
    out = applied(subdomains.local_operator("pinv"), w)
    u = subdomains.solve(subdomains.extended(w))
    assert np.allclose(u[subdomains.trace], out, atol=1e-12 * np.abs(out).max(initial=0.0))


@pytest.mark.parametrize("kind", ["stiffness", "schur"])
def test_local_operators_measure_the_energy_of_trace_vectors(scene, kind):
    """wᵀK_bb w is that of w without the inside, wᵀSw the least of all insides."""
    p, subdomains = scene
    w, u = random(len(subdomains.trace)), np.zeros(num_dofs(p))
    out = applied(subdomains.local_operator(kind), w)
    u[subdomains.trace] = w
    energy = u @ multiplied(p, u)
    if kind == "stiffness":
        assert w @ out == pytest.approx(energy, rel=1e-12)
    else:
        assert -1e-12 * energy <= w @ out <= energy * (1 + 1e-12)


def test_motions_of_bodies(scene):
    """Moments of C a are the metric times a; a kernel that holds C has all of it inside."""
    _, subdomains = scene
    amounts = np.random.default_rng(3).standard_normal((2, subdomains.num_modes))
    motion = subdomains.modes_motion(amounts)
    expected = np.einsum("bij,bj->bi", subdomains.modes_metric(), amounts)
    assert np.allclose(subdomains.moments(motion), expected, rtol=1e-12)
    alpha = subdomains.modes_in_kernel @ amounts.ravel()
    assert np.allclose(subdomains.kernel_motion(alpha), motion, atol=1e-12)
    assert np.abs(subdomains.modes_outside()).max() <= 1e-12
