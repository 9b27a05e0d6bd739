"""Contact conditions before they become rows of B: a frame and scalar weights each."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.mesh.dofs import TornDofs


class Friction(IntEnum):
    """What bounds the tangential force of a condition: nothing to hold, a given force, pressure."""

    NONE = 0
    GIVEN = 1
    COULOMB = 2


@dataclass(frozen=True)
class ContactRecords:
    """Conditions of contact nodes, one for each contact and node whose group this rank owns.

    With the *relative displacement* v_i = Σ_j w_ij u_j of a node against what it meets, the
    condition is n_i · v_i ≤ g_i, and its slip is the tangential part of v_i. A scalar space has
    frames of shape ``(n, 1, 1)``.

    Attributes:
        contact: Index of the contact (in the list that the user gave), shape ``(n,)``.
        group: Owned group of the contact node, shape ``(n,)``.
        frame: Right-handed orthonormal axes, shape ``(n, gdim, gdim)``: axis 0 is the normal n_i,
            in which the node may not go further, the others are tangents.
        gap: Distance g_i, a length, shape ``(n,)``.
        geometric_gap: The distance that the geometry has, whatever a user gives, shape ``(n,)``.
        curved_gap: The distance between the smooth surfaces that the facets of both sides stand
            for, shape ``(n,)``.
        conforms: Whether the facets change the gap by more than that of the smooth surfaces varies
            from node to node, shape ``(n,)``.
        area: Integral ∫φ_i of the node's hat over the contact surface, of a pair over what the
            other side covers of it, shape ``(n,)``.
        within_reach: Whether a row is made at once; a condition out of reach gets one only if
            the solution violates it, shape ``(n,)``.
        condition: Condition of each weight, shape ``(k,)``.
        entry_group: Global group of each weight, shape ``(k,)``.
        weight: The w_ij, without a unit, shape ``(k,)``.
        friction: ``Friction`` of each condition, shape ``(n,)``.
        candidates: Nodes of the contact surface whose groups this rank owns.
    """

    contact: Array
    group: Array
    frame: Array
    gap: Array
    geometric_gap: Array
    curved_gap: Array
    conforms: Array
    area: Array
    within_reach: Array
    condition: Array
    entry_group: Array
    weight: Array
    friction: Array
    candidates: int = 0

    def __len__(self) -> int:
        return len(self.gap)

    @property
    def normal(self) -> Array:
        """Direction in which each node may not go further, shape ``(n, gdim)``."""
        return self.frame[:, 0]

    @property
    def tangents(self) -> Array:
        """The other axes of the frames, shape ``(n, gdim - 1, gdim)``."""
        return self.frame[:, 1:]

    def coefficients(self, axis: int) -> Array:
        """The a_ij of Σ_j a_ij · u_j, v_i along an axis of the frame, shape ``(k, gdim)``."""
        return self.frame[self.condition, axis] * self.weight[:, None]


def concatenate(records: list[ContactRecords], gdim: int) -> ContactRecords:
    """All conditions of several contacts in one table."""
    starts = np.cumsum([0, *(len(r) for r in records)])

    def join(name: str, empty: Array) -> Array:
        return np.concatenate([empty, *(getattr(r, name) for r in records)])

    no_index, no_number = np.empty(0, dtype=np.int64), np.empty(0)
    conditions = [r.condition + start for r, start in zip(records, starts[:-1], strict=True)]
    return ContactRecords(
        contact=join("contact", no_index),
        group=join("group", no_index),
        frame=join("frame", np.empty((0, gdim, gdim))),
        gap=join("gap", no_number),
        geometric_gap=join("geometric_gap", no_number),
        curved_gap=join("curved_gap", no_number),
        conforms=join("conforms", np.empty(0, dtype=bool)),
        area=join("area", no_number),
        within_reach=join("within_reach", np.empty(0, dtype=bool)),
        condition=np.concatenate([no_index, *conditions]),
        entry_group=join("entry_group", no_index),
        weight=join("weight", no_number),
        friction=join("friction", no_index),
        candidates=sum(r.candidates for r in records),
    )


def relative_displacement(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """v_i = Σ_j w_ij u_j of all conditions of this rank: the node's, less what it meets.

    Collective.

    Args:
        records: The conditions.
        dofs: Dof maps.
        u: Displacement in primal order, shape ``(num_nodes * bs,)``; of torn copies the mean.

    Returns:
        Lengths, shape ``(n, gdim)``.
    """
    total = dofs.reduce(u.reshape(-1, dofs.bs), np.add, 0.0)
    (values,) = dofs.lookup(records.entry_group, total / dofs.multiplicity[:, None])
    return sum_rows(records.condition, records.weight[:, None] * values, len(records))


def remaining_gaps(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """g_i − n_i · v_i, negative where bodies overlap, shape ``(n,)``. Collective.

    Args:
        records: The conditions.
        dofs: Dof maps.
        u: Displacement in primal order, shape ``(num_nodes * bs,)``.
    """
    v = relative_displacement(records, dofs, u)
    return records.gap - np.sum(records.normal * v, axis=1)


def slips(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """v_i along the tangents of its frame, shape ``(n, gdim - 1)``. Collective.

    Args:
        records: The conditions.
        dofs: Dof maps.
        u: Displacement in primal order, shape ``(num_nodes * bs,)``.
    """
    v = relative_displacement(records, dofs, u)
    return np.einsum("ntg,ng->nt", records.tangents, v)
