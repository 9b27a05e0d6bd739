"""States of contacts and of rows at a solution."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from tfeti_dolfinx.arrays import Array


class ContactStatus(IntEnum):
    """Status of a node.

    OPEN: no normal force. TOUCHING: one, and no friction there. SLIP, STICK: one, with friction at
    its bound, and below it. A node whose normal displacement is prescribed slips or sticks.
    """

    NONE = 0
    OPEN = 1
    TOUCHING = 2
    SLIP = 3
    STICK = 4


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
        status: ContactStatus: OPEN without a normal force, else TOUCHING; with friction SLIP or
            STICK, shape ``(n,)``.
        tangential_traction: Friction on the node over the area, a vector, shape ``(n, gdim)``.
        slip: Displacement along the surface, against what the node meets, since the load step
            began (``ContactProblem.accept``), a vector, shape ``(n, gdim)``.
    """

    points: Array
    normal: Array
    force: Array
    pressure: Array
    area: Array
    gap: Array
    status: Array
    tangential_traction: Array
    slip: Array
