"""Which rank a subdomain belongs to where equal ones share factors: counted, not timed."""

from argparse import Namespace

import numpy as np
import pytest
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import box

import tfeti_dolfinx as tfeti
from demos import cube_3d
from tfeti_dolfinx.mesh.dolfinx_input import _untorn
from tfeti_dolfinx.mesh.tearing import (
    ALIKE,
    SHARED,
    alike,
    bare_sides,
    deal_shared,
    dearest,
    measured,
)

COMM = MPI.COMM_WORLD


def untorn_cubes(parts, cells, named):
    """A box, its equal subdomains, some sides named; cells lie on any ranks."""
    mesh, facet_tags, _ = box("hexahedron", parts * cells)
    kept = np.isin(facet_tags.values, named)
    tags = dmesh.meshtags(mesh, 2, facet_tags.indices[kept], facet_tags.values[kept])
    untorn = _untorn(mesh, None, tags, {}, {})
    index = (untorn.midpoints() * parts).astype(int)
    return untorn, parts ** np.arange(3) @ index.T


@pytest.mark.parametrize(
    ("named", "count"),
    [((), 27), ((1,), 18), ((1, 2), 9), ((1, 2, 3, 4), 3), (range(1, 7), 1)],
)
def test_sides_that_no_row_will_touch_tell_cubes_apart(named, count):
    """Of 3 x 3 x 3, those at a side without a name differ from those in the middle."""
    mesh, subdomain = untorn_cubes(3, 2, list(named))
    cells, centres, shapes = measured(mesh.midpoints(), mesh.cell_tags, subdomain, 27, COMM)
    kinds = alike(cells, shapes)
    assert len(np.unique(kinds)) == 1
    seen = alike(kinds, bare_sides(mesh, subdomain, cells, centres, COMM))
    assert len(np.unique(seen)) == count
    middle = (centres * 3).astype(int)  # 0, 1, 2 along each axis
    pairs = {1: (0, 0), 2: (0, 2), 5: (1, 0), 6: (1, 2), 3: (2, 0), 4: (2, 2)}
    for tag in named:
        axis, at = pairs[tag]
        middle[middle[:, axis] == at, axis] = 1
    _, expected = np.unique(middle, axis=0, return_inverse=True)
    assert np.array_equal(seen[:, None] == seen, expected.ravel()[:, None] == expected.ravel())


def test_ranks_that_wait_for_each_other():
    """Two ranks: one has three subdomains, two of them equal, the other has one alone."""
    ranks, cells = np.array([0, 0, 0, 1]), np.full(4, 10.0)
    waited = ALIKE * 3 + (3 * SHARED + (1 - SHARED) * 2) + (3 * SHARED + (1 - SHARED) * 3)
    shared = (np.array([7, 7, 1, 2]), np.array([0, 1, 2, 3]))
    assert dearest(ranks, cells, shared, 2) == pytest.approx(waited * 2 / 4, rel=1e-8)


def lattice(*counts):
    """Places of equal boxes, and numbers for what is the same along some axes."""
    return np.stack(
        [a.ravel() for a in np.meshgrid(*map(np.arange, counts), indexing="ij")], axis=1
    )


def made(ranks, numbers):
    """How many different ones each rank has."""
    return [len(np.unique(numbers[ranks == rank])) for rank in range(ranks.max() + 1)]


def ends(x):
    """0 at the low end, 2 at the high one, 1 between."""
    return (x > 0).astype(int) + (x == x.max())


@pytest.mark.parametrize(("num_ranks", "most"), [(2, 4), (4, 4), (8, 4), (64, 1)])
@pytest.mark.parametrize("turn", range(3))
def test_a_cube_is_cut_so_that_no_rank_makes_much_more_than_another(num_ranks, most, turn):
    """4 x 4 x 4, no rows on one side of an axis, on two sides of another, on none of the third.

    Cut in two across the first, one half makes twice as many kinds as the other, 3 and 6.
    """
    place = np.roll(lattice(4, 4, 4), turn, axis=1)
    seen = alike(place[:, turn] == 3, ends(place[:, turn - 2]))
    cells, kinds = np.full(64, 8.0), np.zeros(64, dtype=int)
    ranks = deal_shared(cells, place + 0.5, (kinds, seen), num_ranks, COMM)
    assert COMM.allgather(ranks.tobytes()) == [ranks.tobytes()] * COMM.size
    assert np.bincount(ranks).tolist() == [64 // num_ranks] * num_ranks
    assert max(made(ranks, seen)) == most


def test_ranks_share_equal_subdomains_and_others():
    """A square of equal ones below a square of such without equals: each has half of both."""
    place = lattice(4, 8)
    upper = place[:, 1] >= 4
    kinds = np.where(upper, np.arange(32), 0)
    seen = np.where(upper, kinds, ends(place[:, 0]) * 16)
    ranks = deal_shared(np.full(32, 9.0), place + 0.5, (kinds, seen), 2, COMM)
    assert np.bincount(ranks).tolist() == [16, 16]
    assert np.bincount(ranks[upper]).tolist() == [8, 8]
    assert made(ranks, kinds) == [9, 9]


def test_long_bodies_are_not_cut_lengthwise():
    """However much could be shared: their interfaces would be too long."""
    place = lattice(40, 2)
    kinds = np.where(place[:, 0] < 20, 0, np.arange(80))
    ranks = deal_shared(np.ones(80), place + 0.5, (kinds, kinds), 2, COMM)
    assert np.all(np.diff(place[ranks == 0], axis=0)[::2] == (0, 1))
    assert place[ranks == 0, 0].max() <= place[ranks == 1, 0].min()


@pytest.mark.parametrize("subdomains", [64])
def test_factors_of_a_cube(subdomains):
    """One of K for each rank, and of K_ii as many as there are kinds of traces on it."""
    arguments = Namespace(subdomains=subdomains, cells=2, quick=False)
    p = tfeti.ContactProblem(**cube_3d.scene(cube_3d.torn_mesh(arguments)))
    p.solve()
    factors = COMM.allgather(p._system._counters.factorizations)
    assert sum(factors) == p.report.factorizations
    if COMM.size <= 2:
        assert factors == {1: [19], 2: [13, 13]}[COMM.size]
