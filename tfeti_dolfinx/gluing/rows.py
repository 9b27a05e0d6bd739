"""Tables of rows: the only source of B."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array


@dataclass(frozen=True)
class Rows:
    """Rows of one kind that this rank owns, in coordinate form.

    Attributes:
        group: Owned group that each row belongs to, shape ``(n,)``.
        row: Row of each entry, shape ``(k,)``.
        column: Global primal unknown of each entry, shape ``(k,)``.
        value: The entries, shape ``(k,)``.
    """

    group: Array
    row: Array
    column: Array
    value: Array

    def __len__(self) -> int:
        return len(self.group)

    def without_zeros(self) -> Rows:
        """The same rows without entries that are zero."""
        used = self.value != 0.0
        return Rows(self.group, self.row[used], self.column[used], self.value[used])

    def sorted_by_group(self) -> Rows:
        """The same rows in the order of their groups (stable); entries stay where they are."""
        order = np.argsort(self.group, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        return Rows(self.group[order], place[self.row], self.column, self.value)


def stack(tables: list[Rows]) -> Rows:
    """The rows of several tables, one table after the other, and so are their entries."""
    starts = np.cumsum([0, *(len(t) for t in tables)])
    return Rows(
        group=np.concatenate([t.group for t in tables]),
        row=np.concatenate([t.row + s for t, s in zip(tables, starts[:-1], strict=True)]),
        column=np.concatenate([t.column for t in tables]),
        value=np.concatenate([t.value for t in tables]),
    )
