"""The gaps of conditions: those of the geometry, or what a user gives in their place."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.arguments import CURVED, Gap, given_gaps
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.surfaces import group_points


def gaps_of(
    name: str, gap: Gap, records: ContactRecords, dofs: TornDofs, depth: float = np.inf
) -> Array:
    """Gaps of the conditions of one contact, without a new search or integral. Collective.

    A given gap is taken at the nodes: that is the mean of its linear interpolant.

    Args:
        name: Name of the contact, for messages.
        gap: Checked by ``checked_gap``.
        records: Its conditions.
        dofs: Dof maps.
        depth: A given gap replaces that of the geometry up to this one.

    Returns:
        Lengths, shape ``(n,)``.

    Raises:
        InputError: A given gap is no number somewhere.
    """
    x = group_points(dofs)[records.group]
    with raised_on_all_ranks(dofs.comm):
        given = given_gaps(name, gap, x)
    if given is None:
        return records.curved_gap if gap == CURVED else records.geometric_gap
    return np.where(records.geometric_gap <= depth, given, records.geometric_gap)
