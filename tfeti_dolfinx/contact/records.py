"""Conditions of contact: tables, how integrals make them, forces, and what a solution has."""

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np
import ufl
from dolfinx.fem.petsc import interpolation_matrix
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array, quotient, sum_rows
from tfeti_dolfinx.common.parallel import any_rank, largest, summed
from tfeti_dolfinx.mesh.dofs import Owners, TornDofs
from tfeti_dolfinx.mortar.facets import Facets, hat_integrals
from tfeti_dolfinx.mortar.integrals import GapIntegrals, MortarIntegrals
from tfeti_dolfinx.mortar.multipliers import Triplets
from tfeti_dolfinx.mortar.segments import frames
from tfeti_dolfinx.mortar.tolerances import SEARCH

# --- Tables of conditions ---------------------------------------------------------------------


class Friction(IntEnum):
    """Kind of the bound on a condition's tangential force: none, a given force, or pressure."""

    NONE = 0
    GIVEN = 1
    COULOMB = 2


# tables of whole numbers, and of flags
WHOLE = ("contact", "group", "condition", "entry_group", "friction", "held", "neighbour")
FLAGS = ("conforms", "corner", "within_reach")


@dataclass(frozen=True)
class ContactRecords:
    """Conditions of contact nodes, one for each contact and node whose group this rank owns.

    With the *relative displacement* v_i = Σ_j w_ij u_j − m_i of a node against what it meets, m_i
    the motion of a rigid body, the condition is n_i · v_i ≤ g_i, and its slip is the tangential
    part of v_i. A scalar space has frames of shape ``(n, 1, 1)``.
    """

    contact: Array  # index of the contact (in the list that the user gave), shape (n,)
    group: Array  # owned group of the contact node, shape (n,)
    # right-handed orthonormal axes, shape (n, gdim, gdim): axis 0 is the normal n_i, in which the
    # node may not go further, the others are tangents
    frame: Array
    gap: Array  # distance g_i, a length, shape (n,)
    geometric_gap: Array  # the distance that the geometry has, whatever a user gives, shape (n,)
    # the distance between the smooth surfaces that the facets of both sides stand for, shape (n,)
    curved_gap: Array
    # whether the facets change the gap by more than that of the smooth surfaces varies from node to
    # node, shape (n,)
    conforms: Array
    # whether the node is at an edge that meets two sides at once, shape (n,)
    corner: Array
    # integral ∫φ_i of the node's hat over the contact surface, ∫rφ_i of axisymmetric models, of a
    # pair over what the other side covers of it, shape (n,)
    area: Array
    covered: Array  # the share of that integral over the whole surface, 1 at an obstacle, (n,)
    # whether a row is made at once; a condition out of reach gets one only if the solution violates
    # it, shape (n,)
    within_reach: Array
    condition: Array  # condition of each weight, shape (k,)
    entry_group: Array  # global group of each weight, shape (k,)
    weight: Array  # the w_ij, without a unit, shape (k,)
    friction: Array  # `Friction` of each condition, shape (n,)
    place: Array  # Σ_j w_ij x_j, where a rigid body that moves meets it, else 0, shape (n, gdim)
    motion: Array  # displacement of that body there, as far as it is known, shape (n, gdim)
    # neighbours of vertices that are held, see `held_pressures`: the condition of the vertex, the
    # global group of the neighbour, and its share, which add up to 1, shape (p,)
    held: Array
    neighbour: Array
    share: Array
    candidates: int = 0  # nodes of the contact surface whose groups this rank owns

    def __len__(self) -> int:
        return len(self.gap)

    @property
    def normal(self) -> Array:
        """Direction in which each node may not go further, shape ``(n, gdim)``."""
        return self.frame[:, 0]

    @property
    def tangents(self) -> Array:
        """The other axes of the frames, shape ``(n, gdim - 1, gdim)``."""
        return self.frame[:, 1:]

    def coefficients(self, axis: int) -> Array:
        """The a_ij of Σ_j a_ij · u_j, v_i along an axis of the frame, shape ``(k, gdim)``."""
        return self.frame[self.condition, axis] * self.weight[:, None]


