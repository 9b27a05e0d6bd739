"""Contact between surfaces of two bodies, by dual mortar multipliers."""

from __future__ import annotations

import logging
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.citations import cite
from tfeti_dolfinx.contact.arguments import Gap, checked_gap, checked_reach, give_name, given_gaps
from tfeti_dolfinx.contact.conditions import conditions, triplets
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.contact.sides import Side, side_of, stiffness_ratio
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.candidates import candidate_pairs, rendezvous
from tfeti_dolfinx.mortar.facets import facet_kind
from tfeti_dolfinx.mortar.integrals import integrate
from tfeti_dolfinx.mortar.segments import Segments, find_segments
from tfeti_dolfinx.mortar.surfaces import (
    diameter,
    extent,
    group_points,
    surface_facets,
    surface_nodes,
)

# One looks farther than the reach: else facets at its edge would be covered partly, and an overlap
# that is too deep would not be seen.
SEEN = 3.0
# ratios of stiffness per area: up to the first, rounding must not decide; from the second on, the
# choice of the secondary side shows in the pressure
EQUAL, MUCH_WORSE = 1.01, 2.0

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
class Contact:
    """Two surfaces may not enter each other.

    Surfaces should be smooth: the sides of an edge are surfaces, and pairs, of their own.

    Args:
        a: Name or tag of a surface.
        b: Name or tag of the other one.
        secondary: The surface that carries the multipliers and the pressure, ``a`` or ``b``.
            "auto": the softer one, by the stiffness per area of its elements, E/h.
        gap: "geometry" for the distance between the surfaces, or what replaces it wherever they
            are not farther apart than the reach (negative: interference): a number, or a function
            of the secondary surface's vertices, shape ``(3, n)``.
        reach: Surfaces farther apart than this make no rows at first; after the solve it is
            checked that none of them has come to overlap. Default: 5 % of the smaller surface's
            extent.
        name: For messages and ``solution.contact(name)``. Default: "contact of 'a' with 'b'".

    Example:
        >>> tfeti.Contact("shaft", "hub", gap=-1e-3, secondary="hub").name
        "contact of 'shaft' with 'hub'"
    """

    a: str | int
    b: str | int
    _: KW_ONLY
    secondary: str | int = "auto"
    gap: Gap = "geometry"
    reach: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        give_name(self, f"contact of {self.a!r} with {self.b!r}")

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Both surfaces; where the sides are settled, the secondary one first."""
        return self.a, self.b

    def first_reach(self, decomposition: Decomposition) -> float:
        """The reach to begin with. Collective.

        Raises:
            InputError: A surface is unknown or empty, both are the same, or secondary, gap or
                reach do not fit.
        """
        try:
            facets = [surface_facets(decomposition, name) for name in self.surfaces]
        except InputError as error:  # on all ranks
            raise InputError(f"{self.name}: {error}") from error
        if decomposition.surface(self.a) == decomposition.surface(self.b):
            raise InputError(
                f"{self.name}: both are the same surface; contact of a surface with itself is "
                "not supported, give its two sides different names"
            )
        self._named_first(decomposition)
        checked_gap(self.name, self.gap)
        size = min(extent(decomposition, surface) for surface in facets)
        return min(checked_reach(self.name, self.reach, size), diameter(decomposition))

    def horizon(self, length: float) -> float:
        """The length of the scene: no two facets are farther apart."""
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
            reach: Conditions with a larger gap are not near.
            stiffness: Diagonal of K in primal order, shape ``(num_nodes * bs,)``.

        Raises:
            InputError: As ``records``.
        """
        cite("mortar")
        settled = self._named_first(decomposition)
        sides = settled._sides(dofs, decomposition)
        found = settled._meet(sides, dofs, contact, reach, reach)
        ratio = stiffness_ratio(found, sides, dofs, stiffness)
        if self.secondary == "auto" and ratio > EQUAL:
            settled, sides, ratio = settled._exchanged(), (sides[1], sides[0]), 1.0 / ratio
            found = settled._meet(sides, dofs, contact, reach, reach)
        edges = sides[0].has_edges(dofs.comm)
        if ratio > MUCH_WORSE and dofs.comm.rank == 0:
            log.warning(WORSE, self.name, settled.a, ratio, settled.b, settled.b)
        if edges and dofs.comm.rank == 0:
            log.warning(EDGES, self.name, settled.a)
        return settled, found

    def displacement_bound(self, dofs: TornDofs, decomposition: Decomposition, u: Array) -> float:
        """How far the surfaces may have moved towards each other. Collective.

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
        reach: float,
        depth: float,
    ) -> ContactRecords:
        """One condition per node of ``a`` that faces ``b``. Collective.

        With D_i = ∫ψ_i over the covered part and n_i the averaged normal the condition is
        n_i · (Σ_k D_ik u_k − Σ_j M_ij u_j)/D_i ≤ g_i, g_i the mean gap weighted with ψ_i. A given
        gap is taken at the nodes: that is the mean of its linear interpolant.

        Args:
            dofs: Dof maps.
            decomposition: The torn mesh.
            contact: Index of the contact.
            reach: Conditions with a larger gap are not near; those of surfaces three times as
                far apart are not made.
            depth: Largest initial overlap of the geometry, and how far a given gap replaces it.

        Raises:
            InputError: The surfaces overlap by more than ``depth`` (they are looked at up to three
                times as deep), face away from each other, or have facets without area; or a given
                gap is no number somewhere.
        """
        sides = self._sides(dofs, decomposition)
        return self._meet(sides, dofs, contact, reach, depth)

    def _sides(self, dofs: TornDofs, decomposition: Decomposition) -> tuple[Side, Side]:
        a, b = (side_of(self.name, side, dofs, decomposition) for side in self.surfaces)
        return a, b

    def _meet(
        self, sides: tuple[Side, Side], dofs: TornDofs, contact: int, reach: float, depth: float
    ) -> ContactRecords:
        """The conditions; arguments as of ``records``. Collective."""
        kind, comm = facet_kind(dofs), dofs.comm
        v, secondary, primary = kind.num_vertices, sides[0].facets, sides[1].facets
        seen = SEEN * max(reach, depth)
        near_s, near_p = rendezvous(secondary, primary, seen, comm)
        with raised_on_all_ranks(comm):
            pairs = candidate_pairs(near_s, near_p, seen)
            segments = find_segments(
                kind, near_s, near_p, pairs, depth=SEEN * depth, reach=SEEN * reach
            )
            integrals = integrate(kind, near_s, near_p, segments)
        self._check_facing(segments, comm)
        entries = (
            triplets(
                near_s.groups[integrals.facet, :v], near_s.groups[integrals.facet], integrals.own
            ),
            triplets(
                near_s.groups[integrals.pair_secondary, :v],
                near_p.groups[integrals.pair_primary],
                -integrals.other,
            ),
        )
        found = conditions(
            dofs=dofs,
            contact=contact,
            multipliers=near_s.groups[integrals.facet, :v],
            covered=integrals.covered,
            gaps=integrals.gap,
            entries=entries,
            nodes=sides[0].vertices,
            areas=sides[0].areas,
            normals=sides[0].normals,
            bounds=(integrals.lowest, integrals.highest),
        )
        x, within = group_points(dofs)[found.group], found.gap <= depth
        with raised_on_all_ranks(comm):
            given = given_gaps(self.name, self.gap, x)
        if given is None:
            self._check_depth(found, depth, comm)
        else:
            found = replace(found, gap=np.where(within, given, found.gap))
        return replace(found, near=found.gap <= reach)

    def _named_first(self, decomposition: Decomposition) -> Contact:
        """The contact with the side that is named as secondary as ``a``."""
        if self.secondary == "auto":
            return self
        tags = [decomposition.surface(name) for name in self.surfaces]
        try:
            named = tags.index(decomposition.surface(self.secondary))
        except (InputError, ValueError, TypeError):
            raise InputError(
                f'{self.name}: secondary={self.secondary!r}, expected one of its surfaces or "auto"'
            ) from None
        return self._exchanged() if named else self

    def _exchanged(self) -> Contact:
        return replace(self, a=self.b, b=self.a)

    def _check_facing(self, segments: Segments, comm: MPI.Intracomm) -> None:
        averted = comm.allreduce(int(segments.averted))
        if averted and comm.allreduce(len(segments.weight)) == 0:
            raise InputError(
                f"{self.name}: the surfaces are near but face away from each other; expected "
                "outward normals that oppose each other"
            )

    def _check_depth(self, found: ContactRecords, depth: float, comm: MPI.Intracomm) -> None:
        deepest = -comm.allreduce(float(found.gap.min(initial=0.0)), op=MPI.MIN)
        if deepest > depth:
            raise InputError(
                f"{self.name}: the surfaces overlap by up to {deepest:.6g}, more than the reach "
                f"{depth:.6g}; expected bodies that are apart, a larger reach, or a gap="
            )
