"""Displacements with given jumps, made smooth: the preconditioner beside dense matrices."""

import numpy as np
import pytest
from bodies import held, pressed, stacked, two_body_problem
from dolfinx import fem
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from numpy.polynomial.chebyshev import Chebyshev
from scenes import box, forms
from scipy.linalg import block_diag
from test_solvability import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.feti.preconditioner import PARAMETERS, chebyshev, smoothed
from tfeti_dolfinx.qp.sets import Face, Status
from tfeti_dolfinx.subdomains.sparse_block import stretch_over_shear


@given(st.integers(1, 8), st.floats(1e-3, 1e3), st.floats(1.5, 100.0), st.integers(0, 1000))
def test_steps_are_chebyshev_s_polynomial(count, high, ratio, seed):
    """1 at 0, and T_m moved to the interval over what it is at 0."""
    low, spectrum = high / ratio, np.random.default_rng(seed).uniform(0.0, high, 20)
    found = smoothed(chebyshev(count, low, high), lambda u: spectrum * u, np.array, np.ones(20))
    T = Chebyshev.basis(count, domain=[low, high])
    assert np.allclose(found, T(spectrum) / T(0.0), rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def dual():
    """Two bodies on meshes that do not match, with friction: contact rows depend on each other."""
    d = stacked("quadrilateral", 3, 4, 6)
    contact = tfeti.Contact("upper bottom", "lower top", friction=tfeti.Tresca(0.02))
    p = two_body_problem(d, pressed(d), held(d, "lower bottom"), [contact], tfeti_rtol=1e-8)
    yield dual_of(p)
    p.destroy()


def face_with_springs(dual, kappa):
    """All equalities, every other normal, all tangents, these with springs."""
    sets, rows = dual.constraints.sets, dual.constraints.num_rows
    free, status = np.ones(rows, dtype=bool), np.full(rows, Status.FREE)
    free[sets.normals[::2]] = False
    rows = sets.tangents.ravel()
    free[rows] = False
    ones = np.ones((len(rows), 1))
    return Face(free, status, rows[:, None], ones, np.full(len(rows), kappa))


def dense(operator, size):
    """An operator between vectors of rows, on one rank."""
    return np.stack([operator(e) for e in np.eye(size)], axis=1)


def local_matrix(operator, size):
    out = np.empty((size, size))
    for j, e in enumerate(np.eye(size)):
        operator.mult(e, out[j])
    return out.T


@pytest.mark.parametrize("degree", [1, 2])
def test_resistance_to_changes_of_volume_is_found_whatever_cells_are(degree):
    """(λ + 2μ)/μ = 2(1 − ν)/(1 − 2ν), of a box 50 times as long as thick too."""
    mesh, _, _ = box("hexahedron", 2, MPI.COMM_SELF)
    mesh.geometry.x[:, 2] /= 50.0
    V, a, _ = forms(mesh, None, (0.0, 0.0, 0.0), 1, degree)
    K = fem.assemble_matrix(fem.form(a)).to_scipy()
    x = V.tabulate_dof_coordinates()
    expected = 2.0 * (1.0 - 0.3) / (1.0 - 0.6)
    assert stretch_over_shear(x, 3, lambda u: K @ u) == pytest.approx(expected)
    assert stretch_over_shear(x, 1, lambda u: K @ u) == 0.0


@pytest.mark.parametrize("kappa", [0.0, 3.0])
def test_the_preconditioner_is_what_its_formula_says(dual, kappa, serial_only):
    """With springs as trace unknowns of their own, of weight 1/(κσ) in D and 1/κ in A and K."""
    steps, part = 3, 8.0
    c, pc = dual.constraints, dual.preconditioner
    face = face_with_springs(dual, kappa)
    M = dual.qp().preconditioner_on(face)
    K, S = (local_matrix(op, len(c.weights)) for op in (pc.metric.trace, pc.local))
    B = c.B.convert("dense").getDenseArray().copy()
    Z, D = face.Z.toarray(), c.weights
    size = (B**2) @ (dual.subdomains.diagonal / D**2)
    bends = face.bends > 0.0
    B_f, sigma = Z.T @ B, Z.T @ size
    root = np.sqrt(D)
    top = 1.01 * np.linalg.eigvalsh(K / np.outer(root, root))[-1]
    if kappa:
        B_f = np.hstack((B_f, np.eye(len(sigma))[:, bends]))
        D = np.concatenate((D, 1.0 / (kappa * sigma[bends])))
        K, S = (block_diag(A, np.eye(bends.sum()) / kappa) for A in (K, S))
    shift = np.where(np.isin(np.arange(len(Z)), c.sets.equalities), 0.0, PARAMETERS.shift)
    W_inverse = np.linalg.inv((B_f / D) @ B_f.T + np.diag(Z.T @ shift))
    H = np.diag(1.0 / D) - (B_f / D).T @ W_inverse @ (B_f / D)
    lifting = (B_f / D).T @ W_inverse
    for zero in Chebyshev.basis(steps, domain=[top / part, top]).roots():
        lifting -= H @ K @ lifting / zero
    assert np.allclose(B_f @ lifting, np.eye(len(B_f)), atol=1e-5)
    expected = Z @ (lifting.T @ S @ lifting) @ Z.T
    found = dense(M, len(dual.d))
    assert np.abs(found - expected).max() <= 2e-3 * np.abs(expected).max()
    assert np.allclose(found, found.T, atol=1e-10 * np.abs(found).max())