def concatenate(records: list[ContactRecords], gdim: int) -> ContactRecords:
    """All conditions of several contacts in one table."""
    if len(records) == 1:
        return records[0]
    starts = np.cumsum([0, *(len(r) for r in records)])
    moved = [
        replace(r, condition=r.condition + s, held=r.held + s)
        for r, s in zip(records, starts, strict=False)
    ]
    shapes = {"frame": (0, gdim, gdim), "place": (0, gdim), "motion": (0, gdim)}
    joined: dict[str, Array] = {}
    for name in (field.name for field in fields(ContactRecords) if field.name != "candidates"):
        kind = np.int64 if name in WHOLE else np.bool_ if name in FLAGS else np.float64
        none = np.empty(shapes.get(name, 0), dtype=kind)
        joined[name] = np.concatenate([none, *(getattr(r, name) for r in moved)])
    return ContactRecords(**joined, candidates=sum(r.candidates for r in records))


def relative_motion(records: ContactRecords, dofs: TornDofs, values: Array) -> Array:
    """Σ_j w_ij u_j of all conditions, from u of the owned groups: ``(g, gdim)`` to ``(n, gdim)``.

    It is the motion of a node, less that of what it meets. Collective.
    """
    (u,) = dofs.lookup(records.entry_group, values)
    return sum_rows(records.condition, records.weight[:, None] * u, len(records))


