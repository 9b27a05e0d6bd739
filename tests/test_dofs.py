"""Dof maps: torn copies meet in groups, whatever the degree, the cell and the ranks."""

import basix.ufl
import numpy as np
import pytest
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scenes import box, decomposed

import tfeti_dolfinx as tfeti
from tfeti_dolfinx.mesh.dofs import TornDofs


def torn(cell="hexahedron", degree=1, n=3, subdomains=5, shape=None):
    d = decomposed(cell, n, subdomains)
    shape = (d.mesh.geometry.dim,) if shape is None else shape
    return d, TornDofs(fem.functionspace(d.mesh, ("Lagrange", degree, shape)), d)


@pytest.mark.parametrize(
    ("cell", "degree"),
    [("triangle", 3), ("quadrilateral", 2), ("tetrahedron", 3), ("hexahedron", 1)],
)
def test_groups_are_the_nodes_of_the_untorn_mesh(cell, degree):
    d, dofs = torn(cell, degree)
    mesh, _, _ = box(cell, 3)
    V = fem.functionspace(mesh, ("Lagrange", degree, (mesh.geometry.dim,)))
    comm = d.comm
    assert comm.allreduce(dofs.num_groups) == V.dofmap.index_map.size_global
    assert comm.allreduce(len(dofs.copies)) == dofs.offsets[-1]
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node]
    low, high = dofs.reduce(x, np.minimum), dofs.reduce(x, np.maximum)
    assert np.allclose(low, high, atol=1e-12)


def test_copies_are_in_different_subdomains_the_lowest_first_and_found_with_their_values():
    _, dofs = torn()
    for g in np.flatnonzero(dofs.multiplicity > 1):
        own = slice(dofs.copy_offsets[g], dofs.copy_offsets[g + 1])
        assert np.all(np.diff(dofs.copy_subdomains[own]) > 0)
    assert dofs.comm.allreduce(int(dofs.multiplicity.max(initial=0)), op=MPI.MAX) >= 4
    own = dofs.group_offsets[dofs.comm.rank] + np.arange(dofs.num_groups)
    assert np.array_equal(dofs.spread(own), dofs.group)
    assert np.array_equal(dofs.reduce(np.ones(dofs.num_nodes), np.add), dofs.multiplicity)
    asked = (own * 7 + 3) % dofs.group_offsets[-1]
    (found,) = dofs.lookup(asked, own)
    assert np.array_equal(found, asked)
    groups = np.arange(dofs.group_offsets[-1])[:: dofs.comm.rank + 2]
    values = dofs.gather_copies(dofs.group.astype(float))
    position, nodes, found = dofs.lookup_copies(groups, values)
    assert np.array_equal(found, groups[position])
    (count,) = dofs.lookup(groups, dofs.multiplicity)
    assert np.array_equal(np.bincount(position, minlength=len(groups)), count)
    assert len(np.unique(nodes)) == len(nodes)


def test_numberings_are_inverse_to_each_other():
    d, dofs = torn("tetrahedron", 2)
    values = np.random.default_rng(0).random(dofs.num_nodes * dofs.bs)
    assert np.array_equal(dofs.to_dolfinx(dofs.to_primal(values)), values)
    assert np.array_equal(values[dofs.dolfinx_dofs()], dofs.to_primal(values))
    nodes = np.arange(dofs.num_nodes)
    assert np.array_equal(dofs.primal_node[dofs.dolfinx_node], nodes)
    assert np.all(np.diff(dofs.node_subdomain) >= 0)
    assert np.array_equal(np.unique(dofs.node_subdomain), d.subdomains)


def test_nodes_of_two_bodies_are_two_groups(comm):
    """Where they coincide, and where the number of one body's node is that of the other body."""
    x = np.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0], [1.0, 1.0]])
    cells, own = np.array([[1, 2, 3], [0, 4, 5]]), slice(0 if comm.rank else None)
    triangle = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    d = tfeti.decompose(dmesh.create_mesh(comm, cells=cells[own], x=x[own], e=triangle), 2)
    dofs = TornDofs(fem.functionspace(d.mesh, ("Lagrange", 1, (2,))), d)
    assert comm.allreduce(dofs.num_groups) == 6
