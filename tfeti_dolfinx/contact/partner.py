"""Data common to obstacles and pairs: name, surfaces, gap, friction, reach."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Self, TypeAlias

import numpy as np

from tfeti_dolfinx.common.arrays import Array, ArrayLike
from tfeti_dolfinx.common.validation import checked_type, is_whole, shown
from tfeti_dolfinx.contact.friction import FrictionLaw, numbers_at, with_friction
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import extent, group_points, surface_facets
from tfeti_dolfinx.mortar.tolerances import SEARCH

Gap: TypeAlias = str | float | Callable[[Array], ArrayLike]
# what the geometry has for a gap: the distance of facets, or of the smooth surfaces through them
GEOMETRY, CURVED = "geometry", "curved"


@dataclass(frozen=True, kw_only=True)
class ContactPartner:
    """An obstacle, or a pair of surfaces. All methods are collective.

    Attributes:
        gap: The gaps of its conditions: those of the geometry, or given ones.
        friction: Its law of friction.
        reach: Distance up to which conditions have rows at first; None: 5 % of the surface.
        name: Name for messages.
    """

    gap: Gap = GEOMETRY
    friction: FrictionLaw | None = None
    reach: float | None = None
    name: str = ""

    def _check_data(self, default_name: str) -> None:
        """Give the contact a name if it has none, and check what is known at once."""
        checked_type(self.name, str, f"{default_name}: name", "a text")
        object.__setattr__(self, "name", self.name or default_name)  # it is frozen
        if self.friction is not None:
            expected = "Tresca(bound), Coulomb(coefficient) or None"
            checked_type(self.friction, FrictionLaw, f"{self.name}: friction", expected)

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Names or tags of the surfaces, that with the multipliers first."""
        raise NotImplementedError

    def records(
        self,
        dofs: TornDofs,
        contact: int,
        reach: float = np.inf,
        depth: float = np.inf,
    ) -> ContactRecords:
        """Return the conditions.

        Args:
            dofs: Dof maps.
            contact: Index of the contact.
            reach: Conditions with a larger gap are out of reach; those of surfaces three times as
                far apart are not made.
            depth: Largest initial overlap of two surfaces, and how far a given gap replaces it.
                A body may lie in an obstacle as deep as it likes.

        Raises:
            InputError: Surfaces, shape, gap or friction do not fit.
        """
        raise NotImplementedError

    def first_reach(self, decomposition: Decomposition) -> float:
        """Return the distance up to which conditions have rows at first.

        Raises:
            InputError: A surface is unknown or empty, or gap or reach do not fit.
        """
        facets = [surface_facets(decomposition, name) for name in self.surfaces]
        self._check_gap()
        size, reach = min(extent(decomposition, surface) for surface in facets), self.reach
        if reach is None:
            return SEARCH.reach * size
        if not isinstance(reach, Real) or isinstance(reach, bool) or not reach > 0.0:
            raise InputError(f"{self.name}: reach={reach!r}, expected a positive length or None")
        return float(reach)

    def settled(
        self, dofs: TornDofs, contact: int, reach: float, stiffness: Array
    ) -> tuple[ContactPartner, ContactRecords]:
        """Return the contact with its sides decided, and its conditions up to a reach, and so deep.

        ``stiffness`` is the block of K of each primal node, shape ``(num_nodes, bs, bs)``.
        """
        return self, self.records(dofs, contact, reach, reach)

    def with_gap(self, gap: Gap) -> Self:
        """Return the same contact with another ``gap=``."""
        found = replace(self, gap=gap)
        found._check_gap()
        return found

    def gaps(self, dofs: TornDofs, records: ContactRecords, depth: float = np.inf) -> Array:
        """Return gaps of its conditions, as ``gap=`` and the geometry have them, shape ``(n,)``.

        No search, no integral: a given gap is taken at the nodes, which is the mean of its linear
        interpolant.

        Args:
            dofs: Dof maps.
            records: The conditions, of any ``gap=``.
            depth: A given gap replaces that of the geometry up to this one.

        Raises:
            InputError: A given gap is no number somewhere, or surfaces overlap too deep.
        """
        if self.gap == CURVED:
            return records.curved_gap
        if self.gap == GEOMETRY:
            return records.geometric_gap
        with raised_on_all_ranks(dofs.comm):
            given = numbers_at(f"{self.name}: gap", self.gap, group_points(dofs)[records.group])
        return np.where(records.geometric_gap <= depth, given, records.geometric_gap)

    def _with_gaps_and_friction(
        self, dofs: TornDofs, records: ContactRecords, reach: float, depth: float
    ) -> ContactRecords:
        """Complete the conditions that the geometry has made."""
        records = with_friction(self.name, self.friction, records, dofs)
        gap = self.gaps(dofs, records, depth)
        return replace(records, gap=gap, within_reach=gap <= reach)

    def _check_gap(self) -> None:
        gap = self.gap
        number = isinstance(gap, Real) and not isinstance(gap, bool) and np.isfinite(float(gap))
        known = isinstance(gap, str) and gap in (GEOMETRY, CURVED)
        if not (number or callable(gap) or known):
            raise InputError(
                f'{self.name}: gap={gap!r}, expected "geometry", "curved", a finite length '
                "(negative: interference), or a function of points of shape (3, n)"
            )


# --- Lists of contacts ------------------------------------------------------------------------


def position_of(contacts: Sequence[ContactPartner], which: int | str) -> int:
    """Return the position of a contact, given that or its name; raise an InputError else."""
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


def gaps_by_position(
    contacts: Sequence[ContactPartner], gaps: Mapping[int | str, Gap]
) -> dict[int, Gap]:
    """Return gaps by position of contacts that are given by position or name, each once."""
    checked_type(gaps, Mapping, "gap", "a dictionary from contacts to gaps")
    found: dict[int, Gap] = {}
    for which, gap in gaps.items():
        position = position_of(contacts, which)
        if position in found:
            raise InputError(f"gap: contact {position} is there twice, by position and by name")
        found[position] = gap
    return found


def checked_contacts(contacts: Sequence[ContactPartner]) -> list[ContactPartner]:
    """Return the contacts as a list; raise an InputError unless they are obstacles and pairs."""
    if not isinstance(contacts, Sequence):
        raise InputError(f"contacts: expected a list, got {shown(contacts)}")
    for contact in contacts:
        if not isinstance(contact, ContactPartner):
            raise InputError(f"contacts: expected obstacles and pairs, got {shown(contact)}")
    return list(contacts)


def check_together(contacts: Sequence[ContactPartner], decomposition: Decomposition) -> None:
    """Raise an InputError where a pair is there twice, or a surface slides by different laws."""
    pairs, obstacles = set(), dict[int, ContactPartner]()
    for contact in contacts:
        tags = frozenset(decomposition.surface(name) for name in contact.surfaces)
        if len(tags) == 2 and tags in pairs:
            raise InputError(f"contacts: the pair of {contact.surfaces} is there twice")
        pairs.add(tags)
        if len(tags) > 1 or contact.friction is None:
            continue
        first = obstacles.setdefault(min(tags), contact)
        if first.friction is not None and not first.friction.is_same_as(contact.friction):
            raise InputError(
                f"{contact.name}: the same surface has another law of friction in {first.name}; "
                "expected one law for a surface, or surfaces of their own"
            )
