"""Which local rows of B are what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array


@dataclass(frozen=True)
class RowSets:
    """Local rows of B by name. Nobody else knows in which order they stand.

    Attributes:
        equalities: Gluing rows, and rows that hold prescribed components, shape ``(e,)``.
        normals: Rows of contact conditions along their normals, λ ≥ 0, shape ``(n,)``.
        tangents: Rows along the tangents of conditions, none today, shape ``(t, gdim - 1)``.
    """

    equalities: Array
    normals: Array
    tangents: Array

    @property
    def num_rows(self) -> int:
        """All local rows."""
        return self.equalities.size + self.normals.size + self.tangents.size


def row_sets(num_equalities: int, num_normals: int, gdim: int) -> RowSets:
    """Equalities first, then normals."""
    rows = np.arange(num_equalities + num_normals)
    no_tangents = np.empty((0, gdim - 1), dtype=rows.dtype)
    return RowSets(rows[:num_equalities], rows[num_equalities:], no_tangents)
