"""Non-penetration conditions before they become rows of B."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.mesh.dofs import TornDofs


@dataclass(frozen=True)
class ContactRecords:
    """Conditions  Σ_j a_ij · u_j ≤ g_i,  one for each contact node whose group this rank owns.

    Attributes:
        contact: Index of the contact (in the list that the user gave), shape ``(n,)``.
        group: Owned group of the contact node, shape ``(n,)``.
        normal: Direction in which the node may not go further, unit length, shape ``(n, gdim)``.
        gap: Distance g_i, a length, shape ``(n,)``.
        area: Integral ∫φ_i of the node's hat over the contact surface, of a pair over what the
            other side covers of it, shape ``(n,)``.
        near: Whether a row is made at once; a far condition gets one only if the solution
            violates it, shape ``(n,)``.
        row: Condition of each coefficient, shape ``(k,)``.
        entry_group: Global group of each coefficient, shape ``(k,)``.
        coefficients: The a_ij, shape ``(k, gdim)``.
        candidates: Nodes of the contact surface whose groups this rank owns.
    """

    contact: Array
    group: Array
    normal: Array
    gap: Array
    area: Array
    near: Array
    row: Array
    entry_group: Array
    coefficients: Array
    candidates: int = 0

    def __len__(self) -> int:
        return len(self.gap)


def concatenate(records: list[ContactRecords], gdim: int) -> ContactRecords:
    """All conditions of several contacts in one table."""
    starts = np.cumsum([0, *(len(r) for r in records)])

    def join(name: str, empty: Array) -> Array:
        return np.concatenate([empty, *(getattr(r, name) for r in records)])

    no_index, no_vector = np.empty(0, dtype=np.int64), np.empty((0, gdim))
    rows = [r.row + start for r, start in zip(records, starts[:-1], strict=True)]
    return ContactRecords(
        contact=join("contact", no_index),
        group=join("group", no_index),
        normal=join("normal", no_vector),
        gap=join("gap", np.empty(0)),
        area=join("area", np.empty(0)),
        near=join("near", np.empty(0, dtype=bool)),
        row=np.concatenate([no_index, *rows]),
        entry_group=join("entry_group", no_index),
        coefficients=join("coefficients", no_vector),
        candidates=sum(r.candidates for r in records),
    )


def remaining_gaps(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """g_i − Σ_j a_ij · u_j for all conditions of this rank, negative where bodies overlap.

    Collective.

    Args:
        records: The conditions.
        dofs: Dof maps.
        u: Displacement in primal order, shape ``(num_nodes * bs,)``.

    Returns:
        Lengths, shape ``(n,)``.
    """
    total = dofs.reduce(u.reshape(-1, dofs.bs), np.add, 0.0)
    (values,) = dofs.lookup(records.entry_group, total / dofs.multiplicity[:, None])
    moved = np.sum(records.coefficients * values, axis=1)
    return records.gap - sum_rows(records.row, moved, len(records))
