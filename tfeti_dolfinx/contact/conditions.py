"""From integrals over facets to conditions of the nodes' owners."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import Exchange, owner_of

HARDLY_COVERED = 1e-6
NEGLIGIBLE = 1e-13

Triplets = tuple[Array, Array, Array]


def conditions(
    dofs: TornDofs,
    contact: int,
    multipliers: Array,
    covered: Array,
    gaps: Array,
    entries: tuple[Triplets, ...],
    nodes: Array,
    areas: Array,
    normals: Array,
    bounds: tuple[Array, Array] | None = None,
) -> ContactRecords:
    """Add up what facets contribute to a node, and divide by ∫ψ_i. Collective.

    A node whose covered share of ∫φ_i is below 1e-6 gets no condition.

    Args:
        dofs: Dof maps.
        contact: Index of the contact.
        multipliers: Global groups of the multipliers' nodes, shape ``(f, v)``.
        covered: ∫φ_i over the covered part of each facet, shape ``(f, v)``.
        gaps: ∫ψ_i g over the facets, g the gap along the node's normal, shape ``(f, v)``.
        entries: Triplets (multiplier's group, displacement's group, ∫ψ_i φ_k with its sign).
        nodes: Groups of all nodes of the secondary surface, shape ``(n, v)``.
        areas: ∫φ_i over the whole facets, shape ``(n, v)``.
        normals: Averaged normal of each owned group, shape ``(g, gdim)``.
        bounds: Smallest and largest g on each facet, shapes ``(f, v)``. ψ_i is negative somewhere,
            and a mean with it would else fall below the smallest gap.
    """
    area = dofs.add_on_owners(multipliers.ravel(), covered.ravel())
    whole = dofs.add_on_owners(nodes.ravel(), areas.ravel())
    gap = dofs.add_on_owners(multipliers.ravel(), gaps.ravel())
    chosen = np.flatnonzero(area > HARDLY_COVERED * whole)
    mean = gap[chosen] / area[chosen]
    if bounds is not None:
        low = dofs.reduce_on_owners(multipliers.ravel(), bounds[0].ravel(), np.minimum, np.inf)
        high = dofs.reduce_on_owners(multipliers.ravel(), bounds[1].ravel(), np.maximum, -np.inf)
        mean = np.clip(mean, low[chosen], high[chosen])
    place = np.full(dofs.num_groups, -1)
    place[chosen] = np.arange(len(chosen))
    slot, column, value = _merged(dofs, entries)
    kept = (place[slot] >= 0) & (np.abs(value) > NEGLIGIBLE * np.maximum(area[slot], 1e-300))
    slot, column, value = slot[kept], column[kept], value[kept]
    return ContactRecords(
        contact=np.full(len(chosen), contact),
        group=chosen,
        normal=normals[chosen],
        gap=mean,
        area=area[chosen],
        near=np.ones(len(chosen), dtype=bool),
        row=place[slot],
        entry_group=column,
        coefficients=normals[slot] * (value / area[slot])[:, None],
        candidates=int(np.sum(whole > 0.0)),
    )


def triplets(rows: Array, columns: Array, values: Array) -> Triplets:
    """Row groups, column groups and values of many small matrices."""
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    return i.ravel(), j.ravel(), values.ravel()


def _merged(dofs: TornDofs, entries: tuple[Triplets, ...]) -> Triplets:
    """Triplets on the ranks that own their rows (as local slots), equal ones added up."""
    row, column, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    exchange = Exchange(dofs.comm, owner_of(dofs.group_offsets, row))
    row = exchange.send(row) - dofs.group_offsets[dofs.comm.rank]
    column, value = exchange.send(column), exchange.send(value)
    order = np.lexsort((column, row))
    row, column, value = row[order], column[order], value[order]
    first = np.ones(len(row), dtype=bool)
    first[1:] = (row[1:] != row[:-1]) | (column[1:] != column[:-1])
    starts = np.flatnonzero(first)
    sums = np.add.reduceat(value, starts) if len(value) else value
    return row[first], column[first], sums
