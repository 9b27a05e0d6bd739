"""What every contact can do, and checks of the list of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import shown
from tfeti_dolfinx.contact.arguments import Gap
from tfeti_dolfinx.contact.friction import Law, same_law
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs


class ContactPartner(Protocol):
    """An obstacle, or a pair of surfaces. All methods are collective."""

    @property
    def name(self) -> str:
        """Name for messages."""
        ...

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Names or tags of the surfaces, that with the multipliers first."""
        ...

    @property
    def gap(self) -> Gap:
        """What its gaps are: those of the geometry, or given."""
        ...

    @property
    def friction(self) -> Law | None:
        """Its law of friction."""
        ...

    def first_reach(self, decomposition: Decomposition) -> float:
        """Distance up to which conditions have rows at first."""
        ...

    def horizon(self, length: float) -> float:
        """Reach beyond which no search finds more conditions, in a scene of a length."""
        ...

    def settled(
        self,
        dofs: TornDofs,
        decomposition: Decomposition,
        contact: int,
        reach: float,
        stiffness: Array,
    ) -> tuple[ContactPartner, ContactRecords]:
        """The contact with its sides decided from the stiffness, and its conditions."""
        ...

    def displacement_bound(self, dofs: TornDofs, decomposition: Decomposition, u: Array) -> float:
        """How far what lay beyond the reach may have come nearer, u of shape (nodes, bs)."""
        ...

    def records(
        self,
        dofs: TornDofs,
        decomposition: Decomposition,
        contact: int,
        reach: float,
        depth: float,
    ) -> ContactRecords:
        """Conditions up to a distance and beyond, and down to a depth of initial overlap."""
        ...

    def with_gap(self, gap: Gap) -> ContactPartner:
        """The same contact with another gap."""
        ...

    def gaps(self, dofs: TornDofs, records: ContactRecords, depth: float) -> Array:
        """Gaps of conditions that were made with another gap: no search, no integral."""
        ...


def checked_contacts(contacts: Sequence[ContactPartner]) -> list[ContactPartner]:
    """The contacts as a list.

    Raises:
        InputError: They are not a sequence of obstacles and pairs.
    """
    if not isinstance(contacts, Sequence):
        raise InputError(f"contacts: expected a list, got {shown(contacts)}")
    for contact in contacts:
        known = all(hasattr(contact, name) for name in ("records", "surfaces", "first_reach"))
        if isinstance(contact, type) or not known:
            raise InputError(f"contacts: expected obstacles and pairs, got {shown(contact)}")
    return list(contacts)


def check_pairs(contacts: Sequence[ContactPartner], decomposition: Decomposition) -> None:
    """Raise if a pair is there twice: its force would be shared between the two."""
    pairs = set()
    for contact in contacts:
        tags = frozenset(decomposition.surface(name) for name in contact.surfaces)
        if len(tags) == 2 and tags in pairs:
            raise InputError(f"contacts: the pair of {contact.surfaces} is there twice")
        pairs.add(tags)


def check_laws(contacts: Sequence[ContactPartner], decomposition: Decomposition) -> None:
    """Raise if a surface that meets several obstacles slides on them by different laws."""
    found: dict[int, ContactPartner] = {}
    for contact in contacts:
        if len(contact.surfaces) > 1 or contact.friction is None:
            continue
        first = found.setdefault(decomposition.surface(contact.surfaces[0]), contact)
        if first.friction is not None and not same_law(first.friction, contact.friction):
            raise InputError(
                f"{contact.name}: the same surface has another law of friction in {first.name}; "
                "expected one law for a surface, or surfaces of their own"
            )
