"""Rows along the tangents of conditions that have friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.contact.records import Friction
from tfeti_dolfinx.gluing.contact import ContactRows
from tfeti_dolfinx.gluing.rows import Rows, stack
from tfeti_dolfinx.gluing.spread import HeldPart, Spread
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import any_rank

NOTHING = np.empty(0, dtype=np.int64)
NO_ROWS = Rows(NOTHING, NOTHING, NOTHING, np.empty(0))


@dataclass(frozen=True)
class TangentRows:
    """What the rows T are of: they lead back to slips and tangential forces.

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
        """What makes T u − c the scaled slip of a step, prescribed values taken in. Collective.

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


def tangent_rows(dofs: TornDofs, spread: Spread, normals: ContactRows) -> tuple[Rows, TangentRows]:
    """T from conditions within reach that have friction, and what belongs to its rows. Collective.

    A condition whose normal row prescribed components decide keeps its tangents under a given
    bound. Under Coulomb's law it has none: the pressure is hidden in what holds the node.

    Args:
        dofs: Dof maps.
        spread: Coefficients of the conditions.
        normals: What the normal rows are of.
    """
    records, count = spread.records, dofs.bs - 1
    if not any_rank(dofs.comm, bool(np.any(records.friction != Friction.NONE))):
        none = np.ones((0, count), dtype=bool)
        return NO_ROWS, _tangents_of(spread, NOTHING, np.zeros(0), none, NOTHING)
    squares, moves = np.zeros((len(records), count)), np.zeros((len(records), count), dtype=bool)
    for k in range(count):
        squares[:, k], moves[:, k] = spread.left(1 + k)
    normal_scale = np.zeros(len(records))
    normal_scale[normals.condition] = normals.scale
    rubs = (records.friction == Friction.GIVEN) & records.within_reach
    rubs |= (records.friction == Friction.COULOMB) & (normal_scale > 0.0)
    condition = np.flatnonzero(rubs & np.any(moves, axis=1))
    longest = np.sqrt(squares[condition].max(axis=1, initial=0.0))
    scale = normal_scale[condition]
    scale = np.where(scale > 0.0, scale, 1.0 / np.maximum(longest, TINY))
    row = np.full(len(records), -1)
    row[normals.condition] = np.arange(len(normals.condition))
    row[records.friction != Friction.COULOMB] = -1
    found = _tangents_of(spread, condition, scale, moves[condition], row[condition])
    tables = [spread.rows(1 + k, condition, scale * found.moves[:, k]) for k in range(count)]
    return _by_condition(tables), found


def _tangents_of(
    spread: Spread, condition: Array, scale: Array, moves: Array, normal: Array
) -> TangentRows:
    tangents = spread.records.tangents[condition]
    return TangentRows(condition, scale, moves, tangents, spread.held, normal)


def _by_condition(tables: list[Rows]) -> Rows:
    """Rows of several axes, those of a condition one after the other."""
    rows, count = stack(tables), len(tables)
    place = np.arange(len(rows)).reshape(-1, count).T.ravel()
    return Rows(np.repeat(tables[0].group, count), place[rows.row], rows.column, rows.value)
