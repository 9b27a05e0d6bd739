"""The solution of a contact problem: displacement, multipliers, and fields that follow lazily."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.boundary.solved import BoundarySolution
from tfeti_dolfinx.contact.forces import BodyForces, body_forces, vertex_tractions
from tfeti_dolfinx.contact.partners import ContactPartner
from tfeti_dolfinx.contact_state import ContactState, Multipliers
from tfeti_dolfinx.discretisation import StressRecovery
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.fields import (
    Stress,
    cellwise,
    checked_stress,
    from_vertices,
    frozen,
    nodal,
    vector_from_vertices,
    von_mises,
)
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.interior import Interior
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mortar.surfaces import hat_integrals
from tfeti_dolfinx.point_values import PointValues, checked_points, values_at
from tfeti_dolfinx.states import ContactStatus


class Solution(ContactState):
    """What a solve has found; fields are made when they are first asked for.

    It owns its data, the constants and functions in the stress too: a later solve of the same
    problem leaves it as it is. Only a mesh whose points are moved takes along the fields that are
    made later. Creating a field is collective.

    Args:
        u: Displacement in primal order, shape ``(num_nodes * bs,)``.
        multipliers: Multipliers of this rank's rows.
        decomposition: The torn mesh.
        gluing: Rows and contact records.
        contacts: Obstacles and pairs, the secondary surface of a pair first.
        stress: UFL stress of a displacement, or None.
        thickness: What areas of the mesh are multiplied with, a number or a scalar in UFL.

    Attributes:
        u: Displacement in primal order.
        lam: Multipliers of this rank's rows.
        boundary: What boundary elements know of it, if there are any.
        contacts: The contacts with their sides decided: ``contacts[i].surfaces[0]`` has the
            multipliers and the pressure.
        v: Velocity in DOLFINx's order of bodies with mass, else None.
    """

    def __init__(
        self,
        u: Array,
        multipliers: Multipliers,
        decomposition: Decomposition,
        gluing: Gluing,
        contacts: Sequence[ContactPartner] = (),
        stress: Stress | None = None,
        thickness: Any = 1.0,
    ) -> None:
        super().__init__(u, multipliers, decomposition, gluing, contacts, frozen(thickness))
        self.v: Array | None = None
        self.boundary: BoundarySolution | None = None
        self._stress = None
        if stress is not None:
            u_h = self.displacement
            self._stress = frozen(checked_stress(stress, u_h), but=u_h)

    @cached_property
    def displacement(self) -> fem.Function:
        """Displacement on the torn mesh."""
        function = fem.Function(self.dofs.V, name="displacement")
        function.x.array[:] = self.dofs.to_dolfinx(self.u)
        return function

    @cached_property
    def velocity(self) -> fem.Function:
        """Velocity on the torn mesh, of a problem with mass."""
        if self.v is None:
            raise InputError("no velocity: expected the solution of a ContactDynamics")
        function = fem.Function(self.dofs.V, name="velocity")
        function.x.array[:] = self.v
        return function

    @property
    def has_velocity(self) -> bool:
        """Whether the bodies have mass."""
        return self.v is not None

    def at(self, points: Any) -> PointValues:
        """Displacement and stress at points inside the bodies. Collective.

        In finite elements these are the values of ``displacement`` and ``stress``, in boundary
        elements those of Somigliana's identity, which are as accurate inside as on the surface;
        where a thickness is in the forms, but not in the problem, their stress has it, too. It is
        that of the law in the forms: an initial stress has ``interior.stress`` alone.

        Args:
            points: The same on all ranks, shape ``(k, gdim)``. On the surface of boundary elements
                the displacement is that of their nodes, and the stress that of a point beside it.

        Raises:
            InputError: The points are of another shape, or not finite.
        """
        points = checked_points(points, self.decomposition.mesh.geometry.dim)
        stress = self.stress if self.has_stress else None
        return values_at(points, self.boundary, self.thickness, self.displacement, stress)

    @cached_property
    def interior(self) -> Interior:
        """Displacement and stress on the mesh by Somigliana's identity in boundary elements."""
        return Interior(self.boundary, self.displacement, self._stress, self.dofs)

    @property
    def has_stress(self) -> bool:
        """Whether the problem was given a stress."""
        return self._stress is not None

    @property
    def has_contact(self) -> bool:
        """Whether the problem has contacts."""
        return bool(self.contacts)

    @property
    def has_friction(self) -> bool:
        """Whether a contact of the problem has friction."""
        return any(contact.friction is not None for contact in self.contacts)

    @cached_property
    def stress(self) -> fem.Function:
        """Stress in the cells, 3×3, discontinuous."""
        return cellwise(self._sigma(), self.dofs, "stress")

    @cached_property
    def von_mises(self) -> fem.Function:
        """Von Mises stress in the cells, discontinuous."""
        return cellwise(von_mises(self._sigma()), self.dofs, "von_mises")

    @cached_property
    def nodal_stress(self) -> fem.Function:
        """Stress averaged at the nodes, 3×3."""
        return nodal(self._sigma(), self.dofs, "stress")

    @cached_property
    def nodal_von_mises(self) -> fem.Function:
        """Von Mises stress of the cells, averaged at the nodes."""
        return nodal(von_mises(self._sigma()), self.dofs, "von_mises")

    @cached_property
    def discretisation_error(self) -> fem.Function:
        """Estimated error in energy of each cell, whose squares add up; see ``StressRecovery``.

        Files for ParaView have it if it has been made, as by ``ContactProblem.estimate``.
        """
        recovery = StressRecovery(
            self.displacement, self._sigma(), self.dofs, self.decomposition, self.thickness
        )
        function = fem.Function(recovery.cells, name="discretisation_error")
        function.x.array[recovery.cell_dof] = np.sqrt(recovery.squares())
        return function

    @property
    def has_discretisation_error(self) -> bool:
        """Whether ``discretisation_error`` has been made."""
        return "discretisation_error" in self.__dict__

    @cached_property
    def pressure(self) -> fem.Function:
        """Contact pressure on the secondary sides and at obstacles, 0 elsewhere.

        A node of several contacts has the sum of their forces over their areas, each part of a
        surface counted once.
        """
        values = self._over_areas(self.force[:, None])[:, 0]
        return self._field(values, self._vertices, "pressure")

    @cached_property
    def gap(self) -> fem.Function:
        """Remaining gap after deformation; 0 where there is no contact condition (see status)."""
        values = np.full(self.dofs.num_groups, np.inf)
        np.minimum.at(values, self.gluing.records.group, self.remaining_gap)
        return self._field(np.where(self._vertices, values, 0.0), self._vertices, "gap")

    @cached_property
    def status(self) -> fem.Function:
        """ContactStatus of each node, as a number."""
        values = np.full(self.dofs.num_groups, float(ContactStatus.NONE))
        known = self.status_of_conditions.astype(float)
        np.maximum.at(values, self.gluing.records.group, known)
        function = self._field(values, self._vertices, "status")
        function.x.array[:] = np.floor(function.x.array)  # between nodes: the lesser of the two
        return function

    @cached_property
    def traction(self) -> fem.Function:
        """Contact traction on the surfaces of both sides, a vector; 0 elsewhere.

        Its moments with the hats of degree 1 are those of the nodal contact forces, so action
        and reaction of two sides have the same resultant.
        """
        surfaces = [name for contact in self.contacts for name in contact.surfaces]
        values, area = vertex_tractions(
            self.nodal_forces, self.dofs, self.decomposition, surfaces, self.thickness
        )
        return vector_from_vertices(self.dofs, values, area > 0.0, "traction")

    @cached_property
    def tangential_traction(self) -> fem.Function:
        """Friction on the secondary sides and at obstacles over the area, a vector; 0 elsewhere."""
        values = self._over_areas(self.tangential_force)
        return vector_from_vertices(self.dofs, values, self._vertices, "tangential_traction")

    @cached_property
    def slip(self) -> fem.Function:
        """How far nodes that slip have slid in this load step, a vector; 0 elsewhere.

        Of a node that slips on several contacts it is the mean.
        """
        records, size = self.gluing.records, self.dofs.num_groups
        slips = (self.status_of_conditions == ContactStatus.SLIP).astype(float)
        count = sum_rows(records.group, slips, size)
        total = sum_rows(records.group, slips[:, None] * self.slip_of_conditions, size)
        values = total / np.maximum(count, 1.0)[:, None]
        return vector_from_vertices(self.dofs, values, self._vertices, "slip")

    @cached_property
    def body_forces(self) -> BodyForces:
        """Resultants of the contact forces on each body. Collective at first use."""
        return body_forces(self.nodal_forces, self.dofs, self.decomposition)

    def _sigma(self) -> Any:
        if self._stress is None:
            raise InputError("no stress: give ContactProblem(..., stress=sigma)")
        return self._stress

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
        whole = hat_integrals(dofs, self.decomposition, self.secondary_surfaces, self.thickness)
        area = np.minimum(area, whole)[:, None]
        return np.divide(total, area, out=np.zeros_like(total), where=area > 0.0)

    def _field(self, values: Array, vertices: Array, name: str) -> fem.Function:
        """Scalar function from values of the owned groups at these vertices, 0 elsewhere."""
        function = from_vertices(self.dofs, values, vertices)
        function.name = name
        return function
