"""Contact conditions of one node that no displacement can meet together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import NoSolutionError, TfetiError

# of the scene's length: overlaps that the linear program's tolerance (for gaps over that length)
# may leave, with room for as many conditions as a node may have
OVERLAP, LP_TOLERANCE = 1e-8, 1e-10


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
            options={"primal_feasibility_tolerance": LP_TOLERANCE},
        )
        if found.status != 0:
            raise TfetiError(
                f"the linear program of contradicting contacts failed: {found.message}"
            )
        overlap = found.x[unknowns:]
        if overlap.max() <= OVERLAP:
            return
        worst = np.argmax(overlap)
        numbers = np.unique(self.contact[self.group == self.group[worst]])
        raise NoSolutionError(
            f"contacts {' and '.join(map(str, numbers))} (in the order given) contradict each "
            f"other, or them the prescribed values: the node {self.points[worst].tolist()} "
            f"penetrates by {overlap.max() * length:.6g} whatever the bodies do"
        )


def shared_nodes(records: ContactRecords, free: Array, kept: Array, points: Array) -> SharedNodes:
    """The conditions of this rank whose nodes have several of them.

    Args:
        records: Conditions of this rank.
        free: Their coefficients without prescribed components, shape ``(k, gdim)``.
        kept: Which of them have rows, shape ``(n,)``.
        points: Points of the owned groups.
    """
    per_node = np.bincount(records.group[kept], minlength=len(points))
    condition = np.flatnonzero(kept & (per_node[records.group] > 1))
    group = records.group[condition]
    return SharedNodes(
        condition, records.contact[condition], group, points[group], _rows(records, free, condition)
    )


def _rows(records: ContactRecords, free: Array, condition: Array) -> csr_array:
    """Rows of some conditions over the unknowns that they touch."""
    place = np.full(len(records), -1)
    place[condition] = np.arange(len(condition))
    used = np.flatnonzero(place[records.condition] >= 0)
    groups, column = np.unique(records.entry_group[used], return_inverse=True)
    gdim = free.shape[1]
    columns = column.ravel()[:, None] * gdim + np.arange(gdim)
    rows = np.repeat(place[records.condition[used]], gdim)
    shape = (len(condition), len(groups) * gdim)
    return csr_array((free[used].ravel(), (rows, columns.ravel())), shape=shape)
