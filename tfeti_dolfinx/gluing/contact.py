"""Non-penetration rows and their right sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import NoSolutionError, raised_on_all_ranks
from tfeti_dolfinx.gluing.consistency import SharedNodes, shared_nodes
from tfeti_dolfinx.gluing.rows import Rows
from tfeti_dolfinx.gluing.spread import HeldPart, Spread
from tfeti_dolfinx.mesh.dofs import TornDofs

# of the scene's length: overlaps below it are rounding of gaps and prescribed values
OVERLAP = 1e-10


@dataclass(frozen=True)
class ContactRows:
    """What the rows B_N are of: it leads back to lengths and forces, and on to right sides.

    None of it depends on prescribed values or gaps.

    Attributes:
        condition: Condition (of the records) of each row, shape ``(n,)``.
        scale: The s_i that a condition was multiplied by, shape ``(n,)``: one number for all rows
            of a condition, that which gives its normal row unit norm. Its force is s_i λ_i.
        decided: Conditions of this rank that prescribed components decide alone, without rows.
        normal: Normals of all conditions, shape ``(n, gdim)``.
        held: What prescribed components contribute to relative displacements.
        shared: Conditions of nodes that have several of them.
    """

    condition: Array
    scale: Array
    decided: Array
    normal: Array
    held: HeldPart
    shared: SharedNodes

    def left_gaps(self, dofs: TornDofs, values: Array, gaps: Array) -> Array:
        """Gaps of all conditions less what prescribed values use up, shape ``(n,)``. Collective."""
        v = self.held.displacement(dofs, values, len(gaps))
        return np.asarray(gaps - np.sum(self.normal * v, axis=1))

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
        _check_decided(left[self.decided], length, dofs.comm)
        with raised_on_all_ranks(dofs.comm):
            self.shared.check(left, length)
        return left[self.condition] * self.scale


def contact_rows(spread: Spread) -> tuple[Rows, ContactRows]:
    """B_N from contact conditions, and what belongs to its rows. Collective.

    The whole row is scaled to unit norm by one number s_i. If less than 1e-10 of it remains, or
    than what rounding makes of it, it is dropped.

    Args:
        spread: Coefficients of the conditions of this rank; those within reach get rows.
    """
    records = spread.records
    after, left = spread.left(0)
    kept = records.within_reach & left
    condition = np.flatnonzero(kept)
    scale = 1.0 / np.sqrt(after[kept])
    found = ContactRows(
        condition=condition,
        scale=scale,
        decided=np.flatnonzero(records.within_reach & ~kept),
        normal=records.normal,
        held=spread.held,
        shared=shared_nodes(records, spread.free(0), kept, spread.points),
    )
    return spread.rows(0, condition, scale), found


def _check_decided(gaps: Array, length: float, comm: MPI.Intracomm) -> None:
    """Raise on all ranks if prescribed components violate conditions, with those of all ranks."""
    overlaps = comm.allreduce(int(np.sum(gaps < -OVERLAP * length)))
    deepest = comm.allreduce(float(gaps.min(initial=0.0)), op=MPI.MIN)
    if overlaps:
        raise NoSolutionError(
            "an obstacle or a contact lies within a part of the surface whose displacement is "
            f"prescribed: {overlaps} nodes penetrate by up to "
            f"{-deepest:.6g} whatever the rest does"
        )
