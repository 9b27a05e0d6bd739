"""The solution of a problem: fields, contact data, values at points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem, geometry
from mpi4py import MPI

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.constraints.contact_state import ContactState, ContactStatus, Multipliers
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.contact.partner import ContactPartner
from tfeti_dolfinx.contact.records import Resultant, body_forces, vertex_tractions
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import plugin
from tfeti_dolfinx.forms.fields import (
    Stress,
    StressRecovery,
    cellwise,
    from_vertices,
    frozen,
    nodal,
    vector_from_vertices,
    von_mises,
)
from tfeti_dolfinx.mortar.facets import hat_integrals

# --- Displacement and stress at given points --------------------------------------------------

# Of the size of the mesh: how far from a cell of finite elements a point may be
PADDING = 1e-10


@dataclass(frozen=True)
class PointValues:
    """Values at points; not a number where a point is in no body.

    Attributes:
        displacement: Shape ``(k, gdim)``.
        stress: Shape ``(k, gdim, gdim)``, in 2D without σ_zz.
    """

    displacement: Array
    stress: Array


def checked_points(points: Any, gdim: int) -> Array:
    """Return finite points as an array of shape ``(k, gdim)``; raise an InputError for others."""
    try:
        found = np.array(points, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"points: {error}; expected numbers of shape (k, {gdim})") from error
    if found.ndim != 2 or found.shape[1] != gdim or not np.all(np.isfinite(found)):
        raise InputError(
            f"points of shape {found.shape}; expected finite numbers of shape (k, {gdim})"
        )
    return found


def value_row(u: Array, stress: Array) -> Array:
    """Return a row for each point: 1, displacement and stress."""
    return np.column_stack((np.ones(len(u)), u, stress.reshape(len(u), u.shape[1] ** 2)))


# --- The solution -----------------------------------------------------------------------------


class Solution(ContactState):
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
    """

    def __init__(
        self,
        u: Array,
        multipliers: Multipliers,
        gluing: Gluing,
        contacts: Sequence[ContactPartner] = (),
        stress: Stress | None = None,
        thickness: Any = 1.0,
    ) -> None:
        super().__init__(u, multipliers, gluing, contacts, frozen(thickness))
        self.v: Array | None = None
        self.boundary: Any = None
        self._stress_of, self.has_stress = stress, stress is not None
        self.has_contact = bool(contacts)
        self.has_friction = any(contact.friction is not None for contact in contacts)

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
                the displacement is that of their nodes, and the stress that of a point next to it.

        Raises:
            InputError: The points are of another shape, or not finite.
        """
        mesh, u = self.decomposition.mesh, self.displacement
        with agreeing(self.dofs.comm, "at") as given:
            points = given["points"] = checked_points(points, mesh.geometry.dim)
        (k, d), x = points.shape, np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        # cells of this rank, each with a point by its position
        nodes = mesh.geometry.x
        size = float(np.ptp(nodes, axis=0).max(initial=0.0)) if len(nodes) else 0.0
        tree = geometry.bb_tree(mesh, mesh.topology.dim, padding=PADDING * size)
        near = geometry.compute_collisions_points(tree, x)
        found = geometry.compute_colliding_cells(mesh, near, x)
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
        mesh.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
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
        return self._field(self._over_areas(self.force[:, None])[:, 0], "pressure")

    @cached_property
    def gap(self) -> fem.Function:
        """Remaining gap after deformation; 0 where there is no contact condition (see status)."""
        values = np.full(self.dofs.num_groups, np.inf)
        np.minimum.at(values, self.gluing.records.group, self.remaining_gap)
        return self._field(np.where(self._vertices, values, 0.0), "gap")

    @cached_property
    def status(self) -> fem.Function:
        """ContactStatus of each node, as a number."""
        values = np.full(self.dofs.num_groups, float(ContactStatus.NONE))
        known = self.status_of_conditions.astype(float)
        np.maximum.at(values, self.gluing.records.group, known)
        function = self._field(values, "status")
        function.x.array[:] = np.floor(function.x.array)  # between nodes: the lesser of the two
        return function

    @cached_property
    def traction(self) -> fem.Function:
        """Contact traction on the surfaces of both sides, a vector; 0 elsewhere.

        Its moments with the shape functions of degree 1 are those of the nodal contact forces,
        so action and reaction of two sides have the same resultant.
        """
        surfaces = [name for contact in self.contacts for name in contact.surfaces]
        values, area = vertex_tractions(self.nodal_forces, self.dofs, surfaces, self.thickness)
        return vector_from_vertices(self.dofs, values, area > 0.0, "traction")

    @cached_property
    def tangential_traction(self) -> fem.Function:
        """Friction on the secondary sides and at obstacles over the area, a vector; 0 elsewhere."""
        values = self._over_areas(self.tangential_force)
        return vector_from_vertices(self.dofs, values, self._vertices, "tangential_traction")

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
        return vector_from_vertices(self.dofs, values, self._vertices, "slip")

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
        whole = hat_integrals(dofs, surfaces, self.thickness)
        area = np.minimum(area, whole)[:, None]
        return np.divide(total, area, out=np.zeros_like(total), where=area > 0.0)

    def _field(self, values: Array, name: str) -> fem.Function:
        """Scalar function from values of the owned groups with a condition, 0 elsewhere."""
        function = from_vertices(self.dofs, values, self._vertices)
        function.name = name
        return function
