"""Meshes before they are torn: cells, their facets and edges."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import basix
import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange

# --- Keys of facets and nodes -----------------------------------------------------------------

NO_TAG = np.iinfo(np.int32).min


def mix(ids: Array) -> Array:
    """64-bit finaliser of SplitMix64 (Steele, Lea, Flood 2014), elementwise."""
    z = np.asarray(ids).astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def set_key(ids: Array) -> Array:
    """Return the key of a set of ids along the last axis, whatever their order.

    Two of N sets get the same key with probability N²/2⁶⁵.
    """
    return mix(ids).sum(axis=-1, dtype=np.uint64)


@cache
def cell_entities(cell_type: dmesh.CellType, dim: int) -> list[Array]:
    """Local vertices of each entity of dimension ``dim``, in DOLFINx's order."""
    cell = getattr(basix.CellType, cell_type.name)
    return [np.asarray(vertices) for vertices in basix.topology(cell)[dim]]


def facet_vertices(cell_type: dmesh.CellType) -> Array:
    """Local vertices of each facet, shape ``(num_facets, vertices_per_facet)``."""
    return np.array(cell_entities(cell_type, dmesh.cell_dim(cell_type) - 1))


def facet_keys(cells: Array, ids: Array, cell_type: dmesh.CellType) -> Array:
    """Return keys of all facets of cells of local nodes with these ids, shape ``(n, facets)``."""
    mixed = mix(ids)[cells[:, : len(cell_entities(cell_type, 0))]]
    keys = np.zeros((len(cells), len(facet_vertices(cell_type))), dtype=np.uint64)
    for key, vertices in zip(keys.T, facet_vertices(cell_type), strict=True):
        for vertex in vertices:
            key += mixed[:, vertex]
    return keys


def equal_pairs(keys: Array) -> tuple[Array, Array]:
    """Positions of keys that occur twice: ``keys[first] == keys[second]``, first < second."""
    order = np.argsort(keys)
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    first, second = np.sort((order[same], order[same + 1]), axis=0)
    return first, second


def exchange_by_key(comm: MPI.Intracomm, keys: Array) -> Exchange:
    """Let equal keys, or ids, of all ranks meet on the rank that they name. Collective."""
    return Exchange(comm, (keys % keys.dtype.type(comm.size)).astype(np.int64))


def cell_facets(mesh: dmesh.Mesh) -> Array:
    """Local facets of each cell owned by this rank, shape ``(n, facets_per_cell)``. Collective."""
    tdim = mesh.topology.dim
    mesh.topology.create_connectivity(tdim, tdim - 1)
    per_cell = len(facet_vertices(mesh.topology.cell_type))
    facets = mesh.topology.connectivity(tdim, tdim - 1).array.reshape(-1, per_cell)
    return facets[: mesh.topology.index_map(tdim).size_local]


def cells_at(mesh: dmesh.Mesh, facets: Array) -> tuple[Array, Array]:
    """Return the cells of local exterior facets, and their places there."""
    fdim = mesh.topology.dim - 1
    mesh.topology.create_connectivity(fdim, fdim + 1)
    cells = mesh.topology.connectivity(fdim, fdim + 1)
    cell = cells.array[cells.offsets[facets]]
    return cell, np.argmax(cell_facets(mesh)[cell] == facets[:, None], axis=1)


def facet_points(mesh: dmesh.Mesh, facets: Array) -> Array:
    """Geometry nodes of local facets, shape ``(n, nodes_per_facet)``."""
    fdim = mesh.topology.dim - 1
    mesh.topology.create_connectivity(fdim, fdim + 1)
    if len(facets) == 0:  # DOLFINx divides by their number
        return np.empty((0, 0), dtype=np.int32)
    return np.asarray(dmesh.entities_to_geometry(mesh, fdim, facets.astype(np.int32)))


# --- The untorn mesh --------------------------------------------------------------------------


@dataclass(frozen=True)
class PhysicalNames:
    """Names of the physical groups: ``surfaces[name]`` and ``volumes[name]`` are tags."""

    surfaces: dict[str, int] = field(default_factory=dict)
    volumes: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class UntornMesh:
    """This rank's share of the untorn mesh."""

    cell_type: dmesh.CellType  # type of all cells
    element: Any  # coordinate element (basix.ufl), the same on all ranks
    # nodes of each cell in DOLFINx's order, their places in `node_ids`, shape (n, nodes_per_cell)
    cells: Array
    cell_ids: Array  # original ids of the cells, shape (n,)
    cell_tags: Array  # material tags, shape (n,), NO_TAG where there is none
    facet_tags: Array  # tags of the cells' facets, shape (n, facets_per_cell), NO_TAG likewise
    node_ids: Array  # original ids of the nodes of these cells, each once, shape (p,)
    x: Array  # coordinates of these nodes, shape (p, gdim)
    names: PhysicalNames  # names of the physical groups, the same on all ranks

    @property
    def vertices(self) -> Array:
        """Vertices among the nodes of each cell, shape ``(n, vertices_per_cell)``."""
        return self.cells[:, : len(cell_entities(self.cell_type, 0))]

    def midpoints(self) -> Array:
        """Mean of each cell's vertices, shape ``(n, gdim)``."""
        corners = self.vertices.T
        total = self.x[corners[0]]
        for corner in corners[1:]:
            total += self.x[corner]
        return total / len(corners)

    def extents(self) -> Array:
        """Sides of each cell's box along the axes, shape ``(n, gdim)``."""
        low, *corners = (self.x[corner] for corner in self.vertices.T)
        high = low.copy()
        for x in corners:
            np.minimum(low, x, out=low)
            np.maximum(high, x, out=high)
        return high - low
