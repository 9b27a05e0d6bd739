"""Rows of contact: normals and tangents."""

import numpy as np

from tfeti_dolfinx.common.arrays import TINY, Array, sum_rows
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.constraints.rows import TOLERANCES, ContactRows, Rows, stack
from tfeti_dolfinx.contact.records import ContactRecords, Friction
from tfeti_dolfinx.contact.tools import RigidEntries
from tfeti_dolfinx.forms.dirichlet import Prescribed
from tfeti_dolfinx.mesh.dofs import TornDofs


class RowBuilder:
    """Rows from conditions. Creation and ``rows`` are collective.

    A coefficient a becomes a·w/Σw on each torn copy, w its weight in D (a/k on k copies of equal
    weight): so rows are orthogonal to the gluing rows in the inner product of D⁻¹. Prescribed
    components are left to the right side. D is that of copies, shape ``(c, bs)``.
    """

    def __init__(
        self,
        dofs: TornDofs,
        prescribed: Prescribed,
        weights: Array,
        records: ContactRecords,
        rigid: RigidEntries,
    ) -> None:
        sums = np.add.reduceat(weights, dofs.copy_offsets[:-1]) if len(weights) else weights
        self.records, self._dofs, self._weights, self._rigid = records, dofs, weights, rigid
        self._prescribed, self._total = dofs.lookup(records.entry_group, prescribed.flag, sums)
        # tangents across a plane of symmetry, where nothing slips, shape (n, gdim - 1)
        self.across = np.zeros(records.tangents.shape[:2], dtype=bool)
        if prescribed.across is not None:
            along = np.abs(records.tangents) * prescribed.across[records.group][:, None]
            self.across = np.any(along > 1.0 - TOLERANCES.nothing_left, axis=2)

    def left(self, axis: int) -> tuple[Array, Array, Array]:
        """Squared norms in D⁻¹, with and without prescribed components.

        And the share of Σ_j |a_ij| along the axis that is not prescribed, free motions of rigid
        bodies included, which does not depend on stiffnesses. Shapes ``(n,)``.
        """
        records, (*both, of_rigid) = self.records, self._along(axis)
        of_D = [np.sum(a**2 / self._total, axis=1) for a in both]
        terms = np.column_stack((*of_D, *(np.linalg.norm(a, axis=1) for a in both)))
        before, after, *moduli = sum_rows(records.condition, terms, len(records)).T
        for of in moduli:
            np.add.at(of, self._rigid.condition, np.abs(of_rigid))
        share = moduli[1] / np.maximum(moduli[0], TINY)
        return before, after, share

    def rows(self, axis: int, condition: Array, scale: Array) -> Rows:
        """Return a row for each of these conditions along an axis, times its scale."""
        records, dofs, rigid = self.records, self._dofs, self._rigid
        place = np.full(len(records), -1)
        place[condition] = np.arange(len(condition))
        used = np.flatnonzero(place[records.condition] >= 0)
        entry, node, weight = dofs.lookup_copies(records.entry_group[used], self._weights)
        row = place[records.condition[used[entry]]]
        _, free, of_rigid = self._along(axis)
        shares = (free / self._total)[used[entry]]
        values = shares * weight * scale[row][:, None]
        columns = node[:, None] * dofs.bs + np.arange(dofs.bs)
        of = np.flatnonzero(place[rigid.condition] >= 0)
        to = place[rigid.condition[of]]
        return Rows(
            group=records.group[condition],
            row=np.append(np.repeat(row, dofs.bs), to),
            column=np.append(columns, dofs.offsets[-1] * dofs.bs + rigid.unknown[of]),
            value=np.append(values, of_rigid[of] * scale[to]),
        )

    def _along(self, axis: int) -> tuple[Array, Array, Array]:
        """Coefficients along an axis of the frames: all, and with 0 at prescribed components.

        And those of the unknowns of rigid bodies.
        """
        given, rigid = self.records.coefficients(axis), self._rigid
        own = np.sum(self.records.frame[rigid.condition, axis] * rigid.direction, axis=1)
        return given, np.where(self._prescribed, 0.0, given), own


# --- Rows of contact: normals, and tangents of conditions with friction ------------------------


def contact_rows(dofs: TornDofs, builder: RowBuilder) -> tuple[Rows, Rows, ContactRows]:
    """B_N and T from the conditions within reach, normal rows of unit norm in D⁻¹. Collective.

    A condition whose normal row prescribed components decide keeps its tangents under a given
    bound. Under Coulomb's law it has none: the pressure is hidden in what holds the node.
    """
    records, count = builder.records, dofs.bs - 1
    before, squares, _ = builder.left(0)
    left = squares > TOLERANCES.nothing_left**2 * before
    own = np.flatnonzero(records.within_reach & left)
    decided, scale = np.flatnonzero(records.within_reach & ~left), 1.0 / np.sqrt(squares[own])
    normals = builder.rows(0, own, scale)
    if not any_rank(dofs.comm, records.friction != Friction.NONE):
        none, number = np.empty(0, dtype=np.int64), np.empty(0)
        moves = np.empty((0, count), dtype=bool)
        contact = ContactRows(own, none, decided, scale, number, none, moves)
        return normals, Rows(none, none, none, number), contact
    of_axes = [builder.left(1 + k) for k in range(count)]
    squares, _, share = np.array(of_axes).transpose(1, 2, 0)
    left = (share > TOLERANCES.little_left) & ~builder.across
    of_normal, row = np.zeros(len(records)), np.full(len(records), -1)
    of_normal[own], row[own] = scale, np.arange(len(own))
    row[records.friction != Friction.COULOMB] = -1
    rubs = (records.friction == Friction.GIVEN) & records.within_reach
    rubs |= (records.friction == Friction.COULOMB) & (of_normal > 0.0)
    points = np.flatnonzero(rubs & np.any(left, axis=1))
    longest = np.sqrt(squares[points].max(axis=1, initial=0.0))
    over, moves = of_normal[points], left[points]
    over = np.where(over > 0.0, over, 1.0 / np.maximum(longest, TINY))
    rows = stack([builder.rows(1 + k, points, over * moves[:, k]) for k in range(count)])
    # those of a condition one after the other
    place = np.arange(len(rows)).reshape(-1, count).T.ravel()
    group = np.repeat(records.group[points], count)
    rows = Rows(group, place[rows.row], rows.column, rows.value)
    return normals, rows, ContactRows(own, points, decided, scale, over, row[points], moves)
