"""Two boxes with a common face, graded towards the middle of one of its edges: of half spaces.

python3 meshes/half_spaces.py half_spaces.msh --partitions 16
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gmsh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import add_mirror_image, graded_size, partition, script, started_model

HXT = 10
CLOSE = 1e-6


def build(
    size: float = 1.0,
    fine: float = 0.01,
    fine_radius: float = 0.06,
    growth: float = 0.3,
    partitions: int = 0,
) -> Any:
    """Mesh |x| ≤ L, 0 ≤ y ≤ L, 0 ≤ z ≤ L and its mirror image below z = 0 on this rank.

    Physical groups: the volumes "upper" and "lower"; the surfaces
    "upper face" and "lower face" at z = 0, "top", "bottom", and "y=0", the cut through both.

    Args:
        size: L.
        fine: Element size within ``fine_radius`` of the origin.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.
        partitions: Number of gmsh's partitions, 0 for none.

    Returns:
        gmsh's model.
    """
    model = started_model("half_spaces")
    box = model.occ.addBox(-size, 0.0, 0.0, 2 * size, size, size)
    model.occ.synchronize()
    graded_size((0.0, 0.0, 0.0), fine, fine_radius, growth)
    gmsh.option.setNumber("Mesh.Algorithm3D", HXT)
    gmsh.model.mesh.generate(3)
    sides = {
        _name(model.occ.getCenterOfMass(2, tag), size): tag
        for _, tag in model.getBoundary([(3, box)], oriented=False)
    }
    image = add_mirror_image(model, axis=2)
    model.addPhysicalGroup(3, [box], name="upper")
    model.addPhysicalGroup(3, [image[3, box]], name="lower")
    below = {name: image[2, tag] for name, tag in sides.items()}
    model.addPhysicalGroup(2, [sides["face"]], name="upper face")
    model.addPhysicalGroup(2, [below["face"]], name="lower face")
    model.addPhysicalGroup(2, [sides["far"]], name="top")
    model.addPhysicalGroup(2, [below["far"]], name="bottom")
    model.addPhysicalGroup(2, [sides["y=0"], below["y=0"]], name="y=0")
    partition(partitions)
    return model


def _name(centre: tuple[float, float, float], size: float) -> str:
    """Which side of the upper box a surface is, from its centre of mass."""
    _, y, z = centre
    if abs(y) < CLOSE * size:
        return "y=0"
    if abs(z) < CLOSE * size:
        return "face"
    return "far" if abs(z - size) < CLOSE * size else "side"


if __name__ == "__main__":
    script(__doc__, build)
