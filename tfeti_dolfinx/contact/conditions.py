"""Conditions of contact from integrals over the facets of a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange, owner_of
from tfeti_dolfinx.contact.records import ContactRecords, Friction
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import Facets
from tfeti_dolfinx.mortar.integrals import GapIntegrals, MortarIntegrals, Triplets
from tfeti_dolfinx.mortar.segments import frames
from tfeti_dolfinx.mortar.tolerances import SEARCH


@dataclass(frozen=True)
class Side:
    """A surface of a pair, or one that faces an obstacle.

    Attributes:
        facets: Its facets on this rank, those of a pair with averaged normals and curvature.
        areas: ∫φ_i over each facet, shape ``(n, v)``.
        normals: Direction in which each owned group may not go further: the averaged normal, at
            an obstacle that towards the shape; 0 off the surface, shape ``(g, gdim)``.
    """

    facets: Facets
    areas: Array
    normals: Array


def conditions(
    dofs: TornDofs, contact: int, side: Side, integrals: MortarIntegrals
) -> ContactRecords:
    """Sum the contributions of facets on any rank to each node, and divide by ∫ψ_i. Collective.

    The vertices of the side get conditions along its normals, but where the covered share of ∫φ_i
    is below 1e-6. The gaps are those of the geometry, all conditions are taken to be within reach,
    and none has friction.
    """
    area = dofs.reduce_on_owners(integrals.vertices.ravel(), integrals.covered.ravel())
    whole = dofs.reduce_on_owners(side.facets.vertices.ravel(), side.areas.ravel())
    chosen = np.flatnonzero(area > SEARCH.hardly_covered * whole)
    vertices, areas = integrals.vertices, area[chosen]
    gap, _ = _mean_gaps(dofs, vertices, integrals.gap, areas, chosen)
    curved_gap, spread = _mean_gaps(dofs, vertices, integrals.curved_gap, areas, chosen)
    changed = np.abs(_without_rounding(dofs, curved_gap - gap))
    place = np.full(dofs.num_groups, -1)
    place[chosen] = np.arange(len(chosen))
    slot, column, value = _merged(dofs, integrals.entries)
    kept = (place[slot] >= 0) & (np.abs(value) > SEARCH.negligible * np.maximum(area[slot], 1e-300))
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
        covered=areas / whole[chosen],
        within_reach=np.ones(len(chosen), dtype=bool),
        condition=place[slot],
        entry_group=column,
        weight=value / area[slot],
        friction=np.full(len(chosen), Friction.NONE),
        place=np.zeros((len(chosen), dofs.bs)),
        motion=np.zeros((len(chosen), dofs.bs)),
        candidates=int(np.sum(whole > 0.0)),
    )


def _mean_gaps(
    dofs: TornDofs, vertices: Array, gap: GapIntegrals, area: Array, chosen: Array
) -> tuple[Array, Array]:
    """∫ψ_i g / ∫ψ_i of some owned groups, and by how much g varies around them. Collective.

    It is kept between the bounds on g: ψ_i is negative somewhere, and the mean would else fall
    below the smallest gap.
    """
    groups = vertices.ravel()
    total = dofs.reduce_on_owners(groups, gap.total.ravel())[chosen]
    low = dofs.reduce_on_owners(groups, gap.lowest.ravel(), np.minimum, np.inf)[chosen]
    high = dofs.reduce_on_owners(groups, gap.highest.ravel(), np.maximum, -np.inf)[chosen]
    return _without_rounding(dofs, np.clip(total / area, low, high)), high - low


def _without_rounding(dofs: TornDofs, gap: Array) -> Array:
    """0 in the place of gaps that rounding of coordinates may have made of it. Collective."""
    own = float(np.abs(dofs.V.mesh.geometry.x).max(initial=0.0))
    largest = dofs.comm.allreduce(own, op=MPI.MAX)
    return np.where(np.abs(gap) <= SEARCH.no_gap * largest, 0.0, gap)


def _merged(dofs: TornDofs, entries: tuple[Triplets, ...]) -> Triplets:
    """Return triplets on the ranks that own their rows (as local slots), equal ones added up."""
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
