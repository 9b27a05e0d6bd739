"""Two bodies that touch at the origin, cylinders, balls or blocks, half of them or a quarter.

python3 meshes/pressed_pair.py pressed_pair.msh --partitions 4
"""

from __future__ import annotations

import sys
from math import inf, pi
from pathlib import Path
from typing import Any

import gmsh
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import graded_field, partition, script, started_model, use_sizes

CLOSE = 1e-6
BODIES = ("upper", "lower")


def build(
    gdim: int = 2,
    radii: tuple[float, float] = (1.0, inf),
    widths: tuple[float, float] = (1.0, 1.0),
    sizes: tuple[float, float] = (0.01, 0.02),
    fine_radius: float = 0.07,
    growth: float = 0.3,
    partitions: int = 0,
) -> Any:
    """Mesh two bodies, the part where x ≥ 0 and in 3D y ≥ 0, and return gmsh's model.

    Physical groups: "upper" and "lower"; their sides "upper face" and "lower face", "load" and
    "bottom" (the far ones), "x=0" and in 3D "y=0" (the cuts through both), and of blocks "upper
    side" and "lower side".

    Args:
        gdim: Dimension.
        radii: Of the upper and the lower half cylinder or half ball; inf for a block of height 1.
        widths: Of the parts of blocks.
        sizes: Element sizes within ``fine_radius`` of the origin.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    model = started_model("pressed_pair")
    fields: list[int] = []
    names: dict[str, list[int]] = {}
    bodies = [
        _body(gdim, radius, width, 1.0 if number == 0 else -1.0)
        for number, (radius, width) in enumerate(zip(radii, widths, strict=True))
    ]
    model.occ.synchronize()
    for number, (tag, radius, size) in enumerate(zip(bodies, radii, sizes, strict=True)):
        model.addPhysicalGroup(gdim, [tag], name=BODIES[number])
        for _, side in model.getBoundary([(gdim, tag)], oriented=False):
            centre = model.occ.getCenterOfMass(gdim - 1, side)[:gdim]
            names.setdefault(_name(centre, radius, number), []).append(side)
        fields.append(graded_field((0.0, 0.0, 0.0), size, fine_radius, growth, (gdim, [tag])))
    for name, sides in names.items():
        model.addPhysicalGroup(gdim - 1, sides, name=name)
    use_sizes(*fields)
    model.mesh.generate(gdim)
    partition(partitions)
    return model


def _body(gdim: int, radius: float, width: float, up: float) -> int:
    """The tag of a body above the origin (up = 1) or below it (−1)."""
    occ = gmsh.model.occ
    if gdim == 3:
        if radius == inf:
            return int(occ.addBox(0, 0, min(0.0, up), width, width, 1))
        angles = (-pi / 2, 0.0) if up > 0 else (0.0, pi / 2)
        return int(occ.addSphere(0, 0, up * radius, radius, -1, *angles, pi / 2))
    if radius == inf:
        return int(occ.addRectangle(0, min(0.0, up), 0, width, 1))
    disc = occ.addDisk(0, up * radius, 0, radius, radius)
    half = occ.addRectangle(0, min(0.0, up * radius), 0, radius, radius)
    ((_, tag),), _ = occ.intersect([(2, disc)], [(2, half)])
    return int(tag)


def _name(centre: Any, radius: float, number: int) -> str:
    """What a side of a body is called, from its centre of mass."""
    cuts = np.flatnonzero(np.abs(centre[:-1]) < CLOSE)
    if len(cuts):
        return f"{'xy'[cuts[0]]}=0"
    height, far = abs(centre[-1]), 1.0 if radius == inf else radius
    if abs(height - far) < CLOSE:
        return ("load", "bottom")[number]
    return f"{BODIES[number]} {'side' if radius == inf and height > CLOSE else 'face'}"


if __name__ == "__main__":
    script(__doc__, build)
