"""A belt on a drum: quadrilaterals on grids that do not match.

python3 meshes/belt.py belt.msh --partitions 8
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.strips import Point, strip
from meshes.tools import partition, script, started_model

QUARTERS = 4


@dataclass(frozen=True)
class BeltDrive:
    """Measures of a belt on a drum about the origin, lengths in mm.

    Attributes:
        radius: Radius R of the drum.
        hub: Inner radius of the drum.
        thickness: Thickness t of the belt.
        angle: Angle θ over which the belt lies on the drum, from the x axis.
        leg: Length of the straight parts on both sides of it.
    """

    radius: float = 100.0
    hub: float = 60.0
    thickness: float = 2.0
    angle: float = pi
    leg: float = 60.0

    @property
    def pull(self) -> Point:
        """Direction in which the belt leaves the drum on its left."""
        return -sin(self.angle), cos(self.angle)

    def stations(self, radius: float, pieces: int) -> list[Point]:
        """Points at a distance from the axis, along the belt from right to left."""
        turns = [self.angle * i / pieces for i in range(pieces + 1)]
        arc = [(radius * cos(turn), radius * sin(turn)) for turn in turns]
        (x, y), along = arc[-1], self.pull
        return [(radius, -self.leg), *arc, (x + self.leg * along[0], y + self.leg * along[1])]


def build(drive: BeltDrive | None = None, cells: int = 120, partitions: int = 0) -> Any:
    """Mesh belt and drum on this rank and return gmsh's model.

    Physical groups: the surfaces "belt" and "drum"; the curves "inside" (of the belt, where it
    lies on the drum), "left end", "right end", "rim" and "hub" (of the drum).

    Args:
        drive: Measures; default those of ``BeltDrive``.
        cells: Quadrilaterals along the part of the belt that lies on the drum, about; those of
            the drum are 1.3 times as long.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    drive = drive or BeltDrive()
    model = started_model("belt")
    long = drive.radius * drive.angle / cells
    # cells of the legs are as long as those of the arc
    legs = max(1, round(drive.leg / long))
    inside, outside = (
        drive.stations(radius, QUARTERS)
        for radius in (drive.radius, drive.radius + drive.thickness)
    )
    along = [legs, *[max(1, round(cells / QUARTERS))] * QUARTERS, legs]
    straight = (0, len(along) - 1)
    belt = strip(model.geo, inside, outside, along, 2, (0.0, 0.0), straight)
    turns = [2.0 * pi * i / QUARTERS for i in range(QUARTERS)]
    rings = [[(r * cos(a), r * sin(a)) for a in turns] for r in (drive.hub, drive.radius)]
    around = max(2, round(0.5 * pi * drive.radius / (1.3 * long)))
    inwards = max(2, round((drive.radius - drive.hub) / (2.0 * long)))
    drum = strip(model.geo, *rings, [around] * QUARTERS, inwards, (0.0, 0.0))
    model.geo.synchronize()
    model.addPhysicalGroup(2, belt.surfaces, name="belt")
    model.addPhysicalGroup(2, drum.surfaces, name="drum")
    model.addPhysicalGroup(1, belt.low[1:-1], name="inside")
    for name, end in zip(("right end", "left end"), belt.ends, strict=True):
        model.addPhysicalGroup(1, [end], name=name)
    model.addPhysicalGroup(1, drum.high, name="rim")
    model.addPhysicalGroup(1, drum.low, name="hub")
    model.mesh.generate(2)
    partition(partitions)
    return model


if __name__ == "__main__":
    script(__doc__, build)
