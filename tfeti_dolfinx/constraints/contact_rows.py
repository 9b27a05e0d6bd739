"""Rows of contact: normals and tangents, and whether gaps contradict each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.constraints.rows import TOLERANCES, HeldPart, RowBuilder, Rows, stack
from tfeti_dolfinx.contact.records import ContactRecords, Friction
from tfeti_dolfinx.errors import NoSolutionError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs

# --- Consistency of contact conditions at one node --------------------------------------------


@dataclass(frozen=True)
class SharedNodes:
    """Conditions with rows whose nodes have several of them, as a linear program.

    Attributes:
        condition: The conditions, shape ``(p,)``.
        contact: Their contacts, shape ``(p,)``.
        group: The owned groups of their nodes, shape ``(p,)``.
        points: The points of these, shape ``(p, 3)``.
        A: Their coefficients over the components that are not prescribed.
    """

    condition: Array
    contact: Array
    group: Array
    points: Array
    A: csr_array

    def check(self, gaps: Array, length: float) -> None:
        """Raise where conditions of the same node contradict each other. Not collective.

        Rows of B that are dependent with coefficients of one sign, on gaps whose sum is negative,
        leave no displacement. Gluing rows are independent of contact rows, so these are contact
        rows alone; those of one contact node are on one rank. Whether min Σt over a·u − t ≤ g,
        t ≥ 0 is 0 is a linear program.

        Args:
            gaps: Gaps of all conditions less what prescribed components use up, shape ``(n,)``.
            length: A length of the scene.

        Raises:
            NoSolutionError: Names the contacts and a node.
        """
        n = len(self.condition)
        if n == 0:
            return
        unknowns = self.A.shape[1]
        found = linprog(
            np.concatenate((np.zeros(unknowns), np.ones(n))),
            A_ub=hstack([self.A, -eye_array(n)]),
            b_ub=gaps[self.condition] / length,
            bounds=[(None, None)] * unknowns + [(0.0, None)] * n,
            method="highs",
            options={"primal_feasibility_tolerance": TOLERANCES.program},
        )
        if found.status != 0:
            raise TfetiError(
                f"the linear program of contradicting contacts failed: {found.message}"
            )
        overlap = found.x[unknowns:]
        if overlap.max() <= TOLERANCES.contradiction:
            return
        worst = np.argmax(overlap)
        numbers = np.unique(self.contact[self.group == self.group[worst]])
        raise NoSolutionError(
            f"contacts {' and '.join(map(str, numbers))} (in the order given) contradict each "
            f"other, or them the prescribed values: the node {self.points[worst].tolist()} "
            f"penetrates by {overlap.max() * length:.6g} whatever the bodies do"
        )


def shared_nodes(records: ContactRecords, free: Array, kept: Array, points: Array) -> SharedNodes:
    """Return the conditions of this rank whose nodes have several of them.

    Args:
        records: Conditions of this rank.
        free: Their coefficients without prescribed components, shape ``(k, gdim)``.
        kept: Which of them have rows, shape ``(n,)``.
        points: Points of the owned groups.
    """
    per_node = np.bincount(records.group[kept], minlength=len(points))
    condition = np.flatnonzero(kept & (per_node[records.group] > 1))
    group = records.group[condition]
    place = np.full(len(records), -1)
    place[condition] = np.arange(len(condition))
    used = np.flatnonzero(place[records.condition] >= 0)
    groups, column = np.unique(records.entry_group[used], return_inverse=True)
    gdim = free.shape[1]
    columns = column.ravel()[:, None] * gdim + np.arange(gdim)
    rows = np.repeat(place[records.condition[used]], gdim)
    shape = (len(condition), len(groups) * gdim)
    A = csr_array((free[used].ravel(), (rows, columns.ravel())), shape=shape)
    return SharedNodes(condition, records.contact[condition], group, points[group], A)


# --- Non-penetration rows and their right sides -----------------------------------------------


@dataclass(frozen=True)
class ContactRows:
    """Origin of the rows B_N: leads to lengths and forces of conditions, and to right sides.

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
        v = self.held.displacement(dofs, values, len(gaps))
        left = gaps - np.sum(self.normal * v, axis=1)
        decided, comm = left[self.decided], dofs.comm
        overlaps = comm.allreduce(int(np.sum(decided < -TOLERANCES.overlap * length)))
        deepest = comm.allreduce(float(decided.min(initial=0.0)), op=MPI.MIN)
        if overlaps:
            raise NoSolutionError(
                "an obstacle or a contact lies within a part of the surface whose displacement is "
                f"prescribed: {overlaps} nodes penetrate by up to {-deepest:.6g} whatever the rest "
                "does"
            )
        with raised_on_all_ranks(dofs.comm):
            self.shared.check(left, length)
        return left[self.condition] * self.scale


def contact_rows(spread: RowBuilder) -> tuple[Rows, ContactRows]:
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


# --- Tangential rows of conditions with friction ----------------------------------------------


