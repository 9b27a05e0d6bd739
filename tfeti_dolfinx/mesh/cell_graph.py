"""Cells of an untorn mesh that share facets or vertices, on any ranks; their connected pieces."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange, offset_of
from tfeti_dolfinx.mesh.untorn import (
    UntornMesh,
    equal_pairs,
    exchange_by_key,
    facet_keys,
    facet_vertices,
)


@dataclass(frozen=True)
class Pieces:
    """Pieces of cells of one colour that hang together by facets, the same on all ranks.

    They are sorted by colour; of one colour the largest is the first (ties: lowest cell id).
    """

    of_cell: Array  # piece of each cell of this rank, shape (n,)
    colour: Array  # colour of each piece, shape (p,)
    size: Array  # its number of cells, shape (p,)
    links: Array  # pairs of pieces that share facets, both ways, shape (l, 2)
    facets: Array  # the number of these facets, shape (l,)


class CellGraph:
    """The cells of this rank, and those of other ranks that they share a vertex with.

    Creation and all methods are collective. No rank holds more than its own cells and these ghosts,
    which come after its own.

    Attributes:
        comm: Ranks that share the cells.
        num_cells: Cells of this rank.
        across: Cell or ghost across each facet of a cell, shape ``(n, facets_per_cell)``; the cell
            itself where there is none.
        vertices: Vertices of cells and ghosts, shape ``(n + g, k)``; those of ghosts that no own
            cell has are ``num_nodes``.
        num_nodes: Nodes of the share.
    """

    def __init__(self, mesh: UntornMesh, comm: MPI.Intracomm) -> None:
        self.comm, self.num_cells, self.num_nodes = comm, len(mesh.cells), len(mesh.node_ids)
        self.vertices = mesh.vertices
        self._mesh, self._ghosts = mesh, Exchange(comm, np.empty(0, dtype=np.int64))
        self._sent: Array = np.empty(0, dtype=np.int64)
        keys = facet_keys(mesh.cells, mesh.node_ids, mesh.cell_type)
        shape, keys = keys.shape, keys.ravel()
        across = np.repeat(np.arange(shape[0], dtype=np.int32), shape[1])
        first, second = equal_pairs(keys)
        across[first], across[second] = across[second], across[first]
        if comm.size > 1:
            lone = np.ones(len(keys), dtype=bool)
            lone[first] = lone[second] = False
            facet, ghost = self._across_ranks(keys, np.flatnonzero(lone))
            across[facet] = ghost
        self.across = across.reshape(shape)

    def _across_ranks(self, keys: Array, facet: Array) -> tuple[Array, Array]:
        """Find ghosts; return which of the facets, that no two own cells share, have which one."""
        comm, mesh, n = self.comm, self._mesh, self.num_cells
        corners = facet_vertices(mesh.cell_type)
        cell, local = np.divmod(facet, len(corners))
        start = offset_of(comm, n)
        exchange = exchange_by_key(comm, keys[facet])
        one, other = equal_pairs(exchange.send(keys[facet]))
        number = exchange.send(start + cell)
        partner = np.full(len(number), -1)
        partner[one], partner[other] = number[other], number[one]
        partner = exchange.answer(partner)
        met = partner >= 0
        # vertices of facets between ranks, and the other ranks that have them
        shared = np.unique(self.vertices[cell[met][:, None], corners[local[met]]])
        exchange = exchange_by_key(comm, mesh.node_ids[shared])
        ids, place = np.unique(exchange.send(mesh.node_ids[shared]), return_inverse=True)
        holders = csr_array(
            (np.ones(len(place)), (place, exchange.source)), shape=(len(ids), comm.size)
        )
        row, rank = holders[place].nonzero()
        others = rank != exchange.source[row]
        row, rank = row[others], rank[others].astype(np.int64)  # the same type on all ranks
        exchange = Exchange(comm, exchange.source[row])
        ids, rank = exchange.send(ids[place[row]]), exchange.send(rank)
        by_id = np.argsort(mesh.node_ids)
        node = by_id[np.searchsorted(mesh.node_ids, ids, sorter=by_id)]
        wanted = csr_array((np.ones(len(node)), (node, rank)), shape=(self.num_nodes, comm.size))
        self._sent, rank = (incidence(self.vertices, self.num_nodes) @ wanted).nonzero()
        self._ghosts = Exchange(comm, rank)
        # ghosts, their vertices where this rank has them
        vertices = self._ghosts.send(mesh.node_ids[self.vertices[self._sent]])
        place = np.searchsorted(mesh.node_ids, vertices, sorter=by_id)
        found = by_id[np.minimum(place, self.num_nodes - 1)] if self.num_nodes else place
        known = mesh.node_ids[found] == vertices if self.num_nodes else place < 0
        self.vertices = np.vstack((self.vertices, np.where(known, found, self.num_nodes)))
        number = self._ghosts.send(start + self._sent)
        by_number = np.argsort(number)
        return facet[met], n + by_number[np.searchsorted(number, partner[met], sorter=by_number)]

    def with_ghosts(self, values: Array) -> Array:
        """Values of cells, then those of the ghosts."""
        if self.comm.size == 1:
            return values
        return np.concatenate((values, self._ghosts.send(values[self._sent])))

    def pieces(self, colour: Array) -> Pieces:
        """Find the pieces of cells with one colour, shape ``(n,)``, that hang together."""
        n, comm = self.num_cells, self.comm
        across, each = self.across, np.arange(n, dtype=np.int32)[:, None]
        same, own = colour[:, None] == self.with_ghosts(colour)[across], across < n
        # each of two neighbours has the other: strong components are found without a transpose
        graph = incidence(np.where(same & own, across, each), n)
        count, label = connected_components(graph, connection="strong")
        label = self.with_ghosts(label + offset_of(comm, count))
        cell, facet = np.nonzero(same & ~own)
        edges = np.unique(np.stack((label[cell], label[across[cell, facet]])), axis=1)
        edges, total = np.concatenate(comm.allgather(edges), axis=1), comm.allreduce(count)
        graph = coo_array((np.ones(edges.shape[1]), tuple(edges)), shape=(total, total))
        count, merged = connected_components(graph, directed=False)
        piece = merged[label]
        size = np.bincount(piece[:n], minlength=count)
        comm.Allreduce(MPI.IN_PLACE, size, op=MPI.SUM)
        lowest = np.full((2, count), np.iinfo(np.int64).max)
        np.minimum.at(lowest[0], piece[:n], colour)
        np.minimum.at(lowest[1], piece[:n], self._mesh.cell_ids)
        comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
        order = np.lexsort((lowest[1], -size, lowest[0]))
        number = np.empty(count, dtype=np.int64)
        number[order] = np.arange(count)
        piece = number[piece]
        cell, facet = np.nonzero(~same)
        links = piece[cell] * count + piece[across[cell, facet]]
        links, facets = np.unique(links, return_counts=True)
        every, counts = map(np.concatenate, zip(*comm.allgather((links, facets)), strict=True))
        links, place = np.unique(every, return_inverse=True)
        facets = np.bincount(place.ravel(), counts, minlength=len(links)).astype(np.int64)
        links = np.stack(np.divmod(links, max(count, 1)), axis=1)
        return Pieces(piece[:n], lowest[0][order], size[order], links, facets)


def incidence(vertices: Array, num_nodes: int) -> csr_array:
    """Return the matrix of cells and their vertices, shape ``(cells, num_nodes)``."""
    n, k = vertices.shape
    table = np.arange(0, n * k + 1, k, dtype=np.result_type(np.int32, np.min_scalar_type(-n * k)))
    columns = vertices.ravel().astype(table.dtype)
    return csr_array((np.ones(n * k), columns, table), shape=(n, num_nodes))
