"""States of contacts and of rows at a solution."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from tfeti_dolfinx.arrays import Array


class ContactStatus(IntEnum):
    """Status of a node."""

    NONE = 0
    OPEN = 1
    TOUCHING = 2


@dataclass(frozen=True)
class ContactData:
    """State of the conditions of one contact on this rank, one row per node.

    A node is on one rank only: sums over all ranks are those of the contact.

    Attributes:
        points: Nodes where they were before the deformation, shape ``(n, 3)``.
        normal: Direction in which a node may not go further, of unit length, out of its body:
            the contact pushes it with −force·normal, shape ``(n, gdim)``.
        force: Normal force on the node, 0 or more, shape ``(n,)``.
        pressure: Force over area, shape ``(n,)``.
        area: ∫φ_i of the node's hat over the surface, of a pair over what the other side covers,
            times the thickness, shape ``(n,)``.
        gap: Remaining distance, shape ``(n,)``.
        status: ContactStatus: TOUCHING where there is a force, else OPEN, shape ``(n,)``.
    """

    points: Array
    normal: Array
    force: Array
    pressure: Array
    area: Array
    gap: Array
    status: Array


@dataclass(frozen=True)
class Multipliers:
    """Multipliers of this rank's rows.

    Attributes:
        lam: λ, shape ``(m,)``.
        carrying: Flags of the rows that carry a force, shape ``(m,)``.
    """

    lam: Array
    carrying: Array
