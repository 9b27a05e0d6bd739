"""Round parts with flat interfaces, from METIS parts or any others."""

from dataclasses import replace

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.spatial import Delaunay

from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.mesh import metis as metis_module
from tfeti_dolfinx.mesh.metis import compact_parts, flatten_interfaces, metis
from tfeti_dolfinx.mesh.partition import PARTITION, split_disconnected
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


def boxes(n):
    """A cube of n³ boxes."""
    mesh = dmesh.create_unit_cube(MPI.COMM_SELF, n, n, n, dmesh.CellType.hexahedron)
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


def test_slabs_become_round_and_stay_balanced():
    x = midpoints(24)
    part = (12 * x[:, 0]).astype(int)
    found = compact_parts(x, part, 12)
    size = np.bincount(found, minlength=12)
    assert size.min() > 0
    assert size.max() <= PARTITION.largest * len(x) / 12
    assert spread(x, found) < 0.6 * spread(x, part)
    x = midpoints(16)
    cubes = np.ravel_multi_index((2 * x).astype(int).T, (2, 2, 2))
    assert np.array_equal(compact_parts(x, cubes, 8), cubes)


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


def test_metis_parts_made_round_are_connected_and_balanced(monkeypatch):
    mesh, num_parts = untorn("tetrahedron", *tetrahedra(3000)), 30
    part = metis(mesh, num_parts, COMM)
    monkeypatch.setattr(metis_module, "PARTITION", replace(PARTITION, fewest=10**9, flattening=0))
    before = metis(mesh, num_parts, COMM)
    assert not split_disconnected(mesh, part, COMM)[1]
    if COMM.rank == 0:
        size = np.bincount(part) * num_parts / len(part)
        assert len(size) == num_parts
        assert size.min() > 0.85
        assert size.max() < PARTITION.largest + 0.02
        assert cuts(mesh, part) <= 1.1 * cuts(mesh, before)
        assert np.mean(part != before) > 0.1
        assert spread(mesh.midpoints(), part) < 0.95 * spread(mesh.midpoints(), before)


def test_bodies_keep_their_parts():
    (one, x), (other, y) = tetrahedra(400), tetrahedra(300, shift=2.0)
    mesh = untorn("tetrahedron", np.vstack((one, other + len(x))), np.vstack((x, y)))
    part = metis(mesh, 8, COMM)
    if COMM.rank == 0:
        assert len(np.unique(part)) == 8
        assert not set(part[: len(one)]) & set(part[len(one) :])
