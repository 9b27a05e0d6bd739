"""Springs in the stiffness: the preconditioner knows what they hold softly."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, displacement, largest, problem
from test_dual import check_operator

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.qp.sets import Face, Status

SUBDOMAINS = 8


def cubes(x):
    """Eight subdomains."""
    i, j, k = np.minimum((2 * x).astype(int), 1)
    return i + 2 * j + 4 * k


def foundation(stiffness, contact=True, **options):
    """A block of 8 cubes, clamped on the left, with springs in each of its points."""
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.2)] if contact else []
    d = decomposed("hexahedron", 6, cubes)
    return problem(d, (0.0, 0.0, -0.1), obstacles, springs=stiffness, **options)


def multiplications(stiffness, **options):
    """Those by F, and how many motions were soft."""
    p = foundation(stiffness, **options)
    p.solve()
    counted, soft = p.report.F_multiplications, p.report.soft_modes
    p.destroy()
    return counted, soft


@pytest.mark.parametrize("options", [{"contact": False}, {"qp_type": "newton"}])
def test_springs_cost_little(options):
    """From next to nothing to stiffer than the body."""
    without, none = multiplications(0.0, **options)
    assert none == 0
    for stiffness in (1e-6, 1.0, 1e4):
        counted, soft = multiplications(stiffness, **options)
        assert soft == (6 * SUBDOMAINS if stiffness <= 1.0 else 0)
        assert counted <= 2 * without


def test_springs_in_clusters():
    """Their motions are among those of subdomains, which the preconditioner has in clusters."""
    without, _ = multiplications(0.0)
    for stiffness in (1e-3, 1e4):
        u, v = (displaced(foundation(stiffness, rtol=1e-8, clusters=count)) for count in (0, 4))
        assert np.abs(u - v).max(initial=0.0) <= 1e-6 * largest(u)
        counted, motions = multiplications(stiffness, clusters=4)
        assert motions == 6 * SUBDOMAINS
        assert counted <= 1.5 * without


def displaced(p):
    """The displacement, on this rank."""
    p.solve()
    u = p.solution.u.copy()
    p.destroy()
    return u


def test_they_do_not_change_the_answer():
    p, q = (foundation(1e-3, pc_type=kind, rtol=1e-10) for kind in ("dirichlet", "none"))
    for each in (p, q):
        each.solve()
    assert (p.report.soft_modes, q.report.soft_modes) == (6 * SUBDOMAINS, 0)
    u, other = displacement(p)[1], displacement(q)[1]
    assert np.abs(u - other).max() <= 1e-8 * np.abs(other).max()
    p.destroy()
    q.destroy()


@pytest.mark.parametrize("held", [True, False])
def test_the_preconditioner_is_symmetric_and_positive(held):
    """Also on a face without contact rows."""
    p = foundation(1e-3)
    p.solve()
    dual = p.dual
    rows = dual.constraints.sets.normals
    free = np.ones(dual.constraints.num_rows, dtype=bool)
    free[rows] = held
    status = np.where(free, Status.TOUCHING, Status.OPEN)
    M = dual.qp().preconditioner_on(Face(free, status))
    check_operator(lambda x: M(np.where(free, x, 0.0)) * free, dual.coarse.comm, len(free))
    assert np.all(M(np.where(free, 1.0, 0.0))[~free] == 0.0)
    p.destroy()
