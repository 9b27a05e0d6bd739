"""Forces, gaps, slips and statuses of conditions at a solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.common.validation import is_whole, shown
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.contact.partner import ContactPartner, position_of
from tfeti_dolfinx.contact.records import (
    Resultant,
    condition_areas,
    relative_displacement,
    resultant,
)
from tfeti_dolfinx.contact.rigid_body import rotation_vector
from tfeti_dolfinx.contact.tools import ToolMotion
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mortar.facets import facet_nodes, group_points, surface_facets
from tfeti_dolfinx.qp.sets import Face

# --- Status of contacts and rows --------------------------------------------------------------


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
    """

    name: str
    displacement: Array
    rotation: Array
    resultant: Resultant

    def __str__(self) -> str:
        """One line: names of what is not 0, and its numbers."""
        parts = {"displacement": self.displacement, "rotation": self.rotation}
        parts |= {"force": self.resultant.force, "moment": self.resultant.moment}
        words = [
            f"{what} ({', '.join(f'{value:.6g}' for value in values)})"
            for what, values in parts.items()
            if what in ("displacement", "force") or np.any(values)
        ]
        return f"{self.name}: {', '.join(words)}"

    @property
    def numbers(self) -> dict[str, float]:
        """All components by name, for tables."""
        axes = "xyz"[: len(self.displacement)]
        turns = "xyz" if len(axes) == 3 else "z"
        parts = {
            "displacement": (axes, self.displacement),
            "rotation": (turns, self.rotation[-len(turns) :]),
            "force": (axes, self.resultant.force),
            "moment": (turns, self.resultant.moment[-len(turns) :]),
        }
        return {
            f"{self.name} {what} {axis}": float(value)
            for what, (names, values) in parts.items()
            for axis, value in zip(names, values, strict=True)
        }


# --- State of contact conditions: forces, gaps, slips -----------------------------------------


@dataclass(frozen=True)
class Multipliers:
    """Multipliers of this rank's rows."""

    lam: Array  # λ, shape (m,)
    face: Face  # which of them carry a force, and which slip


