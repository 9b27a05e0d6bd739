"""Displacements with given jumps, made smooth: the preconditioner beside dense matrices."""

from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bodies import held, pressed, stacked, two_body_problem
from dolfinx import fem
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from numpy.polynomial.chebyshev import Chebyshev
from scenes import box, curved_obstacle, decomposed, forms, problem
from scipy.linalg import block_diag
from test_own_block import DenseBlock
from test_solvable_lp import dual_of

import tfeti_dolfinx as tfeti
from benchmarks import stability_scenes
from benchmarks.stress.meshes import grid
from benchmarks.stress.package import solve_scene
from tfeti_dolfinx.feti import preconditioner as smoothing
from tfeti_dolfinx.feti.operator import near_stiffness
from tfeti_dolfinx.feti.preconditioner import PARAMETERS, FacePreconditioner, chebyshev, smoothed
from tfeti_dolfinx.qp.sets import Face, Status, face_of
from tfeti_dolfinx.subdomains.stiffness import stretch_over_shear


@given(st.integers(1, 8), st.floats(1e-3, 1e3), st.floats(1.5, 100.0), st.integers(0, 1000))
def test_steps_are_chebyshev_s_polynomial(count, high, ratio, seed):
    """1 at 0, and T_m moved to the interval over what it is at 0."""
    low, spectrum = high / ratio, np.random.default_rng(seed).uniform(0.0, high, 20)
    found = smoothed(chebyshev(count, low, high), lambda u: spectrum * u, np.ones(20))
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
    flat = face_of(free, status)
    tangential = np.isin(np.flatnonzero(free), sets.tangents.ravel())
    return Face(flat.Z, np.where(tangential, kappa, 0.0), status)


def dense(operator, like):
    """An operator between vectors of rows, whole on every rank."""
    x, y, columns = like.duplicate(), like.duplicate(), []
    first, last = x.getOwnershipRange()
    comm = like.getComm().tompi4py()
    for j in range(x.getSize()):
        x.set(0.0)
        if first <= j < last:
            x.array[j - first] = 1.0
        operator.mult(x, y)
        columns.append(np.concatenate(comm.allgather(y.array_r)))
    x.destroy()
    y.destroy()
    return np.array(columns).T


def local_matrix(operator, size):
    out = np.empty((size, size))
    for j, e in enumerate(np.eye(size)):
        operator.mult(e, out[j])
    return out.T


def following(metric, subdomains, hard):
    """The metric of cells that keep their volumes."""
    return replace(metric, near=partial(near_stiffness, subdomains.blocks), hard=hard)


def next_to_trace(block):
    """K, dense, the trace and what is next to it, in the order of the stiffness."""
    K = np.array([block.multiply(e) for e in np.eye(len(block.load))])
    touched = np.any(np.abs(K[block.trace_dofs]) > 1e-12 * np.abs(K).max(), axis=0)
    reached = np.repeat(touched.reshape(-1, block.bs).any(axis=1), block.bs)
    near = np.setdiff1d(np.flatnonzero(reached), block.trace_dofs)
    return K, block.trace_dofs, near[np.argsort(block.place[near])]


def near_matrix(subdomains):
    """K on all traces, then on all that is next to them, and the diagonal there."""
    found = [next_to_trace(block) for block in subdomains.blocks]
    K = block_diag(*(K for K, *_ in found))
    starts = np.cumsum([0, *(len(K) for K, *_ in found)])[:-1]
    order = [start + trace for start, (_, trace, _) in zip(starts, found, strict=True)]
    order += [start + near for start, (_, _, near) in zip(starts, found, strict=True)]
    order = np.concatenate(order)
    bs = subdomains.blocks[0].bs
    means = np.repeat(np.diag(K).reshape(-1, bs).mean(axis=1), bs)
    return K[np.ix_(order, order)], means[order][len(subdomains.trace) :]


@pytest.mark.parametrize("equal", [True, False])
def test_K_next_to_the_trace(equal, dual):
    """Some subdomains share a stiffness, some a trace, too; and such that share nothing."""
    if equal:
        d = decomposed("quadrilateral", 12, 9)
        p = problem(d, contacts=[tfeti.Obstacle("bottom", curved_obstacle(2))])
        subdomains = dual_of(p).subdomains
    else:
        p, subdomains = None, dual.subdomains
    found, means = near_stiffness(subdomains.blocks)
    if subdomains.blocks:
        expected, diagonal = near_matrix(subdomains)
        assert len(means) > 0
        assert means == pytest.approx(diagonal)
        assert np.abs(found.toarray() - expected).max() <= 1e-12 * np.abs(expected).max()
    if p is not None:
        p.destroy()


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


KINDS = [(0.0, 100.0, None), (3.0, 100.0, None), (3.0, 0.0, None)]


