"""The directions in which the rows of B act on a node."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.gluing.rows import Rows
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import Exchange, owner_of

# of the largest square: directions of normals that differ by less are one but for rounding
ALIKE = 1e-12


def row_span(dofs: TornDofs, equalities: Rows, contact: Rows, trace: Array) -> Array:
    """Projector onto what rows see of each node, as rows for the trace unknowns. Collective.

    A node that only a contact meets is held along the normal, whatever axis that lies along. Where
    normals of several conditions differ, or there is friction or gluing, it is held in more.

    Args:
        dofs: Dof maps.
        equalities: This rank's rows of equalities, one component each.
        contact: Its rows of contact conditions.
        trace: Local primal unknowns that rows of any rank touch, ascending.

    Returns:
        Shape ``(t, bs)``: the row of the component in the bs × bs projector of the node.
    """
    bs = dofs.bs
    columns = np.unique(equalities.column)
    exchange, start = Exchange(dofs.comm, owner_of(dofs.offsets * bs, columns)), dofs.offsets
    held = np.zeros(dofs.num_nodes * bs)
    held[exchange.send(columns) - start[dofs.comm.rank] * bs] = 1.0
    nodes, grams = _grams(contact, bs)
    exchange = Exchange(dofs.comm, owner_of(start, nodes))
    met, place = np.unique(exchange.send(nodes) - start[dofs.comm.rank], return_inverse=True)
    gram = sum_rows(place, exchange.send(grams), len(met))
    span, component = np.zeros((len(trace), bs)), trace % bs
    span[np.arange(len(trace)), component] = held[trace]
    own, of_met = np.flatnonzero(np.isin(trace // bs, met)), np.searchsorted(met, trace // bs)
    span[own] = _projectors(gram, held.reshape(-1, bs)[met])[of_met[own], component[own]]
    return span


def _grams(rows: Rows, bs: int) -> tuple[Array, Array]:
    """Nodes that rows act on, and the sums of aaᵀ of their coefficients a there."""
    node = rows.column // bs
    pairs, place = np.unique(node * len(rows) + rows.row, return_inverse=True)
    a = np.zeros((len(pairs), bs))
    a[place, rows.column % bs] = rows.value
    nodes, place = np.unique(pairs // max(len(rows), 1), return_inverse=True)
    return nodes, sum_rows(place, a[:, :, None] * a[:, None, :], len(nodes))


def _projectors(gram: Array, held: Array) -> Array:
    """Onto the ranges of Σaaᵀ and of the components that are held, shape ``(k, bs, bs)``."""
    size = np.trace(gram, axis1=1, axis2=2)[:, None, None]
    gram = np.divide(gram, size, out=np.zeros_like(gram), where=size > 0.0)
    values, vectors = np.linalg.eigh(gram + held[:, :, None] * np.eye(held.shape[1]))
    seen = values > ALIKE * values.max(axis=1, initial=0.0, keepdims=True)
    return np.einsum("nik,nk,njk->nij", vectors, seen, vectors)