def relative_displacement(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """The v_i, ``(n, gdim)``, from u in primal order; of torn copies the mean. Collective."""
    return relative_motion(records, dofs, mean_of_copies(dofs, u)) - records.motion


def mean_of_copies(dofs: TornDofs, u: Array) -> Array:
    """Return the means of torn copies, of the owned groups, ``(g, gdim)``. Collective."""
    return np.asarray(dofs.reduce(u.reshape(-1, dofs.bs), np.add) / dofs.multiplicity[:, None])


def slips(records: ContactRecords, dofs: TornDofs, u: Array) -> Array:
    """Return the v_i along the tangents of the frames, shape ``(n, gdim - 1)``. Collective."""
    return np.einsum("ntg,ng->nt", records.tangents, relative_displacement(records, dofs, u))


def given_slips(records: ContactRecords, dofs: TornDofs, flag: Array, values: Array) -> Array:
    """Return what prescribed components make of the v_i along the tangents. Collective.

    What they leave of a condition moves with them: else parts of a body that is carried along would
    slip over each other. Flags and values are those of the owned groups, ``(g, gdim)``, values 0
    where nothing is prescribed.
    """
    (known,) = dofs.lookup(records.entry_group, np.hstack((values, ~flag, flag)))
    value, free, given = np.split(known, 3, axis=1)
    w, size = records.weight[:, None], np.abs(records.weight)[:, None]
    terms = np.hstack((w * value, w * free, size * value, size * given))
    sums = np.split(sum_rows(records.condition, terms, len(records)), 4, axis=1)
    motion = sums[0] - records.motion + sums[1] * quotient(sums[2], sums[3])
    return np.einsum("ntg,ng->nt", records.tangents, motion)


def held_pressures(
    records: ContactRecords, dofs: TornDofs, contacts: int, pressure: Array
) -> Array:
    """Return pressures that vertices which conditions hold bear, else 0, shape ``(n,)``.

    Those are means of their neighbours in the same one of so many contacts, from pressures of all
    conditions. Collective.
    """
    found, of_vertex = np.zeros(len(records.held)), records.contact[records.held]
    for contact in range(contacts):
        own, of = records.contact == contact, of_vertex == contact
        known = np.zeros(dofs.num_groups)
        known[records.group[own]] = pressure[own]
        (found[of],) = dofs.lookup(records.neighbour[of], known)
    return sum_rows(records.held, records.share * found, len(records))


# --- Conditions from integrals ----------------------------------------------------------------


@dataclass(frozen=True)
class Side:
    """A surface of a pair, or one that faces an obstacle."""

    # its facets on this rank; those of a pair have a curvature, and off edges averaged normals
    facets: Facets
    areas: Array  # ∫φ_i over each facet, shape (n, v)
    # direction in which each owned group may not go further: the averaged normal, at an obstacle
    # that towards the shape; 0 off the surface, shape (g, gdim)
    normals: Array
    edges: Array  # which owned groups are at edges, as `edges_at_rest` finds, shape (g,)


def conditions(
    dofs: TornDofs, contact: int, side: Side, integrals: MortarIntegrals, other: Side | None = None
) -> ContactRecords:
    """Sum the contributions of facets on any rank to each node, and divide by ∫ψ_i. Collective.

    The vertices of the side get conditions along its normals, but where the covered share of ∫φ_i
    is below 1e-6, and where the other side of a pair has them, too, as the tip of a notch: they are
    no distance apart. The gaps are those of the geometry, all conditions are taken to be within
    reach, and none has friction.
    """
    owners = dofs.owners_of(integrals.vertices.ravel())
    area = dofs.reduced(owners, integrals.covered.ravel())
    whole = side.facets.on_groups(dofs, side.areas)
    met = area > SEARCH.hardly_covered * whole
    if other is not None:
        met &= other.facets.on_groups(dofs, np.ones(other.areas.shape)) == 0.0
    chosen = np.flatnonzero(met)
    areas = area[chosen]
    # what rounding of coordinates may make of a gap
    rounding = SEARCH.no_gap * largest(dofs.comm, dofs.V.mesh.geometry.x)
    gap, spread = _mean_gaps(dofs, owners, integrals.gap, areas, chosen, rounding)
    curved_gap, curved = gap, integrals.curved_gap
    if any_rank(dofs.comm, curved is not integrals.gap):
        curved_gap, spread = _mean_gaps(dofs, owners, curved, areas, chosen, rounding)
    place = np.full(dofs.num_groups, -1)
    place[chosen] = np.arange(len(chosen))
    slot, column, value = _merged(dofs, integrals.entries)
    kept = (place[slot] >= 0) & (np.abs(value) > SEARCH.negligible * np.maximum(area[slot], 1e-300))
    slot, column, value = slot[kept], column[kept], value[kept]
    of, neighbour, share = _merged(dofs, (integrals.shares,))
    kept = place[of] >= 0
    held, neighbour, share = place[of[kept]], neighbour[kept], share[kept]
    return ContactRecords(
        contact=np.full(len(chosen), contact),
        group=chosen,
        frame=frames(side.normals[chosen]),
        gap=gap,
        geometric_gap=gap,
        curved_gap=curved_gap,
        conforms=np.abs(curved_gap - gap) > np.maximum(spread, rounding),
        corner=np.zeros(len(chosen), dtype=bool),
        area=areas,
        covered=areas / whole[chosen],
        within_reach=np.ones(len(chosen), dtype=bool),
        condition=place[slot],
        entry_group=column,
        weight=value / area[slot],
        friction=np.full(len(chosen), Friction.NONE),
        place=np.zeros((len(chosen), dofs.bs)),
        motion=np.zeros((len(chosen), dofs.bs)),
        held=held,
        neighbour=neighbour,
        share=share / sum_rows(held, share, len(chosen))[held],
        candidates=int(np.sum(whole > 0.0)),
    )


def _mean_gaps(
    dofs: TornDofs, owners: Owners, gap: GapIntegrals, area: Array, chosen: Array, rounding: float
) -> tuple[Array, Array]:
    """∫ψ_i g / ∫ψ_i of groups within the bounds on g, as ψ_i may be negative, and their width.

    Bounds do not follow u as rows do: where nodes have moved, there are none. Means up to
    ``rounding`` are 0. Collective.
    """
    total = dofs.reduced(owners, gap.total.ravel())[chosen]
    low = dofs.reduced(owners, gap.lowest.ravel(), np.minimum, np.inf)[chosen]
    high = dofs.reduced(owners, gap.highest.ravel(), np.maximum, -np.inf)[chosen]
    mean = total / area if dofs.nodes is not None else np.clip(total / area, low, high)
    return np.where(np.abs(mean) <= rounding, 0.0, mean), high - low


def _merged(dofs: TornDofs, entries: tuple[Triplets, ...]) -> Triplets:
    """Return triplets on the ranks that own their rows (as local slots), equal ones added up."""
    row, column, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    exchange, row = dofs.owners_of(row)
    column, total = exchange.send(column), dofs.group_offsets[-1]
    place, which = np.unique(total * row + column, return_inverse=True)
    return *np.divmod(place, total), sum_rows(which, exchange.send(value), len(place))


# --- Forces on nodes, surfaces and bodies -----------------------------------------------------


@dataclass(frozen=True)
class Resultant:
    """Resultant of forces on nodes, the same on all ranks.

    Attributes:
        force: Shape ``(gdim,)``, of each body ``(bodies, gdim)``; with a thickness, that on all of
            it.
        moment: About the origin, shape ``(3,)`` or ``(bodies, 3)``; in 2D only its last component
            is not 0. In finite strain forces act where nodes are, at X + u, else at X.
    """

    force: Array
    moment: Array


def resultant(comm: MPI.Intracomm, points: Array, forces: Array) -> Resultant:
    """Resultant of forces, ``(n, gdim)``, at points of this rank, ``(n, 3)``. Collective."""
    own = summed(comm, np.sum(_with_moments(points, forces), axis=0))
    return Resultant(own[:-3], own[-3:])


def _with_moments(points: Array, forces: Array) -> Array:
    """Return forces and their moments about the origin, shape ``(n, gdim + 3)``."""
    spatial = np.zeros((len(forces), 3))
    spatial[:, : forces.shape[1]] = forces
    return np.column_stack((forces, np.cross(points, spatial)))


def condition_areas(
    records: ContactRecords, dofs: TornDofs, surfaces: list[str | int], thickness: Any = 1.0
) -> Array:
    """∫φ_i of each condition, ``(n,)``, times a number or a scalar in UFL. Collective.

    Where a pair covers a part of the node's surface, the thickness is its mean over the whole.
    """
    if isinstance(thickness, float):
        return thickness * records.area
    measures = (thickness, ufl.SpatialCoordinate(dofs.V.mesh)[0] if dofs.axisymmetric else 1.0)
    volume, area = (hat_integrals(dofs, surfaces, t)[records.group] for t in measures)
    return records.area * volume / area


def body_forces(points: Array, forces: Array, dofs: TornDofs) -> Resultant:
    """Resultants of forces on the owned groups, which are at these points. Collective."""
    lowest = dofs.copy_subdomains[dofs.copy_offsets[:-1]]
    body, num_bodies = dofs.decomposition.body_of_subdomain[lowest], dofs.decomposition.num_bodies
    sums = summed(dofs.comm, sum_rows(body, _with_moments(points, forces), num_bodies))
    return Resultant(sums[:, : forces.shape[1]], sums[:, forces.shape[1] :])


def vertex_tractions(
    forces: Array, dofs: TornDofs, names: list[str | int], thickness: Any = 1.0
) -> tuple[Array, Array]:
    """Tractions whose moments with the hats of degree 1 are those of nodal forces. Collective.

    Return force / ∫φ_i for each owned group that is a vertex of the surfaces of these names, else
    0, shape ``(g, gdim)``; and ∫φ_i, times the thickness, shape ``(g,)``.
    """
    area = hat_integrals(dofs, names, thickness)
    if dofs.V.element.basix_element.degree > 1:
        forces = _on_hats(forces, dofs)
    return quotient(forces, area[:, None]), area


def _on_hats(forces: Array, dofs: TornDofs) -> Array:
    """Return moments with the hats of degree 1: Πᵀf, Π the interpolation from degree 1."""
    W, node = dofs.hats
    S, dof = dofs.scalar
    interpolation = interpolation_matrix(W, S)
    interpolation.assemble()
    source, target = interpolation.createVecLeft(), interpolation.createVecRight()
    share = dofs.spread(forces / dofs.multiplicity[:, None])
    result = np.zeros_like(share)
    for component in range(forces.shape[1]):
        source.array[dof] = share[:, component]
        interpolation.multTranspose(source, target)
        result[node, component] = target.array_r
    for item in (source, target, interpolation):
        item.destroy()
    return dofs.reduce(result, np.add)


# --- Contact at a solution --------------------------------------------------------------------


class ContactStatus(IntEnum):
    """Status of a node.

    OPEN: no normal force. TOUCHING: one, and no friction there. SLIP, STICK: one, with friction at
    its bound, and below it. A node whose normal displacement is prescribed slips or sticks.
    """

    NONE = 0
    OPEN = 1
    TOUCHING = 2
    SLIP = 3
    STICK = 4


@dataclass(frozen=True)
class ContactData:
    """State of the conditions of one contact on this rank, one entry per node.

    A node is on one rank only: sums over all ranks are those of the contact.

    Attributes:
        points: Nodes where they were before the deformation, shape ``(n, 3)``.
        normal: Direction in which a node may not go further, of unit length, out of its body:
            the contact pushes it with −force·normal, shape ``(n, gdim)``.
        force: Normal force on the node, 0 or more, shape ``(n,)``.
        pressure: Force over area, shape ``(n,)``.
        area: ∫φ_i of the node's shape function over the surface, of a pair over what the other
            side covers, times the thickness, shape ``(n,)``.
        gap: Remaining distance, shape ``(n,)``.
        status: ContactStatus: OPEN without a normal force, else TOUCHING; with friction SLIP or
            STICK, shape ``(n,)``.
        tangential_traction: Friction on the node over the area, a vector, shape ``(n, gdim)``.
        slip: Displacement along the surface, against what the node meets, since the load step
            began (``ContactProblem.accept``), a vector, shape ``(n, gdim)``.
        surface: Surface whose nodes these are: of a pair the secondary one.
        resultant: Force and moment, friction included, by which the contact acts on that surface;
            the same on all ranks.
    """

    points: Array
    normal: Array
    force: Array
    pressure: Array
    area: Array
    gap: Array
    status: Array
    tangential_traction: Array
    slip: Array
    surface: str | int
    resultant: Resultant


@dataclass(frozen=True)
class ToolState:
    """A rigid body at a solution; the same on all ranks.

    Attributes:
        name: Its name.
        displacement: Of its point, shape ``(gdim,)``.
        rotation: Rotation vector, in radians, shape ``(3,)``; in 2D only its last component is not
            0.
        resultant: Force and moment of all its contacts on it, friction included; the moment about
            its point.
        velocity: Of its point along free motions, shape ``(gdim,)``; None without a mass.
        spin: Angular velocity likewise, in radians per time, shape ``(3,)``.
    """

    name: str
    displacement: Array
    rotation: Array
    resultant: Resultant
    velocity: Array | None
    spin: Array | None

    @property
    def _parts(self) -> dict[str, Array]:
        parts = {"displacement": self.displacement, "rotation": self.rotation}
        parts |= {"force": self.resultant.force, "moment": self.resultant.moment}
        if self.velocity is not None and self.spin is not None:
            parts |= {"velocity": self.velocity, "spin": self.spin}
        return parts

    def __str__(self) -> str:
        """One line: names of what is not 0, and its numbers."""
        words = [
            f"{what} ({', '.join(f'{value:.6g}' for value in values)})"
            for what, values in self._parts.items()
            if what in ("displacement", "force") or np.any(values)
        ]
        return f"{self.name}: {', '.join(words)}"

    @property
    def numbers(self) -> dict[str, float]:
        """All components by name, for tables."""
        flat = len(self.displacement) == 2  # bodies turn about z alone
        return {
            f"{self.name} {what} {axis}": float(value)
            for what, values in self._parts.items()
            for axis, value in zip("xyz", values, strict=False)
            if not flat or len(values) == 2 or axis == "z"
        }