@pytest.mark.parametrize(("kappa", "high", "hard"), [*KINDS, (3.0, 100.0, False), (3.0, 0.0, True)])
def test_the_preconditioner_is_what_its_formula_says(
    dual, kappa, high, hard, serial_only, monkeypatch
):
    """With springs as trace unknowns of their own, of weight 1/(κσ) in D and 1/κ in A and K.

    What is next to the trace has neither jumps nor S.
    """
    monkeypatch.setattr(smoothing, "PARAMETERS", replace(PARAMETERS, high=high))
    monkeypatch.setattr(dual, "_on_faces", None)
    steps, part = (8, 50.0) if high == 0.0 else (3, 8.0)
    c, pc = dual.constraints, dual.preconditioner
    if hard is not None:
        monkeypatch.setattr(pc, "metric", following(pc.metric, dual.subdomains, hard))
    face = face_with_springs(dual, kappa)
    M = dual._preconditioner_on(face)
    K, S = (local_matrix(op, len(c.weights)) for op in (pc.metric.trace, pc.local))
    B = c.B.convert("dense").getDenseArray().copy()
    Z, D = face.Z.toarray(), c.weights
    size = (B**2) @ (dual.subdomains.diagonal / D**2)
    if hard is not None:
        K, inside = near_matrix(dual.subdomains)
        D = np.concatenate((D, inside / np.max(dual.subdomains.diagonal / D)))
        S, B = block_diag(S, np.zeros((len(inside),) * 2)), np.pad(B, ((0, 0), (0, len(inside))))
    bends = face.curvature > 0.0
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
    found = dense(M, dual.d)
    M.destroy()
    assert np.abs(found - expected).max() <= 2e-3 * np.abs(expected).max()
    assert np.allclose(found, found.T, atol=1e-10 * np.abs(found).max())


def spectrum(dual, face, smooths, follows=False):
    """Eigenvalues of M_f F between vectors of a flat face that balance, whole on every rank."""
    whole = copy(dual.preconditioner)
    if not smooths:
        whole.metric = None
    elif follows:
        whole.metric = following(whole.metric, dual.subdomains, True)
    c = dual.constraints
    faces = FacePreconditioner(whole, c, dual.subdomains.diagonal, "tfeti_face_")
    M_f = faces.on_face(face)
    comm = c.B.getComm().tompi4py()
    M, F = dense(M_f, dual.d), dense(dual.F, dual.d)
    M_f.destroy()
    faces.destroy()
    held_rows = np.concatenate(comm.allgather(face.held))
    G = np.concatenate(comm.allgather(dual.coarse.Gt.toarray()))[~held_rows]
    U, sizes, _ = np.linalg.svd(G)
    rank = int(np.sum(sizes > 1e-10 * sizes[0]))
    M, F = (U[:, rank:].T @ A[~held_rows][:, ~held_rows] @ U[:, rank:] for A in (M, F))
    L = np.linalg.cholesky(0.5 * (F + F.T))
    return np.linalg.eigvalsh(L.T @ (0.5 * (M + M.T)) @ L)


def test_eigenvalues_come_nearer_to_one_from_above(dual):
    """None is below 1, as jumps stay what they are; the largest are smaller."""
    face = face_with_springs(dual, 0.0)
    plain, smooth, follows = (
        spectrum(dual, face, *how) for how in ((False,), (True,), (True, True))
    )
    assert min(plain[0], smooth[0], follows[0]) >= 1.0 - 1e-6
    assert smooth[-1] <= 0.7 * plain[-1], (plain[-1], smooth[-1])
    assert follows[-1] <= 0.7 * smooth[-1], (smooth[-1], follows[-1])
    assert np.log(smooth).sum() <= 0.7 * np.log(plain).sum()
    assert np.log(follows).sum() <= 0.7 * np.log(smooth).sum()


@pytest.mark.parametrize("law", [None, ("coulomb", 0.3)])
def test_what_is_inside_follows_where_cells_keep_their_volumes(law, comm):
    """Blocks of hexahedra with ν = 0.499, on any number of ranks: 35 and 75 multiplications."""
    scene = stability_scenes.pressed("hexahedron", 0.499)
    if law is not None:
        scene = stability_scenes.with_friction(scene, *law)
    counts = [solve_scene(scene, grid(scene), of).report["F"] for of in (comm, MPI.COMM_SELF)]
    counts = comm.bcast(counts)
    assert abs(counts[0] - counts[1]) <= 0.1 * counts[1], counts
    assert max(counts) <= (38 if law is None else 83), counts


def test_it_saves_multiplications_on_any_number_of_ranks(comm):
    counts = []
    for of in (comm, MPI.COMM_SELF):
        d = decomposed("hexahedron", 4, subdomains=6, comm=of)
        obstacle = tfeti.Obstacle("bottom", curved_obstacle(3))
        p = problem(d, contacts=[obstacle])
        p.solve()
        counts.append(p.report.F_multiplications)
        p.destroy()
    assert abs(counts[0] - counts[1]) <= 1
    assert max(counts) <= 14, counts


@pytest.mark.parametrize(
    ("options", "extensions"),
    [
        ({"tfeti_pc_type": "lumped"}, None),
        ({"tfeti_pc_type": "dirichlet"}, tfeti.Extensions(block=DenseBlock)),
    ],
)
def test_only_sparse_blocks_and_S_have_a_metric(options, extensions):
    d = decomposed("hexahedron", 3, 4)
    p = problem(d, extensions=extensions, **options)
    assert dual_of(p).preconditioner.metric is None
    p.destroy()
