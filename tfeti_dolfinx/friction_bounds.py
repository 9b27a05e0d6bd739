"""What bounds the tangential forces of a scene, and where its slips count from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.forces import condition_areas
from tfeti_dolfinx.contact.partners import ContactPartner
from tfeti_dolfinx.contact.records import slips
from tfeti_dolfinx.contact.search import ContactSearch
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import any_rank


class FrictionBounds:
    """Bounds of tangential forces from laws of friction. All methods are collective.

    Args:
        contacts: Obstacles and pairs; without friction nothing is done.
        dofs: Dof maps.
        decomposition: The torn mesh.
        thickness: What areas of the mesh are multiplied with, a number or a scalar in UFL.

    Attributes:
        exists: Whether a contact has friction.
        rest: Displacement at which the load step begins, in primal order; None: no displacement.
    """

    def __init__(
        self,
        contacts: Sequence[ContactPartner],
        dofs: TornDofs,
        decomposition: Decomposition,
        thickness: Any,
    ) -> None:
        self._dofs, self._decomposition, self._thickness = dofs, decomposition, thickness
        self._known: Array | None = None
        self.exists = any(contact.friction is not None for contact in contacts)
        self.rest: Array | None = None

    def slip(self, search: ContactSearch) -> Array:
        """Tangential v_i of all conditions where the load step begins, shape ``(n, gdim - 1)``."""
        records = search.records
        if self.rest is None:
            return np.zeros(records.tangents.shape[:2])
        return slips(records, self._dofs, self.rest)

    def has_changed(self, search: ContactSearch) -> bool:
        """Whether laws say something else than when the limits were last set.

        Raises:
            InputError: A value is negative or no number somewhere.
        """
        if not self.exists or self._known is None:
            return False
        return any_rank(self._dofs.comm, not np.array_equal(search.friction(), self._known))

    def set_limits(self, gluing: Gluing, search: ContactSearch) -> None:
        """Fill the ψ_i of the rows, and the μ_i under Coulomb's law.

        Raises:
            InputError: A value is negative or no number somewhere.
        """
        if not self.exists:
            return
        contacts = search.contacts
        surfaces = [contact.surfaces[0] for contact in contacts]
        of, thickness = self._decomposition, self._thickness
        area = condition_areas(gluing.records, self._dofs, of, surfaces, thickness)
        self._known = search.friction()
        gluing.constraints.set_limits(gluing.tangents.limits(self._known, area))
        gluing.constraints.coefficients[:] = gluing.tangents.coefficients(self._known)
