"""Contact between surfaces of two bodies, by dual mortar multipliers."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.candidates import candidate_pairs, rendezvous
from tfeti_dolfinx.contact.conditions import conditions, triplets
from tfeti_dolfinx.contact.facets import Facets, facet_kind, local_facets, with_averaged_normals
from tfeti_dolfinx.contact.mortar import Segments, find_segments, hat_areas, integrate
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.contact.surfaces import extent, surface_facets, surface_nodes
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs

REACH = 0.05
# One looks farther than the search radius: else facets at its edge would be covered partly,
# and an overlap that is too deep would not be seen.
SEEN = 3.0
DEGENERATE = 1e-12  # of the square (in 2D: of the length) of a facet's radius
CREASE = 0.75  # facets that make more than about 40 degrees with the averaged normal

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Contact:
    """Two surfaces may not enter each other.

    Surfaces should be smooth: the sides of an edge are surfaces, and pairs, of their own.

    Args:
        secondary: Name or tag of the surface that carries the multipliers and the pressure;
            better that of the softer body, or of the coarser mesh.
        primary: Name or tag of the other surface.
        search_radius: Surfaces farther apart than this make no rows at first; after the solve it
            is checked that none of them has come to overlap. Default: 5 % of the smaller
            surface's extent.
    """

    secondary: str | int
    primary: str | int
    search_radius: float | None = None

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"contact of {self.secondary!r} with {self.primary!r}"

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Both surfaces."""
        return self.secondary, self.primary

    def first_radius(self, decomposition: Decomposition) -> float:
        """The search radius to begin with. Collective.

        Raises:
            InputError: A surface is unknown or empty, both are the same, or the radius is not
                positive.
        """
        try:
            facets = [
                surface_facets(decomposition, name) for name in (self.secondary, self.primary)
            ]
        except InputError as error:  # on all ranks
            raise InputError(f"{self.name}: {error}") from error
        if decomposition.surface(self.secondary) == decomposition.surface(self.primary):
            raise InputError(
                f"{self.name}: both are the same surface; contact of a surface with itself is "
                "not supported, give its two sides different names"
            )
        if self.search_radius is None:
            return REACH * min(extent(decomposition, surface) for surface in facets)
        if not 0.0 < self.search_radius < np.inf:
            raise InputError(
                f"{self.name}: search_radius={self.search_radius}, expected a positive length"
            )
        return float(self.search_radius)

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
            for name in (self.secondary, self.primary)
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
        radius: float,
        depth: float,
    ) -> ContactRecords:
        """One condition per secondary node that faces the primary surface. Collective.

        With D_i = ∫ψ_i over the covered part and n_i the averaged normal the condition is
        n_i · (Σ_k D_ik u_k − Σ_j M_ij u_j)/D_i ≤ g_i, g_i the mean gap weighted with ψ_i.

        Args:
            dofs: Dof maps.
            decomposition: The torn mesh.
            contact: Index of the contact.
            radius: Conditions with a larger gap are not near; those with a gap three times as
                large are not made.
            depth: Largest initial overlap.

        Raises:
            InputError: The surfaces overlap by more than ``depth`` (they are looked at up to three
                times as deep), face away from each other, or have facets without area.
        """
        kind, comm = facet_kind(dofs), decomposition.comm
        v = kind.num_vertices
        secondary, normals, primary = self._sides(dofs, decomposition, v)
        reach = SEEN * max(radius, depth)
        near_s, near_p = rendezvous(secondary, primary, reach, comm)
        with raised_on_all_ranks(comm):
            pairs = candidate_pairs(near_s, near_p, reach)
            segments = find_segments(
                kind, near_s, near_p, pairs, depth=SEEN * depth, reach=SEEN * radius
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
            nodes=secondary.groups[:, :v],
            areas=hat_areas(kind, secondary),
            normals=normals,
        )
        self._check_depth(found, depth, comm)
        return replace(found, near=found.gap <= radius)

    def _sides(
        self, dofs: TornDofs, decomposition: Decomposition, num_vertices: int
    ) -> tuple[Facets, Array, Facets]:
        """Secondary facets, averaged normals of the owned groups, primary facets. Collective."""
        sides = []
        for name in (self.secondary, self.primary):
            facets = local_facets(dofs, decomposition, surface_facets(decomposition, name))
            whole = facets.radius ** (facets.x.shape[2] - 1)
            flat = int(np.sum(facets.area <= DEGENERATE * whole))
            if count := decomposition.comm.allreduce(flat):
                raise InputError(f"{self.name}: {count} facets of {name!r} have no area")
            sides.append(facets)
        secondary, normals = with_averaged_normals(sides[0], dofs, num_vertices)
        cosine = np.einsum("nvg,ng->nv", secondary.vertex_normals, secondary.normal)
        if decomposition.comm.allreduce(int(np.sum(cosine < CREASE))) and not dofs.comm.rank:
            log.warning(
                "%s: %r has edges; normals are averaged there. Give the sides of an edge names of "
                "their own, and a pair each",
                self.name,
                self.secondary,
            )
        return secondary, normals, sides[1]

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
                f"{self.name}: the surfaces overlap by up to {deepest:.6g}, more than the search "
                f"radius {depth:.6g}; expected bodies that are apart, or a larger search_radius"
            )
