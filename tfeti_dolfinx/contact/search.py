"""The search for contact conditions of obstacles and pairs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, count_over, maxima, summed
from tfeti_dolfinx.contact.friction import friction_values
from tfeti_dolfinx.contact.partner import ContactPartner, Gap, Obstacle, check_together
from tfeti_dolfinx.contact.records import ContactRecords, concatenate, relative_displacement
from tfeti_dolfinx.contact.rigid_body import RigidBody, has_facets
from tfeti_dolfinx.contact.shapes import distance_and_gradient
from tfeti_dolfinx.contact.tools import Tools
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.forms.assembly import Data
from tfeti_dolfinx.forms.dirichlet import Prescribed, prescribe
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import diameter, group_points
from tfeti_dolfinx.mortar.tolerances import SEARCH

# how far was searched in each contact, and the owned groups whose nodes have rows
KnownRows = tuple[list[float], list[Array]]


class ContactSearch:
    """Conditions of all contacts. Creation and all methods are collective.

    Conditions out of a contact's reach have no rows at first; ``take_in_overlapping`` gives them to
    those that a displacement violates, ``widen`` to those that may hold a body yet. Creation raises
    an InputError where a pair is there twice, or a contact raises it. ``stiffness`` is the block of
    K of each primal node, shape ``(num_nodes, bs, bs)``; without it sides are decided. ``origin``
    has the displacements in primal order at which nodes and facets are, by default 0: gaps are
    those of the total one. Obstacles meet nodes, pairs facets, which a mesh of degree 1 has
    straight where u is of degree 2. Tools are where they are placed. Without ``prescribed``
    no component is.

    Attributes:
        contacts: The contacts with their sides decided: of a pair the secondary one comes first.
        length: Length of the scene.
        records: All conditions of this rank; those ``within_reach`` get rows.
    """

    def __init__(
        self,
        contacts: Sequence[ContactPartner],
        dofs: TornDofs,
        stiffness: Array | None,
        origin: Array | None = None,
        tools: Tools | None = None,
        prescribed: Prescribed | None = None,
    ) -> None:
        self._dofs, self._origin = dofs, origin
        self._tools = Tools(contacts, dofs) if tools is None else tools
        self._prescribed = prescribe(dofs, []) if prescribed is None else prescribed
        decomposition = dofs.decomposition
        self.length = bcast_from_root(dofs.comm, diameter(decomposition))
        reach = [contact.first_reach(decomposition) for contact in contacts]
        self._depths = bcast_from_root(dofs.comm, reach)
        self._reach = list(self._depths)
        check_together(contacts, decomposition)
        found = [
            contact.with_sides(dofs, i, self._reach[i], stiffness, self._prescribed)
            for i, contact in enumerate(contacts)
        ]
        self.contacts = [contact for contact, _ in found]
        self._records = [self._from_origin(i, records) for i, (_, records) in enumerate(found)]
        # beside the conditions that they were found with, some up to a larger reach
        self._wide: dict[int, tuple[ContactRecords, ContactRecords, float]] = {}
        self._own_shapes = [
            (contact.name, contact.shape, records.group)
            for contact, records in zip(self.contacts, self._records, strict=True)
            # laws move rigid bodies, and nothing moves a mesh
            if isinstance(contact, Obstacle)
            and not (isinstance(contact.shape, RigidBody) or has_facets(contact.shape))
        ]
        self._shapes = Data(self._of_shapes, dofs.comm)
        self.shapes_have_changed()  # from here on

    @cached_property
    def _nodes(self) -> list[list[Array]]:
        """Primal nodes of the surfaces of each contact."""
        dofs, facets = self._dofs, self._dofs.decomposition.facets
        return [[np.unique(dofs.facet_nodes(facets(s))) for s in c.surfaces] for c in self.contacts]

    @property
    def records(self) -> ContactRecords:
        """All conditions of this rank."""
        return concatenate(self._records, self._dofs.bs)

    def friction(self) -> Array:
        """Bounds or coefficients along tangents, ``(n, gdim - 1)``, 0 without a law."""
        none = np.zeros((0, self._dofs.bs - 1))
        pairs = zip(self.contacts, self._records, strict=True)
        found = [friction_values(c.name, c.friction, records, self._dofs) for c, records in pairs]
        return np.concatenate([none, *found])

    def set_gaps(self, gaps: Mapping[int, Gap]) -> None:
        """Give contacts, by position, another ``gap=``; their conditions stay, but for their gaps.

        Conditions within reach stay those, so that rows of B stay; others are looked at by
        ``take_in_overlapping``, as ever. Raise an InputError where a gap does not fit, or that of
        the geometry overlaps too deep; nothing has changed then.
        """
        given = enumerate(self.contacts)
        contacts = [c.with_gap(gaps[i]) if i in gaps else c for i, c in given]
        self._take_gaps(contacts, gaps)
        self.contacts = contacts

    def read_gaps(self) -> bool:
        """Take the values that functions have as gaps now; return whether one is new.

        Raise as ``set_gaps``.
        """
        varying = [i for i, contact in enumerate(self.contacts) if callable(contact.gap)]
        return bool(varying) and self._take_gaps(self.contacts, varying)

    def _take_gaps(self, contacts: Sequence[ContactPartner], which: Iterable[int]) -> bool:
        """Take gaps of some contacts as they are now; return whether one is new."""
        records, changed = list(self._records), False
        for i in which:
            values = contacts[i].gaps(self._dofs, records[i], self._depths[i])
            records[i] = self._from_origin(i, replace(records[i], gap=values))
            changed |= not np.array_equal(records[i].gap, self._records[i].gap)
        if changed := any_rank(self._dofs.comm, changed):
            self._records = records
        return changed

    def shapes_have_changed(self) -> bool:
        """Return whether shapes of obstacles are others at the nodes than when last asked.

        A function that a user has given may depend on what changes. Raise an InputError where it
        fails.
        """
        return bool(self._own_shapes) and self._shapes.has_changed()

    def _of_shapes(self) -> list[Array]:
        """Return distances and gradients of shapes at nodes of their surfaces."""
        points = group_points(self._dofs)
        with raised_on_all_ranks(self._dofs.comm):
            found = [
                distance_and_gradient(shape, points[group], name)
                for name, shape, group in self._own_shapes
            ]
        return [array for both in found for array in both]

    def rows(self) -> KnownRows:
        """Return the rows that conditions have."""
        return list(self._reach), [r.group[r.within_reach] for r in self._records]

    def move(self) -> None:
        """Let rigid bodies be where their laws have them now."""
        self._records = [replace(r, motion=self._tools.motion(r)) for r in self._records]

    def take_rows(self, reach: Sequence[float], groups: Sequence[Array]) -> None:
        """Have the rows that an earlier search of the same scene had, as ``rows`` said."""
        for i, known in enumerate(self._records):
            found = known if reach[i] <= self._reach[i] else self._search(i, reach[i])
            self._records[i] = replace(found, within_reach=np.isin(found.group, groups[i]))
            self._reach[i] = max(reach[i], self._reach[i])

    def take_in_overlapping(self, u: Array, tolerance: float) -> int:
        """Give rows to conditions without one that u, in primal order, violates by a length.

        Where surfaces have moved farther than the search went, it is done again. Return how many
        rows are new, on all ranks.
        """
        way = u if self._origin is None else u - self._origin[1]
        comm, count = self._dofs.comm, 0
        for i, contact in enumerate(self.contacts):
            moved = 0.0
            if len(contact.surfaces) > 1:
                moved = self._approach(self._nodes[i], way.reshape(-1, self._dofs.bs))
            tried = [(self._records[i], self._reach[i])]
            if moved > self._reach[i]:
                # conditions up to twice the way, kept for the next ways while those near stay
                known, wide, reach = self._wide.get(i, (None, self._records[i], 0.0))
                if known is not self._records[i] or reach < moved:
                    wide = self._search(i, 2.0 * moved)
                    self._wide[i] = self._records[i], wide, 2.0 * moved
                if count_over(comm, self._overlapping(wide, u, tolerance) & ~wide.within_reach):
                    tried.insert(0, (self._search(i, moved), moved))
            for found, reach in tried:
                overlaps = self._overlapping(found, u, tolerance)
                if new := count_over(comm, overlaps & ~found.within_reach):
                    self._records[i] = replace(found, within_reach=found.within_reach | overlaps)
                    self._reach[i] = reach
                    count += new
                    break
        return count

    def _overlapping(self, found: ContactRecords, u: Array, tolerance: float) -> Array:
        there = found
        if self._tools:
            there = replace(found, motion=self._tools.motion(found, found=True))
        v = relative_displacement(there, self._dofs, u)
        return np.asarray(found.gap - np.sum(found.normal * v, axis=1) < -tolerance)

    def widen(self) -> int:
        """Increase the reach until a condition gets a row, since far contact may hold a body.

        Return how many rows are new, on all ranks; 0 where nothing is left to find.
        """
        comm = self._dofs.comm
        while True:
            new, left = 0, False
            for i, contact in enumerate(self.contacts):
                found, before = self._records[i], count_over(comm, self._records[i].within_reach)
                searched = len(contact.surfaces) == 1 or self._reach[i] >= self.length
                if searched and count_over(comm, ~found.within_reach) == 0:
                    continue  # all nodes have their rows
                reach = max(SEARCH.wider * self._reach[i], SEARCH.least * self.length)
                if not searched:
                    found = self._search(i, reach)
                distance = found.gap if self._origin is None else found.geometric_gap
                within = found.within_reach | (distance <= reach)
                self._reach[i], self._records[i] = reach, replace(found, within_reach=within)
                new, left = new + count_over(comm, within) - before, True
            if new or not left:
                return new

    def unmet(self) -> list[str]:
        """Contacts none of whose nodes has a row: position in the list, and name."""
        rows = np.array([np.sum(known.within_reach) for known in self._records], dtype=np.int64)
        return self.named(np.flatnonzero(summed(self._dofs.comm, rows) == 0))

    def named(self, positions: Iterable[int] | Array) -> list[str]:
        """Contacts as reports name them: position in the list, and name."""
        return [f"{i}: {self.contacts[i].name}" for i in positions]

    def _approach(self, nodes: Sequence[Array], u: Array) -> float:
        """Sum of both surfaces' largest displacements against their common mean, on all ranks."""
        comm, moved = self._dofs.comm, [u[at] for at in nodes]
        own = np.sum([np.append(part.sum(axis=0), len(part)) for part in moved], axis=0)
        *total, count = summed(comm, own)
        squares = [np.sum((u - np.divide(total, count)) ** 2, axis=1) for u in moved]
        largest = maxima(comm, np.sqrt([square.max(initial=0.0) for square in squares]))
        return bcast_from_root(comm, float(largest.sum()))

    def _search(self, i: int, reach: float) -> ContactRecords:
        """Conditions up to a larger reach, of which those have rows that had them before."""
        known = self._records[i]
        found = self.contacts[i].records(self._dofs, i, reach, self._depths[i], self._prescribed)
        had_rows = np.isin(found.group, known.group[known.within_reach])
        return replace(self._from_origin(i, found), within_reach=had_rows)

    def _from_origin(self, i: int, found: ContactRecords) -> ContactRecords:
        """Conditions of contact i with the gaps of the total displacement."""
        found = replace(found, motion=self._tools.motion_there(found))  # at their places
        way = -found.motion
        if self._origin is not None:
            nodes, facets = self._origin
            here = facets if len(self.contacts[i].surfaces) > 1 else nodes
            way = relative_displacement(found, self._dofs, here)
        return replace(found, gap=found.gap + np.sum(found.normal * way, axis=1))
