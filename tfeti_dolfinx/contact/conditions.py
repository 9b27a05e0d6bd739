"""From integrals over facets to conditions of the nodes' owners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords, Friction
from tfeti_dolfinx.contact.sides import Side
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.frames import frames
from tfeti_dolfinx.mortar.integrals import GapIntegrals
from tfeti_dolfinx.parallel import Exchange, owner_of

# of ∫φ_i: a node whose hat is covered by less has slivers of facets only, and divides by them
HARDLY_COVERED = 1e-6
# of ∫φ_i: a weight below it is what rounding leaves of one that biorthogonality makes 0; as an
# entry of B it would make an unknown of the trace of every node of a facet
NEGLIGIBLE = 1e-13
# of the largest coordinate: a smaller gap is what rounding leaves of none. A body that nothing
# loads would have such an overlap for its displacement, of which nothing is right.
NO_GAP = 1e-14

Triplets = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Shares:
    """What facets of a surface contribute to the conditions of their vertices.

    Attributes:
        vertices: Global groups of the facets' vertices, shape ``(f, v)``.
        covered: ∫φ_i over the covered part of each facet, shape ``(f, v)``.
        gap: Gap g along the node's normal, between the facets or of an obstacle.
        curved_gap: That between the smooth surfaces that facets stand for.
        entries: Triplets (multiplier's group, displacement's group, ∫ψ_i φ_k with its sign).
    """

    vertices: Array
    covered: Array
    gap: GapIntegrals
    curved_gap: GapIntegrals
    entries: tuple[Triplets, ...]


def conditions(dofs: TornDofs, contact: int, side: Side, shares: Shares) -> ContactRecords:
    """Add up what facets contribute to a node, and divide by ∫ψ_i. Collective.

    A node whose covered share of ∫φ_i is below 1e-6 gets no condition. The gaps are those of the
    geometry, all conditions are taken to be within reach, and none has friction.

    Args:
        dofs: Dof maps.
        contact: Index of the contact.
        side: The surface whose vertices get conditions, along its normals.
        shares: What facets on any rank contribute.
    """
    area = dofs.add_on_owners(shares.vertices.ravel(), shares.covered.ravel())
    whole = dofs.add_on_owners(side.vertices.ravel(), side.areas.ravel())
    chosen = np.flatnonzero(area > HARDLY_COVERED * whole)
    vertices, areas = shares.vertices, area[chosen]
    gap, _ = _mean_gaps(dofs, vertices, shares.gap, areas, chosen)
    curved_gap, spread = _mean_gaps(dofs, vertices, shares.curved_gap, areas, chosen)
    changed = np.abs(_without_rounding(dofs, curved_gap - gap))
    place = np.full(dofs.num_groups, -1)
    place[chosen] = np.arange(len(chosen))
    slot, column, value = _merged(dofs, shares.entries)
    kept = (place[slot] >= 0) & (np.abs(value) > NEGLIGIBLE * np.maximum(area[slot], 1e-300))
    slot, column, value = slot[kept], column[kept], value[kept]
    return ContactRecords(
        contact=np.full(len(chosen), contact),
        group=chosen,
        frame=frames(side.normals[chosen]),
        gap=gap,
        geometric_gap=gap,
        curved_gap=curved_gap,
        conforms=changed > spread,
        area=areas,
        within_reach=np.ones(len(chosen), dtype=bool),
        condition=place[slot],
        entry_group=column,
        weight=value / area[slot],
        friction=np.full(len(chosen), Friction.NONE),
        candidates=int(np.sum(whole > 0.0)),
    )


def triplets(rows: Array, columns: Array, values: Array) -> Triplets:
    """Row groups, column groups and values of many small matrices."""
    i, j = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    return i.ravel(), j.ravel(), values.ravel()


def _mean_gaps(
    dofs: TornDofs, vertices: Array, gap: GapIntegrals, area: Array, chosen: Array
) -> tuple[Array, Array]:
    """∫ψ_i g / ∫ψ_i of some owned groups, and by how much g varies around them. Collective.

    It is kept between the bounds on g: ψ_i is negative somewhere, and the mean would else fall
    below the smallest gap.
    """
    groups = vertices.ravel()
    total = dofs.add_on_owners(groups, gap.total.ravel())[chosen]
    low = dofs.reduce_on_owners(groups, gap.lowest.ravel(), np.minimum, np.inf)[chosen]
    high = dofs.reduce_on_owners(groups, gap.highest.ravel(), np.maximum, -np.inf)[chosen]
    return _without_rounding(dofs, np.clip(total / area, low, high)), high - low


def _without_rounding(dofs: TornDofs, gap: Array) -> Array:
    """0 in the place of gaps that rounding of coordinates may have made of it. Collective."""
    own = float(np.abs(dofs.V.mesh.geometry.x).max(initial=0.0))
    largest = dofs.comm.allreduce(own, op=MPI.MAX)
    return np.where(np.abs(gap) <= NO_GAP * largest, 0.0, gap)


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
