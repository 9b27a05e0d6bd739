"""The solution of a contact problem: displacement, multipliers, and fields that follow lazily."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import first_component
from tfeti_dolfinx.contact.records import remaining_gaps
from tfeti_dolfinx.contact.surfaces import group_points
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.fields import Stress, cellwise, checked_stress, nodal, von_mises
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs


class ContactStatus(IntEnum):
    """Status of a node."""

    NONE = 0
    OPEN = 1
    TOUCHING = 2


@dataclass(frozen=True)
class ContactData:
    """State of the conditions of one contact on this rank, one row per node.

    Attributes:
        points: Nodes, shape ``(n, 3)``.
        normal: Direction in which a node may not go further, shape ``(n, gdim)``.
        force: Normal force on the node, 0 or more, shape ``(n,)``.
        pressure: Force / ∫φ_i, shape ``(n,)``.
        gap: Remaining distance, shape ``(n,)``.
        area: ∫φ_i, shape ``(n,)``.
    """

    points: Array
    normal: Array
    force: Array
    pressure: Array
    gap: Array
    area: Array


class Solution:
    """What a solve has found; fields are made when they are first asked for.

    Creating a field is collective.

    Args:
        u: Displacement on the torn mesh.
        dofs: Dof maps.
        decomposition: The torn mesh.
        gluing: Rows and contact records.
        lam: Multipliers of this rank's rows.
        mu: Multipliers of Gλ = e.
        stress: UFL stress of a displacement, or None.
    """

    def __init__(
        self,
        u: fem.Function,
        dofs: TornDofs,
        decomposition: Decomposition,
        gluing: Gluing,
        lam: Array,
        mu: Array,
        stress: Stress | None,
    ) -> None:
        self.displacement, self.dofs, self.decomposition = u, dofs, decomposition
        self.gluing, self.lam, self.mu = gluing, lam, mu
        self._stress = stress

    @property
    def has_stress(self) -> bool:
        """Whether the problem was given a stress."""
        return self._stress is not None

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
        """Contact pressure, 0 off the contact surfaces."""
        values = np.zeros(self.dofs.num_groups)
        np.add.at(values, self.gluing.records.group, self.contact_pressure)
        return self._scalar(values, "pressure")

    @cached_property
    def gap(self) -> fem.Function:
        """Remaining gap after deformation, 0 off the contact surfaces."""
        values = np.full(self.dofs.num_groups, np.inf)
        np.minimum.at(values, self.gluing.records.group, self.remaining_gap)
        return self._scalar(np.where(np.isfinite(values), values, 0.0), "gap")

    @cached_property
    def status(self) -> fem.Function:
        """ContactStatus of each node, as a number."""
        values = np.full(self.dofs.num_groups, float(ContactStatus.NONE))
        touching = np.where(self.force > 0.0, ContactStatus.TOUCHING, ContactStatus.OPEN)
        np.maximum.at(values, self.gluing.records.group, touching.astype(float))
        return self._scalar(values, "status")

    def contact(self, index: int = 0) -> ContactData:
        """State of the nodes of a contact, those that this rank owns. Collective.

        Args:
            index: Position in the list of contacts.

        Raises:
            InputError: There is no such contact.
        """
        records = self.gluing.records
        last = self.dofs.comm.allreduce(int(records.contact.max(initial=-1)), op=MPI.MAX)
        if not 0 <= index <= last:
            raise InputError(f"contact {index}: there are {last + 1}, counted from 0")
        points = group_points(self.dofs)
        own = records.contact == index
        return ContactData(
            points=points[records.group[own]],
            normal=records.normal[own],
            force=self.force[own],
            pressure=self.contact_pressure[own],
            gap=self.remaining_gap[own],
            area=records.area[own],
        )

    @cached_property
    def force(self) -> Array:
        """Normal force s_i λ_i of each contact condition of this rank, 0 without a row."""
        inequalities = self.gluing.inequalities
        values = np.zeros(len(self.gluing.records))
        lam = self.lam[self.gluing.constraints.inequalities]
        values[inequalities.condition] = inequalities.scale * lam
        return values

    @cached_property
    def contact_pressure(self) -> Array:
        """Force / ∫φ_i of each contact condition of this rank, 0 where ∫φ_i = 0."""
        area = self.gluing.records.area
        return np.divide(self.force, area, out=np.zeros_like(area), where=area > 0.0)

    @cached_property
    def remaining_gap(self) -> Array:
        """Gap after deformation of each contact condition of this rank. Collective at first use."""
        u = self.dofs.to_primal(self.displacement.x.array)
        return remaining_gaps(self.gluing.records, self.dofs, u)

    def _sigma(self) -> Any:
        if self._stress is None:
            raise InputError("no stress: give ContactProblem(..., stress=sigma)")
        return checked_stress(self._stress, self.displacement)

    @cached_property
    def _scalar_space(self) -> tuple[fem.FunctionSpace, Array]:
        """Scalar space of the displacement's element, and its dof of each DOLFINx node."""
        V = self.dofs.V
        if self.dofs.bs == 1:
            return V, np.arange(V.dofmap.index_map.size_local)
        S, parent = first_component(V)
        dof = np.empty(len(parent), dtype=np.int64)
        dof[parent // self.dofs.bs] = np.arange(len(parent))
        return S, dof

    def _scalar(self, values: Array, name: str) -> fem.Function:
        """Function from one value per owned group."""
        S, dof = self._scalar_space
        function = fem.Function(S, name=name)
        function.x.array[dof[self.dofs.dolfinx_node]] = self.dofs.spread(values)
        return function
