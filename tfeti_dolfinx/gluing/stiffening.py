"""Stiffness on what Dirichlet conditions hold at 0, beside their rows."""

from __future__ import annotations

from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.gluing.prescribed import Prescribed
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import any_rank


class Stiffening:
    """Adds ρ K_ii to K_ii where a component is prescribed as 0.

    An augmented Lagrangian: rows hold the component at 0, so that nothing of the solution changes,
    but a flat subdomain that conditions hold along a side no longer bends far more easily than the
    body can. Creation and all methods are collective.

    Args:
        penalty: ρ.
        dofs: Dof maps.
    """

    def __init__(self, penalty: float, dofs: TornDofs) -> None:
        self._penalty, self._dofs = penalty, dofs
        self._held: Array = np.zeros(dofs.num_nodes * dofs.bs, dtype=bool)

    def look(self, prescribed: Prescribed) -> bool:
        """Take new conditions; whether another K comes of them."""
        if self._penalty == 0.0:
            return False
        held = self._dofs.spread(prescribed.flag & (prescribed.value == 0.0))
        held = self._dofs.to_dolfinx(held.ravel()) > 0.0
        old, self._held = self._held, held
        return any_rank(self._dofs.comm, not np.array_equal(old, held))

    def stiffened(self, K: Any) -> Any:
        """K of this rank in DOLFINx's numbering, scipy CSR, or a copy with what is added."""
        if self._penalty == 0.0:
            return K
        K, diagonal = K.copy(), K.diagonal()
        K.setdiag(np.where(self._held, (1.0 + self._penalty) * diagonal, diagonal))
        return K
