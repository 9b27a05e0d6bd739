"""Which local rows of B are what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array


@dataclass(frozen=True)
class RowSets:
    """Local rows of B by name. Nobody else knows in which order they stand.

    Attributes:
        equalities: Gluing rows, and rows that hold prescribed components, shape ``(e,)``.
        normals: Rows of contact conditions along their normals, λ ≥ 0, shape ``(n,)``.
        tangents: Rows along the tangents of conditions with friction, shape ``(t, gdim - 1)``.
    """

    equalities: Array
    normals: Array
    tangents: Array

    @property
    def contact(self) -> Array:
        """All rows of contact conditions, normals first."""
        return np.concatenate((self.normals, self.tangents.ravel()))

    def contact_rows(self, comm: MPI.Intracomm) -> tuple[int, int]:
        """Number of normal and of tangential rows on all ranks. Collective."""
        normals, tangents = comm.allreduce(np.array([self.normals.size, self.tangents.size]))
        return int(normals), int(tangents)

    @property
    def num_rows(self) -> int:
        """All local rows."""
        return self.equalities.size + self.normals.size + self.tangents.size


def row_sets(num_equalities: int, num_normals: int, num_tangents: int, gdim: int) -> RowSets:
    """Equalities first, then normals, then tangents, those of a condition together."""
    rows, count = np.arange(num_equalities + num_normals + num_tangents), max(gdim - 1, 1)
    equalities, normals, tangents = np.split(rows, [num_equalities, num_equalities + num_normals])
    shape = (num_tangents // count, gdim - 1)
    return RowSets(equalities, normals, tangents.reshape(shape))
