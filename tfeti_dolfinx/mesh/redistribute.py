"""Cells and their nodes travel to the rank of their subdomain."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.dealing import dealt
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import Exchange


def redistribute(
    mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm
) -> tuple[UntornMesh, Array]:
    """Send every cell to the rank of its subdomain. Collective.

    Args:
        mesh: This rank's share of the untorn mesh.
        subdomain: Subdomain of each local cell, shape ``(n,)``.
        comm: Communicator.

    Returns:
        The share after the move, cells sorted by subdomain and then original id, and their
        subdomains.
    """
    destination = dealt(mesh, subdomain, comm)[subdomain]
    exchange = Exchange(comm, destination)
    moved = mesh.with_cells(
        **{
            name: exchange.send(getattr(mesh, name))
            for name in ("cells", "cell_ids", "cell_tags", "facet_tags")
        }
    )
    subdomain = exchange.send(subdomain)
    node_ids, x = _send_nodes(mesh, destination, comm)
    order = np.lexsort((moved.cell_ids, subdomain))
    return (
        moved.with_cells(
            cells=moved.cells[order],
            cell_ids=moved.cell_ids[order],
            cell_tags=moved.cell_tags[order],
            facet_tags=moved.facet_tags[order],
            node_ids=node_ids,
            x=x,
        ),
        subdomain[order],
    )


def _send_nodes(mesh: UntornMesh, destination: Array, comm: MPI.Intracomm) -> tuple[Array, Array]:
    """Ids and coordinates of the nodes of the cells that arrive, ids ascending."""
    local = np.searchsorted(mesh.node_ids, mesh.cells)
    needed = np.unique(destination[:, None].astype(np.int64) * len(mesh.node_ids) + local)
    rank, node = np.divmod(needed, max(len(mesh.node_ids), 1))
    exchange = Exchange(comm, rank)
    node_ids, first = np.unique(exchange.send(mesh.node_ids[node]), return_index=True)
    return node_ids, exchange.send(mesh.x[node])[first]
