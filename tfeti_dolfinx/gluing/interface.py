"""Rows that glue torn copies together, and rows that hold prescribed components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.gluing.rows import Rows, stack
from tfeti_dolfinx.mesh.dofs import TornDofs


@dataclass(frozen=True)
class HeldRows:
    """The equality rows that hold prescribed components; the others have right sides 0.

    Attributes:
        row: Place of each among the equality rows, shape ``(h,)``.
        component: Component that it holds, unrolled over the owned groups, shape ``(h,)``.
        factor: What the component is multiplied by, shape ``(h,)``.
    """

    row: Array
    component: Array
    factor: Array

    def right_side(self, values: Array) -> Array:
        """Right sides of these rows, from values of the owned groups, shape ``(g, bs)``."""
        return values.ravel()[self.component] * self.factor


def equality_rows(dofs: TornDofs, flag: Array, weights: Array) -> tuple[Rows, HeldRows]:
    """B_E, and which of its rows hold prescribed components.

    A component that is prescribed has one row per copy and no gluing rows. The k − 1 gluing
    rows of k copies are orthonormal in the inner product of D⁻¹, D the weights; with equal
    weights they are (1, …, 1, −j)/√(j + j²), j = 1, …, k − 1. Differences of neighbours instead
    would have a Gram matrix of condition O(k²).

    Args:
        dofs: Dof maps.
        flag: Which components of the owned groups are prescribed, shape ``(g, bs)``.
        weights: D for each copy of the owned groups, shape ``(c, bs)``.
    """
    multiplicities = np.unique(dofs.multiplicity)
    tables = [_glue(dofs, flag, weights, int(k)) for k in multiplicities if k > 1]
    holding, component = _hold(dofs, flag, weights)
    rows = stack([holding, *tables]).sorted_by_group()
    n = len(holding)  # these rows have one entry each, and their entries come first
    return rows, HeldRows(rows.row[:n], component, rows.value[:n])


def _glue(dofs: TornDofs, flag: Array, weights: Array, k: int) -> Rows:
    """Gluing rows of all free components of groups with k copies."""
    group, component = np.nonzero((dofs.multiplicity == k)[:, None] & ~flag)
    places = dofs.copy_offsets[group][:, None] + np.arange(k)
    columns = dofs.copies[places] * dofs.bs + component[:, None]
    pattern = _orthonormal(weights[places, component[:, None]])
    n = len(group)
    row, copy = (index.ravel() for index in np.indices((n * (k - 1), k)))
    return Rows(
        group=np.repeat(group, k - 1),
        row=row,
        column=columns[row // (k - 1), copy],
        value=pattern.reshape(-1, k)[row, copy],
    ).without_zeros()


def _orthonormal(weights: Array) -> Array:
    """Rows with zero sum, orthonormal in the inner product of diag(weights)⁻¹.

    Gram–Schmidt on e_i − e_{i+1} in closed form: row j is proportional to (w_1, …, w_j, −W_j)
    with W_j = w_1 + … + w_j.

    Args:
        weights: Positive weights, shape ``(n, k)``.

    Returns:
        Rows, shape ``(n, k - 1, k)``.
    """
    k = weights.shape[1]
    sums = np.cumsum(weights, axis=1)
    rows = np.tril(np.ones((k - 1, k))) * weights[:, None, :]
    j = np.arange(k - 1)
    rows[:, j, j + 1] = -sums[:, :-1]
    norms = sums[:, :-1] + sums[:, :-1] ** 2 / weights[:, 1:]
    return rows / np.sqrt(norms)[:, :, None]


def _hold(dofs: TornDofs, flag: Array, weights: Array) -> tuple[Rows, Array]:
    """One row with one entry per copy and prescribed component, and the components."""
    group = np.repeat(np.arange(dofs.num_groups), dofs.multiplicity)
    copy, component = np.nonzero(flag[group])
    rows = Rows(
        group=group[copy],
        row=np.arange(len(copy)),
        column=dofs.copies[copy] * dofs.bs + component,
        value=np.sqrt(weights[copy, component]),
    )
    return rows, group[copy] * dofs.bs + component
