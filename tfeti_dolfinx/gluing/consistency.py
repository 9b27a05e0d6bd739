"""Contact conditions of one node that no displacement can meet together."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import NoSolutionError, TfetiError

# Overlap, as a share of the scene's length, that the linear program's tolerance may leave.
OVERLAP, LP_TOLERANCE = 1e-8, 1e-10


def check_consistent(
    records: ContactRecords, free: Array, gap: Array, kept: Array, points: Array, length: float
) -> None:
    """Raise where conditions of the same node contradict each other. Not collective.

    Rows of B that are dependent with coefficients of one sign, on gaps whose sum is negative,
    leave no displacement. Gluing rows are independent of contact rows, so these are contact rows
    alone; those of one contact node are on one rank. Whether min Σt over a·u − t ≤ g, t ≥ 0 is 0
    is a linear program.

    Args:
        records: Conditions of this rank.
        free: Their coefficients without prescribed components, shape ``(k, gdim)``.
        gap: Their gaps less what prescribed components use up, shape ``(n,)``.
        kept: Which of them have rows, shape ``(n,)``.
        points: Points of the owned groups.
        length: A length of the scene.

    Raises:
        NoSolutionError: Names the contacts and a node.
    """
    together = kept & (np.bincount(records.group[kept], minlength=len(points))[records.group] > 1)
    if not np.any(together):
        return
    condition = np.flatnonzero(together)
    A, g = _rows(records, free, condition), gap[condition] / length
    n = len(condition)
    found = linprog(
        np.concatenate((np.zeros(A.shape[1]), np.ones(n))),
        A_ub=hstack([A, -eye_array(n)]),
        b_ub=g,
        bounds=[(None, None)] * A.shape[1] + [(0.0, None)] * n,
        method="highs",
        options={"primal_feasibility_tolerance": LP_TOLERANCE},
    )
    if found.status != 0:
        raise TfetiError(f"the linear program of contradicting contacts failed: {found.message}")
    overlap = found.x[A.shape[1] :]
    if overlap.max() <= OVERLAP:
        return
    worst = records.group[condition[np.argmax(overlap)]]
    numbers = np.unique(records.contact[condition[records.group[condition] == worst]])
    raise NoSolutionError(
        f"contacts {' and '.join(map(str, numbers))} (in the order given) contradict each other, "
        f"or them the prescribed values: the node {points[worst].tolist()} penetrates by "
        f"{overlap.max() * length:.6g} whatever the bodies do"
    )


def _rows(records: ContactRecords, free: Array, condition: Array) -> csr_array:
    """Rows of some conditions over the unknowns that they touch."""
    place = np.full(len(records), -1)
    place[condition] = np.arange(len(condition))
    used = np.flatnonzero(place[records.row] >= 0)
    groups, column = np.unique(records.entry_group[used], return_inverse=True)
    gdim = free.shape[1]
    columns = column.ravel()[:, None] * gdim + np.arange(gdim)
    rows = np.repeat(place[records.row[used]], gdim)
    shape = (len(condition), len(groups) * gdim)
    return csr_array((free[used].ravel(), (rows, columns.ravel())), shape=shape)
