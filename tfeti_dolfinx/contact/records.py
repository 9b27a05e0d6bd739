"""Conditions of contact as tables, and the gaps a user gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from numbers import Real
from typing import Any

import numpy as np

from tfeti_dolfinx.common.arrays import Array, ArrayLike, sum_rows
from tfeti_dolfinx.common.validation import checked_type, is_whole, real_numbers, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import group_points

# --- Data common to all contacts: name, reach, gap --------------------------------------------

# of the extent of the smaller surface: few nodes farther off ever touch in small strains, and those
# that do are taken in after the solve
REACH = 0.05

# what the geometry has for a gap: the distance of facets, or of the smooth surfaces through them
GEOMETRY, CURVED = "geometry", "curved"

Gap = str | float | Callable[[Array], ArrayLike]


def give_name(contact: Any, default: str) -> None:
    """Give a contact that has none its default name.

    Raises:
        InputError: Its name is not a text.
    """
    checked_type(contact.name, str, f"{default}: name", "a text")
    object.__setattr__(contact, "name", contact.name or default)  # it is frozen


def position_of(contacts: Sequence[Any], which: int | str) -> int:
    """Return the position of a contact that is given by its position or its name.

    Raises:
        InputError: There is no such contact, or several have the name.
    """
    names = [contact.name for contact in contacts]
    if is_whole(which) and 0 <= which < len(names):
        return int(which)
    if isinstance(which, str) and names.count(which) == 1:
        return names.index(which)
    known = ", ".join(f"{i}: {name}" for i, name in enumerate(names)) or "none"
    raise InputError(
        f"contact {shown(which)}: there are {len(names)}, counted from 0; their positions and "
        f"names, of which one was expected, are {known}"
    )


def gaps_by_position(contacts: Sequence[Any], gaps: Mapping[int | str, Gap]) -> dict[int, Gap]:
    """Return gaps of contacts that are given by their positions or names, by position.

    Raises:
        InputError: There is no such contact, or one is there twice.
    """
    checked_type(gaps, Mapping, "gap", "a dictionary from contacts to gaps")
    found: dict[int, Gap] = {}
    for which, gap in gaps.items():
        position = position_of(contacts, which)
        if position in found:
            raise InputError(f"gap: contact {position} is there twice, by position and by name")
        found[position] = gap
    return found


def checked_reach(name: str, reach: float | None, extent: float) -> float:
    """Return the reach, or its default.

    Args:
        name: Name of the contact, for messages.
        reach: A length, infinite for all that there is; None for 5 % of the extent.
        extent: Extent of the smaller surface.

    Raises:
        InputError: It is not a positive number.
    """
    if reach is None:
        return REACH * extent
    if not isinstance(reach, Real) or isinstance(reach, bool) or not reach > 0.0:
        raise InputError(f"{name}: reach={reach!r}, expected a positive length or None")
    return float(reach)


def checked_gap(name: str, gap: Gap) -> None:
    """Raise if a gap is none of "geometry", "curved", a finite number, a callable.

    Raises:
        InputError: It is not.
    """
    number = isinstance(gap, Real) and not isinstance(gap, bool) and np.isfinite(float(gap))
    if not (number or callable(gap) or (isinstance(gap, str) and gap in (GEOMETRY, CURVED))):
        raise InputError(
            f'{name}: gap={gap!r}, expected "geometry", "curved", a finite length (negative: '
            "interference), or a function of points of shape (3, n)"
        )


def given_gaps(name: str, gap: Gap, x: Array) -> Array | None:
    """Return gaps that a user gives at points, None where the geometry has them.

    Args:
        name: Name of the contact, for messages.
        gap: Checked by ``checked_gap``.
        x: Points, shape ``(n, 3)``.

    Returns:
        Lengths, shape ``(n,)``.

    Raises:
        InputError: A function gave something else than one finite number for each point.
    """
    if isinstance(gap, str):
        return None
    if not callable(gap):
        return np.full(len(x), float(gap))
    try:
        values = real_numbers(gap(x.T))
        values = np.array(np.broadcast_to(values, (len(x),)))
    except Exception as error:  # a user's function may raise anything
        raise InputError(
            f"{name}: gap, a function, did not give one number for each of {len(x)} points of "
            f"shape (3, {len(x)}): {type(error).__name__}: {error}"
        ) from error
    if np.any(wrong := ~np.isfinite(values)):
        raise InputError(f"{name}: gap is {values[wrong][0]} at the point {x[wrong][0].tolist()}")
    return values


# --- Records of contact conditions ------------------------------------------------------------


class Friction(IntEnum):
    """Kind of the bound on a condition's tangential force: none, a given force, or pressure."""

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


# --- Gaps of conditions -----------------------------------------------------------------------


def gaps_of(
    name: str, gap: Gap, records: ContactRecords, dofs: TornDofs, depth: float = np.inf
) -> Array:
    """Return gaps of the conditions of one contact, without a new search or integral. Collective.

    A given gap is taken at the nodes: that is the mean of its linear interpolant.

    Args:
        name: Name of the contact, for messages.
        gap: Checked by ``checked_gap``.
        records: Its conditions.
        dofs: Dof maps.
        depth: A given gap replaces that of the geometry up to this one.

    Returns:
        Lengths, shape ``(n,)``.

    Raises:
        InputError: A given gap is no number somewhere.
    """
    x = group_points(dofs)[records.group]
    with raised_on_all_ranks(dofs.comm):
        given = given_gaps(name, gap, x)
    if given is None:
        return records.curved_gap if gap == CURVED else records.geometric_gap
    return np.where(records.geometric_gap <= depth, given, records.geometric_gap)
