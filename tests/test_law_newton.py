"""Newton's method on Coulomb's law: its pieces on small programs, and it beside the fixed point."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import decomposed, displacement, problem
from test_friction_fields import floor, on_a_floor
from test_mpgp import as_set
from test_qp import matrix, vector

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.friction_newton import Law, LawPoint, LawProgram, newton_on_law
from tfeti_dolfinx.qp.problem import QP
from tfeti_dolfinx.testing import DenseCoarse

SEEDS = st.integers(0, 1000)
DIMENSIONS = st.sampled_from([1, 2])


def program(seed, k, r, points=8, m=40):
    """F, d, G, e and a law with coefficients that leave one solution."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((m, m))
    F = X @ X.T / m + 0.2 * np.eye(m)
    order = rng.permutation(m)
    normals, tangents = order[:points], order[points : points * (1 + k)].reshape(points, k)
    mu = np.repeat(rng.uniform(0.05, 0.3, (points, 1)), k, axis=1)
    if rng.random() < 0.5:
        mu[:, -1] *= rng.uniform(0.3, 1.0, points)
    law = Law(
        lambda pressures: as_set(normals, tangents, mu * pressures[:, None], False),
        normals,
        tangents,
    )
    inside = rng.standard_normal(m)
    inside[normals] = np.abs(inside[normals])
    inside[tangents] = 0.3 * mu * inside[normals][:, None] * rng.uniform(-1.0, 1.0, (points, k))
    G = rng.standard_normal((r, m))
    return F, 2.0 * rng.standard_normal(m), G, G @ inside, law


def solve(F, d, G, e, law, target=1e-10):
    coarse = DenseCoarse(G, e)
    qp = QP(matrix(F), vector(d), coarse, law.at(np.ones(len(law.normals))))

    def oblique(face, C):
        H = np.linalg.pinv(G @ C.followed(face.restricted(G.T)))
        return Coarse(coarse.comm, coarse.Gt, e, H.__matmul__, face, C.followed)

    program = LawProgram(qp, law, oblique, 3.0)
    zero = LawPoint(np.zeros(len(d)), -d, np.zeros(len(e)))
    return program, *newton_on_law(program, zero, target)


@settings(max_examples=15)
@given(SEEDS, DIMENSIONS, st.sampled_from([0, 3]))
def test_it_solves_the_law(seed, k, r):
    """λ in its set, Gλ = e, the rest of Fλ − d in the normal cone: the natural map of any step."""
    F, d, G, e, law = program(seed, k, r)
    whole, end, steps = solve(F, d, G, e, law)
    assert end is not None
    assert 0 < steps < 25
    s = F @ end.lam - d - G.T @ end.mu
    assert np.allclose(end.s, s, rtol=0, atol=1e-11)
    assert np.allclose(G @ end.lam, e, rtol=0, atol=1e-11)
    for norm in (0.3, 3.0, 21.0):  # its zeros do not depend on the step
        assert replace(whole, norm=norm).natural_map(LawPoint(end.lam, s, end.mu))[2] <= 1e-8
    near = law.at(np.maximum(end.lam[law.normals], 0.0)).project(end.lam)
    assert np.allclose(near, end.lam, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "options", [{}, {"qp_type": "smalse"}, {"pc_type": "lumped"}, {"pc_type": "none"}]
)
def test_it_finds_what_the_fixed_point_finds(options):
    """With any solver and preconditioner."""
    scene = "quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05)
    p = on_a_floor(*scene, friction_type="newton", **options)
    fixed_point = on_a_floor(*scene, friction_type="fixed_point")
    u, expected = displacement(p)[1], displacement(fixed_point)[1]
    assert p.report.friction_newton_steps > 0 == fixed_point.report.friction_newton_steps
    assert p.report.converged_reason == "CONVERGED_RTOL"
    assert np.abs(u - expected).max() <= 1e-7 * np.abs(expected).max()


def test_laws_of_both_kinds_in_one_scene():
    """The wall's bound is given, the floor's is the law's."""
    found = []
    for kind in ("newton", "fixed_point"):
        d = decomposed("quadrilateral", 4, 3)
        wall = tfeti.Obstacle("left", tfeti.Plane((0.0, 0), (1, 0)), friction=tfeti.Tresca(0.01))
        contacts = [floor(2, tfeti.Coulomb(0.3)), wall]
        p = problem(d, (-0.02, -0.05), contacts, clamped=(), rtol=1e-9, friction_type=kind)
        p.solve()
        assert p.report.sliding > 0
        found.append(displacement(p)[1])
        p.destroy()
    assert np.abs(found[0] - found[1]).max() <= 1e-6 * np.abs(found[1]).max()


def test_the_same_load_again_takes_no_step():
    p = on_a_floor("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05), rtol=1e-6)
    assert p.report.friction_newton_steps > 0
    p.solve()
    assert p.report.friction_newton_steps == 0
    assert p.report.F_multiplications <= 2
