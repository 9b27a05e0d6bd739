"""Block Newton against independent solutions and SMALSE-M, and what it costs."""

import numpy as np
import pytest
from bodies import held, pressed, stacked, stiffer_above, two_body_problem
from mpi4py import MPI
from reference.untorn import check_optimal
from scenes import apart, curved_obstacle, decomposed, displacement, problem
from test_faces import in_a_corner, on_a_block
from test_newton_discs import solved
from test_qp import bounds_on, matrix, vector

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.qp.coarse import imbalance
from tfeti_dolfinx.qp.krylov import solve_by_pcpg
from tfeti_dolfinx.qp.newton import first_point, newton
from tfeti_dolfinx.qp.problem import QP, StoppingRule, homogenise
from tfeti_dolfinx.qp.projection import project_onto_feasible
from tfeti_dolfinx.qp.recycling import Recycled
from tfeti_dolfinx.qp.sets import Bounds, Ellipses, Product
from tfeti_dolfinx.testing import DenseCoarse


def program(seed, kind="regular"):
    """A random program with a feasible point; r and the share of bounds vary with the seed."""
    rng = np.random.default_rng(seed)
    m, r = int(rng.integers(10, 50)), int(rng.integers(1, 6))
    bounded = np.sort(rng.permutation(m)[: rng.integers(1, m - r)])
    A = rng.standard_normal((m, m)) * 10.0 ** rng.uniform(-1, 1, m)
    F = A @ A.T / m + 0.01 * np.eye(m)
    G = rng.standard_normal((r, m))
    if kind == "held by bounds":  # without rows that carry, G has no rank
        G[:, np.setdiff1d(np.arange(m), bounded)] = 0.0
    if kind == "dependent":  # two rows that are the same, but for what they demand
        one, two = bounded[0], bounded[-1]
        F[two], F[:, two], G[:, two] = F[one], F[:, one], G[:, one]
        F[two, two] = F[one, one]
        F[one, two] = F[two, one] = F[one, one]
    G = G[:0] if kind == "no kernel" else G
    feasible = rng.standard_normal(m)
    feasible[bounded] = np.maximum(feasible[bounded], 0.0)
    return F, 3.0 * rng.standard_normal(m), G, G @ feasible, bounded


KINDS = ["regular", "held by bounds", "dependent", "no kernel"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(5))
def test_random_programs(kind, seed):
    F, d, G, e, bounded = program(seed, kind)
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), bounds_on(bounded))
    result = solved(qp, 1e-9)
    assert result.reason > 0
    # forces that are their small difference leave rounding where rows depend on each other
    share = 1e-5 if kind == "dependent" else 1e-8
    check_optimal(F, d, G, e, bounded, result.lam, share, result.mu)
    assert np.all(result.lam[bounded] >= 0.0)


@pytest.mark.parametrize("stiff", [1e3, 1e6])
def test_soft_rows_that_hold_are_seen_beside_stiff_ones_that_are_open(stiff):
    """λ₁ − rλ₂ = 1 at (1, 0): G_f G_fᵀ = 1 beside GGᵀ = 1 + r²."""
    coarse = DenseCoarse(np.array([[1.0, -stiff]]), np.ones(1))
    found, _ = project_onto_feasible(coarse, bounds_on(np.arange(2)), vector([0.0, -1.0 / stiff]))
    assert np.allclose(found, [1.0, 0.0], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(30))
def test_the_nearest_point_is_found_where_bounds_and_forces_are_far_apart(seed):
    rng = np.random.default_rng(seed)
    r, contact, friction = (int(rng.integers(low, 5)) for low in (2, 1, 1))
    rows = contact + friction
    G = rng.integers(-2, 3, (r, rows)) * 1.0
    G /= np.maximum(np.linalg.norm(G, axis=1, keepdims=True), 1e-300)
    bounds = 10.0 ** rng.integers(-5, 1, friction)
    pressed = rng.integers(0, 3, contact)
    rubbed = bounds * rng.integers(-1, 2, friction) * rng.choice([1.0, 0.5])
    coarse = DenseCoarse(G, 0.5 * G @ np.r_[pressed, rubbed])
    sides = [(slice(contact), Bounds()), (slice(contact, rows), Ellipses(bounds[:, None]))]
    y = rng.integers(-3, 4, rows) * 10.0 ** rng.integers(-4, 2, rows)
    found, alpha = project_onto_feasible(coarse, feasible := Product(sides), vector(y))
    assert imbalance(coarse, found) < 1e-8
    far = 1e-12 * max(np.abs(y).max(), np.abs(alpha).max(), 1.0)
    assert np.allclose(found, feasible.project(y + G.T @ alpha), rtol=0.0, atol=far)


