"""Conditions of contact from two sides that meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import Exchange, bcast_from_root, owner_of
from tfeti_dolfinx.contact.records import ContactRecords, Friction
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.curvature import with_curvature
from tfeti_dolfinx.mortar.facets import (
    Facets,
    facet_kind,
    hat_areas,
    local_facets,
    with_averaged_normals,
)
from tfeti_dolfinx.mortar.integrals import GapIntegrals, MortarIntegrals, Triplets, integrate
from tfeti_dolfinx.mortar.segments import find_segments, frames, possible_pairs, rendezvous
from tfeti_dolfinx.mortar.surfaces import surface_facets
from tfeti_dolfinx.mortar.tolerances import SEARCH

# --- Sides of a contact -----------------------------------------------------------------------


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

    def has_edges(self, comm: MPI.Intracomm) -> bool:
        """Return whether a facet's normal is far off the averaged one at a vertex. Collective."""
        cosine = np.einsum("nvg,ng->nv", self.facets.vertex_normals, self.facets.normal)
        return comm.allreduce(int(np.sum(cosine < SEARCH.crease))) > 0


def side_of(contact: str, surface: str | int, dofs: TornDofs, decomposition: Decomposition) -> Side:
    """Return a surface of a pair. Collective.

    Args:
        contact: Name of the contact, for messages.
        surface: Name or tag of the surface.
        dofs: Dof maps.
        decomposition: The torn mesh.

    Raises:
        InputError: The surface is unknown or empty, or has facets without area.
    """
    kind = facet_kind(dofs)
    facets = local_facets(dofs, decomposition, surface_facets(decomposition, surface))
    whole = facets.radius ** (facets.x.shape[2] - 1)
    flat = int(np.sum(facets.area <= SEARCH.degenerate * whole))
    if count := dofs.comm.allreduce(flat):
        raise InputError(f"{contact}: {count} facets of {surface!r} have no area")
    facets, normals = with_averaged_normals(facets, dofs)
    facets = with_curvature(facets, dofs, kind)
    return Side(facets, hat_areas(kind, facets), normals)


@dataclass(frozen=True)
class Ratios:
    """The first side of a pair over the second one, where they meet; the same on all ranks.

    Attributes:
        size: Of facets (roots of areas, in 2D lengths), h over h.
        stiffness: Stiffness per area of the elements, E/h over E/h.
    """

    size: float
    stiffness: float

    @property
    def finer(self) -> bool:
        """True if the first side has the finer mesh by more than meshes of one size differ."""
        return self.size < 1.0 / SEARCH.same_size

    @property
    def exchanged(self) -> Ratios:
        """The second side over the first one."""
        return Ratios(1.0 / self.size, 1.0 / self.stiffness)

    def second_is_better(self) -> bool:
        """Return whether the second side is the better secondary one; not if both are equal.

        The coarser one is; where meshes are of one size, the softer one.
        """
        if max(self.size, 1.0 / self.size) > SEARCH.same_size:
            return self.finer
        return self.stiffness > SEARCH.same_stiffness


