"""Coefficients of contact conditions: without prescribed components, shared by torn copies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.gluing.rows import Rows
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import group_points

# Of a row's norm: what is left of less is rounding, scaled up to unit norm.
NOTHING_LEFT = 1e-10
# of what rounding makes of a condition's coefficients, and of lengths: errors of several add up
SEVERAL, EPSILON = 10.0, 2.2e-16
# a condition of which more than this remains is one, however uncertain its normal is
HARDLY_LEFT = 1e-3


@dataclass(frozen=True)
class HeldPart:
    """What prescribed components contribute to the relative displacements of conditions.

    Attributes:
        condition: Condition of each weight of a node with prescribed components.
        group: Global group of each.
        weight: Its weight at the prescribed components, else 0, shape ``(h, gdim)``.
    """

    condition: Array
    group: Array
    weight: Array

    def displacement(self, dofs: TornDofs, values: Array, size: int) -> Array:
        """The v_i of prescribed values alone, shape ``(size, gdim)``. Collective.

        Args:
            dofs: Dof maps.
            values: Prescribed values of the owned groups, shape ``(g, bs)``.
            size: Number of conditions.
        """
        (value,) = dofs.lookup(self.group, values)
        return sum_rows(self.condition, self.weight * value, size)


class Spread:
    """Rows from conditions. Creation and ``rows`` are collective.

    A coefficient a becomes a·w/Σw on each torn copy, w its weight in D (a/k on k copies of equal
    weight): so rows are orthogonal to the gluing rows in the inner product of D⁻¹. Prescribed
    components are left to the right side.

    Args:
        dofs: Dof maps.
        flag: Which components of the owned groups are prescribed, shape ``(g, bs)``.
        weights: D for each copy of the owned groups, shape ``(c, bs)``.
        records: Conditions of this rank.

    Attributes:
        records: The conditions.
        points: Points of the owned groups, shape ``(g, 3)``.
        nothing_left: Share of each condition that is rounding, shape ``(n,)``.
    """

    def __init__(
        self, dofs: TornDofs, flag: Array, weights: Array, records: ContactRecords
    ) -> None:
        sums = np.add.reduceat(weights, dofs.copy_offsets[:-1]) if len(weights) else weights
        self.records, self._dofs, self._weights = records, dofs, weights
        self._prescribed, self._total = dofs.lookup(records.entry_group, flag, sums)
        self.points = group_points(dofs)
        self.nothing_left = _nothing_left(records, self.points)

    def free(self, axis: int) -> Array:
        """Coefficients along an axis of the frames, 0 at prescribed components."""
        return np.where(self._prescribed, 0.0, self.records.coefficients(axis))

    def squares(self, coefficients: Array) -> Array:
        """Squared norms in D⁻¹ of the rows that coefficients make, unscaled, shape ``(n,)``."""
        squares = np.sum(coefficients**2 / self._total, axis=1)
        return sum_rows(self.records.condition, squares, len(self.records))

    def left(self, axis: int) -> tuple[Array, Array]:
        """Squared norms without prescribed components, and whether they are more than rounding."""
        before = self.squares(self.records.coefficients(axis))
        after = self.squares(self.free(axis))
        return after, after > self.nothing_left**2 * before

    @cached_property
    def held(self) -> HeldPart:
        """What prescribed components contribute."""
        holds = np.flatnonzero(np.any(self._prescribed, axis=1))
        records = self.records
        weight = np.where(self._prescribed, records.weight[:, None], 0.0)[holds]
        return HeldPart(records.condition[holds], records.entry_group[holds], weight)

    def rows(self, axis: int, condition: Array, scale: Array) -> Rows:
        """A row for each of these conditions along an axis, times its scale."""
        records, dofs = self.records, self._dofs
        place = np.full(len(records), -1)
        place[condition] = np.arange(len(condition))
        used = np.flatnonzero(place[records.condition] >= 0)
        entry, node, weight = dofs.lookup_copies(records.entry_group[used], self._weights)
        row = place[records.condition[used[entry]]]
        shares = (self.free(axis) / self._total)[used[entry]]
        values = shares * weight * scale[row][:, None]
        columns = node[:, None] * dofs.bs + np.arange(dofs.bs)
        return Rows(
            group=records.group[condition],
            row=np.repeat(row, dofs.bs),
            column=columns.ravel(),
            value=values.ravel(),
        ).without_zeros()


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
