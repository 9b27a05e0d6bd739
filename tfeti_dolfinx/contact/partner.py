"""Obstacles and pairs of surfaces: what a user says of a contact, and its conditions."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from numbers import Real
from typing import Self, TypeAlias

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.common.parallel import any_rank, bcast_from_root, count_over, least
from tfeti_dolfinx.common.validation import checked_type, is_whole, shown
from tfeti_dolfinx.contact.friction import (
    FrictionLaw,
    Value,
    is_of_points,
    values_on,
    with_friction,
)
from tfeti_dolfinx.contact.records import ContactRecords, Side, conditions, relative_motion
from tfeti_dolfinx.contact.rigid_body import Law, RigidBody, has_facets
from tfeti_dolfinx.contact.shapes import Shape, check_placement, check_shape, distance_and_gradient
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.dirichlet import Prescribed
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import (
    Facets,
    apart_at_edges,
    diameter,
    facet_kind,
    group_points,
    hat_areas,
    local_facets,
    shares_at_edges,
    surface_facets,
    unit,
    with_averaged_normals,
    with_images,
)
from tfeti_dolfinx.mortar.integrals import integrate, integrate_distance, with_curvature
from tfeti_dolfinx.mortar.multipliers import with_held_vertices
from tfeti_dolfinx.mortar.segments import find_segments, met_at_edges, possible_pairs, rendezvous
from tfeti_dolfinx.mortar.tolerances import SEARCH

Gap: TypeAlias = "str | Value"
# what the geometry has for a gap: the distance of facets, or of the smooth surfaces through them
GEOMETRY, CURVED = "geometry", "curved"


@dataclass(frozen=True, kw_only=True)
class ContactPartner(ABC):
    """An obstacle, or a pair of surfaces. All methods are collective."""

    gap: Gap = GEOMETRY  # the gaps of its conditions: those of the geometry, or given ones
    friction: FrictionLaw | None = None
    # distance up to which conditions have rows at first; None: 5 % of the surface
    reach: float | None = None
    name: str = ""  # for messages

    def _check_data(self, default_name: str) -> None:
        """Give the contact a name if it has none, and check what is known at once."""
        checked_type(self.name, str, f"{default_name}: name", "a text")
        object.__setattr__(self, "name", self.name or default_name)  # it is frozen
        if self.friction is not None:
            expected = "Tresca(bound), Coulomb(coefficient) or None"
            checked_type(self.friction, FrictionLaw, f"{self.name}: friction", expected)

    @property
    @abstractmethod
    def surfaces(self) -> tuple[str | int, ...]:
        """Names or tags of the surfaces, that with the multipliers first."""

    @abstractmethod
    def records(
        self, dofs: TornDofs, contact: int, reach: float, depth: float, held: Prescribed
    ) -> ContactRecords:
        """Return the conditions; raise an InputError where a surface, shape, gap or law is unfit.

        Conditions with a gap above the reach are out of reach; those of surfaces three times as far
        apart are not made. The depth is the largest initial overlap of two surfaces, and how far a
        given gap replaces it; a body may lie in an obstacle as deep as it likes.
        """

    def first_reach(self, decomposition: Decomposition) -> float:
        """Return the first reach; raise an InputError where it, surfaces or gap do not fit."""
        try:
            facets = [surface_facets(decomposition, name) for name in self.surfaces]
        except InputError as error:  # on all ranks
            raise InputError(f"{self.name}: {error}") from error
        self._check_gap()
        size, reach = min(diameter(decomposition, surface) for surface in facets), self.reach
        if reach is None:
            return SEARCH.reach * size
        if not isinstance(reach, Real) or isinstance(reach, bool) or not reach > 0.0:
            raise InputError(f"{self.name}: reach={reach!r}, expected a positive length or None")
        return float(reach)

    @abstractmethod
    def with_sides(
        self, dofs: TornDofs, contact: int, reach: float, stiffness: Array | None, held: Prescribed
    ) -> tuple[ContactPartner, ContactRecords]:
        """Return the contact with its sides decided, and its conditions up to a reach, and so deep.

        ``stiffness`` is the block of K of each primal node, shape ``(num_nodes, bs, bs)``; None:
        the sides are those of an earlier search.
        """

    def with_gap(self, gap: Gap) -> Self:
        """Return the same contact with another ``gap=``."""
        found = replace(self, gap=gap)
        found._check_gap()
        return found

    def gaps(self, dofs: TornDofs, records: ContactRecords, depth: float = np.inf) -> Array:
        """Return gaps of its conditions, as ``gap=`` and the geometry have them, shape ``(n,)``.

        No search, no integral: a given gap is taken at the nodes, which is the mean of its linear
        interpolant; it replaces that of the geometry up to a depth. Raise an InputError where it is
        no number somewhere, or surfaces overlap too deep.
        """
        if self.gap == CURVED:
            return records.curved_gap
        if self.gap == GEOMETRY:
            return records.geometric_gap
        given = values_on(f"{self.name}: gap", self.gap, records.group, dofs)
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
        if not (number or known or is_of_points(f"{self.name}: gap", gap)):
            raise InputError(
                f'{self.name}: gap={gap!r}, expected "geometry", "curved", a finite length '
                "(negative: interference), a dolfinx.fem.Constant or Function of lengths, or a "
                "function of points of shape (3, n)"
            )


# --- Lists of contacts ------------------------------------------------------------------------


def position_of(names: Sequence[str], which: int | str, what: str = "contact") -> int:
    """Return the position of a contact or tool, given it or its name; raise an InputError else."""
    if is_whole(which) and 0 <= which < len(names):
        return int(which)
    if isinstance(which, str) and names.count(which) == 1:
        return names.index(which)
    known = ", ".join(f"{i}: {name}" for i, name in enumerate(names)) or "none"
    several = isinstance(which, str) and which in names
    raise InputError(
        f"{what} {shown(which)}: {'several have this name' if several else 'there is none'}; "
        f"expected a position or a name, of {known}; name= gives names"
    )


def gaps_by_position(
    contacts: Sequence[ContactPartner], gaps: Mapping[int | str, Gap]
) -> dict[int, Gap]:
    """Return gaps by position of contacts that are given by position or name, each once."""
    checked_type(gaps, Mapping, "gap", "a dictionary from contacts to gaps")
    found: dict[int, Gap] = {}
    names = [contact.name for contact in contacts]
    for which, gap in gaps.items():
        position = position_of(names, which)
        if position in found:
            raise InputError(f"gap: contact {position} is there twice, by position and by name")
        found[position] = gap
    return found


def checked_contacts(contacts: Sequence[ContactPartner]) -> tuple[ContactPartner, ...]:
    """Return the contacts; raise an InputError unless they are obstacles and pairs."""
    if not isinstance(contacts, Sequence):
        raise InputError(f"contacts: expected a list, got {shown(contacts)}")
    for contact in contacts:
        if not isinstance(contact, ContactPartner):
            raise InputError(f"contacts: expected obstacles and pairs, got {shown(contact)}")
    return tuple(contacts)


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


# --- Contact with a rigid obstacle ------------------------------------------------------------


@dataclass(frozen=True)
class Obstacle(ContactPartner):
    """A surface may not enter a rigid shape.

    Args:
        surface: Name or tag of the surface.
        shape: A ``Plane``, ``Sphere``, ``Cylinder``, ``SignedDistance``, ``SurfaceMesh``, or
            anything with their two methods; or a ``RigidBody``, which moves.
        displacement: Of the shape: short for a ``RigidBody`` with this law.
        gap: "geometry" for the shape's distance from the vertices, where straight facets do not
            show ("curved" is the same); or what replaces it, however far the shape is (negative:
            interference): a number, a function of the vertices, shape ``(3, n)``, a DOLFINx
            constant, or a scalar DOLFINx function on the torn mesh. ``solve`` sees new values.
        friction: ``Tresca``, ``Coulomb``, or None.
        reach: Nodes farther than this from the obstacle get no constraint at first. After the solve
            all are checked, and those that came to overlap get theirs. Default: 5 % of the
            surface's extent.
        name: For messages and ``solution.contact(name)``. Default: "obstacle of surface 'a'".

    Example:
        >>> table = tfeti.Plane((0, 0, -0.01), normal=(0, 0, 1))
        >>> tfeti.Obstacle("bottom", table, gap=0.0, name="table").name
        'table'
    """

    surface: str | int
    shape: Shape
    displacement: Law | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        self._check_data(f"obstacle of surface {_written(self.surface)}")
        check_shape(self.shape, self.name)
        if self.displacement is not None:
            if isinstance(self.shape, RigidBody):
                raise InputError(
                    f"{self.name}: displacement= and a RigidBody; expected one of them"
                )
            tool = RigidBody(self.shape, displacement=self.displacement, name=self.name)
            object.__setattr__(self, "shape", tool)  # it is frozen
            object.__setattr__(self, "displacement", None)

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """The surface."""
        return (self.surface,)

    def with_sides(
        self, dofs: TornDofs, contact: int, reach: float, stiffness: Array | None, held: Prescribed
    ) -> tuple[ContactPartner, ContactRecords]:
        """Return the contact and its conditions. Collective.

        At the first search the shape has to fit: later the surface may have turned away from it.
        """
        if stiffness is not None and dofs.bs > 1:  # else the gradient's first component counts
            self._check_shape(dofs)
        return self, self.records(dofs, contact, reach, reach, held)

    def _check_shape(self, dofs: TornDofs) -> None:
        """Raise an InputError unless the gradient is the distance's and a facet faces the shape."""
        facets = local_facets(dofs, dofs.decomposition.facets(self.surface), facet_kind(dofs))
        centres, size = facets.corners.mean(axis=1), diameter(dofs.decomposition)
        check_placement(self.shape, centres, dofs.bs, self.name, size, dofs.comm)
        with raised_on_all_ranks(dofs.comm):
            _, towards = self._distances(centres, dofs.bs)
        if count_over(dofs.comm, np.sum(towards * facets.normal, axis=1) > 0.0) == 0:
            raise InputError(
                f"{self.name}: the surface faces away from it; expected "
                "a shape whose distance falls along the outward normal (is its normal turned?)"
            )

    def records(
        self, dofs: TornDofs, contact: int, reach: float, depth: float, held: Prescribed
    ) -> ContactRecords:
        """One condition per vertex of the surface, from its present distance. Collective.

        With φ the signed distance, n = −∇φ/|∇φ| and g = φ/|∇φ| at the vertex (or the gap that is
        given), it is that of a dual multiplier, ∫ψ_i n_i·u ≤ g_i ∫ψ_i, divided by ∫ψ_i: of degree 1
        n·u ≤ g at the node, as ψ_i is biorthogonal to the shape functions.
        """
        kind, across = facet_kind(dofs), held.across
        facets = local_facets(dofs, dofs.decomposition.facets(self.surface), kind, across)
        corners = facets.corners
        with raised_on_all_ranks(dofs.comm):
            distance, towards = self._distances(corners.reshape(-1, corners.shape[2]), dofs.bs)
            beside, at_edge = self._beside_edges(facets, distance, towards)
        vertices = facets.vertices.ravel()
        normals = dofs.reduce_on_owners(vertices, towards, np.maximum, -np.inf)
        normals[~np.isfinite(normals)] = 0.0  # off the surface
        sides = dofs.reduce_on_owners(vertices[at_edge], beside)
        normals = np.where(np.any(sides != 0.0, axis=1, keepdims=True), unit(sides), normals)
        if across is not None and has_facets(self.shape):
            # on a plane of symmetry its facets have the normal of the smooth surface
            inside = np.where(across, 0.0, normals)
            share = np.linalg.norm(inside, axis=1, keepdims=True)
            share[share < SEARCH.edge] = 1.0
            normals = np.where(share < 1.0, inside / share, normals)
            distance = distance / dofs.lookup(vertices, share)[0].ravel()
        if not (isinstance(self.shape, RigidBody) and self.shape.free):
            facets = with_held_vertices(facets, dofs, normals, held.flag)
        share, edges = shares_at_edges(facets, dofs, towards, across)
        side = Side(facets, hat_areas(kind, facets), normals, edges)
        integrals = integrate_distance(kind, facets, distance.reshape(corners.shape[:2]), share)
        found = conditions(dofs, contact, side, integrals)
        if isinstance(self.shape, RigidBody):
            x = group_points(dofs)[:, : dofs.bs]
            found = replace(found, place=relative_motion(found, dofs, x))
        return self._with_gaps_and_friction(dofs, found, reach, np.inf)

    def _beside_edges(self, facets: Facets, distance: Array, towards: Array) -> tuple[Array, Array]:
        """Return normals a little inside of facets, and at which corners they replace ``towards``.

        These are corners at an edge of the shape, where it has no normal: that of the facet decides
        which side's counts.
        """
        corners, gdim = facets.corners, towards.shape[1]
        off = SEARCH.at_edge * facets.radius
        at = np.flatnonzero(np.abs(distance) <= np.repeat(off, corners.shape[1]))
        inside = corners + 2.0 * SEARCH.at_edge * (corners.mean(axis=1)[:, None] - corners)
        _, beside = self._distances(inside.reshape(-1, corners.shape[2])[at], gdim)
        own, towards = np.repeat(facets.normal, corners.shape[1], axis=0)[at], towards[at]
        edge = np.sum(beside * towards, axis=1) < SEARCH.edge
        edge &= np.sum((beside - towards) * own, axis=1) > 0.0
        return beside[edge], at[edge]

    def _distances(self, x: Array, gdim: int) -> tuple[Array, Array]:
        """Return distances and normals at points of shape ``(n, 2)`` or ``(n, 3)``."""
        gap, gradient = distance_and_gradient(self.shape, x, self.name)
        gradient = gradient[:, :gdim]
        length = np.linalg.norm(gradient, axis=1)
        wrong = ~(np.isfinite(gap) & np.isfinite(length) & (length > 0.0))
        if np.any(wrong):
            space = ", in a scalar space: expected displacements" if gdim == 1 else ""
            raise InputError(
                f"{self.name} has no distance and normal at the node {x[wrong][0].tolist()}: "
                f"distance {gap[wrong][0]}, gradient {gradient[wrong][0]}{space}"
            )
        return gap / length, -gradient / length[:, None]


