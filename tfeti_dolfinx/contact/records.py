"""Conditions of contact as tables."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.mesh.dofs import TornDofs


class Friction(IntEnum):
    """Kind of the bound on a condition's tangential force: none, a given force, or pressure."""

    NONE = 0
    GIVEN = 1
    COULOMB = 2


# tables of whole numbers, and of flags
WHOLE = ("contact", "group", "condition", "entry_group", "friction")
FLAGS = ("conforms", "within_reach")


@dataclass(frozen=True)
class ContactRecords:
    """Conditions of contact nodes, one for each contact and node whose group this rank owns.

    With the *relative displacement* v_i = Σ_j w_ij u_j − m_i of a node against what it meets, m_i
    the motion of a rigid body, the condition is n_i · v_i ≤ g_i, and its slip is the tangential
    part of v_i. A scalar space has frames of shape ``(n, 1, 1)``.

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
        covered: The share of that integral over the whole surface, 1 at an obstacle, ``(n,)``.
        within_reach: Whether a row is made at once; a condition out of reach gets one only if
            the solution violates it, shape ``(n,)``.
        condition: Condition of each weight, shape ``(k,)``.
        entry_group: Global group of each weight, shape ``(k,)``.
        weight: The w_ij, without a unit, shape ``(k,)``.
        friction: ``Friction`` of each condition, shape ``(n,)``.
        place: Σ_j w_ij x_j, where a rigid body that moves meets it, else 0, shape ``(n, gdim)``.
        motion: Displacement of that body there, as far as it is known, shape ``(n, gdim)``.
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
    covered: Array
    within_reach: Array
    condition: Array
    entry_group: Array
    weight: Array
    friction: Array
    place: Array
    motion: Array
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

    def at(self, motion: Array) -> ContactRecords:
        """Return the same conditions with rigid bodies at another motion."""
        return replace(self, motion=motion)


def concatenate(records: list[ContactRecords], gdim: int) -> ContactRecords:
    """All conditions of several contacts in one table."""
    starts = np.cumsum([0, *(len(r) for r in records)])
    moved = [replace(r, condition=r.condition + s) for r, s in zip(records, starts, strict=False)]
    shapes = {"frame": (0, gdim, gdim), "place": (0, gdim), "motion": (0, gdim)}
    joined: dict[str, Array] = {}
    for name in (field.name for field in fields(ContactRecords) if field.name != "candidates"):
        kind = np.int64 if name in WHOLE else np.bool_ if name in FLAGS else np.float64
        none = np.empty(shapes.get(name, 0), dtype=kind)
        joined[name] = np.concatenate([none, *(getattr(r, name) for r in moved)])
    return ContactRecords(**joined, candidates=sum(r.candidates for r in records))


def relative_motion(records: ContactRecords, dofs: TornDofs, values: Array) -> Array:
    """Σ_j w_ij u_j of all conditions, from u of the owned groups: ``(g, gdim)`` to ``(n, gdim)``.

    It is the motion of a node, less that of what it meets. Collective.
    """
    (u,) = dofs.lookup(records.entry_group, values)
    return sum_rows(records.condition, records.weight[:, None] * u, len(records))


def relative_displacement(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """The v_i, ``(n, gdim)``, from u in primal order; of torn copies the mean. Collective."""
    total = dofs.reduce(u.reshape(-1, dofs.bs), np.add, 0.0)
    return relative_motion(records, dofs, total / dofs.multiplicity[:, None]) - records.motion


def remaining_gaps(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """g_i − n_i · v_i, negative where bodies overlap, shape ``(n,)``. Collective."""
    v = relative_displacement(records, dofs, u)
    return records.gap - np.sum(records.normal * v, axis=1)


def slips(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """Return the v_i along the tangents of the frames, shape ``(n, gdim - 1)``. Collective."""
    v = relative_displacement(records, dofs, u)
    return np.einsum("ntg,ng->nt", records.tangents, v)