def nearly_dependent(near=1e-6, m=60):
    """Two rows of G that are nearly the same, d nearly all in Gᵀμ, and an M that has Gᵀ for 0."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((m, m)) * 10.0 ** rng.uniform(-0.5, 0.5, m)
    F = A @ A.T / m + 0.1 * np.eye(m)
    G = rng.standard_normal((4, m))
    G[1] = G[0] + near * G[1]
    Q = np.linalg.qr(G.T)[0]
    P = np.eye(m) - Q @ Q.T
    d = rng.standard_normal(m) + 1e3 * G.T @ rng.standard_normal(4)
    M = P @ np.diag(1.0 / np.diag(F)) @ P
    return QP(matrix(F), vector(d), DenseCoarse(G, G @ np.ones(m)), Product(), matrix(M)), F, P


def test_what_nearly_dependent_rows_of_G_leave_is_no_residual():
    """κ(GGᵀ) = 1e12: a projection leaves 1e-7 of d, which M does not see."""
    qp, F, P = nearly_dependent()
    result = solve_by_pcpg(qp, homogenise(qp), StoppingRule(1e-9), max_it=3000)
    assert np.linalg.norm(P @ (F @ result.lam - qp.d)) <= 2e-8


def test_images_of_earlier_directions_that_are_off_by_1e_10_do_not_stall_conjugate_gradients():
    """r is not orthogonal to W then, and p, conjugate to it, soon is to r."""
    F, d, G, e, _ = program(2, "no kernel")
    W = np.linalg.inv(np.linalg.cholesky(F)).T[:, :3]
    images, known = F @ W * (1.0 + 1e-10 * np.sign(W)), Recycled(9, MPI.COMM_SELF)
    known.take(np.stack((W, images), axis=1))
    qp = QP(matrix(F), vector(d), DenseCoarse(G, e), Product(), recycled=known)
    result = solve_by_pcpg(qp, homogenise(qp), StoppingRule(1e-13), max_it=500)
    assert result.reason > 0
    assert np.allclose(F @ result.lam, qp.d, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(("room", "solvable"), [(-0.5, False), (0.5, True)])
def test_rows_that_exclude_each_other_are_named(room, solvable):
    """u ≤ −1 and −u ≤ 1 + room; with less than none q falls forever along (1, 1)."""
    F = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    d = vector([1.0, -1.0 - room, 1.0])
    qp = QP(matrix(F), d, DenseCoarse(np.zeros((0, 3)), np.zeros(0)), bounds_on(np.arange(3)))
    start = vector([1.0, 1.0, 0.0])  # both touch
    result = newton(qp, homogenise(qp, start), StoppingRule(1e-10), max_it=100)
    if not solvable:
        assert result.reason.name == "DIVERGED_CONTRADICTION"
        assert result.excluding.tolist() == [0, 1]
    else:
        assert result.reason > 0
        assert result.lam == pytest.approx([1.0, 0.0, 1.0], abs=1e-9)
        assert result.excluding.size == 0


def test_the_first_point_is_feasible_where_0_is_inside():
    """With adhesion, λ ≥ −a, rows are free at 0, and may be pulled by more than a."""
    coarse = DenseCoarse(np.ones((1, 3)), np.array([-1.5]))
    feasible = Product([(np.arange(2), Bounds(np.array([-0.2, -0.2])))])
    qp = QP(matrix(np.eye(3)), vector(np.zeros(3)), coarse, feasible)
    lam = first_point(qp)
    assert np.allclose(lam, (-0.2, -0.2, -1.1), rtol=0, atol=1e-9)


RTOL = 1e-8


def on_an_obstacle(cell, reach=0.2):
    d = decomposed(cell, 4, 6)
    obstacle = tfeti.Obstacle("bottom", curved_obstacle(d.mesh.geometry.dim), reach=reach)
    return lambda **options: problem(d, contacts=[obstacle], **options)


def between_parallel_planes(gap):
    """The rows of two obstacles on the same nodes are the same rows, with other gaps."""

    def made(**options):
        d = decomposed("hexahedron", 3, 4)
        planes = [tfeti.Plane((0, 0, -0.002 - z), (0, 0, 1)) for z in (0.0, gap)]
        contacts = [tfeti.Obstacle("bottom", plane, reach=0.2) for plane in planes]
        return problem(d, contacts=contacts, **options)

    return made


def blocks(ratio):
    """A block on a block that does not match it, one of them stiffer."""

    def made(**options):
        d = stacked("hexahedron", 3, 4, 4)
        stress = stiffer_above(d, ratio)
        clamped = held(d, "lower bottom", "upper left", "upper front")
        contact = tfeti.Contact("lower top", "upper bottom", secondary="lower top")
        return two_body_problem(d, pressed(d, 1e-2), clamped, [contact], stress=stress, **options)

    return made


SCENES = {
    "triangles on an obstacle": on_an_obstacle("triangle"),
    "late rows": on_an_obstacle("hexahedron", 0.035),
    "in a corner": in_a_corner,
    "on a block": on_a_block,
    "equal blocks": blocks(1.0),
    "a soft block": blocks(1e-4),
    "two equal obstacles": between_parallel_planes(0.0),
    "two parallel obstacles": between_parallel_planes(1e-3),
}


@pytest.mark.parametrize("name", list(SCENES))
def test_it_finds_what_smalse_finds(name):
    newton, smalse = (SCENES[name](rtol=RTOL, qp_type=kind) for kind in ("newton", "smalse"))
    newton.solve()
    smalse.solve()
    assert apart(displacement(newton)[1], displacement(smalse)[1]) <= 100 * RTOL
    assert newton.report.active_contacts > 0
    assert newton.report.newton_faces > 0 == smalse.report.newton_faces
    assert newton.report.power_method_multiplications == 0
    assert newton.report.F_multiplications < smalse.report.F_multiplications
