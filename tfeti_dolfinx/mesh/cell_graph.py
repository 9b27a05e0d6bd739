"""Cells of an untorn mesh that share facets, on any ranks; their connected pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange, offset_of
from tfeti_dolfinx.mesh.untorn import UntornMesh, equal_pairs, exchange_by_key, facet_keys


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
    """The cells of this rank, and those of other ranks across their facets.

    Creation and all methods are collective. No rank holds more than its own cells and these ghosts,
    one for each facet between ranks, which come after its own.

    Attributes:
        comm: Ranks that share the cells.
        num_cells: Cells of this rank.
        across: Cell or ghost across each facet of a cell, shape ``(n, facets_per_cell)``; the cell
            itself where there is none.
    """

    def __init__(self, mesh: UntornMesh, comm: MPI.Intracomm) -> None:
        self.comm, self.num_cells, self._cell_ids = comm, len(mesh.cells), mesh.cell_ids
        keys = facet_keys(mesh.cells, mesh.node_ids, mesh.cell_type)
        shape, keys = keys.shape, keys.ravel()
        across = np.repeat(np.arange(shape[0], dtype=np.int32), shape[1])
        first, second = equal_pairs(keys)
        across[first], across[second] = across[second], across[first]
        if comm.size > 1:
            lone = np.ones(len(keys), dtype=bool)
            lone[first] = lone[second] = False
            facet = np.flatnonzero(lone)
            meeting = exchange_by_key(comm, keys[facet])
            first, second = equal_pairs(meeting.send(keys[facet]))
            rank: Array = np.full(len(meeting.source), -1)
            rank[first], rank[second] = meeting.source[second], meeting.source[first]
            rank = meeting.answer(rank)
            facet, rank = facet[rank >= 0], rank[rank >= 0]
            order = np.lexsort((keys[facet], rank))  # two ranks have their facets in one order
            facet, rank = facet[order], rank[order]
            self._ghosts, self._sent = Exchange(comm, rank), facet // shape[1]
            across[facet] = shape[0] + np.arange(len(facet))
        self.across = across.reshape(shape)

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
        start = across.shape[1] * np.arange(n + 1)
        columns = np.where(same & own, across, each).ravel()
        graph = csr_array((np.ones(across.size), columns, start), shape=(n, n))
        # each of two neighbours has the other: strong components are found without a transpose
        count, label = connected_components(graph, connection="strong")
        label = self.with_ghosts(label.astype(np.int64) + offset_of(comm, count))
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
        np.minimum.at(lowest[1], piece[:n], self._cell_ids)
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
