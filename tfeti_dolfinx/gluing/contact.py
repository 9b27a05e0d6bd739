"""Non-penetration rows: spread over torn copies, freed of prescribed components, scaled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import NoSolutionError, raised_on_all_ranks
from tfeti_dolfinx.gluing.consistency import check_consistent
from tfeti_dolfinx.gluing.prescribed import Prescribed
from tfeti_dolfinx.gluing.rows import Rows
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import group_points

NOTHING_LEFT = 1e-10
# of what rounding makes of a condition's coefficients, and of lengths: errors of several add up
SEVERAL, EPSILON = 10.0, 2.2e-16
# a condition of which more than this remains is one, however uncertain its normal is
HARDLY_LEFT = 1e-3


@dataclass(frozen=True)
class InequalityRows:
    """B_N and its right side, with what leads back to lengths and forces.

    Attributes:
        rows: The rows, of unit norm.
        condition: Condition (of the records) of each row, shape ``(n,)``.
        scale: The s_i that a condition was multiplied by, shape ``(n,)``: its force is s_i λ_i.
        dropped: Conditions of this rank that prescribed components decide alone.
    """

    rows: Rows
    condition: Array
    scale: Array
    dropped: int


def inequality_rows(
    dofs: TornDofs,
    prescribed: Prescribed,
    weights: Array,
    records: ContactRecords,
    length: float,
) -> InequalityRows:
    """B_N and its right side from contact conditions. Collective.

    A coefficient a becomes a·w/Σw on each torn copy, w its weight in D (a/k on k copies of equal
    weight): so the rows are orthogonal to the gluing rows in the inner product of D⁻¹.
    Prescribed components move to the right side. Then the whole row is scaled to unit norm by
    one number s_i. If less than 1e-10 of it remains, or than what rounding makes of it, it is
    dropped.

    Args:
        dofs: Dof maps.
        prescribed: Dirichlet values.
        weights: D for each copy of the owned groups, shape ``(c, bs)``.
        records: Conditions of this rank; those that are near get rows.
        length: A length of the scene; gaps below 1e-10 of it count as zero.

    Raises:
        NoSolutionError: Prescribed components alone violate a condition, or the conditions of a
            node contradict each other.
    """
    sums = np.add.reduceat(weights, dofs.copy_offsets[:-1]) if len(weights) else weights
    flag, value, total = dofs.lookup(records.entry_group, prescribed.flag, prescribed.value, sums)

    def squared_norms(coefficients: Array) -> Array:
        squares = np.sum(coefficients**2 / total, axis=1)
        return sum_rows(records.row, squares, len(records))

    held = np.sum(np.where(flag, records.coefficients * value, 0.0), axis=1)
    rhs = records.gap - sum_rows(records.row, held, len(records))
    free = np.where(flag, 0.0, records.coefficients)
    before, after = squared_norms(records.coefficients), squared_norms(free)
    points = group_points(dofs)
    kept = records.near & (after > _nothing_left(records, points) ** 2 * before)
    decided = records.near & ~kept
    with raised_on_all_ranks(dofs.comm):
        _check_dropped(rhs[decided], length)
        check_consistent(records, free, rhs, kept, points, length)
    condition = np.flatnonzero(kept)
    scale = 1.0 / np.sqrt(after[kept])
    return InequalityRows(
        rows=_spread(dofs, weights, records, free / total, rhs, condition, scale),
        condition=condition,
        scale=scale,
        dropped=int(np.sum(decided)),
    )


def _nothing_left(records: ContactRecords, points: Array) -> Array:
    """Share of a condition that is rounding, shape ``(n,)``.

    The normal of a facet of size h at x is exact to ε|x|/h, and so is a place on it. At a distance
    g the normal points that much times g beside the place that it should point to.
    """
    x = np.abs(points[records.group]).max(axis=1, initial=0.0)
    h = records.area ** (1.0 / max(records.normal.shape[1] - 1, 1))
    g = np.abs(records.gap)
    error = EPSILON * (x * (1.0 + g / h) + g) / h
    return np.clip(SEVERAL * error, NOTHING_LEFT, HARDLY_LEFT)


def _check_dropped(rhs: Array, length: float) -> None:
    if np.any(rhs < -NOTHING_LEFT * length):
        raise NoSolutionError(
            "an obstacle or a contact lies within a part of the surface whose displacement is "
            f"prescribed: {np.sum(rhs < -NOTHING_LEFT * length)} nodes penetrate by up to "
            f"{-rhs.min():.6g} whatever the rest does"
        )


def _spread(
    dofs: TornDofs,
    weights: Array,
    records: ContactRecords,
    per_weight: Array,
    rhs: Array,
    condition: Array,
    scale: Array,
) -> Rows:
    """Rows of the conditions kept, their coefficients per weight spread over the copies."""
    place = np.full(len(records), -1)
    place[condition] = np.arange(len(condition))
    used = np.flatnonzero(place[records.row] >= 0)
    entry, node, weight = dofs.lookup_copies(records.entry_group[used], weights)
    row = place[records.row[used[entry]]]
    values = per_weight[used[entry]] * weight * scale[row][:, None]
    columns = node[:, None] * dofs.bs + np.arange(dofs.bs)
    return Rows(
        group=records.group[condition],
        rhs=rhs[condition] * scale,
        row=np.repeat(row, dofs.bs),
        column=columns.ravel(),
        value=values.ravel(),
    ).without_zeros()
