"""The solution of a contact problem: displacement, multipliers, and fields that follow lazily."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array, sum_rows
from tfeti_dolfinx.contact.arguments import position_of
from tfeti_dolfinx.contact.forces import BodyForces, body_forces, nodal_forces, vertex_tractions
from tfeti_dolfinx.contact.records import remaining_gaps
from tfeti_dolfinx.contact.search import ContactPartner
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.fields import (
    Stress,
    cellwise,
    checked_stress,
    from_vertices,
    frozen,
    nodal,
    von_mises,
)
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mortar.surfaces import group_points, hat_integrals
from tfeti_dolfinx.states import ContactData, ContactStatus, Multipliers


class Solution:
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
        contacts: The contacts with their sides decided: ``contacts[i].surfaces[0]`` has the
            multipliers and the pressure.
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
        self.u, self.lam, self.carrying = u, multipliers.lam, multipliers.carrying
        self.decomposition, self.gluing, self.dofs = decomposition, gluing, gluing.dofs
        self.contacts, self._thickness = list(contacts), frozen(thickness)
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

    @property
    def has_stress(self) -> bool:
        """Whether the problem was given a stress."""
        return self._stress is not None

    @property
    def has_contact(self) -> bool:
        """Whether the problem has contacts."""
        return bool(self.contacts)

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
    def pressure(self) -> fem.Function:
        """Contact pressure on the secondary sides and at obstacles, 0 elsewhere.

        A node of several contacts has the sum of their forces over their areas, each part of a
        surface counted once.
        """
        records, dofs = self.gluing.records, self.dofs
        force = sum_rows(records.group, self.force, dofs.num_groups)
        area = sum_rows(records.group, self.area, dofs.num_groups)
        whole = hat_integrals(dofs, self.decomposition, self._secondary_surfaces, self._thickness)
        values = np.divide(force, np.minimum(area, whole), out=0.0 * force, where=area > 0.0)
        return self._field(values, self._vertices, "pressure")

    @cached_property
    def gap(self) -> fem.Function:
        """Remaining gap after deformation; 0 where there is no contact condition (see status)."""
        values = np.full(self.dofs.num_groups, np.inf)
        np.minimum.at(values, self.gluing.records.group, self.remaining_gap)
        return self._field(np.where(self._vertices, values, 0.0), self._vertices, "gap")

    @property
    def _status_of_conditions(self) -> Array:
        """ContactStatus of each contact condition of this rank."""
        carrying = self._of_conditions(self.carrying)
        return np.where(carrying, ContactStatus.TOUCHING, ContactStatus.OPEN)

    @cached_property
    def status(self) -> fem.Function:
        """ContactStatus of each node, as a number."""
        values = np.full(self.dofs.num_groups, float(ContactStatus.NONE))
        known = self._status_of_conditions.astype(float)
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
        dofs = self.dofs
        surfaces = [name for contact in self.contacts for name in contact.surfaces]
        values, area = vertex_tractions(
            self._nodal_forces, dofs, self.decomposition, surfaces, self._thickness
        )
        function = fem.Function(dofs.V, name="traction")
        components = function.x.array.reshape(-1, dofs.bs)
        for i in range(dofs.bs):
            component = from_vertices(dofs, values[:, i], area > 0.0)
            components[dofs.dolfinx_node, i] = component.x.array[dofs.scalar[1]]
        return function

    @cached_property
    def body_forces(self) -> BodyForces:
        """Resultants of the contact forces on each body. Collective at first use."""
        return body_forces(self._nodal_forces, self.dofs, self.decomposition)

    def contact(self, which: int | str = 0) -> ContactData:
        """State of the nodes of a contact, those that this rank owns. Collective.

        Args:
            which: Position in the list of contacts, or name.

        Raises:
            InputError: There is no such contact, or several have the name.
        """
        records = self.gluing.records
        own = records.contact == position_of(self.contacts, which)
        return ContactData(
            points=group_points(self.dofs)[records.group[own]],
            normal=records.normal[own],
            force=self.force[own],
            pressure=self.contact_pressure[own],
            area=self.area[own],
            gap=self.remaining_gap[own],
            status=self._status_of_conditions[own],
        )

    @cached_property
    def force(self) -> Array:
        """Normal force s_i λ_i of each contact condition of this rank, 0 without a row."""
        scale = np.zeros(len(self.gluing.records))
        scale[self.gluing.contact.condition] = self.gluing.contact.scale
        return scale * self._of_conditions(self.lam)

    def _of_conditions(self, of_rows: Array) -> Array:
        """Values of the rows of each contact condition of this rank, 0 without a row."""
        values = np.zeros(len(self.gluing.records), dtype=of_rows.dtype)
        normals = self.gluing.constraints.sets.normals
        values[self.gluing.contact.condition] = of_rows[normals]
        return values

    @cached_property
    def contact_pressure(self) -> Array:
        """Force over area of each contact condition of this rank. Collective at first use."""
        return np.divide(self.force, self.area, out=0.0 * self.force, where=self.area > 0.0)

    @cached_property
    def area(self) -> Array:
        """∫φ_i times the thickness of each contact condition of this rank. Collective at first use.

        Where a pair covers a part of the node's surface, the thickness is its mean over the whole.
        """
        records = self.gluing.records
        if isinstance(self._thickness, float):
            return self._thickness * records.area
        of, surfaces = self.decomposition, self._secondary_surfaces
        volume = hat_integrals(self.dofs, of, surfaces, self._thickness)[records.group]
        return records.area * volume / hat_integrals(self.dofs, of, surfaces)[records.group]

    @cached_property
    def remaining_gap(self) -> Array:
        """Gap after deformation of each contact condition of this rank. Collective at first use."""
        return remaining_gaps(self.gluing.records, self.dofs, self.u)

    def _sigma(self) -> Any:
        if self._stress is None:
            raise InputError("no stress: give ContactProblem(..., stress=sigma)")
        return self._stress

    @property
    def _secondary_surfaces(self) -> list[str | int]:
        return [contact.surfaces[0] for contact in self.contacts]

    @property
    def _vertices(self) -> Array:
        """Owned groups with a contact condition."""
        found = np.zeros(self.dofs.num_groups, dtype=bool)
        found[self.gluing.records.group] = True
        return found

    @cached_property
    def _nodal_forces(self) -> Array:
        """Contact forces on the owned groups, shape ``(g, gdim)``. Collective at first use."""
        return nodal_forces(self.gluing.records, self.force, self.dofs)

    def _field(self, values: Array, vertices: Array, name: str) -> fem.Function:
        """Scalar function from values of the owned groups at these vertices, 0 elsewhere."""
        function = from_vertices(self.dofs, values, vertices)
        function.name = name
        return function
