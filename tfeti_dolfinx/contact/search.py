"""All contacts of a problem: their conditions, which of them have rows, and what comes later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import shown
from tfeti_dolfinx.contact.records import ContactRecords, concatenate, remaining_gaps
from tfeti_dolfinx.contact.surfaces import diameter
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs

# how much farther one looks for what may hold a body; of the scene's length at least
WIDER, LEAST = 4.0, 0.01


class ContactPartner(Protocol):
    """An obstacle, or a pair of surfaces. All methods are collective."""

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Names or tags of the surfaces."""
        ...

    def first_radius(self, decomposition: Decomposition) -> float:
        """Distance up to which conditions are made at first."""
        ...

    def displacement_bound(self, dofs: TornDofs, decomposition: Decomposition, u: Array) -> float:
        """How far what lay beyond the radius may have come nearer, u of shape (nodes, bs)."""
        ...

    def records(
        self,
        dofs: TornDofs,
        decomposition: Decomposition,
        contact: int,
        radius: float,
        depth: float,
    ) -> ContactRecords:
        """Conditions up to a distance, and down to a depth of initial overlap."""
        ...


def checked_contacts(contacts: Sequence[ContactPartner]) -> list[ContactPartner]:
    """The contacts as a list.

    Raises:
        InputError: They are not a sequence of obstacles and pairs.
    """
    if not isinstance(contacts, Sequence):
        raise InputError(f"contacts: expected a list, got {shown(contacts)}")
    for contact in contacts:
        known = all(hasattr(contact, name) for name in ("records", "surfaces", "first_radius"))
        if isinstance(contact, type) or not known:
            raise InputError(f"contacts: expected obstacles and pairs, got {shown(contact)}")
    return list(contacts)


class ContactSearch:
    """Conditions of all contacts. Creation and all methods are collective.

    Args:
        contacts: Obstacles and pairs.
        dofs: Dof maps.
        decomposition: The torn mesh.

    Attributes:
        length: Length of the scene.
        records: All conditions of this rank; those that are ``near`` have rows.

    Raises:
        InputError: A pair is there twice, or a contact raises it.
    """

    def __init__(
        self, contacts: Sequence[ContactPartner], dofs: TornDofs, decomposition: Decomposition
    ) -> None:
        self._contacts, self._dofs, self._decomposition = contacts, dofs, decomposition
        self.length = diameter(decomposition)
        self._depths = [contact.first_radius(decomposition) for contact in contacts]
        self._radii = list(self._depths)
        self._check_pairs()
        self._parts = [self._search(i, radius) for i, radius in enumerate(self._radii)]

    @property
    def records(self) -> ContactRecords:
        """All conditions of this rank."""
        return concatenate(self._parts, self._dofs.bs)

    def take_in_overlapping(self, u: Array, tolerance: float) -> int:
        """Give rows to conditions without one that a displacement violates.

        Where surfaces have moved farther than the search went, it is done again.

        Args:
            u: Displacement in primal order, shape ``(num_nodes * bs,)``.
            tolerance: Overlaps up to this are let be.

        Returns:
            How many rows are new, on all ranks.
        """
        late = 0
        for i, contact in enumerate(self._contacts):
            known = self._parts[i]
            moved = contact.displacement_bound(
                self._dofs, self._decomposition, u.reshape(-1, self._dofs.bs)
            )
            found = known
            if moved > self._radii[i]:
                found = self._with_rows_of(self._search(i, moved), known)
            overlaps, new = self._overlapping(found, u, tolerance)
            if new == 0 and found is not known:
                found = known
                overlaps, new = self._overlapping(found, u, tolerance)
            if new:
                self._parts[i] = replace(found, near=found.near | overlaps)
                if found is not known:
                    self._radii[i] = moved
                late += new
        return late

    def _overlapping(self, found: ContactRecords, u: Array, tolerance: float) -> tuple[Array, int]:
        """Conditions that a displacement violates, and how many of them have no row."""
        overlaps = remaining_gaps(found, self._dofs, u) < -tolerance
        return overlaps, self._count(overlaps & ~found.near)

    def widen(self) -> int:
        """Give rows to all conditions, and search farther: what is far may hold a body yet.

        Returns:
            How many rows are new, on all ranks; 0 where nothing is left to search.
        """
        late = 0
        for i, radius in enumerate(self._radii):
            known = self._parts[i]
            if radius < self.length:
                self._radii[i] = min(max(WIDER * radius, LEAST * self.length), self.length)
                known = self._search(i, self._radii[i])
            late += self._count(~known.near) + self._count(known.near)
            late -= self._count(self._parts[i].near)
            self._parts[i] = replace(known, near=np.ones(len(known), dtype=bool))
        return late

    @property
    def is_exhausted(self) -> bool:
        """Whether every node has been looked at, however far it is, and has its row."""
        far = any(radius < self.length for radius in self._radii)
        return not far and sum(self._count(~part.near) for part in self._parts) == 0

    def _check_pairs(self) -> None:
        """Raise if a pair is there twice: its force would be shared between the two."""
        pairs = set()
        for contact in self._contacts:
            tags = frozenset(self._decomposition.surface(name) for name in contact.surfaces)
            if len(tags) == 2 and tags in pairs:
                raise InputError(f"contacts: the pair of {contact.surfaces} is there twice")
            pairs.add(tags)

    def _search(self, index: int, radius: float) -> ContactRecords:
        contact = self._contacts[index]
        return contact.records(self._dofs, self._decomposition, index, radius, self._depths[index])

    def _with_rows_of(self, found: ContactRecords, known: ContactRecords) -> ContactRecords:
        """Conditions of a wider search, near where they had rows before."""
        return replace(found, near=np.isin(found.group, known.group[known.near]))

    def _count(self, flags: Array) -> int:
        return int(self._dofs.comm.allreduce(int(np.sum(flags))))