@dataclass(frozen=True)
class TangentRows:
    """Origin of the rows T: leads to slips and tangential forces of conditions.

    Attributes:
        condition: Condition of each point of ``RowSets.tangents``, shape ``(t,)``.
        scale: The s_i of the normal row of the same condition, shape ``(t,)``; where prescribed
            components leave none, one that gives the longer tangential row unit norm.
        moves: Whether anything of a row is left by prescribed components; rows without entries
            stay, so that a disc stays a disc, shape ``(t, gdim - 1)``.
        tangents: Axes of the rows, shape ``(t, gdim - 1, gdim)``.
        held: What prescribed components contribute to relative displacements.
        normal: Under Coulomb's law the normal row of the same condition, as a position in
            ``RowSets.normals``, else −1, shape ``(t,)``.
    """

    condition: Array
    scale: Array
    moves: Array
    tangents: Array
    held: HeldPart
    normal: Array

    def right_side(self, dofs: TornDofs, values: Array, slip: Array) -> Array:
        """Return c such that T u − c is the scaled slip of a step. Collective.

        Args:
            dofs: Dof maps.
            values: Prescribed values of the owned groups, shape ``(g, bs)``.
            slip: Where the step begins: the tangential v_i of all conditions then, shape
                ``(n, gdim - 1)``.

        Returns:
            Shape ``(t, gdim - 1)``.
        """
        v = self.held.displacement(dofs, values, len(slip))[self.condition]
        along = np.einsum("tkg,tg->tk", self.tangents, v)
        left = slip[self.condition] - along
        return np.where(self.moves, left * self.scale[:, None], 0.0)

    def limits(self, traction: Array, area: Array) -> Array:
        """The ψ_i: semi-axes of what λ_T may be, 0 on rows without entries.

        Args:
            traction: Largest tractions of all conditions along their tangents, shape
                ``(n, gdim - 1)``.
            area: ∫φ_i of all conditions, shape ``(n,)``.

        Returns:
            traction · ∫φ_i / s_i, shape ``(t, gdim - 1)``; 0 under Coulomb's law.
        """
        over = (area[self.condition] / self.scale)[:, None]
        given = self.moves & (self.normal < 0)[:, None]
        return np.where(given, traction[self.condition] * over, 0.0)

    def coefficients(self, values: Array) -> Array:
        """The μ_i: semi-axes over λ_N, 0 on rows without entries and under a given bound.

        Args:
            values: Coefficients of all conditions along their tangents, shape ``(n, gdim - 1)``.

        Returns:
            Shape ``(t, gdim - 1)``.
        """
        pressed = self.moves & (self.normal >= 0)[:, None]
        return np.where(pressed, values[self.condition], 0.0)


def tangent_rows(
    dofs: TornDofs, spread: RowBuilder, normals: ContactRows
) -> tuple[Rows, TangentRows]:
    """T from conditions within reach that have friction, and what belongs to its rows. Collective.

    A condition whose normal row prescribed components decide keeps its tangents under a given
    bound. Under Coulomb's law it has none: the pressure is hidden in what holds the node.

    Args:
        dofs: Dof maps.
        spread: Coefficients of the conditions.
        normals: What the normal rows are of.
    """
    records, count = spread.records, dofs.bs - 1
    condition: Array = np.empty(0, dtype=np.int64)
    normal: Array = condition
    scale: Array = np.zeros(0)
    moves: Array = np.ones((0, count), dtype=bool)
    rows = Rows(condition, condition, condition, scale)
    if any_rank(dofs.comm, bool(np.any(records.friction != Friction.NONE))):
        squares, left = (np.zeros((len(records), count)) for _ in range(2))
        for k in range(count):
            squares[:, k], left[:, k] = spread.left(1 + k)
        of_normal, row = np.zeros(len(records)), np.full(len(records), -1)
        of_normal[normals.condition] = normals.scale
        row[normals.condition] = np.arange(len(normals.condition))
        row[records.friction != Friction.COULOMB] = -1
        rubs = (records.friction == Friction.GIVEN) & records.within_reach
        rubs |= (records.friction == Friction.COULOMB) & (of_normal > 0.0)
        condition = np.flatnonzero(rubs & np.any(left > 0.0, axis=1))
        longest = np.sqrt(squares[condition].max(axis=1, initial=0.0))
        normal, moves = row[condition], left[condition] > 0.0
        scale = of_normal[condition]
        scale = np.where(scale > 0.0, scale, 1.0 / np.maximum(longest, TINY))
        rows = stack([spread.rows(1 + k, condition, scale * moves[:, k]) for k in range(count)])
        # those of a condition one after the other
        place = np.arange(len(rows)).reshape(-1, count).T.ravel()
        group = np.repeat(records.group[condition], count)
        rows = Rows(group, place[rows.row], rows.column, rows.value)
    return rows, TangentRows(
        condition, scale, moves, records.tangents[condition], spread.held, normal
    )
