"""All rows of a scene: from Dirichlet conditions and contact records to B and c."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import TfetiError
from tfeti_dolfinx.gluing.constraints import Constraints, assemble_constraints
from tfeti_dolfinx.gluing.contact import ContactRows, contact_rows
from tfeti_dolfinx.gluing.interface import HeldRows, equality_rows
from tfeti_dolfinx.gluing.prescribed import Prescribed
from tfeti_dolfinx.gluing.spread import Spread
from tfeti_dolfinx.gluing.tangents import TangentRows, tangent_rows
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import any_rank

# more than any mesh has nodes, and times any number of contacts within 64 bits
MANY_GROUPS = 2**40


@dataclass(frozen=True)
class Gluing:
    """Rows of a scene, and the Dirichlet values and contact records that they come from.

    B depends on which components are prescribed, on the records' normals and weights, on which
    of them are within reach, and on D. Prescribed values and gaps are in c alone.

    Attributes:
        dofs: Dof maps.
        prescribed: Dirichlet values.
        records: Contact conditions of this rank.
        held: The rows that hold prescribed components.
        contact: What belongs to the normal rows.
        tangents: What belongs to the tangential rows.
        constraints: B, c and the sets of rows.
        length: A length of the scene.
        slip: Where the load step begins: the tangential v_i of all conditions then, shape
            ``(n, gdim - 1)``. Friction acts on what comes to it.
    """

    dofs: TornDofs
    prescribed: Prescribed
    records: ContactRecords
    held: HeldRows
    contact: ContactRows
    tangents: TangentRows
    constraints: Constraints
    length: float
    slip: Array

    def right_side(self, values: Array, gaps: Array, slip: Array | None = None) -> Array:
        """This rank's part of c for any prescribed values, gaps and slips; B stays. Collective.

        Args:
            values: Prescribed values of the owned groups, shape ``(g, bs)``; what stands at
                components that are not prescribed has no effect.
            gaps: Gap of each condition of the records, a length, shape ``(n,)``.
            slip: Where the load step begins, as the attribute; default that.

        Returns:
            Shape ``(num_rows,)``, for ``Constraints.set_right_side``.

        Raises:
            NoSolutionError: Prescribed components alone violate a condition, or the conditions
                of a node contradict each other.
        """
        sets = self.constraints.sets
        c = np.zeros(sets.num_rows)
        c[sets.equalities[self.held.row]] = self.held.right_side(values)
        c[sets.normals] = self.contact.right_side(self.dofs, values, gaps, self.length)
        slip = self.slip if slip is None else slip
        c[sets.tangents] = self.tangents.right_side(self.dofs, values, slip)
        return c

    def with_right_side(self, values: Array, gaps: Array, slip: Array | None = None) -> Gluing:
        """The same rows with other prescribed values, gaps, slips; c is filled anew. Collective.

        The constraints are shared with these rows: their c is the new one too. What raises
        leaves it as it was.

        Args:
            values: Prescribed values of the owned groups, shape ``(g, bs)``.
            gaps: Gap of each condition of the records, shape ``(n,)``.
            slip: Where the load step begins, as the attribute; default that.

        Raises:
            NoSolutionError: As ``right_side``.
        """
        self.constraints.set_right_side(self.right_side(values, gaps, slip))
        flag = self.prescribed.flag
        return replace(
            self,
            prescribed=Prescribed(flag, np.where(flag, values, 0.0)),
            records=replace(self.records, gap=gaps),
            slip=self.slip if slip is None else slip,
        )

    def with_supports_at(self, values: Array) -> Array:
        """This rank's part of c as it is, but for supports, which hold other values.

        Contacts meet prescribed components where the prescribed values have them.

        Args:
            values: Values of the owned groups, shape ``(g, bs)``.
        """
        c = np.array(self.constraints.c.array_r)
        c[self.constraints.sets.equalities[self.held.row]] = self.held.right_side(values)
        return c

    def multipliers(self, earlier: Gluing, lam: Array) -> Array:
        """Multipliers of earlier rows of the same scene on these; zero on rows that are new.

        Where other components are prescribed all rows of equalities are. Collective.

        Args:
            earlier: The earlier rows.
            lam: Their multipliers on this rank.
        """
        sets, before = self.constraints.sets, earlier.constraints.sets
        start = np.zeros(sets.num_rows)
        flags, flags_before = self.prescribed.flag, earlier.prescribed.flag
        if not any_rank(self.dofs.comm, not np.array_equal(flags, flags_before)):
            start[sets.equalities] = lam[before.equalities]
        new, old = _common(self._keys(self.contact), earlier._keys(earlier.contact))
        # ratios: of rows that stay they are exactly 1, and what F makes of the start is known
        ratio = earlier.contact.scale[old] / self.contact.scale[new]
        start[sets.normals[new]] = lam[before.normals[old]] * ratio
        new, old = _common(self._keys(self.tangents), earlier._keys(earlier.tangents))
        ratio = earlier.tangents.scale[old] / self.tangents.scale[new]
        start[sets.tangents[new]] = lam[before.tangents[old]] * ratio[:, None]
        return start

    def contacts_of(self, rows: Array) -> list[int]:
        """Positions, in the user's list, of the contacts that some local rows are of. Collective.

        Args:
            rows: Local rows; equalities among them belong to no contact.
        """
        sets = self.constraints.sets
        normals = self.contact.condition[np.isin(sets.normals, rows)]
        tangents = self.tangents.condition[np.isin(sets.tangents, rows).any(axis=1)]
        own = np.unique(self.records.contact[np.concatenate((normals, tangents))])
        return sorted(set().union(*self.dofs.comm.allgather(own.tolist())))

    def _keys(self, rows: ContactRows | TangentRows) -> Array:
        """A number for the contact and the node of each condition with such rows."""
        kept, records = rows.condition, self.records
        return records.contact[kept] * MANY_GROUPS + records.group[kept]


def _common(keys: Array, earlier: Array) -> tuple[Array, Array]:
    """Where the numbers stand that are in both arrays."""
    _, new, old = np.intersect1d(keys, earlier, return_indices=True)
    return new, old


def glue(
    dofs: TornDofs,
    prescribed: Prescribed,
    records: ContactRecords,
    length: float,
    weights: Array,
    slip: Array | None = None,
) -> Gluing:
    """Rows of interfaces, Dirichlet conditions and contacts, and their right sides. Collective.

    Args:
        dofs: Dof maps.
        prescribed: Dirichlet values.
        records: Contact conditions of this rank; those within reach get rows.
        length: A length of the scene.
        weights: D, positive, one per local primal unknown: the stiffness there, or ones. Rows
            are orthonormal in the inner product of D⁻¹ as far as they can be.
        slip: Where the load step begins: the tangential v_i of all conditions then, shape
            ``(n, gdim - 1)``; default 0.

    Raises:
        NoSolutionError: Dirichlet conditions and contacts contradict each other.
    """
    D = dofs.gather_copies(weights.reshape(-1, dofs.bs))
    spread = Spread(dofs, prescribed.flag, D, records)
    normal_rows, contact = contact_rows(spread)
    sliding_rows, tangents = tangent_rows(dofs, spread, contact)
    equalities, held = equality_rows(dofs, prescribed.flag, D)
    tables = (equalities, normal_rows, sliding_rows)
    constraints = assemble_constraints(
        dofs, tables, weights, contact.scale, tangents.scale, tangents.normal
    )
    slip = np.zeros(records.tangents.shape[:2]) if slip is None else slip
    gluing = Gluing(dofs, prescribed, records, held, contact, tangents, constraints, length, slip)
    try:
        constraints.set_right_side(gluing.right_side(prescribed.value, records.gap))
    except TfetiError:  # on all ranks
        constraints.destroy()
        raise
    return gluing
