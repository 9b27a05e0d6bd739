"""Tearing: subdomains, bodies, tags, tears; the same on any number of ranks."""

from typing import NamedTuple

import numpy as np
import pytest
import ufl
from dolfinx import mesh as dmesh
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI
from scenes import CELLS, SIDES, box, decomposed, integral, measures

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.tearing import deal


def cells_of(decomposition):
    """Original cells and their subdomains, sorted, of all ranks."""
    comm = decomposition.comm
    ids = np.concatenate(comm.allgather(decomposition.original_cells))
    subdomains = np.concatenate(comm.allgather(decomposition.cell_subdomain))
    order = np.argsort(ids)
    return ids[order], subdomains[order]


@pytest.mark.parametrize("cell", CELLS)
def test_tags_survive_the_tearing(cell):
    d = decomposed(cell, n=4, subdomains=5)
    gdim = d.mesh.geometry.dim
    _, ds = measures(d)
    assert integral(1 * ufl.dx(domain=d.mesh)) == pytest.approx(1.0)
    for name in SIDES[gdim]:
        assert integral(1 * ds(d.surface(name))) == pytest.approx(1.0)
    assert d.num_subdomains == 5
    assert d.num_bodies == 1
    assert d.is_torn


def test_the_boundary_is_the_exterior_without_the_tears():
    d = decomposed("hexahedron", n=4, subdomains=lambda x: (x[0] > 0.5) + 2 * (x[1] > 0.5))
    comm = d.comm
    assert comm.allreduce(len(d.boundary)) == 6 * 16
    assert comm.allreduce(len(d.tears)) == 2 * 2 * 16
    exterior = dmesh.exterior_facet_indices(d.mesh.topology)
    assert np.array_equal(np.union1d(d.tears, d.boundary), np.sort(exterior))


def test_subdomains_do_not_depend_on_the_ranks_and_each_is_on_one():
    d = decomposed("tetrahedron", n=4, subdomains=7)
    alone = decomposed("tetrahedron", n=4, subdomains=7, comm=MPI.COMM_SELF)
    ids, subdomains = cells_of(d)
    ids_alone, subdomains_alone = cells_of(alone)
    assert np.array_equal(ids, ids_alone)
    assert np.array_equal(subdomains, subdomains_alone)
    # ranks have about equal shares
    d = decomposed("hexahedron", n=6, subdomains=24)
    lists = d.comm.allgather(d.subdomains.tolist())
    assert sorted(s for part in lists for s in part) == list(range(24))
    cells = d.comm.allgather(len(d.cell_subdomain))
    assert max(cells) <= 1.3 * min(cells)
    assert tfeti.decompose(box("triangle", 4)[0]).num_subdomains == 1  # of about 4000 unknowns


def test_disconnected_subdomains_are_split_and_reported(caplog):
    caplog.set_level("INFO")
    d = decomposed("quadrilateral", n=4, subdomains=lambda x: np.abs(x[0] - 0.5) > 0.25)
    assert d.split == {1: [1, 2]}
    assert d.num_subdomains == 3
    ids, subdomains = cells_of(d)
    assert len(np.unique(subdomains)) == 3
    if d.comm.rank == 0:
        assert "split" in caplog.text


@settings(max_examples=25)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 10**6))
def test_dealing_is_balanced_and_leaves_no_rank_idle(num_subdomains, num_ranks, seed):
    rng = np.random.default_rng(seed)
    weights = rng.integers(50, 100, num_subdomains).astype(float)
    ranks = deal(weights, rng.random((num_subdomains, 3)), num_ranks)
    assert len(np.unique(ranks)) == min(num_subdomains, num_ranks)
    loads = np.bincount(ranks, weights, minlength=num_ranks)
    assert loads.max() <= weights.sum() / num_ranks + 2 * weights.max()


@settings(max_examples=25)
@given(st.integers(1, 20), st.integers(2, 3), st.integers(0, 10**6))
def test_bisection_of_points_is_balanced(parts, gdim, seed):
    x = np.random.default_rng(seed).random((200, gdim))
    own = x[MPI.COMM_WORLD.rank :: MPI.COMM_WORLD.size]
    part = bisect_points(own, parts, MPI.COMM_WORLD)
    counts = MPI.COMM_WORLD.allreduce(np.bincount(part, minlength=parts))
    assert counts.min() >= 200 // parts - 5
    assert counts.max() <= 200 // parts + 6
    alone = bisect_points(x, parts, MPI.COMM_SELF)
    assert np.array_equal(part, alone[MPI.COMM_WORLD.rank :: MPI.COMM_WORLD.size])


def grid_of_cells(counts, size):
    """Midpoints and extents of boxes of that size, in an order that means nothing."""
    axes = [(np.arange(n) + 0.5) * h for n, h in zip(counts, size, strict=True)]
    x = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)
    x = np.random.default_rng(0).permutation(x)
    return x, np.broadcast_to(size, x.shape)


