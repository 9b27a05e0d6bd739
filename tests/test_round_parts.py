"""Round parts with flat interfaces, of meshes that ranks share in any way."""

import numpy as np
import pymetis
import pytest
from bodies import clamped, no_load, two_body_problem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import box, solved
from scipy.spatial import Delaunay

import tfeti_dolfinx as tfeti
from meshes.half_ball import build
from tfeti_dolfinx.common.compat import GRAPH_PARTITIONERS, geometry_dofmap
from tfeti_dolfinx.mesh.cell_graph import CellGraph, Pieces
from tfeti_dolfinx.mesh.partition import connected_parts, make_parts
from tfeti_dolfinx.mesh.round_parts import balanced_kmeans, flatten_interfaces
from tfeti_dolfinx.mesh.tearing import moved
from tfeti_dolfinx.mesh.untorn import PhysicalNames, UntornMesh

COMM = MPI.COMM_WORLD


def whole_midpoints(n):
    """Those of n³ cells of a cube, n whole numbers to a side."""
    return np.stack(np.indices((n,) * 3), axis=-1).reshape(-1, 3).astype(float)


def untorn(kind, cells, x, comm=COMM):
    """A mesh, every so many cells on a rank: as much ghosts as there may be."""
    own = np.arange(comm.rank, len(cells), comm.size)
    nodes, places = np.unique(cells[own], return_inverse=True)
    facets = 6 if kind == "hexahedron" else 4
    return UntornMesh(
        cell_type=dmesh.to_type(kind),
        element=None,
        cells=places.reshape(len(own), -1),
        cell_ids=own,
        cell_tags=np.zeros(len(own)),
        facet_tags=np.zeros((len(own), facets)),
        node_ids=nodes,
        x=x[nodes],
        names=PhysicalNames(),
    )


def boxes(n):
    """A cube of n³ boxes."""
    mesh = dmesh.create_unit_cube(MPI.COMM_SELF, n, n, n, dmesh.CellType.hexahedron)
    return untorn("hexahedron", geometry_dofmap(mesh), mesh.geometry.x)


def tetrahedra(n, shift=0.0):
    """Tetrahedra between n points, which are denser near a corner of a cube."""
    x = np.random.default_rng(0).random((n, 3)) ** 2 + (shift, 0.0, 0.0)
    return Delaunay(x).simplices.astype(np.int64), x


def everywhere(mesh, values):
    """Values of all ranks' cells, by cell id."""
    ids = np.concatenate(COMM.allgather(mesh.cell_ids))
    return np.concatenate(COMM.allgather(values))[np.argsort(ids)]


def spread(x, part):
    """Sum of the squares of the distances from the means of the parts."""
    size = np.bincount(part)
    means = np.stack([np.bincount(part, weights=c) / size for c in x.T], axis=1)
    return np.sum((x - means[part]) ** 2)


def pairs(graph):
    """Cells and those across their facets, of this rank or ghosts: each pair from both sides."""
    cell, facet = np.nonzero(graph.across != np.arange(graph.num_cells)[:, None])
    return cell, graph.across[cell, facet]


def cuts(graph, part):
    """Facets between parts."""
    first, second = pairs(graph)
    return COMM.allreduce(np.sum(part[first] != graph.with_ghosts(part)[second])) // 2


