"""What a user says of a contact besides its surfaces: its name, how far it looks, its gap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array, ArrayLike
from tfeti_dolfinx.checks import checked_type, is_whole, real_numbers, shown
from tfeti_dolfinx.errors import InputError

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
    """Position of a contact that is given by its position or its name.

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
    """Gaps of contacts that are given by their positions or names, by position.

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
    """The reach, or its default.

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
    """Gaps that a user gives at points, None where the geometry has them.

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
