"""Newton's method on Coulomb's law: its pieces on small programs, and it beside the fixed point."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI
from scenes import clamp, decomposed, displacement, forms, problem
from scipy.sparse import csr_array
from test_friction_fields import SCENES, floor, solved
from test_mpgp import as_set
from test_qp import matrix, vector

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.qp.coarse import DenseCoarse, NoCoarse, NoOblique
from tfeti_dolfinx.qp.friction_newton import (
    Law,
    LawPoint,
    LawProgram,
    OnFace,
    gcr,
    known_on,
    newton_on_law,
)
from tfeti_dolfinx.qp.problem import QP
from tfeti_dolfinx.qp.recycling import Recycled

SEEDS = st.integers(0, 1000)
DIMENSIONS = st.sampled_from([1, 2])


class DenseOblique:
    """P, H of a dense G, by the formulas."""

    def __init__(self, G, face, C):
        self.ZZ = (face.Z @ face.Z.T).toarray()
        self.follows = G @ (np.eye(G.shape[1]) + C.toarray()) @ self.ZZ
        self.Gt = self.ZZ @ G.T
        self.H = np.linalg.pinv(self.follows @ G.T)

    def coordinates(self, x):
        return self.H @ (self.follows @ x)

    def project(self, x):
        return self.ZZ @ x - self.Gt @ self.coordinates(x)

    def restoring(self, y):
        return self.Gt @ (self.H @ y)


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
    coarse = DenseCoarse(G, e) if len(e) else NoCoarse()
    qp = QP(matrix(F), vector(d), coarse, law.at(np.ones(len(law.normals))))

    def oblique(face, C):
        return DenseOblique(G, face, C) if len(e) else NoOblique(face)

    program = LawProgram(qp, law, oblique, 3.0)
    zero = LawPoint(np.zeros(len(d)), -d, np.zeros(len(e)))
    return program, *newton_on_law(program, zero, target)


@settings(max_examples=30)
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
        assert replace(whole, norm=norm).residual(LawPoint(end.lam, s, end.mu)) <= 1e-8
    _, near = law.nearest(end.lam)
    assert np.allclose(near, end.lam, rtol=0, atol=1e-9)


@given(SEEDS, st.integers(2, 30))
def test_conjugate_residuals(seed, n):
    """Directions that are known give what they can for nothing; others are gone beside them."""
    rng = np.random.default_rng(seed)
    A = np.eye(n) + 0.3 * rng.standard_normal((n, n)) / np.sqrt(n)
    M, W, k = np.diag(rng.uniform(0.5, 2.0, n)), rng.standard_normal((n, n)), rng.integers(0, n)
    Q, _ = np.linalg.qr(A @ rng.standard_normal((n, k)))
    Z, calls = np.linalg.solve(A, Q), []

    def apply(z):
        calls.append(1)
        return A @ z, W @ z

    def solved(b):
        known = np.stack((Q.T, Z.T, (W @ Z).T))
        u, image, basis, _ = gcr(apply, lambda r: M @ r, b, 1e-9, known, MPI.COMM_SELF)
        assert np.linalg.norm(b - A @ u) <= 1e-8
        assert np.allclose(image, W @ u, rtol=0, atol=1e-8)
        return basis

    solved(Q @ rng.standard_normal(k))
    assert not calls
    AZ, Z, WZ = solved(rng.standard_normal(n))
    assert len(Z) - k <= len(calls) <= n - k + 1
    assert np.allclose(AZ @ AZ.T, np.eye(len(Z)), rtol=0, atol=1e-8)
    assert np.allclose(AZ, Z @ A.T, rtol=0, atol=1e-8)
    assert np.allclose(WZ, Z @ W.T, rtol=0, atol=1e-8)


@given(SEEDS, DIMENSIONS, st.sampled_from([0, 3]))
def test_what_earlier_directions_tell(seed, k, r):
    """Known directions follow their normals, lie in the face, and have the images of A."""
    F, _, G, _, law = program(seed, k, r)
    rng = np.random.default_rng(seed)
    y = rng.standard_normal(40)
    feasible, p = law.nearest(y)
    face = feasible.face(p, rng.standard_normal(40))
    on = OnFace(face, law.following(p, face), p)
    past = Recycled(38, MPI.COMM_SELF)
    Gt_plus = np.linalg.pinv(G) if r else np.zeros((40, 0))
    for _ in range(38):  # any directions of Gλ = 0
        x = rng.standard_normal(40)
        x -= Gt_plus @ (G @ x)
        past.add(x, F @ x, x @ F @ x)
    oblique = DenseOblique(G, face, on.C) if r else NoOblique(face)
    Q, U, images = known_on(past, on, oblique.project)
    assert len(Q) > 0
    assert np.allclose(Q @ Q.T, np.eye(len(Q)), rtol=0, atol=1e-6)
    for q, u, image in zip(Q, U, images, strict=True):
        assert np.allclose(face.restricted(u), u, rtol=0, atol=1e-6)
        assert np.allclose(image, F @ on.followed(u), rtol=0, atol=1e-6)
        assert np.allclose(q, oblique.project(image + on.bend(u)), rtol=0, atol=1e-6)
        assert np.allclose(G @ on.followed(u), 0.0, rtol=0, atol=1e-6)
    for u, image in zip(U, images, strict=True):
        past.keep(on.followed(u), image)
    W, FW = past.columns
    assert np.allclose(W.T @ FW, np.eye(past.count), rtol=0, atol=1e-6)
    assert np.allclose(FW, F @ W, rtol=0, atol=1e-6)


def slipping_face(p):
    """A face of the scene's rows on which some conditions slip, and what follows."""
    constraints = p.dual.constraints
    normals, tangents = constraints.pressed_by[constraints.pressed], constraints.sets.tangents
    law = Law(p.dual.set_under, normals, tangents[constraints.pressed])
    y = np.where(np.arange(constraints.num_rows) % 3 == 0, 1.0, -0.5)
    y[normals] = np.where(np.arange(len(normals)) % 4 == 3, -1.0, 1.0)
    feasible, at = law.nearest(y)
    face = feasible.face(at, np.zeros(constraints.num_rows))
    return face, law.following(at, face)


