"""Non-penetration rows: spread over torn copies, freed of prescribed components, scaled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import NoSolutionError, raised_on_all_ranks
from tfeti_dolfinx.gluing.consistency import SharedNodes, shared_nodes
from tfeti_dolfinx.gluing.rows import Rows
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import group_points

# Of a row's norm: what is left of less is rounding, scaled up to unit norm. Of the scene's length:
# overlaps below it are rounding of gaps and prescribed values.
NOTHING_LEFT = 1e-10
# of what rounding makes of a condition's coefficients, and of lengths: errors of several add up
SEVERAL, EPSILON = 10.0, 2.2e-16
# a condition of which more than this remains is one, however uncertain its normal is
HARDLY_LEFT = 1e-3


@dataclass(frozen=True)
class ContactRows:
    """What the rows B_N are of: it leads back to lengths and forces, and on to right sides.

    None of it depends on prescribed values or gaps.

    Attributes:
        condition: Condition (of the records) of each row, shape ``(n,)``.
        scale: The s_i that a condition was multiplied by, shape ``(n,)``: one number for all rows
            of a condition, that which gives its normal row unit norm. Its force is s_i λ_i.
        decided: Conditions of this rank that prescribed components decide alone, without rows.
        held_condition: Condition of each weight of a node with prescribed components.
        held_group: Global group of each.
        held: Its coefficients of the prescribed components, else 0, shape ``(h, gdim)``.
        shared: Conditions of nodes that have several of them.
    """

    condition: Array
    scale: Array
    decided: Array
    held_condition: Array
    held_group: Array
    held: Array
    shared: SharedNodes

    def left_gaps(self, dofs: TornDofs, values: Array, gaps: Array) -> Array:
        """Gaps of all conditions less what prescribed values use up, shape ``(n,)``. Collective."""
        (value,) = dofs.lookup(self.held_group, values)
        used = np.sum(self.held * value, axis=1)
        return gaps - sum_rows(self.held_condition, used, len(gaps))

    def right_side(self, dofs: TornDofs, values: Array, gaps: Array, length: float) -> Array:
        """Right sides of the normal rows. Collective.

        Args:
            dofs: Dof maps.
            values: Prescribed values of the owned groups, shape ``(g, bs)``.
            gaps: Gap of each condition, shape ``(n,)``.
            length: A length of the scene; gaps below 1e-10 of it count as zero.

        Raises:
            NoSolutionError: Prescribed components alone violate a condition, or the conditions of
                a node contradict each other.
        """
        left = self.left_gaps(dofs, values, gaps)
        with raised_on_all_ranks(dofs.comm):
            _check_decided(left[self.decided], length)
            self.shared.check(left, length)
        return left[self.condition] * self.scale


def contact_rows(
    dofs: TornDofs, flag: Array, weights: Array, records: ContactRecords
) -> tuple[Rows, ContactRows]:
    """B_N from contact conditions, and what belongs to its rows. Collective.

    A coefficient a becomes a·w/Σw on each torn copy, w its weight in D (a/k on k copies of equal
    weight): so the rows are orthogonal to the gluing rows in the inner product of D⁻¹.
    Prescribed components are left to the right side. Then the whole row is scaled to unit norm
    by one number s_i. If less than 1e-10 of it remains, or than what rounding makes of it, it is
    dropped.

    Args:
        dofs: Dof maps.
        flag: Which components of the owned groups are prescribed, shape ``(g, bs)``.
        weights: D for each copy of the owned groups, shape ``(c, bs)``.
        records: Conditions of this rank; those within reach get rows.
    """
    sums = np.add.reduceat(weights, dofs.copy_offsets[:-1]) if len(weights) else weights
    prescribed, total = dofs.lookup(records.entry_group, flag, sums)

    def squared_norms(coefficients: Array) -> Array:
        squares = np.sum(coefficients**2 / total, axis=1)
        return sum_rows(records.condition, squares, len(records))

    coefficients = records.coefficients(0)
    free = np.where(prescribed, 0.0, coefficients)
    before, after = squared_norms(coefficients), squared_norms(free)
    points = group_points(dofs)
    kept = records.within_reach & (after > _nothing_left(records, points) ** 2 * before)
    condition = np.flatnonzero(kept)
    scale = 1.0 / np.sqrt(after[kept])
    holds = np.flatnonzero(np.any(prescribed, axis=1))
    found = ContactRows(
        condition=condition,
        scale=scale,
        decided=np.flatnonzero(records.within_reach & ~kept),
        held_condition=records.condition[holds],
        held_group=records.entry_group[holds],
        held=coefficients[holds] - free[holds],
        shared=shared_nodes(records, free, kept, points),
    )
    return _spread(dofs, weights, records, free / total, found), found


def _nothing_left(records: ContactRecords, points: Array) -> Array:
    """Share of a condition that is rounding, shape ``(n,)``.

    The normal of a facet of size h at x is exact to ε|x|/h, and so is a place on it. At a distance
    g the normal points that much times g beside the place that it should point to.
    """
    x = np.abs(points[records.group]).max(axis=1, initial=0.0)
    h = records.area ** (1.0 / max(records.normal.shape[1] - 1, 1))
    g = np.abs(records.geometric_gap)
    error = EPSILON * (x * (1.0 + g / h) + g) / h
    return np.clip(SEVERAL * error, NOTHING_LEFT, HARDLY_LEFT)


def _check_decided(gaps: Array, length: float) -> None:
    overlaps = gaps < -NOTHING_LEFT * length
    if np.any(overlaps):
        raise NoSolutionError(
            "an obstacle or a contact lies within a part of the surface whose displacement is "
            f"prescribed: {np.sum(overlaps)} nodes penetrate by up to "
            f"{-gaps.min():.6g} whatever the rest does"
        )


def _spread(
    dofs: TornDofs,
    weights: Array,
    records: ContactRecords,
    per_weight: Array,
    found: ContactRows,
) -> Rows:
    """Rows of the conditions kept, their coefficients per weight spread over the copies."""
    place = np.full(len(records), -1)
    place[found.condition] = np.arange(len(found.condition))
    used = np.flatnonzero(place[records.condition] >= 0)
    entry, node, weight = dofs.lookup_copies(records.entry_group[used], weights)
    row = place[records.condition[used[entry]]]
    values = per_weight[used[entry]] * weight * found.scale[row][:, None]
    columns = node[:, None] * dofs.bs + np.arange(dofs.bs)
    return Rows(
        group=records.group[found.condition],
        row=np.repeat(row, dofs.bs),
        column=columns.ravel(),
        value=values.ravel(),
    ).without_zeros()
