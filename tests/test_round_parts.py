"""Round parts with flat interfaces, from METIS parts or any others."""

import numpy as np
import pytest
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.spatial import Delaunay

from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.mesh import metis as metis_module
from tfeti_dolfinx.mesh.metis import CUT, LARGEST, compact_parts, flatten_interfaces, metis
from tfeti_dolfinx.mesh.partition import split_disconnected
from tfeti_dolfinx.mesh.untorn import PhysicalNames, UntornMesh

COMM = MPI.COMM_WORLD


def midpoints(n):
    """Those of n³ cells of the unit cube."""
    return (np.stack(np.indices((n,) * 3), axis=-1).reshape(-1, 3) + 0.5) / n


def untorn(kind, cells, x):
    """A mesh, all of it on rank 0."""
    some = cells if COMM.rank == 0 else cells[:0]
    ids, facets = np.arange(len(some)), 6 if kind == "hexahedron" else 4
    tags = (np.zeros(len(some)), np.zeros((len(some), facets)))
    nodes = np.unique(some)
    return UntornMesh(dmesh.to_type(kind), None, some, ids, *tags, nodes, x[nodes], PhysicalNames())


def boxes(n, layers=None, height=1.0):
    """A cube of n³ boxes, or a plate of so many layers of that height."""
    counts, corners = [n, n, layers or n], [(0.0, 0.0, 0.0), (1.0, 1.0, height)]
    mesh = dmesh.create_box(MPI.COMM_SELF, corners, counts, dmesh.CellType.hexahedron)
    return untorn("hexahedron", geometry_dofmap(mesh), mesh.geometry.x)


def tetrahedra(n, shift=0.0):
    """Tetrahedra between n points, which are denser near a corner of a cube."""
    x = np.random.default_rng(0).random((n, 3)) ** 2 + (shift, 0.0, 0.0)
    return Delaunay(x).simplices.astype(np.int64), x


def spread(x, part):
    """Sum of the squares of the distances from the means of the parts."""
    size = np.bincount(part)
    means = np.stack([np.bincount(part, weights=c) / size for c in x.T], axis=1)
    return np.sum((x - means[part]) ** 2)


def cuts(mesh, part):
    first, second = mesh.neighbours()
    return int(np.sum(part[first] != part[second]))


def compacted(x, part, comm=MPI.COMM_SELF, ids=None):
    ids = np.arange(len(x)) if ids is None else ids
    return compact_parts(x, np.ones(len(x)), ids, part, int(part.max()) + 1, comm)


def test_cubes_stay():
    x = midpoints(16)
    part = np.ravel_multi_index((2 * x).astype(int).T, (2, 2, 2))
    assert np.array_equal(compacted(x, part), part)


@pytest.mark.parametrize("grading", [1.0, 3.0])
def test_slabs_become_round_and_stay_balanced(grading):
    x = midpoints(24)
    part = (12 * x[:, 0]).astype(int)
    found = compacted(x**grading, part)
    size = np.bincount(found, minlength=12)
    assert size.min() > 0
    assert size.max() <= LARGEST * len(x) / 12
    assert spread(x**grading, found) < (0.6 if grading == 1.0 else 0.8) * spread(x**grading, part)


def test_ranks_do_not_matter():
    x = midpoints(20) ** 2
    part = (10 * x[:, 2] ** 0.5).astype(int)
    alone = compacted(x, part)
    own = np.flatnonzero(np.arange(len(x)) * 7 // 3 % COMM.size == COMM.rank)
    together = compact_parts(x[own], np.ones(len(own)), own, part[own], 10, COMM)
    assert np.array_equal(together, alone[own])
    assert np.any(alone != part)


def test_small_parts_stay():
    x = midpoints(4)
    part = np.arange(64) // 8
    assert np.array_equal(compacted(x, part), part)


def test_what_sticks_out_of_a_flat_interface_is_taken_off():
    if COMM.rank > 0:
        return
    mesh = boxes(12)
    x = mesh.midpoints()
    flat = (x[:, 0] > 0.5).astype(int)
    assert np.array_equal(flatten_interfaces(mesh, mesh.neighbours(), flat), flat)
    side, y, z = (12 * x).astype(int).T
    some = np.flatnonzero((side == 5 + y // 3 % 2) & (y % 3 == 1) & (z % 3 == 1))
    ragged = flat.copy()
    ragged[some] = 1 - ragged[some]
    assert cuts(mesh, ragged) == cuts(mesh, flat) + 4 * len(some) > cuts(mesh, flat)
    assert np.array_equal(flatten_interfaces(mesh, mesh.neighbours(), ragged), flat)


def parts_of_metis(mesh, num_parts, monkeypatch):
    """The parts that METIS makes itself."""
    with monkeypatch.context() as patch:
        patch.setattr(metis_module, "_made_round", lambda mesh, part, *others: part)
        patch.setattr(metis_module, "flatten_interfaces", lambda mesh, pairs, part: part)
        return metis(mesh, num_parts, COMM)


def test_metis_parts_made_round_are_connected_and_balanced(monkeypatch):
    mesh, num_parts = untorn("tetrahedron", *tetrahedra(3000)), 30
    part, before = metis(mesh, num_parts, COMM), parts_of_metis(mesh, num_parts, monkeypatch)
    assert not split_disconnected(mesh, part, COMM)[1]
    if COMM.rank == 0:
        size = np.bincount(part) * num_parts / len(part)
        assert len(size) == num_parts
        assert size.min() > 0.85
        assert size.max() < LARGEST + 0.02
        assert cuts(mesh, part) <= CUT * cuts(mesh, before)
        assert np.mean(part != before) > 0.1
        assert spread(mesh.midpoints(), part) < 0.95 * spread(mesh.midpoints(), before)


def test_parts_that_round_ones_do_not_suit_stay(monkeypatch):
    mesh = boxes(10)
    assert np.array_equal(metis(mesh, 9, COMM), parts_of_metis(mesh, 9, monkeypatch))


def test_bodies_keep_their_parts():
    (one, x), (other, y) = tetrahedra(400), tetrahedra(300, shift=2.0)
    mesh = untorn("tetrahedron", np.vstack((one, other + len(x))), np.vstack((x, y)))
    part = metis(mesh, 8, COMM)
    if COMM.rank == 0:
        assert len(np.unique(part)) == 8
        assert not set(part[: len(one)]) & set(part[len(one) :])


def test_metis_leaves_columns_of_flat_boxes_whole(monkeypatch):
    """Three cells of 25 : 1 on each other; METIS alone, which counts facets, cuts columns."""
    mesh = boxes(12, layers=3, height=0.01)
    columns = np.unique(np.round(mesh.midpoints()[:, :2], 6), axis=0, return_inverse=True)[1]
    broken = []
    for weighted in (True, False):
        with monkeypatch.context() as patch:
            if not weighted:
                patch.setattr(metis_module, "_weights", lambda mesh, first, _: np.ones(len(first)))
            part = metis(mesh, 6, COMM)
        pairs = np.unique(np.stack((columns.ravel(), part)), axis=1)
        broken.append(pairs.shape[1] - len(np.unique(columns)))
    if COMM.rank == 0:
        assert broken[0] == 0
        assert broken[0] < broken[1]
