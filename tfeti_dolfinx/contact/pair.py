"""Contact between surfaces of two bodies, by dual mortar multipliers."""

from __future__ import annotations

import logging
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.contact.conditions import Side, conditions, meeting, ratios, side_of
from tfeti_dolfinx.contact.partner import ContactPartner
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import diameter, surface_facets, surface_nodes
from tfeti_dolfinx.mortar.tolerances import SEARCH

WORSE = (
    "%s: the secondary side %r is %.3g times as stiff per area as %r, where they meet; the "
    "pressure would be better with secondary=%r"
)
EDGES = (
    "%s: %r has edges; normals are averaged there. Give the sides of an edge names of their own, "
    "and a pair each"
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Contact(ContactPartner):
    """Two surfaces may not enter each other.

    Surfaces should be smooth: the sides of an edge are surfaces, and pairs, of their own.

    Args:
        a: Name or tag of a surface.
        b: Name or tag of the other one.
        secondary: The surface that carries the multipliers and the pressure, ``a`` or ``b``.
            "auto": the one with the coarser mesh where they meet; where both are of one size
            (to 12 %), the softer one, by the stiffness per area of its elements, E/h.
        gap: "geometry" for the distance between the facets; "curved" for that between smooth
            surfaces fitted to straight facets, as pins and bearings need it; or what replaces the
            distance where it is at most the reach (negative: interference): a number, or a
            function of the secondary surface's vertices, shape ``(3, n)``.
        friction: ``Tresca``, ``Coulomb``, or None.
        reach: Surfaces farther apart than this make no rows at first; those that have come to
            overlap after the solve get theirs, and the solve goes on. Default: 5 % of the smaller
            surface's extent.
        name: For messages and ``solution.contact(name)``. Default: "contact of 'a' with 'b'".

    Example:
        >>> tfeti.Contact("shaft", "hub", gap=-1e-3, secondary="hub").name
        "contact of 'shaft' with 'hub'"
    """

    a: str | int
    b: str | int
    _: KW_ONLY
    secondary: str | int = "auto"

    def __post_init__(self) -> None:
        self._check_data(f"contact of {self.a!r} with {self.b!r}")

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Both surfaces; where the sides are settled, the secondary one first."""
        return self.a, self.b

    def first_reach(self, decomposition: Decomposition) -> float:
        """Return the reach to begin with. Collective.

        Raises:
            InputError: A surface is unknown or empty, both are the same, or secondary, gap or
                reach do not fit.
        """
        try:
            for name in self.surfaces:
                surface_facets(decomposition, name)
        except InputError as error:  # on all ranks
            raise InputError(f"{self.name}: {error}") from error
        if decomposition.surface(self.a) == decomposition.surface(self.b):
            raise InputError(
                f"{self.name}: both are the same surface; contact of a surface with itself is "
                "not supported, give its two sides different names"
            )
        self._named_first(decomposition)
        return min(super().first_reach(decomposition), diameter(decomposition))

    def horizon(self, length: float) -> float:
        """Return the length of the scene: no two facets are farther apart."""
        return length

    def settled(
        self,
        dofs: TornDofs,
        decomposition: Decomposition,
        contact: int,
        reach: float,
        stiffness: Array,
    ) -> tuple[Contact, ContactRecords]:
        """The contact with its secondary side decided, as ``a``, and its conditions. Collective.

        Args:
            dofs: Dof maps.
            decomposition: The torn mesh.
            contact: Index of the contact.
            reach: Conditions with a larger gap are out of reach.
            stiffness: Block of K of each primal node, shape ``(num_nodes, bs, bs)``.

        Raises:
            InputError: As ``records``.
        """
        cite("mortar")
        settled = self._named_first(decomposition)
        sides = settled._sides(dofs, decomposition)
        found = settled._meet(sides, dofs, contact, reach, reach)
        compared = ratios(found, sides, dofs, stiffness)
        if self.secondary == "auto" and compared.second_is_better():
            settled, sides = replace(settled, a=settled.b, b=settled.a), sides[::-1]
            compared = compared.exchanged
            found = settled._meet(sides, dofs, contact, reach, reach)
        edges = sides[0].has_edges(dofs.comm)
        ratio = compared.stiffness
        if compared.finer and ratio > SEARCH.much_stiffer and dofs.comm.rank == 0:
            log.warning(WORSE, self.name, settled.a, ratio, settled.b, settled.b)
        if edges and dofs.comm.rank == 0:
            log.warning(EDGES, self.name, settled.a)
        return settled, found

    def displacement_bound(self, dofs: TornDofs, decomposition: Decomposition, u: Array) -> float:
        """Bound how far the surfaces have moved towards each other. Collective.

        Args:
            dofs: Dof maps.
            decomposition: The torn mesh.
            u: Displacement in primal order, shape ``(num_nodes, gdim)``.

        Returns:
            Largest displacements of both surfaces, against their common mean, added up.
        """
        comm = decomposition.comm
        moved = [
            u[surface_nodes(dofs, decomposition, decomposition.facets(name))]
            for name in self.surfaces
        ]
        total = comm.allreduce(np.sum([part.sum(axis=0) for part in moved], axis=0))
        mean = total / comm.allreduce(sum(len(part) for part in moved))
        largest = [np.linalg.norm(part - mean, axis=1).max(initial=0.0) for part in moved]
        return sum(comm.allreduce(float(size), op=MPI.MAX) for size in largest)

    def records(
        self,
        dofs: TornDofs,
        decomposition: Decomposition,
        contact: int,
        reach: float = np.inf,
        depth: float = np.inf,
    ) -> ContactRecords:
        """One condition per node of ``a`` that faces ``b``. Collective.

        With D_i = ∫ψ_i over the covered part and n_i the averaged normal the condition is
        n_i · (Σ_k D_ik u_k − Σ_j M_ij u_j)/D_i ≤ g_i, g_i the mean gap weighted with ψ_i.

        Args:
            dofs: Dof maps.
            decomposition: The torn mesh.
            contact: Index of the contact.
            reach: Conditions with a larger gap are out of reach; those of surfaces three times as
                far apart are not made.
            depth: Largest initial overlap of the geometry, and how far a given gap replaces it.

        Raises:
            InputError: The surfaces overlap by more than ``depth`` (they are looked at up to three
                times as deep), face away from each other, or have facets without area; a given
                gap is no number somewhere; or the friction does not fit.
        """
        sides = self._sides(dofs, decomposition)
        return self._meet(sides, dofs, contact, reach, depth)

    def gaps(self, dofs: TornDofs, records: ContactRecords, depth: float = np.inf) -> Array:
        """Return gaps of its conditions, as ``gap=`` and the geometry have them. Collective.

        Args:
            dofs: Dof maps.
            records: The conditions, of any ``gap=``.
            depth: Largest initial overlap of the geometry, and how far a given gap replaces it.

        Raises:
            InputError: The surfaces overlap by more than ``depth`` and no gap is given, or it is
                no number somewhere.
        """
        found = super().gaps(dofs, records, depth)
        deepest = -dofs.comm.allreduce(float(found.min(initial=0.0)), op=MPI.MIN)
        if isinstance(self.gap, str) and deepest > depth:
            raise InputError(
                f"{self.name}: the surfaces overlap by up to {deepest:.6g}, more than the reach "
                f"{depth:.6g}; expected bodies that are apart, a larger reach, or a gap="
            )
        return found

    def _sides(self, dofs: TornDofs, decomposition: Decomposition) -> tuple[Side, Side]:
        if dofs.bs != decomposition.mesh.geometry.dim:
            raise InputError(
                f"{self.name}: the space is scalar; expected displacements of "
                f"{decomposition.mesh.geometry.dim} components, since surfaces meet along normals"
            )
        a, b = (side_of(self.name, side, dofs, decomposition) for side in self.surfaces)
        return a, b

    def _meet(
        self, sides: tuple[Side, Side], dofs: TornDofs, contact: int, reach: float, depth: float
    ) -> ContactRecords:
        """Return the conditions; arguments as of ``records``. Collective."""
        shares = meeting(self.name, sides, dofs, reach, depth)
        found = conditions(dofs, contact, sides[0], shares)
        return self._with_gaps_and_friction(dofs, found, reach, depth)

    def _named_first(self, decomposition: Decomposition) -> Contact:
        """Return the contact with the side that is named as secondary as ``a``."""
        if self.secondary == "auto":
            return self
        tags = [decomposition.surface(name) for name in self.surfaces]
        try:
            named = tags.index(decomposition.surface(self.secondary))
        except (InputError, ValueError, TypeError):
            raise InputError(
                f'{self.name}: secondary={self.secondary!r}, expected one of its surfaces or "auto"'
            ) from None
        return replace(self, a=self.b, b=self.a) if named else self
