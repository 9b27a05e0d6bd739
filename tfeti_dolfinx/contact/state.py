"""Statuses of contact conditions, and what a solution says of a contact or a rigid body."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.contact.records import Resultant


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
    """State of the conditions of one contact on this rank, one entry per node.

    A node is on one rank only: sums over all ranks are those of the contact.

    Attributes:
        points: Nodes where they were before the deformation, shape ``(n, 3)``.
        normal: Direction in which a node may not go further, of unit length, out of its body:
            the contact pushes it with −force·normal, shape ``(n, gdim)``.
        force: Normal force on the node, 0 or more, shape ``(n,)``.
        pressure: Force over area, shape ``(n,)``.
        area: ∫φ_i of the node's shape function over the surface, of a pair over what the other
            side covers, times the thickness, shape ``(n,)``.
        gap: Remaining distance, shape ``(n,)``.
        status: ContactStatus: OPEN without a normal force, else TOUCHING; with friction SLIP or
            STICK, shape ``(n,)``.
        tangential_traction: Friction on the node over the area, a vector, shape ``(n, gdim)``.
        slip: Displacement along the surface, against what the node meets, since the load step
            began (``ContactProblem.accept``), a vector, shape ``(n, gdim)``.
        surface: Surface whose nodes these are: of a pair the secondary one.
        resultant: Force and moment, friction included, by which the contact acts on that surface;
            the same on all ranks.
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
    surface: str | int
    resultant: Resultant


@dataclass(frozen=True)
class ToolState:
    """A rigid body at a solution; the same on all ranks.

    Attributes:
        name: Its name.
        displacement: Of its point, shape ``(gdim,)``.
        rotation: Rotation vector, in radians, shape ``(3,)``; in 2D only its last component is not
            0.
        resultant: Force and moment of all its contacts on it, friction included; the moment about
            its point.
        velocity: Of its point along free motions, shape ``(gdim,)``; None without a mass.
        spin: Angular velocity likewise, in radians per time, shape ``(3,)``.
    """

    name: str
    displacement: Array
    rotation: Array
    resultant: Resultant
    velocity: Array | None
    spin: Array | None

    def __str__(self) -> str:
        """One line: names of what is not 0, and its numbers."""
        parts = {"displacement": self.displacement, "rotation": self.rotation}
        parts |= {"force": self.resultant.force, "moment": self.resultant.moment}
        if self.velocity is not None and self.spin is not None:
            parts |= {"velocity": self.velocity, "spin": self.spin}
        words = [
            f"{what} ({', '.join(f'{value:.6g}' for value in values)})"
            for what, values in parts.items()
            if what in ("displacement", "force") or np.any(values)
        ]
        return f"{self.name}: {', '.join(words)}"

    @property
    def numbers(self) -> dict[str, float]:
        """All components by name, for tables."""
        axes = "xyz"[: len(self.displacement)]
        turns = "xyz" if len(axes) == 3 else "z"
        parts = {
            "displacement": (axes, self.displacement),
            "rotation": (turns, self.rotation[-len(turns) :]),
            "force": (axes, self.resultant.force),
            "moment": (turns, self.resultant.moment[-len(turns) :]),
        }
        if self.velocity is not None and self.spin is not None:
            parts |= {"velocity": (axes, self.velocity), "spin": (turns, self.spin[-len(turns) :])}
        return {
            f"{self.name} {what} {axis}": float(value)
            for what, (names, values) in parts.items()
            for axis, value in zip(names, values, strict=True)
        }