def ratios(
    records: ContactRecords, sides: tuple[Side, Side], dofs: TornDofs, stiffness: Array
) -> Ratios:
    """Compare the meshes and the stiffness of two sides. Collective.

    Stiffness per area is E/h of the elements at a surface: Σ n_i·K_ii n_i / Σ ∫φ_i over its
    vertices, K_ii the block of K before anything is glued, n_i the normal. Sizes are harmonic
    means, which a few large facets beside many small ones do not decide. The vertices that rows
    name are taken, so that a mesh that is fine only where the bodies touch is judged there; where
    there is no such row, all of them.

    Args:
        records: Conditions between the sides.
        sides: Both sides.
        dofs: Dof maps.
        stiffness: Block of K of each primal node, shape ``(num_nodes, bs, bs)``.
    """
    whole = dofs.reduce(stiffness.reshape(-1, dofs.bs**2), np.add, 0.0)
    blocks = whole.reshape(-1, dofs.bs, dofs.bs)
    named = records.entry_group[records.within_reach[records.condition]]
    meets = dofs.add_on_owners(named, np.ones(len(named))) > 0.0
    if dofs.comm.allreduce(int(np.sum(meets))) == 0:
        meets[:] = True
    sums = []
    for side in sides:
        vertices = side.facets.vertices.ravel()
        area = dofs.add_on_owners(vertices, side.areas.ravel())
        facets = dofs.add_on_owners(
            vertices, np.full(len(vertices), 1.0 / side.facets.vertices.shape[1])
        )
        at = meets & (area > 0.0)
        n = side.normals[at]
        along = np.einsum("gi,gij,gj", n, blocks[at], n)
        sums.append((along, area[at].sum(), np.sum(facets[at] / area[at]), np.sum(at)))
    along, area, density, count = dofs.comm.allreduce(np.array(sums, dtype=float)).T
    size, per_area = (count / density) ** (1.0 / (dofs.bs - 1)), along / area
    return Ratios(
        *bcast_from_root(dofs.comm, (float(size[0] / size[1]), float(per_area[0] / per_area[1])))
    )


# --- Assembly of conditions from integrals over facets ----------------------------------------


def conditions(dofs: TornDofs, contact: int, side: Side, shares: MortarIntegrals) -> ContactRecords:
    """Sum the facets' contributions to each node, and divide by ∫ψ_i. Collective.

    A node whose covered share of ∫φ_i is below 1e-6 gets no condition. The gaps are those of the
    geometry, all conditions are taken to be within reach, and none has friction.

    Args:
        dofs: Dof maps.
        contact: Index of the contact.
        side: The surface whose vertices get conditions, along its normals.
        shares: What facets on any rank contribute.
    """
    area = dofs.add_on_owners(shares.vertices.ravel(), shares.covered.ravel())
    whole = dofs.add_on_owners(side.facets.vertices.ravel(), side.areas.ravel())
    chosen = np.flatnonzero(area > SEARCH.hardly_covered * whole)
    vertices, areas = shares.vertices, area[chosen]
    gap, _ = _mean_gaps(dofs, vertices, shares.gap, areas, chosen)
    curved_gap, spread = _mean_gaps(dofs, vertices, shares.curved_gap, areas, chosen)
    changed = np.abs(_without_rounding(dofs, curved_gap - gap))
    place = np.full(dofs.num_groups, -1)
    place[chosen] = np.arange(len(chosen))
    slot, column, value = _merged(dofs, shares.entries)
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
        within_reach=np.ones(len(chosen), dtype=bool),
        condition=place[slot],
        entry_group=column,
        weight=value / area[slot],
        friction=np.full(len(chosen), Friction.NONE),
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
    total = dofs.add_on_owners(groups, gap.total.ravel())[chosen]
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


# --- Mortar integrals of a pair ---------------------------------------------------------------


def meeting(
    name: str, sides: tuple[Side, Side], dofs: TornDofs, reach: float, depth: float
) -> MortarIntegrals:
    """Integrate over the first side's facets that face the second. Collective.

    Args:
        name: Name of the contact, for messages.
        sides: The secondary side and the primary one.
        dofs: Dof maps.
        reach: How far apart facets may be; one looks three times as far.
        depth: How deep they may overlap; one looks three times as deep.

    Raises:
        InputError: The surfaces face away from each other.
    """
    kind, comm = facet_kind(dofs), dofs.comm
    distance = SEARCH.seen * max(reach, depth)
    secondary, primary = rendezvous(sides[0].facets, sides[1].facets, distance, comm)
    with raised_on_all_ranks(comm):
        pairs = possible_pairs(secondary, primary, distance)
        segments = find_segments(
            kind, secondary, primary, pairs, SEARCH.seen * depth, SEARCH.seen * reach
        )
        integrals = integrate(kind, secondary, primary, segments)
    averted = comm.allreduce(int(segments.averted))
    if averted and comm.allreduce(len(segments.weight)) == 0:
        raise InputError(
            f"{name}: the surfaces are near but face away from each other; expected "
            "outward normals that oppose each other"
        )
    return integrals
