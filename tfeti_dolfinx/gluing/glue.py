"""All rows of a scene: from Dirichlet conditions and contact records to B and c."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.gluing.constraints import Constraints, assemble_constraints
from tfeti_dolfinx.gluing.contact import InequalityRows, inequality_rows
from tfeti_dolfinx.gluing.interface import equality_rows
from tfeti_dolfinx.gluing.prescribed import Prescribed, prescribe
from tfeti_dolfinx.mesh.dofs import TornDofs


@dataclass(frozen=True)
class Gluing:
    """Rows of a scene, and the Dirichlet values and contact records that they come from."""

    prescribed: Prescribed
    records: ContactRecords
    inequalities: InequalityRows
    constraints: Constraints

    def multipliers(self, earlier: Gluing, lam: Array) -> Array:
        """Multipliers of earlier rows of the same scene on these; zero on rows that are new.

        Args:
            earlier: The earlier rows.
            lam: Their multipliers on this rank.
        """
        start = np.zeros(self.constraints.num_rows)
        equalities = self.constraints.num_equalities
        start[:equalities] = lam[:equalities]
        _, new, old = np.intersect1d(
            self._condition_keys(), earlier._condition_keys(), return_indices=True
        )
        force = lam[equalities + old] * earlier.inequalities.scale[old]
        start[equalities + new] = force / self.inequalities.scale[new]
        return start

    def _condition_keys(self) -> Array:
        """A number for the contact and the node of each inequality row."""
        rows, records = self.inequalities.condition, self.records
        return records.contact[rows] * 2**40 + records.group[rows]


def glue(
    dofs: TornDofs,
    bcs: Sequence[fem.DirichletBC],
    records: ContactRecords,
    length: float,
    weights: Array,
) -> Gluing:
    """Rows of interfaces, Dirichlet conditions and contacts. Collective.

    Args:
        dofs: Dof maps.
        bcs: Dirichlet conditions.
        records: Contact conditions of this rank; those that are near get rows.
        length: A length of the scene.
        weights: D, positive, one per local primal unknown: the stiffness there, or ones. Rows
            are orthonormal in the inner product of D⁻¹ as far as they can be.

    Raises:
        InputError: Dirichlet conditions contradict each other.
        NoSolutionError: Dirichlet conditions and contacts contradict each other.
    """
    prescribed = prescribe(dofs, bcs)
    D = dofs.gather_copies(weights.reshape(-1, dofs.bs))
    inequalities = inequality_rows(dofs, prescribed, D, records, length)
    equalities = equality_rows(dofs, prescribed, D)
    constraints = assemble_constraints(
        dofs, equalities, inequalities.rows, weights, inequalities.scale
    )
    return Gluing(prescribed, records, inequalities, constraints)
