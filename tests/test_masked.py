"""Preconditioning in face: MPRGP and SMALSE-M with an approximate inverse on the free rows."""

import numpy as np
import pytest
from reference.active_set import dense_qp
from scenes import curved_obstacle, decomposed, problem
from test_newton_scenes import SCENES, apart, solved
from test_qp import bounds_on, matrix, random_program, to, vector

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.qp.coarse import DenseCoarse, NoCoarse
from tfeti_dolfinx.qp.homogenised import homogenise
from tfeti_dolfinx.qp.krylov import estimate_norm
from tfeti_dolfinx.qp.mprgp import MaskedPreconditioner, MprgpIterate, MprgpParameters, mprgp
from tfeti_dolfinx.qp.problem import QP, Steps
from tfeti_dolfinx.qp.smalse import smalse


class OnFace:
    """ZA⁻¹Zᵀ, A = ZᵀMZ, for a dense M: on the rows of a face alone."""

    def __init__(self, M, face, made):
        Z = face.Z.toarray()
        self.inverse = Z @ np.linalg.solve(Z.T @ M @ Z, Z.T)
        made.append(face.holding)

    def mult(self, x, y):
        y.array[:] = self.inverse @ x.array_r

    def destroy(self):
        pass


def making(M, made):
    return lambda face: OnFace(M, face, made)


def program(seed, spread=1.0):
    """A strictly convex program whose Hessian is badly scaled, and its bounded rows."""
    F, d, _, _, bounded = random_program(seed)
    scale = np.logspace(0, spread, len(F))
    return scale[:, None] * F * scale, d, bounded


def run_mprgp(F, d, bounded, preconditioner):
    """The iterate at the end, and its steps."""
    feasible, x = bounds_on(bounded), vector(np.zeros(len(d)))
    state, steps = MprgpIterate(matrix(F), x, vector(-d), feasible, preconditioner), Steps()

    def stop(state):
        assert np.all(x.array[bounded] >= 0.0)
        return state.projected_gradient <= 1e-9 * np.linalg.norm(d)

    reason = mprgp(state, MprgpParameters(1.9 / np.linalg.norm(F, 2)), stop, steps, 5000)
    assert reason is None
    return x.array.copy(), steps


@pytest.mark.parametrize("seed", range(3))
def test_mprgp_takes_an_exact_inverse_of_the_face(seed):
    """On each face one step: conjugate gradients are as few as faces."""
    F, d, bounded = program(seed)
    made = []
    exact = MaskedPreconditioner(making(F, made), NoCoarse(), 1.0, vector(d))
    x, steps = run_mprgp(F, d, bounded, exact)
    plain, its = run_mprgp(F, d, bounded, None)
    expected = dense_qp(F, d, np.zeros((0, len(d))), np.zeros(0), bounded)
    for found in (x, plain):
        assert np.allclose(found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert steps.cg <= len(made) < its.cg
    assert len(made) <= 1 + steps.expansion + steps.proportioning


def test_the_identity_changes_nothing():
    F, d, bounded = program(3, 0.3)
    identity = MaskedPreconditioner(making(np.eye(len(d)), []), NoCoarse(), 1.0, vector(d))
    x, steps = run_mprgp(F, d, bounded, identity)
    plain, its = run_mprgp(F, d, bounded, None)
    assert steps == its
    assert np.allclose(x, plain, rtol=0, atol=1e-12 * np.abs(plain).max())


def test_it_is_symmetric_positive_definite_on_the_face_and_0_elsewhere():
    F, d, G, e, bounded = random_program(7)
    rho, made = 2.0, []
    masked = MaskedPreconditioner(making(F, made), DenseCoarse(G, e), rho, vector(d))
    x = np.maximum(np.random.default_rng(0).standard_normal(len(d)), 0.0)
    feasible, g = bounds_on(bounded), np.ones(len(d))
    face = feasible.face(x, g)
    free, columns = face.holding, []
    for i in np.flatnonzero(free):
        z = vector(np.zeros(len(d)))
        masked.apply(face, vector(np.eye(len(d))[i]), z)
        assert np.all(z.array[~free] == 0.0)
        columns.append(z.array[free])
    A = np.array(columns)
    assert len(made) == 1
    assert np.allclose(A, A.T, rtol=0, atol=1e-12 * np.abs(A).max())
    values = np.linalg.eigvalsh(A)
    assert values[0] > 1e-8 * values[-1]
    masked.destroy()


@pytest.mark.parametrize("seed", range(3))
def test_smalse_finds_the_same(seed):
    F, d, G, e, bounded = random_program(seed)
    coarse = DenseCoarse(G, e)
    norm = estimate_norm(matrix(F), coarse, vector(d), 15)
    lam = []
    for on in (None, making(F, [])):
        qp = QP(matrix(F), vector(d), coarse, bounds_on(bounded), None, norm, on)
        homogenised = homogenise(qp)
        result = smalse(qp, homogenised, to(1e-9, homogenised))
        assert result.reason > 0
        lam.append(result.lam.array.copy())
    expected = dense_qp(F, d, G, e, bounded)
    for found in lam:
        assert np.allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


class Leaky:
    """Bounds whose free gradient does not see the bound."""

    def __init__(self, bounds):
        self._bounds = bounds

    def __getattr__(self, name):
        return getattr(self._bounds, name)

    def split(self, x, g):
        return np.array(g), np.zeros(len(g))


def test_a_set_that_cannot_be_masked_is_named():
    F, d, bounded = program(1)
    masked = MaskedPreconditioner(making(F, []), NoCoarse(), 1.0, vector(d))
    state = MprgpIterate(
        matrix(F), vector(np.zeros(len(d))), vector(-d), Leaky(bounds_on(bounded)), masked
    )
    with pytest.raises(InputError, match="the free gradient of the feasible set is not 0 on rows"):
        state.precondition()


@pytest.mark.parametrize("pc_type", ["lumped", "dirichlet"])
@pytest.mark.parametrize("name", ["hexahedra on an obstacle", "equal blocks", "in a corner"])
def test_scenes_with_preconditioners(name, pc_type):
    """Contact rows that are orthonormal, that are not, and several on a node."""
    plain = solved(SCENES[name], tfeti_qp_type="smalse")
    p = solved(SCENES[name], tfeti_qp_type="smalse", tfeti_pc_type=pc_type)
    assert apart(p, plain) <= 1e-6
    trials = p.report.cg_steps + p.report.expansion_steps
    assert p.report.preconditioner_multiplications == trials
    for item in (p, plain):
        item.destroy()


def test_it_saves_multiplications_by_F():
    counts = {}
    for pc_type in ("none", "dirichlet"):
        obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3))]
        p = problem(
            decomposed("hexahedron", 8, 8),
            contacts=obstacles,
            tfeti_qp_type="smalse",
            tfeti_pc_type=pc_type,
        )
        p.solve()
        counts[pc_type] = p.report.F_multiplications
        p.destroy()
    assert counts["dirichlet"] < counts["none"]