@pytest.mark.parametrize(("cell", "traction"), SCENES)
def test_oblique_projectors(cell, traction, comm):
    p = solved(cell, tfeti.Coulomb(0.3), traction)
    coarse, (face, C) = p.dual.coarse, slipping_face(p)
    assert comm.allreduce(C.nnz) > 0
    oblique, rows = coarse.oblique(face, C), p.dual.constraints.num_rows
    x = np.random.default_rng(comm.rank).standard_normal(rows)
    Px, y = oblique.project(x), coarse.G(x)
    assert np.allclose(oblique.project(Px), Px, rtol=0, atol=1e-9)
    assert np.allclose(coarse.G(Px + C @ Px), 0.0, atol=1e-9)
    given_by_G = face.restricted(coarse.Gt @ y)
    size = comm.allreduce(float(np.abs(given_by_G).max(initial=0.0)), op=MPI.MAX)
    assert np.allclose(oblique.project(given_by_G), 0.0, atol=1e-9 * size)
    u = oblique.restoring(y)
    assert np.allclose(coarse.G(u + C @ u), y, rtol=0, atol=1e-8 * np.abs(y).max())
    # without what follows it is the orthogonal one
    plain, flat = coarse.oblique(face, csr_array(C.shape)), coarse.on_face(face)
    vec = p.dual.d.duplicate()
    vec.array[:] = x
    flat.project(vec)
    assert np.allclose(plain.project(x), vec.array_r, rtol=0, atol=1e-9)
    flat.destroy()
    vec.destroy()
    p.destroy()


@pytest.mark.parametrize(("cell", "traction"), SCENES)
@pytest.mark.parametrize("law", [tfeti.Coulomb(0.3), tfeti.Coulomb(0.05)])
def test_it_finds_what_the_fixed_point_finds(cell, traction, law):
    found, counts = [], []
    for kind in ("newton", "fixed_point"):
        p = solved(cell, law, traction, friction_type=kind)
        found.append(displacement(p)[1])
        counts.append((p.report.friction_newton_steps, p.report.F_multiplications))
        right = ("CONVERGED_RTOL", "CONVERGED_FRICTION_RTOL")
        assert p.report.converged_reason in right[: 1 + (kind == "fixed_point")]
        p.destroy()
    assert np.abs(found[0] - found[1]).max() <= 1e-7 * np.abs(found[1]).max()
    (steps, newton), (none, fixed_point) = counts
    assert steps > 0 == none
    assert newton <= fixed_point


@pytest.mark.parametrize(
    "options",
    [
        {"qp_type": "smalse"},
        {"pc_type": "lumped"},
        {"pc_type": "none"},
    ],
)
def test_with_other_solvers_and_preconditioners(options):
    usual = solved("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05))
    other = {"friction_type": "newton", **options}
    p = solved("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05), **other)
    u, expected = displacement(p)[1], displacement(usual)[1]
    assert p.report.friction_newton_steps > 0
    assert np.abs(u - expected).max() <= 1e-7 * np.abs(expected).max()
    usual.destroy()
    p.destroy()


def test_a_scene_without_the_law_pays_nothing():
    p = solved("quadrilateral", tfeti.Tresca(0.02), (0.05, -0.05))
    assert p.report.friction_newton_steps == p.report.friction_iterations == 0
    p.destroy()


def test_the_same_load_again_takes_no_step():
    p = solved("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05), rtol=1e-6)
    assert p.report.friction_newton_steps > 0
    p.solve()
    assert p.report.friction_newton_steps == 0
    assert p.report.F_multiplications <= 2
    p.destroy()


def test_the_solver_decides_what_auto_takes():
    both = [
        solved("quadrilateral", tfeti.Coulomb(0.3), (0.05, -0.05), rtol=1e-6, qp_type=qp_type)
        for qp_type in ("newton", "smalse")
    ]
    assert both[0].report.friction_newton_steps > 0 == both[1].report.friction_newton_steps
    for p in both:
        p.destroy()


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


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_a_load_that_turns_round(cell):
    """Steps there and back, as the fixed point goes: what slips turns."""
    found = []
    for kind in ("newton", "fixed_point"):
        d = decomposed(cell, 3, 3)
        gdim = d.mesh.geometry.dim
        V, a, _ = forms(d.mesh, d.facet_tags, np.zeros(gdim), d.surface("top"))
        t = fem.Constant(d.mesh, np.array([*np.zeros(gdim - 1), -0.05]))
        ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        L = ufl.dot(t, ufl.TestFunction(V)) * ds(d.surface("top"))
        options = {"rtol": 1e-9, "friction_type": kind}
        rough = [floor(gdim, tfeti.Coulomb(0.3))]
        held = [clamp(V, d.facets("left"))]
        p = tfeti.ContactProblem(a, L, held, rough, d, petsc_options=options)
        path = []
        for shear in (0.03, -0.03, 0.01):
            t.value[0] = shear
            p.solve()
            path.append(displacement(p)[1])
        found.append(np.array(path))
        p.destroy()
    assert np.abs(found[0] - found[1]).max() <= 1e-6 * np.abs(found[1]).max()