# --- Contact between two bodies ---------------------------------------------------------------

WORSE = (
    "%s: the secondary side %r is %.3g times as stiff per area as %r, where they meet; the "
    "pressure would be better with secondary=%r"
)
LITTLE = (
    "%s: %r covers so little of the facets of the secondary side %r that nodes may lack "
    "conditions; expected secondary=%r"
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Contact(ContactPartner):
    """Two surfaces may not enter each other.

    Where facets of the secondary side turn by more than 40°, the normal is that of what they meet.
    So a surface may be a whole boundary: sides that stand on what an edge meets bear nothing.

    Args:
        a: Name or tag of a surface.
        b: Name or tag of the other one.
        secondary: The surface that carries the multipliers and the pressure, ``a`` or ``b``.
            "auto": the one with the coarser mesh where they meet; where both are of one size
            (to 12 %), the softer one, by the stiffness per area of its elements, E/h. In finite
            strain the one that the other covers wholly, if that is one alone. It is not one whose
            facets are so large that the other covers less than 2 % around each node.
        gap: "geometry" for the distance between the facets; "curved" for that between smooth
            surfaces fitted to straight facets, as pins and bearings need it; or what replaces the
            distance where it is at most the reach (negative: interference), as for an ``Obstacle``,
            at the secondary surface's vertices.
        friction: ``Tresca``, ``Coulomb``, or None.
        reach: Surfaces farther apart than this make no constraints at first; those that overlap
            after the solve get theirs, and the solve goes on. Default: 5 % of the smaller
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
        self._check_data(f"contact of {_written(self.a)} with {_written(self.b)}")

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """Both surfaces; where the sides are decided, the secondary one first."""
        return self.a, self.b

    def first_reach(self, decomposition: Decomposition) -> float:
        """Return the reach to begin with, and check the surfaces. Collective."""
        reach = super().first_reach(decomposition)
        if decomposition.surface(self.a) == decomposition.surface(self.b):
            raise InputError(
                f"{self.name}: both are the same surface; contact of a surface with itself is "
                "not supported, give its two sides different names"
            )
        self._named_first(decomposition)
        return min(reach, diameter(decomposition))

    def with_sides(
        self, dofs: TornDofs, contact: int, reach: float, stiffness: Array | None, held: Prescribed
    ) -> tuple[Contact, ContactRecords]:
        """Return the contact with its secondary side as ``a``, and its conditions. Collective.

        The secondary side is that which is named, else the one with the coarser mesh; where meshes
        are of one size, the softer one; of equal ones the first. In finite strain it is the one
        that is covered wholly, if that is one alone: what is covered in part changes. A side that
        the other one covers by little at all nodes is secondary only if both are so.
        """
        cite("mortar")
        chosen = self._named_first(dofs.decomposition)
        sides = chosen._sides(dofs, held)
        found = chosen._meet(sides, dofs, contact, reach, reach, held)
        if stiffness is None:
            return chosen, found
        size, per_area = _ratios(found, sides, dofs, stiffness)
        of_one_size = max(size, 1.0 / size) <= SEARCH.same_size
        exchange = per_area > SEARCH.same_stiffness if of_one_size else size < 1.0
        auto, finite = self.secondary == "auto", dofs.nodes is not None
        cover = _cover(found, dofs)
        if not cover[0] or (auto and (exchange or finite)):
            other = chosen._meet(sides[::-1], dofs, contact, reach, reach, held)
            of_other = _cover(other, dofs)
            if auto and (of_other, exchange) > (cover, False):
                chosen, found = replace(chosen, a=chosen.b, b=chosen.a), other
            elif not auto and of_other[0] and not cover[0] and dofs.comm.rank == 0:
                log.warning(LITTLE, self.name, chosen.b, chosen.a, chosen.b)
        worse = size < 1.0 / SEARCH.same_size and per_area > SEARCH.much_stiffer
        if worse and not auto and dofs.comm.rank == 0:
            log.warning(WORSE, self.name, chosen.a, per_area, chosen.b, chosen.b)
        return chosen, found

    def records(
        self, dofs: TornDofs, contact: int, reach: float, depth: float, held: Prescribed
    ) -> ContactRecords:
        """One condition per node of ``a`` opposite to ``b``. Collective.

        With D_i = ∫ψ_i over the covered part and n_i the averaged normal the condition is
        n_i · (Σ_k D_ik u_k − Σ_j M_ij u_j)/D_i ≤ g_i, g_i the mean gap weighted with ψ_i.
        """
        return self._meet(self._sides(dofs, held), dofs, contact, reach, depth, held)

    def gaps(self, dofs: TornDofs, records: ContactRecords, depth: float = np.inf) -> Array:
        """Return gaps of its conditions; those of the geometry may not overlap too deep."""
        found = super().gaps(dofs, records, depth)
        deepest = -least(dofs.comm, float(found.min(initial=0.0)))
        if isinstance(self.gap, str) and deepest > depth:
            raise InputError(
                f"{self.name}: the surfaces overlap by up to {deepest:.6g}, more than the reach "
                f"{depth:.6g}; expected bodies that are apart, a larger reach, or a gap="
            )
        return found

    def _sides(self, dofs: TornDofs, held: Prescribed) -> tuple[Side, Side]:
        """Facets of both surfaces, with averaged normals and curvature."""
        gdim = dofs.V.mesh.geometry.dim
        if dofs.bs != gdim:
            raise InputError(
                f"{self.name}: the space is scalar; expected displacements of {gdim} components, "
                "since surfaces meet along normals"
            )
        sides, kind, across = [], facet_kind(dofs), held.across
        for surface in self.surfaces:
            facets = local_facets(dofs, dofs.decomposition.facets(surface), kind, across)
            whole = facets.radius ** (dofs.bs - 1)
            if count := count_over(dofs.comm, facets.area <= SEARCH.degenerate * whole):
                raise InputError(f"{self.name}: {count} facets of {surface!r} have no area")
            facets, normals, edges = with_averaged_normals(facets, dofs, across)
            facets = with_curvature(facets, dofs, kind, across)
            facets = with_held_vertices(facets, dofs, normals, held.flag)
            areas, facets = hat_areas(kind, facets), apart_at_edges(facets, dofs, edges)
            sides.append(Side(facets, areas, normals, edges))
        return sides[0], sides[1]

    def _meet(
        self,
        sides: tuple[Side, Side],
        dofs: TornDofs,
        contact: int,
        reach: float,
        depth: float,
        held: Prescribed,
    ) -> ContactRecords:
        """Return conditions from integrals over the first side's facets that face the second."""
        kind, comm, across = facet_kind(dofs), dofs.comm, held.across
        moved, curved = dofs.nodes is not None, self.gap == CURVED
        distance = max(height := SEARCH.seen * reach, deep := SEARCH.seen * depth)
        own, edges, aside = sides[0], (sides[0].edges, sides[1].edges), False
        if dofs.nodes is not None:  # faces without edges press as they are meshed, however narrow
            aside = any_rank(comm, bool(np.any(edges) or np.any(np.diff(dofs.nodes, axis=0))))
        images = with_images(sides[1].facets, dofs, across)
        secondary, primary = rendezvous(own.facets, images, distance, comm)
        with raised_on_all_ranks(comm):
            pairs = possible_pairs(secondary, primary, distance)
            segments = find_segments(kind, secondary, primary, pairs, deep, height, aside)
        where = segments, secondary, primary, across
        normals, corner, secondary, segments = met_at_edges(dofs, edges, own.normals, *where)
        with raised_on_all_ranks(comm):
            integrals = integrate(kind, secondary, primary, segments, moved, curved)
        averted = any_rank(comm, segments.averted)
        if averted and count_over(comm, len(segments.weight)) == 0:
            raise InputError(
                f"{self.name}: the surfaces are near but face away from each other; expected "
                "outward normals that oppose each other"
            )
        found = conditions(dofs, contact, replace(own, normals=normals), integrals, sides[1])
        found = replace(found, corner=corner[found.group])
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


def _cover(records: ContactRecords, dofs: TornDofs) -> tuple[bool, bool]:
    """Return whether the other side covers enough of a node for its pressure. Collective.

    And, in finite strain, whether it covers all nodes wholly.
    """
    partly = records.within_reach & (records.covered < 1.0 - SEARCH.hardly_covered)
    whole = dofs.nodes is not None and not any_rank(dofs.comm, partly)
    return any_rank(dofs.comm, records.covered >= SEARCH.believed), whole


def _written(surface: object) -> str:
    """Return what was given for a surface, as names of contacts have it."""
    return repr(surface) if is_whole(surface) or isinstance(surface, str) else shown(surface)


def _ratios(
    records: ContactRecords, sides: tuple[Side, Side], dofs: TornDofs, stiffness: Array
) -> tuple[float, float]:
    """Compare sizes and stiffness of the sides where they meet, first over second. Collective.

    Stiffness per area is E/h of the elements at a surface: Σ n_i·K_ii n_i / Σ ∫φ_i over the
    vertices that rows name, or all where there are none, K_ii the block of K before anything is
    glued. Sizes h, roots of areas, are harmonic means, which few large facets do not decide.
    """
    whole = dofs.reduce(stiffness.reshape(-1, dofs.bs**2), np.add)
    blocks = whole.reshape(-1, dofs.bs, dofs.bs)
    named = records.entry_group[records.within_reach[records.condition]]
    meets = dofs.reduce_on_owners(named, np.ones(len(named))) > 0.0
    if not any_rank(dofs.comm, meets):
        meets[:] = True
    sums = []
    for side in sides:
        of, v = side.facets, side.areas.shape[1]
        parts = (np.repeat(of.area[:, None] / v, v, axis=1), np.full(side.areas.shape, 1.0 / v))
        area, facets = (of.on_groups(dofs, part) for part in parts)
        at = meets & (area > 0.0)
        n = side.normals[at]
        along = np.einsum("gi,gij,gj", n, blocks[at], n)
        sums.append((along, area[at].sum(), np.sum(facets[at] / area[at]), np.sum(at)))
    along, area, density, count = dofs.comm.allreduce(np.array(sums, dtype=float)).T
    size, per_area = (count / density) ** (1.0 / (dofs.bs - 1)), along / area
    return bcast_from_root(dofs.comm, (float(size[0] / size[1]), float(per_area[0] / per_area[1])))
