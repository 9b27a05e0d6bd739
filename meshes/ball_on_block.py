"""A quarter of a half ball on a quarter of a block, tetrahedra graded towards their contact.

python3 meshes/ball_on_block.py ball_on_block.msh --partitions 16
"""

from __future__ import annotations

import sys
from math import pi
from pathlib import Path
from typing import Any

import gmsh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import graded_field, partition, script, started_model, use_sizes

HXT = 10
CLOSE = 1e-6


def build(
    radius: float = 1.0,
    block: float = 1.0,
    fine: float = 0.01,
    fine_radius: float = 0.06,
    growth: float = 0.3,
    coarser: float = 1.3,
    partitions: int = 0,
) -> Any:
    """Mesh |x − (0, 0, R)| ≤ R, z ≤ R and 0 ≤ x, y ≤ b, −b ≤ z ≤ 0, the part where x, y ≥ 0.

    Physical groups: the volumes "ball" and "block"; the surfaces "cap" and "load" (the ball's
    flat top), "top" and "bottom" (of the block), "x=0" and "y=0" (the cuts through both).

    Args:
        radius: R.
        block: Width and height b of the quarter block.
        fine: Element size of the ball within ``fine_radius`` of the origin.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.
        coarser: How much larger the block's elements are.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    model = started_model("ball_on_block")
    ball = model.occ.addSphere(0.0, 0.0, radius, radius, angle1=-pi / 2, angle2=0.0, angle3=pi / 2)
    box = model.occ.addBox(0.0, 0.0, -block, block, block, block)
    model.occ.synchronize()
    names: dict[str, list[int]] = {}
    for volume, above in ((ball, True), (box, False)):
        for _, tag in model.getBoundary([(3, volume)], oriented=False):
            name = _name(model.occ.getCenterOfMass(2, tag), above, radius, block)
            names.setdefault(name, []).append(tag)
    model.addPhysicalGroup(3, [ball], name="ball")
    model.addPhysicalGroup(3, [box], name="block")
    for name in ("cap", "load", "top", "bottom", "x=0", "y=0"):
        model.addPhysicalGroup(2, names[name], name=name)
    origin = (0.0, 0.0, 0.0)
    use_sizes(
        graded_field(origin, fine, fine_radius, growth, (3, [ball])),
        graded_field(origin, coarser * fine, fine_radius, growth, (3, [box])),
    )
    gmsh.option.setNumber("Mesh.Algorithm3D", HXT)
    gmsh.model.mesh.generate(3)
    partition(partitions)
    return model


def _name(centre: tuple[float, float, float], above: bool, radius: float, block: float) -> str:
    """Which side of a body a surface is, from its centre of mass."""
    x, y, z = centre
    if abs(x) < CLOSE:
        return "x=0"
    if abs(y) < CLOSE:
        return "y=0"
    if above:
        return "load" if abs(z - radius) < CLOSE else "cap"
    if abs(z) < CLOSE:
        return "top"
    return "bottom" if abs(z + block) < CLOSE else "side"


if __name__ == "__main__":
    script(__doc__, build)
