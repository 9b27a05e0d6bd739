"""Directions of earlier solves: what they save, and that they stay right."""

import numpy as np
import pytest
from scenes import apart
from test_repeated import Repeated

from tfeti_dolfinx.common.parallel import norm_over
from tfeti_dolfinx.qp.krylov import Directions, PcpgParameters, pcpg
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Point, Steps, StoppingRule
from tfeti_dolfinx.qp.recycling import DirectionStore, right_singular
from tfeti_dolfinx.qp.sets import Product
from tfeti_dolfinx.testing import DenseCoarse


def images(problem):
    """How far FW is from F of W, and WᵀFW from 1."""
    dual = problem.dual
    W, FW = dual.recycled.directions.T, dual.recycled.images.T
    comm, worst = dual.coarse.comm, 0.0
    for w, Fw in zip(W.T, FW.T, strict=True):
        Fx = dual.F(w)
        worst = max(worst, norm_over(comm, Fx - Fw) / norm_over(comm, Fx))
    off = comm.allreduce(W.T @ FW) - np.eye(W.shape[1])
    return worst, np.abs(off).max()


@pytest.mark.parametrize(("cell", "qp_type"), [("tetrahedron", "pcpg"), ("triangle", "newton")])
def test_what_was_learnt_from_a_load_is_right_for_its_multiples(cell, qp_type):
    """Without inequalities the answer is linear in the load, and forces know no rigid motion."""
    scene = Repeated(cell, contact=False, qp_type=qp_type, recycle=60)
    counts = []
    for load, held in ((-0.05, 0.0), (0.03, 0.01), (-0.2, 0.02)):
        found = scene.solve(load=load, held=held)
        counts.append(scene.problem.report.F_multiplications)
        assert apart(found.u, scene.fresh(load=load, held=held).u) <= 1e-9
    assert counts[0] >= 8
    assert max(counts[1:]) <= 2
    assert scene.problem.report.recycled_directions >= 8


def test_steps_with_contact_take_fewer_multiplications():
    scenes, counts = [Repeated("triangle", recycle=n) for n in (60, 0)], np.zeros(2)
    for i, scene in enumerate(scenes):
        for load in -0.05 - 0.03 * np.arange(8):
            found = scene.solve(load=load)
            counts[i] += scene.problem.report.F_multiplications
        assert apart(found.u, scene.fresh(load=load).u) <= 1e-9
    assert scenes[1].problem.report.recycled_directions == 0
    assert counts[0] <= 0.7 * counts[1]


def test_images_stay_right_over_many_solves_on_many_faces():
    """Memory is what was allowed, rounding does not grow, and another stiffness forgets."""
    scene, rng = Repeated("triangle", recycle=15), np.random.default_rng(3)
    for load, held in rng.uniform([-0.2, -0.02], [0.05, 0.02], (20, 2)):
        scene.solve(load=load, held=held)
    assert scene.problem.dual.recycled.count == 15
    assert max(images(scene.problem)) <= 1e-11
    assert apart(scene.problem.solution.u, scene.fresh(load=load, held=held).u) <= 1e-8
    found, report = scene.solve(E=3.0, load=-0.1, held=0.0), scene.problem.report
    assert report.recycled_directions <= report.cg_steps
    assert apart(found.u, scene.fresh(E=3.0, load=-0.1).u) <= 1e-9


def test_singular_vectors_where_the_fast_method_gives_up(comm, monkeypatch):
    A = np.random.default_rng(comm.rank).standard_normal((5, 3))
    fast = right_singular(comm, A)
    monkeypatch.setattr(np.linalg, "svd", lambda R: np.linalg.cholesky(-np.eye(len(R))))
    assert np.allclose(*(np.abs(np.vstack(found)) for found in (fast, right_singular(comm, A))))


@pytest.mark.parametrize("capacity", [15, 6, 0])
def test_another_run_goes_on_with_what_was_kept(capacity):
    """The newest, where it keeps fewer; and takes as many multiplications as the run before."""
    rng = np.random.default_rng(5)
    one, other = Repeated("triangle", recycle=15), Repeated("triangle", recycle=capacity)
    for load, held in rng.uniform([-0.2, -0.02], [0.05, 0.02], (6, 2)):
        one.solve(load=load, held=held)
    one.problem.accept()
    state = one.problem.state()
    assert state.directions.shape[2] == 15
    other.change(load=load, held=held)
    other.problem.restore(state)
    if capacity:
        known = other.problem.dual.recycled
        assert known.count == min(capacity, 15)
        assert np.array_equal(known.in_order(), state.directions[:, :, -known.count :])
        assert max(images(other.problem)) <= 1e-11
    first, second = (scene.solve(load=-0.13) for scene in (one, other))
    assert apart(first.u, second.u) <= (1e-12 if capacity == 15 else 1e-9)
    if capacity == 15:
        assert one.problem.report.cg_steps == other.problem.report.cg_steps


pytestmark = pytest.mark.usefixtures("serial_only")

n = 60


def program(spread):
    """A program whose F has eigenvalues from 1 to ``spread``, and its minimiser."""
    rng = np.random.default_rng(0)
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    F = V @ np.diag(np.geomspace(1.0, spread, n)) @ V.T
    F = 0.5 * (F + F.T)
    G = rng.standard_normal((3, n))
    N = np.linalg.svd(G)[2][3:].T
    d = F @ rng.standard_normal(n)
    known = N @ np.linalg.solve(N.T @ F @ N, N.T @ d)
    return QP(F.__matmul__, d, DenseCoarse(G, np.zeros(3)), Product()), F, known


def solved(qp, directions, target, most=1000):
    steps, rule = Steps(), StoppingRule(target * np.linalg.norm(qp.d))
    start = Point(np.zeros(n), -qp.d)
    end, reason = pcpg(qp, start, rule, steps, most, directions=directions)
    return reason, steps.cg, end.lam


@pytest.mark.parametrize(("spread", "times"), [(1e2, 1.0), (1e6, 1.1), (1e8, 3.0)])
def test_hardly_more_steps_than_dimensions(spread, times):
    """In exact arithmetic no more; with the last direction alone rounding makes it many more."""
    qp, F, known = program(spread)
    reason, steps, found = solved(qp, Directions(qp), 1e-9)
    assert reason == ConvergedReason.CONVERGED_RTOL
    assert steps <= times * n
    error = found - known
    assert error @ F @ error <= 1e-10 * (known @ F @ known)
    _, more, _ = solved(qp, Directions(qp, PcpgParameters(keeps=False)), 1e-9, 5000)
    assert more >= (steps if spread < 1e6 else 4 * steps)


def test_directions_are_conjugate():
    qp, F, _ = program(1e6)
    directions = Directions(qp)
    _, steps, _ = solved(qp, directions, 0.0, 40)
    kept = directions.kept
    assert kept.count == steps == 40
    P = kept.directions
    assert np.abs(P @ F @ P.T - np.eye(40)).max() <= 1e-6
    kept.clear()
    assert kept.images.shape == (0, n)


def test_where_memory_does_not_last_the_oldest_goes():
    kept = DirectionStore(3, 2)
    for k in range(4):
        kept.put(np.full(2, k), np.full(2, -k))
    assert kept.count == 3
    assert sorted(kept.directions[:, 0]) == [1, 2, 3]
    assert np.array_equal(kept.images, -kept.directions)
