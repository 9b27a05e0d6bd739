"""Contact between surfaces of two bodies, by dual mortar multipliers."""

from __future__ import annotations

import logging
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.contact.conditions import Side, conditions
from tfeti_dolfinx.contact.partner import ContactPartner
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import InputError, OverlapError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.curvature import with_curvature
from tfeti_dolfinx.mortar.facets import facet_kind, hat_areas, local_facets, with_averaged_normals
from tfeti_dolfinx.mortar.integrals import integrate
from tfeti_dolfinx.mortar.segments import find_segments, possible_pairs, rendezvous
from tfeti_dolfinx.mortar.surfaces import diameter, surface_facets
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
        """Return the reach to begin with, and check the surfaces. Collective."""
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

    def settled(
        self, dofs: TornDofs, contact: int, reach: float, stiffness: Array
    ) -> tuple[Contact, ContactRecords]:
        """Return the contact with its secondary side as ``a``, and its conditions. Collective.

        The secondary side is that which is named, else the one with the coarser mesh; where meshes
        are of one size, the softer one; of equal ones the first.
        """
        cite("mortar")
        settled = self._named_first(dofs.decomposition)
        sides = settled._sides(dofs)
        found = settled._meet(sides, dofs, contact, reach, reach)
        size, per_area = _ratios(found, sides, dofs, stiffness)
        of_one_size = max(size, 1.0 / size) <= SEARCH.same_size
        exchange = per_area > SEARCH.same_stiffness if of_one_size else size < 1.0
        if self.secondary == "auto" and exchange:
            settled, sides = replace(settled, a=settled.b, b=settled.a), sides[::-1]
            size, per_area = 1.0 / size, 1.0 / per_area
            found = settled._meet(sides, dofs, contact, reach, reach)
        facets = sides[0].facets
        cosine = np.einsum("nvg,ng->nv", facets.vertex_normals, facets.normal)
        edges = dofs.comm.allreduce(int(np.sum(cosine < SEARCH.crease)))
        worse = size < 1.0 / SEARCH.same_size and per_area > SEARCH.much_stiffer
        if worse and dofs.comm.rank == 0:
            log.warning(WORSE, self.name, settled.a, per_area, settled.b, settled.b)
        if edges and dofs.comm.rank == 0:
            log.warning(EDGES, self.name, settled.a)
        return settled, found

    def records(
        self,
        dofs: TornDofs,
        contact: int,
        reach: float = np.inf,
        depth: float = np.inf,
    ) -> ContactRecords:
        """One condition per node of ``a`` that faces ``b``. Collective.

        With D_i = ∫ψ_i over the covered part and n_i the averaged normal the condition is
        n_i · (Σ_k D_ik u_k − Σ_j M_ij u_j)/D_i ≤ g_i, g_i the mean gap weighted with ψ_i.
        """
        return self._meet(self._sides(dofs), dofs, contact, reach, depth)

    def gaps(self, dofs: TornDofs, records: ContactRecords, depth: float = np.inf) -> Array:
        """Return gaps of its conditions; those of the geometry may not overlap too deep."""
        found = super().gaps(dofs, records, depth)
        deepest = -dofs.comm.allreduce(float(found.min(initial=0.0)), op=MPI.MIN)
        if isinstance(self.gap, str) and deepest > depth:
            raise OverlapError(
                f"{self.name}: the surfaces overlap by up to {deepest:.6g}, more than the reach "
                f"{depth:.6g}; expected bodies that are apart, a larger reach, or a gap="
            )
        return found

    def _sides(self, dofs: TornDofs) -> tuple[Side, Side]:
        """Facets of both surfaces, with averaged normals and curvature."""
        gdim = dofs.V.mesh.geometry.dim
        if dofs.bs != gdim:
            raise InputError(
                f"{self.name}: the space is scalar; expected displacements of {gdim} components, "
                "since surfaces meet along normals"
            )
        sides, kind = [], facet_kind(dofs)
        for surface in self.surfaces:
            facets = local_facets(dofs, surface_facets(dofs.decomposition, surface))
            whole = facets.radius ** (dofs.bs - 1)
            flat = int(np.sum(facets.area <= SEARCH.degenerate * whole))
            if count := dofs.comm.allreduce(flat):
                raise InputError(f"{self.name}: {count} facets of {surface!r} have no area")
            facets, normals = with_averaged_normals(facets, dofs)
            facets = with_curvature(facets, dofs, kind)
            sides.append(Side(facets, hat_areas(kind, facets), normals))
        return sides[0], sides[1]

    def _meet(
        self, sides: tuple[Side, Side], dofs: TornDofs, contact: int, reach: float, depth: float
    ) -> ContactRecords:
        """Return conditions from integrals over the first side's facets that face the second."""
        kind, comm = facet_kind(dofs), dofs.comm
        height, deep = SEARCH.seen * reach, SEARCH.seen * depth
        distance = max(height, deep)
        secondary, primary = rendezvous(sides[0].facets, sides[1].facets, distance, comm)
        with raised_on_all_ranks(comm):
            pairs = possible_pairs(secondary, primary, distance)
            segments = find_segments(kind, secondary, primary, pairs, deep, height)
            integrals = integrate(kind, secondary, primary, segments)
        averted = comm.allreduce(int(segments.averted))
        if averted and comm.allreduce(len(segments.weight)) == 0:
            raise InputError(
                f"{self.name}: the surfaces are near but face away from each other; expected "
                "outward normals that oppose each other"
            )
        found = conditions(dofs, contact, sides[0], integrals)
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


def _ratios(
    records: ContactRecords, sides: tuple[Side, Side], dofs: TornDofs, stiffness: Array
) -> tuple[float, float]:
    """Compare sizes and stiffness of the sides where they meet, first over second. Collective.

    Stiffness per area is E/h of the elements at a surface: Σ n_i·K_ii n_i / Σ ∫φ_i over its
    vertices, K_ii the block of K before anything is glued, n_i the normal. Sizes h, roots of areas,
    are harmonic means, which a few large facets beside many small ones do not decide. The vertices
    that rows name are taken, so that a mesh that is fine only where the bodies touch is judged
    there; where there is no such row, all of them.
    """
    whole = dofs.reduce(stiffness.reshape(-1, dofs.bs**2), np.add, 0.0)
    blocks = whole.reshape(-1, dofs.bs, dofs.bs)
    named = records.entry_group[records.within_reach[records.condition]]
    meets = dofs.reduce_on_owners(named, np.ones(len(named))) > 0.0
    if dofs.comm.allreduce(int(np.sum(meets))) == 0:
        meets[:] = True
    sums = []
    for side in sides:
        vertices = side.facets.vertices.ravel()
        area = dofs.reduce_on_owners(vertices, side.areas.ravel())
        facets = dofs.reduce_on_owners(vertices, np.full(len(vertices), 1.0 / side.areas.shape[1]))
        at = meets & (area > 0.0)
        n = side.normals[at]
        along = np.einsum("gi,gij,gj", n, blocks[at], n)
        sums.append((along, area[at].sum(), np.sum(facets[at] / area[at]), np.sum(at)))
    along, area, density, count = dofs.comm.allreduce(np.array(sums, dtype=float)).T
    size, per_area = (count / density) ** (1.0 / (dofs.bs - 1)), along / area
    return bcast_from_root(dofs.comm, (float(size[0] / size[1]), float(per_area[0] / per_area[1])))
