"""The coarse problem on faces: projectors of G_f = GZ, against dense ones; PCPG on a face."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import gathered, held, pressed, stacked, two_body_problem
from scenes import decomposed, problem
from test_qp import matrix, random_program, vector
from test_solvability import dual_of

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.common.parallel import dot_over, norm_over
from tfeti_dolfinx.qp.krylov import pcpg
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Point, Steps, StoppingRule
from tfeti_dolfinx.qp.sets import Face, Product, Status
from tfeti_dolfinx.testing import DenseCoarse


def in_a_corner(**options):
    """A block that contact with three planes holds, and nothing else."""
    d = decomposed("hexahedron", 3, subdomains=4)
    planes = {"bottom": (0, 0, 1), "left": (1, 0, 0), "front": (0, 1, 0)}
    contacts = [tfeti.Obstacle(name, tfeti.Plane((0, 0, 0), n)) for name, n in planes.items()]
    return problem(d, (-0.01, -0.02, -0.05), contacts, clamped=(), **options)


def on_a_block(**options):
    """A block on another one, which holds it in one direction."""
    d = stacked("quadrilateral", 3, 4, 5)
    sides = held(d, "lower bottom", "upper left")
    contact = tfeti.Contact("lower top", "upper bottom")
    return two_body_problem(d, pressed(d, 1e-2), sides, [contact], **options)


@pytest.fixture(scope="module", params=[in_a_corner, on_a_block])
def dual(request):
    p = request.param()
    yield dual_of(p)
    p.destroy()


def mask(dual, kept):
    """The face of the equality rows and of those contact rows that are kept."""
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    bounded = np.arange(len(free))[dual.constraints.sets.normals]
    free[bounded] = kept(bounded)
    return Face(free, np.where(free, Status.TOUCHING, Status.OPEN))


def sliding(dual):
    """A face of pairs of contact rows, one direction for two rows, as slip has it."""
    m = dual.constraints.num_rows
    bounded = np.arange(m)[dual.constraints.sets.normals]
    free, rest = np.ones(m, dtype=bool), len(bounded) // 2
    free[bounded] = False
    return around(free, bounded[: 2 * rest], np.arange(rest) + 0.3, Status.SLIP)


def around(free, rows, angle, status):
    """A face with one direction for each two of the rows, at an angle."""
    tangents = np.stack((np.cos(angle), np.sin(angle)), axis=1)
    statuses = np.full(len(free), status)
    return Face(free, statuses, rows.reshape(-1, 2), tangents, np.zeros(len(angle)))


FACES = {
    "all": lambda dual: mask(dual, lambda rows: rows >= 0),
    "open": lambda dual: mask(dual, lambda rows: rows < 0),
    "every third": lambda dual: mask(dual, lambda rows: rows % 3 == 0),
    "sliding": sliding,
}


@pytest.mark.parametrize("kind", list(FACES))
def test_projectors_of_a_face(dual, kind):
    """P is idempotent, symmetric, kills Z G_fᵀ and what is not in Z, and is the dense one."""
    face = FACES[kind](dual)
    coarse, comm = dual.coarse.on_face(face), dual.coarse.comm
    x, y = np.random.default_rng(comm.rank).standard_normal((2, len(dual.d)))
    Px, Py, Qx = coarse.project(x), coarse.project(y), coarse.Q(x)
    one, other = dot_over(comm, (Px, y), (x, Py))
    assert abs(one - other) <= 1e-10 * norm_over(comm, x) * norm_over(comm, y)
    assert norm_over(comm, coarse.project(Px) - Px) <= 1e-10 * norm_over(comm, x)
    assert np.allclose(face.restricted(Px), Px, atol=1e-10)
    assert coarse.norm_Q(x) == pytest.approx(norm_over(comm, Qx), rel=1e-8)
    assert np.allclose(Px + Qx, face.restricted(x), atol=1e-9)
    y = coarse.combined(np.random.default_rng(0).standard_normal(dual.coarse.dimension))
    assert norm_over(comm, coarse.project(y)) <= 1e-9 * norm_over(comm, y)
    Gt = gathered(face.restricted(dual.coarse.Gt.toarray()))
    U, values, _ = np.linalg.svd(Gt, full_matrices=False)
    U = U[:, values > 1e-9 * values[0]]
    masked = gathered(face.restricted(x))
    assert np.allclose(gathered(Px), masked - U @ (U.T @ masked), atol=1e-8)


@pytest.mark.parametrize("kind", list(FACES))
def test_the_particular_solution_of_a_face(dual, kind):
    """It has rows of the face alone, and Gλ = e where the face holds all bodies."""
    face = FACES[kind](dual)
    coarse = dual.coarse.on_face(face)
    lam = coarse.particular()
    assert np.allclose(face.restricted(lam), lam)
    left = dual.coarse.e - dual.coarse.G(lam)
    Gt = gathered(face.restricted(dual.coarse.Gt.toarray()))
    rank = np.linalg.matrix_rank(Gt, tol=1e-9 * np.linalg.norm(Gt, 2))
    if rank == dual.coarse.dimension - dual.coarse.free_motions.count:
        assert np.linalg.norm(left) <= 1e-9 * np.linalg.norm(dual.coarse.e)


@pytest.mark.parametrize(("preconditioned", "with_coarse"), [(False, True), (True, False)])
def test_pcpg_on_a_face(preconditioned, with_coarse):
    """It moves in the face alone, keeps Gλ, and knows the gradient on all rows."""
    F, d, G, e, _ = random_program(4)
    # the first 20 rows, one direction in each of 5 pairs, and no rows of the last 10
    face = around(np.arange(40) < 20, np.arange(20, 30), np.arange(5.0), Status.FREE)
    Z = face.Z.toarray()
    coarse = DenseCoarse(G, e) if with_coarse else DenseCoarse(np.zeros((0, 40)), np.zeros(0))
    qp = QP(matrix(F), vector(d), coarse, Product())
    helper = matrix(Z @ np.linalg.inv(Z.T @ F @ Z) @ Z.T) if preconditioned else None
    on_face = replace(qp, coarse=coarse.on_face(face), preconditioner=helper)
    start = np.random.default_rng(5).standard_normal(40)
    steps, first = Steps(), Point(start, F @ start - d)
    point, reason = pcpg(on_face, first, StoppingRule(1e-11), steps, 100)
    assert reason == ConvergedReason.CONVERGED_RTOL
    assert steps.cg <= (12 if preconditioned else 26)
    assert np.allclose(point.g, F @ point.lam - d, atol=1e-9)
    GZ = G @ Z if with_coarse else np.zeros((0, 25))
    r = len(GZ)
    KKT = np.block([[Z.T @ F @ Z, GZ.T], [GZ, np.zeros((r, r))]])
    right = np.concatenate((-Z.T @ (F @ start - d), np.zeros(r)))
    exact = start + Z @ np.linalg.solve(KKT, right)[:25]
    assert np.allclose(point.lam, exact, atol=1e-9)
