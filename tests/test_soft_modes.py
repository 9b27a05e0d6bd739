"""Soft springs in the stiffness: their ends are rows, and subdomains float."""

import numpy as np
import pytest
from scenes import curved_obstacle, decomposed, displacement, grid, largest, problem
from test_clusters import solved

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.subdomains.block import Springs

SUBDOMAINS = 8


def foundation(stiffness, contact=True, **options):
    """A block of 8 cubes, clamped on the left, with springs in each of its points."""
    obstacles = [tfeti.Obstacle("bottom", curved_obstacle(3), reach=0.2)] if contact else []
    d = decomposed("hexahedron", 6, grid(2))
    return problem(d, (0.0, 0.0, -0.1), obstacles, springs=stiffness, **options)


def multiplications(stiffness, **options):
    """Those by F, and how many motions were soft."""
    _, report = solved(foundation(stiffness, **options))
    return report.F_multiplications, report.soft_modes


@pytest.mark.parametrize("options", [{"contact": False}, {"qp_type": "newton"}])
def test_springs_cost_little(options):
    """From next to nothing to stiffer than the body."""
    without, none = multiplications(0.0, **options)
    assert none == 0
    for stiffness in (1e-9, 1e-6, 0.1, 1.0, 1e4):
        counted, soft = multiplications(stiffness, **options)
        assert soft == (6 * SUBDOMAINS if stiffness <= 1.0 else 0)
        assert counted <= 2 * without


def test_springs_in_clusters():
    """Their motions are among those of subdomains, which the preconditioner has in clusters."""
    without, _ = multiplications(0.0)
    for stiffness in (1e-3, 1e4):
        u, v = (solved(foundation(stiffness, rtol=1e-8, clusters=count))[0] for count in (0, 4))
        assert np.abs(u - v).max(initial=0.0) <= 1e-6 * largest(u)
        counted, motions = multiplications(stiffness, clusters=4)
        assert motions == 6 * SUBDOMAINS
        assert counted <= 1.5 * without


def test_springs_are_soft_in_the_mean_and_do_not_change_the_answer():
    """Those of a ring differ: without its softest ones alone a subdomain does not float."""
    stiffnesses = (np.diag([0.1, stiff, 1.0]) for stiff in (1.0, 20.0))
    found = [Springs.of(np.eye(3)[:, :2], K.__matmul__, 1.0) for K in stiffnesses]
    assert [springs is None for springs in found] == [False, True]
    p, q = (foundation(1e-3, without=name, rtol=1e-10) for name in ("cautious", "soft_springs"))
    for each in (p, q):
        each.solve()
    assert (p.report.soft_modes, q.report.soft_modes) == (6 * SUBDOMAINS, 0)
    u, other = displacement(p)[1], displacement(q)[1]
    assert np.abs(u - other).max() <= 1e-8 * np.abs(other).max()


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
@pytest.mark.parametrize("subdomains", [1, 4])
def test_a_block_on_rough_ground_that_weak_springs_hold(cell, subdomains):
    """They change nothing, however weak: without them friction holds it, too."""
    gdim, found = 2 if cell == "quadrilateral" else 3, []
    ground = tfeti.Plane((0.0,) * gdim, (0.0,) * (gdim - 1) + (1.0,))
    for stiffness in (0.0, 1e-11, 1e-9, 1e-6):
        rough = tfeti.Obstacle("bottom", ground, friction=tfeti.Coulomb(0.3), gap=0.0)
        d, push = decomposed(cell, 4, subdomains), (0.01,) + (0.0,) * (gdim - 2) + (-0.1,)
        p = problem(d, push, [rough], clamped=(), springs=stiffness, rtol=1e-9)
        p.solve()
        assert p.report.F_multiplications <= 60
        found.append(displacement(p)[1])
        p.destroy()
    for u, allowed in zip(found[1:], (1e-9, 1e-8, 1e-5), strict=True):
        assert np.abs(u - found[0]).max() <= allowed * np.abs(found[0]).max()
