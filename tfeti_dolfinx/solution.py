"""The solution of a problem: fields, contact data, values at points."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem, geometry

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import EPSILON, Array, quotient, sum_rows
from tfeti_dolfinx.common.parallel import any_rank, largest, maxima, summed
from tfeti_dolfinx.common.validation import real_numbers
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.constraints.rows import TOLERANCES
from tfeti_dolfinx.contact.partner import ContactPartner, position_of
from tfeti_dolfinx.contact.records import (
    ContactData,
    ContactStatus,
    Friction,
    Resultant,
    ToolState,
    body_forces,
    condition_areas,
    held_pressures,
    relative_displacement,
    resultant,
    vertex_tractions,
)
from tfeti_dolfinx.contact.rigid_body import rotation_vector
from tfeti_dolfinx.contact.tools import ToolMotion
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import plugin
from tfeti_dolfinx.forms.fields import (
    PointValues,
    Stress,
    StressRecovery,
    cellwise,
    from_vertices,
    frozen,
    nodal,
    value_row,
    von_mises,
)
from tfeti_dolfinx.mortar.facets import diameter, group_points, hat_integrals, surface_facets
from tfeti_dolfinx.mortar.tolerances import SEARCH
from tfeti_dolfinx.qp.sets import Face

# of the size of the mesh: how far from a cell of finite elements a point may be
PADDING = 1e-10
# a length: how far it may be for DOLFINx, whatever the size of the mesh
OF_DOLFINX = 1e-6


class Solution:
    """Solution of a contact problem; fields are made when they are first asked for.

    It owns its data, the constants and functions in the stress too: a later solve of the same
    problem leaves it as it is. Only a mesh whose points are moved takes along the fields that are
    made later. Creating a field is collective.

    Attributes:
        u: Displacement in primal order, shape ``(num_nodes * bs,)``.
        lam: Multipliers of this rank's constraints.
        boundary: What boundary elements know of it, if there are any: ``values_at``, which gives
            values as ``value_row``, and ``finite``, the cells of this rank without them.
        contacts: The contacts with their sides decided: ``contacts[i].surfaces[0]`` has the
            multipliers and the pressure.
        v: Velocity in DOLFINx's order of bodies with mass, else None.
        has_stress: True if the problem was given a stress.
        has_contact: True if the problem has contacts.
        has_friction: True if a contact of the problem has friction.
        tool_motions: Where rigid bodies are.
        friction: Bounds or coefficients of the conditions along tangents, else None.
        thickness: What areas are multiplied with, a number or a scalar in UFL.
        finite: True where forces act at X + u, as in finite strain.
    """

    def __init__(
        self,
        u: Array,
        lam: Array,
        face: Face,
        gluing: Gluing,
        contacts: Sequence[ContactPartner],
        *,
        stress: Stress | None,
        thickness: Any,
        finite: bool,
        boundary: Any,
        tool_motions: Sequence[ToolMotion],
        friction: Array | None,
    ) -> None:
        self.u, self.lam = u, lam
        self.carrying, self.holding = face.carrying, face.holding
        self.gluing, self.dofs, self.decomposition = gluing, gluing.dofs, gluing.dofs.decomposition
        # Bᵀλ now: a problem destroys B with its rows
        self._row_forces = gluing.constraints.forces(self.lam)
        self.contacts, self.thickness = list(contacts), frozen(thickness)
        self.finite, self.boundary = finite, boundary
        self.tool_motions, self.friction = tool_motions, friction
        self.v: Array | None = None
        self._stress_of, self.has_stress = stress, stress is not None
        self.has_contact = bool(contacts)
        self.has_friction = any(contact.friction is not None for contact in contacts)

    # ------------------------------------------------------------------- fields

    @cached_property
    def displacement(self) -> fem.Function:
        """Displacement on the torn mesh."""
        function = fem.Function(self.dofs.V, name="displacement")
        function.x.array[:] = self.dofs.to_dolfinx(self.u)
        return function

    @cached_property
    def velocity(self) -> fem.Function:
        """Velocity on the torn mesh, of a problem with mass.

        Raises:
            InputError: It has none.
        """
        if self.v is None:
            raise InputError("no velocity: expected the solution of a ContactDynamics")
        function = fem.Function(self.dofs.V, name="velocity")
        function.x.array[:] = self.v
        return function

    def at(self, points: Any) -> PointValues:
        """Return displacement and stress at points inside the bodies. Collective.

        In finite elements these are the values of ``displacement`` and ``stress``, in boundary
        elements those of Somigliana's identity, which are as accurate inside as on the surface;
        where a thickness is in the forms, but not in the problem, their stress has it, too. It is
        that of the law in the forms: an initial stress has ``interior.stress`` alone.

        Args:
            points: The same on all ranks, shape ``(k, gdim)``. On the surface of boundary elements
                the displacement is that of the nodes, and the stress the mean of points next to it.

        Raises:
            InputError: The points are of another shape, or not finite.
        """
        mesh, u = self.decomposition.mesh, self.displacement
        with agreeing(self.dofs.comm, "at") as given:
            gdim = mesh.geometry.dim
            try:
                points = real_numbers(points)
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"points: {error}; expected numbers of shape (k, {gdim})"
                ) from error
            if points.ndim != 2 or points.shape[1] != gdim or not np.all(np.isfinite(points)):
                raise InputError(
                    f"points of shape {points.shape}; expected finite numbers of shape (k, {gdim})"
                )
            given["points"] = points
        (k, d), x = points.shape, np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        # cells of this rank, each with a point by its position
        nodes, unscaled = mesh.geometry.x, mesh.geometry.x.copy()
        rounding = 4.0 * EPSILON * float(np.abs(nodes).max(initial=0.0))
        scale = OF_DOLFINX / (PADDING * diameter(self.decomposition) + rounding)
        try:
            nodes *= scale
            tree = geometry.bb_tree(mesh, mesh.topology.dim, padding=OF_DOLFINX)
            near = geometry.compute_collisions_points(tree, scale * x)
            found = geometry.compute_colliding_cells(mesh, near, scale * x)
        finally:
            nodes[:] = unscaled
        place, cells = np.repeat(np.arange(k), np.diff(found.offsets)), np.asarray(found.array)
        # rows of each subdomain that has a point, added
        total = np.zeros((k, 1 + d + d * d))
        if self.boundary is not None:  # where a thickness varies there is none
            thickness = self.thickness
            if isinstance(thickness, fem.Constant):
                thickness = float(thickness.value)
            number = thickness if isinstance(thickness, float) else 1.0
            total += self.boundary.values_at(points, (place, cells), number, u)
            kept = np.isin(cells, self.boundary.finite)
            place, cells = place[kept], cells[kept]
        stress = self.stress if self.has_stress else None
        if len(place):
            sigma = np.full((len(place), d, d), np.nan)
            if stress is not None:
                sigma = stress.eval(x[place], cells).reshape(-1, 3, 3)[:, :d, :d]
            np.add.at(total, place, value_row(u.eval(x[place], cells).reshape(-1, d), sigma))
        # means of the subdomains that share a point
        total = summed(mesh.comm, total)
        with np.errstate(invalid="ignore"):
            mean = np.where(total[:, :1] > 0.0, total[:, 1:] / total[:, :1], np.nan)
        return PointValues(mean[:, :d], mean[:, d:].reshape(k, d, d))

    @cached_property
    def interior(self) -> Any:
        """Displacement and stress on the mesh by Somigliana's identity in boundary elements."""
        sigma = self._sigma if self.has_stress else None
        return plugin("Interior")(self.boundary, self.displacement, sigma, self.dofs)

    def to_pyvista(self) -> Any:
        """Return the bodies as a ``pyvista.UnstructuredGrid``, for notebooks. Collective.

        Nodes have the displacement, von Mises stress, contact pressure and status (``von_mises``
        where the problem has a stress), cells their body and subdomain; tears are closed. Rank 0
        has the whole, other ranks None. In a notebook
        ``solution.to_pyvista().warp_by_vector("displacement").plot(scalars="pressure")`` draws it.
        """
        return plugin("to_pyvista")(self)

    @cached_property
    def stress(self) -> fem.Function:
        """Stress in the cells, 3×3, discontinuous."""
        return cellwise(self._sigma, self.dofs, "stress")

    @cached_property
    def von_mises(self) -> fem.Function:
        """Von Mises stress in the cells, discontinuous."""
        return cellwise(von_mises(self._sigma), self.dofs, "von_mises")

    @cached_property
    def nodal_stress(self) -> fem.Function:
        """Stress averaged at the nodes, 3×3."""
        return nodal(self._sigma, self.dofs, "stress")

    @cached_property
    def nodal_von_mises(self) -> fem.Function:
        """Von Mises stress of the cells, averaged at the nodes."""
        return nodal(von_mises(self._sigma), self.dofs, "von_mises")

    @cached_property
    def discretisation_error(self) -> fem.Function:
        """Estimated error in energy of each cell, whose squares add up; see ``StressRecovery``.

        Files for ParaView have it if it has been made, as by ``ContactProblem.estimate``.
        """
        recovery = StressRecovery(self.displacement, self._sigma, self.dofs, self.thickness)
        function = fem.Function(recovery.cells, name="discretisation_error")
        function.x.array[recovery.cell_dof] = np.sqrt(recovery.squares())
        return function

    @property
    def has_discretisation_error(self) -> bool:
        """True if ``discretisation_error`` has been made."""
        return "discretisation_error" in self.__dict__

    @cached_property
    def pressure(self) -> fem.Function:
        """Contact pressure on the secondary sides and at obstacles, 0 elsewhere.

        A node of several contacts has the sum of their forces over their areas, each part of a
        surface counted once.
        """
        values = self._over_areas(self.force[:, None])[:, 0]
        return from_vertices(self.dofs, values, self._vertices, "pressure")

    @cached_property
    def gap(self) -> fem.Function:
        """Remaining gap after deformation; 0 where there is no contact condition (see status)."""
        values = np.full(self.dofs.num_groups, np.inf)
        np.minimum.at(values, self.gluing.records.group, self.remaining_gap)
        return from_vertices(self.dofs, values, self._vertices, "gap")

    @cached_property
    def status(self) -> fem.Function:
        """ContactStatus of each node, as a number."""
        values = np.full(self.dofs.num_groups, float(ContactStatus.NONE))
        known = self.status_of_conditions.astype(float)
        np.maximum.at(values, self.gluing.records.group, known)
        function = from_vertices(self.dofs, values, self._vertices, "status")
        function.x.array[:] = np.floor(function.x.array)  # between nodes: the lesser of the two
        return function

    @cached_property
    def traction(self) -> fem.Function:
        """Contact traction on the surfaces of both sides, a vector; 0 elsewhere.

        It is a force over areas of the mesh as it was, in finite strain, too: its moments with
        the shape functions of degree 1 are those of the nodal contact forces, so action and
        reaction of two sides have the same resultant.
        """
        surfaces = [name for contact in self.contacts for name in contact.surfaces]
        values, area = vertex_tractions(self.nodal_forces, self.dofs, surfaces, self.thickness)
        return from_vertices(self.dofs, values, area > 0.0, "traction")

    @cached_property
    def tangential_traction(self) -> fem.Function:
        """Friction on the secondary sides and at obstacles over the area, a vector; 0 elsewhere."""
        values = self._over_areas(self.tangential_force)
        return from_vertices(self.dofs, values, self._vertices, "tangential_traction")

    @cached_property
    def slip(self) -> fem.Function:
        """Slip of the slipping nodes in this load step, a vector; 0 elsewhere.

        Of a node that slips on several contacts it is the mean.
        """
        records, size = self.gluing.records, self.dofs.num_groups
        slips = (self.status_of_conditions == ContactStatus.SLIP).astype(float)
        count = sum_rows(records.group, slips, size)
        total = sum_rows(records.group, slips[:, None] * self.slip_of_conditions, size)
        values = total / np.maximum(count, 1.0)[:, None]
        return from_vertices(self.dofs, values, self._vertices, "slip")

    @cached_property
    def body_forces(self) -> Resultant:
        """Resultants of the contact forces on each body. Collective at first use."""
        return body_forces(self.places(), self.nodal_forces, self.dofs)

    @cached_property
    def _sigma(self) -> Any:
        if self._stress_of is None:
            raise InputError("no stress: give ContactProblem(..., stress=sigma)")
        return self._stress_of(self.displacement)

    @property
    def _vertices(self) -> Array:
        """Owned groups with a contact condition."""
        found = np.zeros(self.dofs.num_groups, dtype=bool)
        found[self.gluing.records.group] = True
        return found

    def _over_areas(self, force: Array) -> Array:
        """Forces of conditions, shape ``(n, k)``, over the area of their nodes: of groups."""
        records, dofs = self.gluing.records, self.dofs
        total = sum_rows(records.group, force, dofs.num_groups)
        area = sum_rows(records.group, self.area, dofs.num_groups)
        surfaces = [contact.surfaces[0] for contact in self.contacts]
        u = self.displacement if self.finite else None
        whole = hat_integrals(dofs, surfaces, self.thickness, u)
        return quotient(total, np.minimum(area, whole)[:, None])

    # ---------------------------------------- contacts, conditions, rigid bodies

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
        friction, area = self.tangential_force[own], self.area[own, None]
        return ContactData(
            points=group_points(self.dofs)[records.group[own]],
            normal=records.normal[own],
            force=self.force[own],
            pressure=self.contact_pressure[own],
            area=self.area[own],
            gap=self.remaining_gap[own],
            status=self.status_of_conditions[own],
            tangential_traction=quotient(friction, area),
            slip=self.slip_of_conditions[own],
            surface=self.contacts[position].surfaces[0],
            resultant=self._resultant(position),
        )

    def _resultant(self, position: int) -> Resultant:
        """Resultant of a contact's forces on the secondary side. Collective.

        Facets of degree 2 may be curved: lever arms are those of all their nodes.
        """
        records, dofs = self.gluing.records, self.dofs
        own = records.contact == position
        group, force = records.group[own], self.condition_forces[own]
        if dofs.V.element.basix_element.degree > 1:
            of = np.flatnonzero(own[records.condition])
            shares = records.weight[of, None] * self.condition_forces[records.condition[of]]
            group = self._groups_on(self.contacts[position].surfaces[0])
            force = dofs.reduce_on_owners(records.entry_group[of], shares)[group]
        return resultant(dofs.comm, self.places()[group], force)

    def _groups_on(self, surface: str | int) -> Array:
        """Owned groups of the nodes of a surface, ascending. Collective."""
        member = np.zeros(self.dofs.num_nodes, dtype=bool)
        member[self.dofs.facet_nodes(surface_facets(self.decomposition, surface))] = True
        return np.flatnonzero(self.dofs.reduce(member, np.logical_or))

    def tool(self, which: int | str = 0) -> ToolState:
        """Return motion and forces of a rigid body. Collective.

        Args:
            which: Position among the rigid bodies, or name.

        Raises:
            InputError: There is no such body.
        """
        with agreeing(self.dofs.comm, "tool") as given:
            names = [tool.name for tool in self.tool_motions]
            position = given["tool"] = position_of(names, which, "tool")
        tool, records = self.tool_motions[position], self.gluing.records
        gdim, own = len(tool.centre), np.isin(records.contact, tool.contacts)
        arm = np.zeros((int(np.sum(own)), 3))
        arm[:, :gdim] = records.place[own] - tool.centre
        return ToolState(
            name=tool.name,
            displacement=tool.motion[:gdim],
            rotation=rotation_vector(tool.motion, gdim),
            resultant=resultant(self.dofs.comm, arm, -self.condition_forces[own]),
            velocity=None if tool.velocity is None else tool.velocity[:gdim],
            spin=None if tool.velocity is None else rotation_vector(tool.velocity, gdim),
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
        groups = self._groups_on(surface)
        # −Bᵀλ, summed over the copies of a node, less the contact forces: gluing forces cancel
        constraints = self.gluing.constraints
        own = constraints.trace < len(self.u)  # those behind are of rigid bodies
        forces = np.zeros_like(self.u)
        forces[constraints.trace[own]] = -self._row_forces[own]
        total = self.dofs.reduce(forces.reshape(-1, self.dofs.bs), np.add)
        force = (total - self.nodal_forces)[groups]
        return resultant(self.dofs.comm, self.places()[groups], force)

    @cached_property
    def force(self) -> Array:
        """Normal force s_i λ_i of each contact condition of this rank. Collective at first use.

        It is 0 without a constraint, but where held vertices touch: they bear what their neighbours
        do.
        """
        rows, records = self.gluing.constraints, self.gluing.records
        force = np.zeros(len(records))
        force[rows.contact.normals] = rows.scale * self.lam[rows.sets.normals]
        if any_rank(self.dofs.comm, len(records.held) > 0):
            pressure, contacts = quotient(force, self.area), len(self.contacts)
            borne, at = held_pressures(records, self.dofs, contacts, pressure), self.gluing.closed()
            force[at] = (borne * self.area)[at]
        return force

    @cached_property
    def tangential_force(self) -> Array:
        """Friction on the node of each contact condition of this rank, shape ``(n, gdim)``.

        Collective at first use.
        """
        rows, records = self.gluing.constraints.contact, self.gluing.records
        lam = self.lam[self.gluing.constraints.sets.tangents]
        force = np.zeros(records.normal.shape)
        along = np.einsum("tk,tkg->tg", lam, records.tangents[rows.points])
        force[rows.points] = -rows.tangent_scale[:, None] * along
        return force + self.forced_friction

    @cached_property
    def forced_slip(self) -> Array:
        """Slips along tangents that are prescribed, else no numbers; collective at first use."""
        if self.friction is None:
            return np.full(self.gluing.slip.shape, np.nan)
        slip = np.where(self.gluing.forced(), self.gluing.given_slip, np.nan)
        slip[np.abs(slip) < TOLERANCES.still * largest(self.dofs.comm, self.u)] = 0.0
        return slip

    @cached_property
    def forced_friction(self) -> Array:
        """Friction of nodes that are made to slip, ``(n, gdim)``, else 0. Collective at first."""
        records = self.gluing.records
        if self.friction is None:
            return np.zeros(records.normal.shape)
        given = np.where(records.friction == Friction.COULOMB, self.force, self.area)
        bound = self.friction * given[:, None]
        pull = bound * self.forced_slip
        share = quotient(bound * pull, np.linalg.norm(pull, axis=1, keepdims=True))
        held = self.gluing.prescribed.flag[records.group]
        return -np.einsum("nt,ntg->ng", share, records.tangents) * held

    @cached_property
    def contact_pressure(self) -> Array:
        """Force over area of each contact condition of this rank. Collective at first use."""
        return quotient(self.force, self.area)

    @cached_property
    def largest_pressures(self) -> Array:
        """Largest pressures of each contact, shape ``(2, contacts)``. Collective at first use.

        Those of nodes of which the other side covers 2 % or more, and those of others, which are
        not believed; 0 where there are none.
        """
        records, found = self.gluing.records, np.zeros((2, len(self.contacts)))
        hardly = (records.covered < SEARCH.believed).astype(int)
        np.maximum.at(found, (hardly, records.contact), self.contact_pressure)
        return maxima(self.dofs.comm, found)

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
        forced = self.forced_slip
        slip = np.where(np.isnan(forced), self._motion[1] - self.gluing.slip, forced)
        return np.einsum("nt,ntg->ng", slip, self.gluing.records.tangents)

    @cached_property
    def slip_at_end(self) -> Array:
        """Tangential v_i of each condition at the end of the step, shape ``(n, gdim - 1)``.

        Of a node that sticks it is what it was: else a step would take the algebraic error of the
        one before for a slip. Collective at first use.
        """
        gluing, rows = self.gluing, self.gluing.constraints.contact
        at, end = gluing.constraints.sets.tangents, self._motion[1]
        rubs = np.any(self.lam[at] != 0.0, axis=1) & np.all(self.holding[at] | ~rows.moves, axis=1)
        forced, kept = gluing.slip + self.forced_slip, np.zeros(end.shape, dtype=bool)
        end = np.where(np.isnan(forced), end, forced)
        kept[rows.points] = rubs[:, None] & rows.moves
        return np.where(kept, gluing.slip, end)

    @cached_property
    def dissipation(self) -> Array:
        """Energy that friction dissipates at each condition in this step, shape ``(n,)``.

        −F·s, F the friction on the node and s its slip. Collective at first use.
        """
        return -np.sum(self.tangential_force * self.slip_of_conditions, axis=1)

    @cached_property
    def status_of_conditions(self) -> Array:
        """ContactStatus of each contact condition of this rank. Collective at first use."""
        sets, rows = self.gluing.constraints.sets, self.gluing.constraints.contact
        status = np.full(len(self.gluing.records), ContactStatus.OPEN)
        touching, decided = rows.normals[self.carrying[sets.normals]], rows.decided
        status[touching] = ContactStatus.TOUCHING
        status[decided[self.force[decided] > 0.0]] = ContactStatus.TOUCHING
        sticks = np.all(self.holding[sets.tangents] | ~rows.moves, axis=1)
        rubbing = np.where(sticks, ContactStatus.STICK, ContactStatus.SLIP)
        closed = np.isin(rows.points, np.concatenate((touching, decided)))
        status[rows.points[closed]] = rubbing[closed]
        status[np.any(self.forced_friction, axis=1)] = ContactStatus.SLIP
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