class ContactState:
    """Displacement, multipliers, and what follows for the contact conditions of this rank.

    u is in primal order, shape ``(num_nodes * bs,)``; areas are multiplied by the thickness, a
    number or a scalar in UFL. ``finite``: forces act at X + u, as in finite strain.
    """

    def __init__(
        self,
        u: Array,
        multipliers: Multipliers,
        gluing: Gluing,
        contacts: Sequence[ContactPartner],
        thickness: Any,
    ) -> None:
        self.u, self.lam = u, multipliers.lam
        self.carrying, self.holding = multipliers.face.carrying, multipliers.face.holding
        self.gluing, self.dofs, self.decomposition = gluing, gluing.dofs, gluing.dofs.decomposition
        self.contacts, self.thickness = list(contacts), thickness
        self.tool_motions: Sequence[ToolMotion] = ()
        self.finite = False

    def places(self) -> Array:
        """Points where forces on the owned groups act, shape ``(g, 3)``. Collective."""
        points = group_points(self.dofs)
        if self.finite and self.dofs.nodes is None:  # else nodes have moved there
            moved = np.zeros((self.dofs.num_nodes, 3))
            moved[:, : self.dofs.bs] = self.u.reshape(-1, self.dofs.bs)
            points += self.dofs.reduce(moved, np.minimum)
        return points

    def contact(self, which: int | str = 0) -> ContactData:
        """State of the nodes of a contact, those that this rank owns. Collective.

        Args:
            which: Position in the list of contacts, or name.

        Raises:
            InputError: There is no such contact, or several have the name.
        """
        with agreeing(self.dofs.comm, "contact") as given:
            names = [contact.name for contact in self.contacts]
            position = given["contact"] = position_of(names, which)
        records = self.gluing.records
        own = records.contact == position
        points, places = (x[records.group[own]] for x in (group_points(self.dofs), self.places()))
        area = self.area[:, None]
        traction = np.divide(
            self.tangential_force, area, out=0.0 * self.tangential_force, where=area > 0.0
        )
        return ContactData(
            points=points,
            normal=records.normal[own],
            force=self.force[own],
            pressure=self.contact_pressure[own],
            area=self.area[own],
            gap=self.remaining_gap[own],
            status=self.status_of_conditions[own],
            tangential_traction=traction[own],
            slip=self.slip_of_conditions[own],
            surface=self.contacts[position].surfaces[0],
            resultant=resultant(self.dofs.comm, places, self.condition_forces[own]),
        )

    def tool(self, which: int | str = 0) -> ToolState:
        """Return motion and forces of a rigid body. Collective.

        Args:
            which: Position among the rigid bodies, or name.

        Raises:
            InputError: There is no such body.
        """
        names = [tool.name for tool in self.tool_motions]
        with agreeing(self.dofs.comm, "tool") as given:
            if which in names:
                which = names.index(str(which))
            if not is_whole(which) or not 0 <= which < len(names):
                raise InputError(f"tool {shown(which)}: expected one of {names}, or its position")
            given["tool"] = which
        tool, records = self.tool_motions[which], self.gluing.records
        gdim, own = len(tool.centre), np.isin(records.contact, tool.contacts)
        arm = np.zeros((int(np.sum(own)), 3))
        arm[:, :gdim] = records.place[own] - tool.centre
        return ToolState(
            name=tool.name,
            displacement=tool.motion[:gdim],
            rotation=rotation_vector(tool.motion, gdim),
            resultant=resultant(self.dofs.comm, arm, -self.condition_forces[own]),
        )

    def reaction(self, surface: str | int) -> Resultant:
        """Return the force and moment by which Dirichlet conditions hold a surface. Collective.

        Contact forces are not in it. Of a node that two surfaces share, both have the whole force.
        Of bodies with mass it is the mean of the step.

        Args:
            surface: Name or tag.

        Raises:
            InputError: The surface is unknown, has no facets, or lies inside a body.
        """
        with agreeing(self.dofs.comm, "reaction") as given:
            given["surface"] = self.decomposition.surface(surface)
        facets = surface_facets(self.decomposition, surface)
        member = np.zeros(self.dofs.num_nodes, dtype=bool)
        member[facet_nodes(self.dofs, facets)] = True
        groups = np.flatnonzero(self.dofs.reduce(member, np.logical_or))
        # −Bᵀλ, summed over the copies of a node, less the contact forces: gluing forces cancel
        constraints = self.gluing.constraints
        own = constraints.trace < len(self.u)  # those behind are of rigid bodies
        forces = np.zeros_like(self.u)
        forces[constraints.trace[own]] = -constraints.forces(self.lam)[own]
        total = self.dofs.reduce(forces.reshape(-1, self.dofs.bs), np.add)
        force = (total - self.nodal_forces)[groups]
        return resultant(self.dofs.comm, self.places()[groups], force)

    @cached_property
    def force(self) -> Array:
        """Normal force s_i λ_i of each contact condition of this rank. Collective at first use.

        It is 0 without a row, but where held vertices touch: they bear what their neighbours do.
        """
        rows, records = self.gluing.contact, self.gluing.records
        force = np.zeros(len(records))
        force[rows.condition] = rows.scale * self.lam[self.gluing.constraints.sets.normals]
        if not any_rank(self.dofs.comm, len(records.held) > 0):
            return force
        pressure = np.divide(force, self.area, out=0.0 * force, where=self.area > 0.0)
        beside = np.zeros(len(records.held))
        for contact in range(len(self.contacts)):
            own, of = records.contact == contact, records.contact[records.held] == contact
            known = np.zeros(self.dofs.num_groups)
            known[records.group[own]] = pressure[own]
            (beside[of],) = self.dofs.lookup(records.beside[of], known)
        at = self.gluing.closed()
        force[at] = (sum_rows(records.held, records.share * beside, len(records)) * self.area)[at]
        return force

    @cached_property
    def tangential_force(self) -> Array:
        """Friction on the node of each contact condition of this rank, shape ``(n, gdim)``."""
        rows, records = self.gluing.tangents, self.gluing.records
        lam = self.lam[self.gluing.constraints.sets.tangents]
        force = np.zeros(records.normal.shape)
        along = np.einsum("tk,tkg->tg", lam, records.tangents[rows.condition])
        force[rows.condition] = -rows.scale[:, None] * along
        return force

    @cached_property
    def contact_pressure(self) -> Array:
        """Force over area of each contact condition of this rank. Collective at first use."""
        return np.divide(self.force, self.area, out=0.0 * self.force, where=self.area > 0.0)

    @cached_property
    def area(self) -> Array:
        """∫φ_i times the thickness of each contact condition of this rank. Collective at first use.

        Where a pair covers a part of the node's surface, the thickness is its mean over the whole.
        """
        surfaces = [contact.surfaces[0] for contact in self.contacts]
        return condition_areas(self.gluing.records, self.dofs, surfaces, self.thickness)

    @cached_property
    def remaining_gap(self) -> Array:
        """Gap after deformation of each contact condition of this rank. Collective at first use."""
        return self.gluing.records.gap - self._motion[0]

    @cached_property
    def _motion(self) -> tuple[Array, Array]:
        """The v_i along normals, ``(n,)``, and tangents, ``(n, gdim - 1)``. Collective at first."""
        records = self.gluing.records
        v = relative_displacement(records, self.dofs, self.u)
        return np.sum(records.normal * v, axis=1), np.einsum("ntg,ng->nt", records.tangents, v)

    @cached_property
    def slip_of_conditions(self) -> Array:
        """Change of the tangential v_i of each condition in this step, a vector.

        Shape ``(n, gdim)``. Collective at first use.
        """
        records = self.gluing.records
        return np.einsum("nt,ntg->ng", self._motion[1] - self.gluing.slip, records.tangents)

    @cached_property
    def slip_at_end(self) -> Array:
        """Tangential v_i of each condition at the end of the step, shape ``(n, gdim - 1)``.

        Of a node that sticks it is what it was: else a step would take the algebraic error of the
        one before for a slip. Collective at first use.
        """
        gluing, rows = self.gluing, self.gluing.tangents
        at, end = gluing.constraints.sets.tangents, self._motion[1]
        rubs = np.any(self.lam[at] != 0.0, axis=1) & np.all(self.holding[at] | ~rows.moves, axis=1)
        kept = np.zeros(end.shape, dtype=bool)
        kept[rows.condition] = rubs[:, None] & rows.moves
        return np.where(kept, gluing.slip, end)

    @cached_property
    def dissipation(self) -> Array:
        """Energy that friction dissipates at each condition in this step, shape ``(n,)``.

        −F·s, F the friction on the node and s its slip. Collective at first use.
        """
        return -np.sum(self.tangential_force * self.slip_of_conditions, axis=1)

    @cached_property
    def status_of_conditions(self) -> Array:
        """ContactStatus of each contact condition of this rank."""
        gluing, sets = self.gluing, self.gluing.constraints.sets
        status = np.full(len(gluing.records), ContactStatus.OPEN)
        touching = gluing.contact.condition[self.carrying[sets.normals]]
        status[touching] = ContactStatus.TOUCHING
        decided = gluing.contact.decided
        status[decided[self.force[decided] > 0.0]] = ContactStatus.TOUCHING
        rows = gluing.tangents
        held = np.all(self.holding[sets.tangents] | ~rows.moves, axis=1)
        rubbing = np.where(held, ContactStatus.STICK, ContactStatus.SLIP)
        closed = np.isin(rows.condition, np.concatenate((touching, decided)))
        status[rows.condition[closed]] = rubbing[closed]
        return status

    @cached_property
    def condition_forces(self) -> Array:
        """Force on the node of each contact condition of this rank, shape ``(n, gdim)``."""
        return self.tangential_force - self.force[:, None] * self.gluing.records.normal

    @cached_property
    def nodal_forces(self) -> Array:
        """Contact forces Σ_i w_ij F_i on the owned groups. Collective at first use.

        Shape ``(g, gdim)``, of both sides.
        """
        records = self.gluing.records
        shares = records.weight[:, None] * self.condition_forces[records.condition]
        return self.dofs.reduce_on_owners(records.entry_group, shares)