def test_slabs_become_round_and_stay_balanced():
    x, own = whole_midpoints(24), slice(COMM.rank, None, COMM.size)
    key, body = np.arange(len(x), dtype=np.uint64), np.zeros(len(x), dtype=np.int64)
    found = balanced_kmeans(x[own], key[own], body[own], np.array([12]), COMM)
    alone = balanced_kmeans(x, key, body, np.array([12]), MPI.COMM_SELF)
    assert np.array_equal(found, alone[own])
    size = np.bincount(alone, minlength=12)
    assert size.min() > 0
    assert size.max() <= 1.1 * len(x) / 12
    assert spread(x, alone) < 0.6 * spread(x, (x[:, 0] // 2).astype(int))
    x = whole_midpoints(16)
    cubes = np.ravel_multi_index((x // 8).astype(int).T, (2, 2, 2))
    found = balanced_kmeans(x, key[: len(x)], body[: len(x)], np.array([8]), MPI.COMM_SELF)
    assert len(np.unique(np.stack((cubes, found)), axis=1).T) == 8


@pytest.mark.parametrize("parts", [100, 200])
def test_parts_of_a_strongly_graded_cloud_are_balanced(parts):
    """A ball of points 30 000 times denser near its middle; no part swallows those around it."""
    rng, r = np.random.default_rng(0), np.linspace(0.0, 1.0, 10_000)
    share = np.cumsum(r**2 / (0.0055 + 0.2 * np.maximum(r - 0.15, 0.0)) ** 3)
    x = rng.normal(size=(60_000, 3))
    radius = np.interp(rng.uniform(0, share[-1], len(x)), share, r)
    x *= (radius / np.linalg.norm(x, axis=1))[:, None]
    x = np.rint(2.0**20 * x)
    key, body = np.arange(len(x), dtype=np.uint64), np.zeros(len(x), dtype=np.int64)
    own = slice(COMM.rank, None, COMM.size)
    found = balanced_kmeans(x[own], key[own], body[own], np.array([parts]), COMM)
    size = COMM.allreduce(np.bincount(found, minlength=parts))
    assert size.max() <= 1.1 * size.mean()
    assert size.min() >= 0.9 * size.mean()


def test_what_sticks_out_of_a_flat_interface_is_taken_off():
    mesh = boxes(12)
    graph, x = CellGraph(mesh, COMM), mesh.midpoints()
    key, wanted = mesh.cell_ids.astype(np.uint64), np.full(2, 12**3 / 2)
    flat = (x[:, 0] > 0.5).astype(int)
    assert np.array_equal(flatten_interfaces(graph, flat, key, wanted), flat)
    side, y, z = (12 * x).astype(int).T
    some = np.flatnonzero((side == 5 + y // 3 % 2) & (y % 3 == 1) & (z % 3 == 1))
    ragged = flat.copy()
    ragged[some] = 1 - ragged[some]
    assert cuts(graph, ragged) == cuts(graph, flat) + 4 * COMM.allreduce(len(some)) > 144
    assert np.array_equal(flatten_interfaces(graph, ragged, key, wanted), flat)
    assert np.array_equal(flatten_interfaces(graph, ragged, key, 0.0 * wanted), ragged)


def test_parts_are_connected_balanced_and_as_round_as_those_of_metis():
    mesh, num_parts = untorn("tetrahedron", *tetrahedra(3000)), 30
    graph = CellGraph(mesh, COMM)
    pieces = graph.pieces(make_parts(mesh, graph, num_parts, "round"))
    of_piece, split, body = connected_parts(pieces, absorb=True)
    part = of_piece[pieces.of_cell]
    assert split == {}
    assert np.array_equal(body, np.zeros(num_parts))
    assert len(graph.pieces(part).colour) == num_parts
    all_cells, x = everywhere(mesh, part), everywhere(mesh, mesh.midpoints())
    size = np.bincount(all_cells) * num_parts / len(all_cells)
    assert size.min() > 0.85
    assert size.max() < 1.12
    # METIS has the whole mesh on each rank here
    alone = untorn("tetrahedron", *tetrahedra(3000), MPI.COMM_SELF)
    lone = CellGraph(alone, MPI.COMM_SELF)
    first, second = pairs(lone)
    start = np.searchsorted(first, np.arange(lone.num_cells + 1))
    adjacency = pymetis.CSRAdjacency(start.tolist(), second.tolist())
    options = pymetis.Options(contig=True, seed=1)
    _, theirs = pymetis.part_graph(num_parts, adjacency, options=options, recursive=False)
    theirs = np.asarray(theirs)
    assert cuts(graph, part) <= 1.1 * np.sum(theirs[first] != theirs[second]) / 2
    assert spread(x, all_cells) < 0.95 * spread(x, theirs)


def test_parts_of_a_graded_mesh_cost_what_those_of_others_do():
    """A half ball on a plane, cells there 100 times shorter than its radius; boxes take 67 F."""
    model = build(1.0, 0.0112, 0.15, 0.2) if COMM.rank == 0 else None
    cut = tfeti.read_gmsh(model, COMM, 40)
    bcs = clamped(cut, ("top", np.array([0.0, 0.0, -0.01])))
    plane = tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), normal=(0, 0, 1)))
    problem = solved(two_body_problem(cut, no_load, bcs, [plane]))
    assert problem.report.F_multiplications < 25


def test_bodies_keep_their_parts():
    (one, x), (other, y) = tetrahedra(400), tetrahedra(300, shift=2.0)
    mesh = untorn("tetrahedron", np.vstack((one, other + len(x))), np.vstack((x, y)))
    graph = CellGraph(mesh, COMM)
    part = everywhere(mesh, make_parts(mesh, graph, 8, "round"))
    assert len(np.unique(part)) == 8
    assert not set(part[: len(one)]) & set(part[len(one) :])


def test_ghosts_are_the_cells_of_others_at_own_vertices():
    mesh = boxes(6)
    graph = CellGraph(mesh, COMM)
    n = graph.num_cells
    first, second = pairs(graph)
    assert COMM.allreduce(len(first)) == 2 * 3 * 5 * 36
    x = graph.with_ghosts(mesh.midpoints())
    assert np.allclose(np.linalg.norm(x[first] - x[second], axis=1), 1 / 6)
    every = everywhere(mesh, mesh.midpoints())
    near = np.abs(every[:, None] - x[:n]).max(axis=2).min(axis=1, initial=1.0) < 1.1 / 6
    assert len(x) == near.sum()  # a cell and its ghosts, each once
    known = np.append(mesh.node_ids, -1)[graph.vertices]
    here = np.linalg.norm(np.vstack((mesh.x, np.zeros(3)))[graph.vertices] - x[:, None], axis=2)
    assert np.allclose(here[known >= 0], np.sqrt(0.75) / 6)


def test_a_share_of_a_mesh_has_few_ghosts():
    """DOLFINx has shared out the cells; nobody holds the mesh."""
    mesh = box("tetrahedron", 12)[0]
    d = tfeti.decompose(mesh, 13)
    cells = 6 * 12**3
    assert COMM.allreduce(len(d.original_cells)) == cells
    assert len(d.original_cells) < 1.3 * cells / COMM.size
    alone = tfeti.decompose(box("tetrahedron", 12, MPI.COMM_SELF)[0], 13)
    ids, there = d.original_cells, np.empty(cells, dtype=np.int64)
    there[alone.original_cells] = alone.cell_subdomain
    assert np.array_equal(d.cell_subdomain, there[ids])


def test_fragments_join_the_neighbour_with_most_facets():
    """Part 0 has pieces 0, 1, 2; piece 2 is beside piece 1 alone, 1 beside parts 1 and 2."""
    links = np.array([(1, 3), (3, 1), (1, 4), (4, 1), (1, 2), (2, 1), (0, 3), (3, 0)])
    facets = np.array([2, 2, 3, 3, 1, 1, 9, 9])
    cells, colour = np.arange(5), np.array([0, 0, 0, 1, 2])
    pieces = Pieces(cells, colour, np.array([9, 2, 1, 9, 9]), links, facets)
    parts, split, body = connected_parts(pieces, absorb=True)
    assert parts.tolist() == [0, 2, 2, 1, 2]
    assert split == {}
    assert body.tolist() == [0, 0, 0]
    parts, split, body = connected_parts(pieces, absorb=False)
    assert parts.tolist() == [0, 3, 4, 1, 2]
    assert split == {0: [0, 3, 4]}
    assert body.tolist() == [0, 0, 0, 0, 0]


@pytest.mark.parametrize("name", ["bisection", *GRAPH_PARTITIONERS])
def test_other_partitioners_give_as_many_connected_parts(name):
    d = tfeti.decompose(box("tetrahedron", 8)[0], 9, partitioner=name)
    assert (d.num_subdomains, d.split) == (9, {})
    size = COMM.allreduce(np.bincount(d.cell_subdomain, minlength=9))
    assert size.max() < 1.2 * size.mean()


@pytest.mark.parametrize("name", ["round", "bisection", *GRAPH_PARTITIONERS])
def test_all_cells_on_one_rank(name):
    """The others have neither cells nor nodes."""
    mesh = untorn("tetrahedron", *tetrahedra(200))
    mesh, _ = moved(mesh, np.zeros(len(mesh.cells), dtype=np.int64), mesh.cell_ids, COMM)
    graph = CellGraph(mesh, COMM)
    assert (graph.num_cells > 0) == (COMM.rank == 0)
    pieces = graph.pieces(make_parts(mesh, graph, 5, name))
    assert np.array_equal(np.unique(pieces.colour), np.arange(5))
    assert len(everywhere(mesh, pieces.of_cell)) == pieces.size.sum()
