"""Facet-connected pieces of subdomains: a subdomain must have only one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.entities import equal_pairs, facet_keys
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import Exchange


@dataclass(frozen=True)
class _Pieces:
    """Pieces of this rank's subdomains.

    Attributes:
        of_cell: Piece of each cell.
        subdomain: Subdomain of each piece.
        is_main: Whether a piece is the largest of its subdomain (ties: lowest cell id).
        order: The pieces sorted by subdomain, the main one first, then by lowest cell id.
    """

    of_cell: Array
    subdomain: Array
    is_main: Array
    order: Array


def _pieces(mesh: UntornMesh, subdomain: Array) -> _Pieces:
    n = len(subdomain)
    first, second = mesh.neighbours(colours=subdomain)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    _, start, of_cell, size = np.unique(
        label, return_index=True, return_inverse=True, return_counts=True
    )
    owner = subdomain[start]
    lowest = np.full(len(start), np.iinfo(np.int64).max)
    np.minimum.at(lowest, of_cell, mesh.cell_ids)
    order = np.lexsort((lowest, -size, owner))
    is_main = np.ones(len(start), dtype=bool)
    is_main[order[1:]] = owner[order[1:]] != owner[order[:-1]]
    return _Pieces(of_cell, owner, is_main, order)


def split_disconnected(
    mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm
) -> tuple[Array, dict[int, list[int]]]:
    """Give the pieces of a subdomain ids of their own. Collective.

    The largest piece keeps the id, the others get ids after the last.

    Args:
        mesh: Cells on the ranks of their subdomains.
        subdomain: Their subdomains.
        comm: Communicator.

    Returns:
        The subdomains after the split, and for each that was split its new ids.
    """
    pieces = _pieces(mesh, subdomain)
    new = pieces.order[~pieces.is_main[pieces.order]]
    owner = pieces.subdomain[new]
    total = comm.allreduce(int(subdomain.max(initial=-1)), op=MPI.MAX) + 1
    everyone = np.sort(np.concatenate(comm.allgather(owner)))
    ids = pieces.subdomain.copy()
    ids[new] = total + np.searchsorted(everyone, owner)
    ids[new] += np.arange(len(new)) - np.searchsorted(owner, owner)
    split = {int(s): [int(s), *(total + np.flatnonzero(everyone == s)).tolist()] for s in everyone}
    return ids[pieces.of_cell], split


def absorb_fragments(mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm) -> Array:
    """Let the smaller pieces of a subdomain join the neighbour they share most facets with.

    Collective. Only main pieces of other subdomains take fragments in; what finds none stays.

    Args:
        mesh: Cells on the ranks of their subdomains.
        subdomain: Their subdomains.
        comm: Communicator.

    Returns:
        The new subdomains of the cells.
    """
    pieces = _pieces(mesh, subdomain)
    main = pieces.is_main[pieces.of_cell]
    keys = facet_keys(mesh.cells, mesh.cell_type)
    exchange = Exchange(comm, (keys.ravel() % np.uint64(comm.size)).astype(np.int64))
    owner = exchange.send(np.repeat(np.where(main, subdomain, -1), keys.shape[1]))
    first, second = equal_pairs(exchange.send(keys.ravel()))
    across = np.full(len(owner), -1)
    across[first], across[second] = owner[second], owner[first]
    neighbour = exchange.answer(across).reshape(keys.shape)
    cell, facet = np.nonzero((neighbour >= 0) & ~main[:, None])
    joined = pieces.subdomain.copy()
    contacts = np.stack((pieces.of_cell[cell], neighbour[cell, facet]), axis=1)
    (pair, count) = np.unique(contacts, axis=0, return_counts=True)
    best = np.lexsort((-pair[:, 1], count, pair[:, 0]))
    joined[pair[best, 0]] = pair[best, 1]
    return joined[pieces.of_cell]