@pytest.mark.parametrize(("thin", "parts"), [(0, 2), (1, 7), (2, 8)])
def test_bisection_leaves_columns_of_flat_cells_whole(thin, parts):
    """Cells 50 times as wide as thick; columns of 5 are less than a part may change by."""
    size = np.ones(3)
    size[thin] = 0.02
    x, extents = grid_of_cells([7 if k != thin else 5 for k in range(3)], size)
    own = slice(MPI.COMM_WORLD.rank, None, MPI.COMM_WORLD.size)
    part = bisect_points(x[own], parts, MPI.COMM_WORLD, extents[own])
    alone = bisect_points(x, parts, MPI.COMM_SELF, extents)
    assert np.array_equal(part, alone[own])
    columns = np.unique(np.round(np.delete(x, thin, axis=1), 6), axis=0, return_inverse=True)[1]
    assert len(np.unique(np.stack((columns.ravel(), alone)), axis=1).T) == 49
    assert len(np.unique(alone)) == parts


def test_bisection_cuts_between_layers():
    """Ten layers of flat cells in three parts: 3, 4 and 3 or so, each interface is a plane."""
    kind = dmesh.CellType.tetrahedron
    mesh = dmesh.create_box(MPI.COMM_WORLD, [(0, 0, 0), (5, 1, 0.2)], [10, 2, 2], kind)
    d = tfeti.decompose(mesh, 3)
    cells = np.arange(len(d.original_cells), dtype=np.int32)
    layer = np.floor(2.0 * dmesh.compute_midpoints(d.mesh, 3, cells)[:, 0]).astype(int)
    found = {(int(k), int(s)) for k, s in zip(layer, d.cell_subdomain, strict=True)}
    assert len(set().union(*d.comm.allgather(found))) == 10


def test_markers_name_surfaces_and_volumes(comm):
    mesh = dmesh.create_unit_square(comm, 8, 8)
    top = dmesh.locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 1))
    tags = dmesh.meshtags(mesh, 1, np.sort(top), np.full_like(top, 7))
    named = [("bottom", lambda x: np.isclose(x[1], 0)), ("right", lambda x: np.isclose(x[0], 1))]
    names = dict(named[:: -1 if comm.rank == 1 else 1], top=7)  # ranks order them as they like
    left = {"left half": lambda x: x[0] <= 0.5}
    d = tfeti.decompose(mesh, 4, facet_tags=tags, surfaces=names, volumes=left)
    assert [d.surface(name) for name in ("top", "bottom", "right")] == [7, 8, 9]
    assert d.volume("left half") == 1
    for name, at in (("top", 1.0), ("bottom", 0.0)):
        facets = d.facets(name)
        assert comm.allreduce(len(facets)) == 8
        assert np.allclose(dmesh.compute_midpoints(d.mesh, 1, facets)[:, 1], at)
    dx, ds = measures(d)
    assert np.allclose((integral(1 * ds(8)), integral(1 * dx(1))), (1.0, 0.5))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"top": lambda x: x[1] > 2}, r"surfaces\['top'\]: the marker finds no facet"),
        ({"top": lambda x: x[7] > 2}, r"surfaces\['top'\]: IndexError"),
        ({"top": lambda x: x[1]}, r"surfaces\['top'\]: .* got float64 of"),
        ({"top": lambda x: True}, r"surfaces\['top'\]: .* bool of shape \(\)"),
        (
            {"top": lambda x: x[1] > 0.99, "right": lambda x: (x[0] > 0.99) | (x[1] > 0.99)},
            r"surfaces\['right'\]: the marker finds some that are 'top'",
        ),
    ],
)
def test_markers_that_do_not_fit_are_named(names, message, comm):
    with pytest.raises(tfeti.InputError, match=message):
        tfeti.decompose(dmesh.create_unit_square(comm, 4, 4), 2, surfaces=names)


class Data(NamedTuple):
    """As of ``dolfinx.io.gmsh`` from DOLFINx 0.10 on."""

    mesh: dmesh.Mesh
    cell_tags: dmesh.MeshTags | None
    facet_tags: dmesh.MeshTags | None
    physical_groups: dict


def test_data_of_gmsh_bring_their_names(comm):
    mesh = dmesh.create_unit_square(comm, 4, 4)
    top = dmesh.locate_entities_boundary(mesh, 1, lambda x: np.isclose(x[1], 1))
    tags = dmesh.meshtags(mesh, 1, np.sort(top), np.full_like(top, 3))
    data = Data(mesh, None, tags, {"lid": (1, 3), "corner": (0, 3)})
    d = tfeti.decompose(data, 2)
    assert d.surface("lid") == 3
    assert comm.allreduce(len(d.facets("lid"))) == 4
