"""Balls above each other, tetrahedra graded towards their lowest and highest points.

python3 meshes/balls.py balls.msh --partitions 16
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from math import pi
from pathlib import Path
from typing import Any

import gmsh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import graded_field, partition, script, started_model, use_sizes

HXT = 10


def build(
    lowest: Sequence[float] = (0.3, 2.6),
    radius: float = 1.0,
    fine: float = 0.1,
    coarse: float = 0.3,
    partitions: int = 0,
) -> Any:
    """Mesh balls on the z axis on this rank and return gmsh's model.

    Physical groups, for balls that are counted from 1 on: the volumes "ball 1", the surfaces
    "ball 1 lower" and "ball 1 upper".

    Args:
        lowest: Heights of their lowest points.
        radius: R.
        fine: Element size at their lowest and highest points.
        coarse: Element size that grows from there to the middle.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    model, fields = started_model("balls"), []
    for number, low in enumerate(lowest, start=1):
        middle = (0.0, 0.0, low + radius)
        halves = [
            model.occ.addSphere(*middle, radius, angle1=a, angle2=b)
            for a, b in ((-pi / 2, 0.0), (0.0, pi / 2))
        ]
        found, _ = model.occ.fragment([(3, halves[0])], [(3, halves[1])])
        model.occ.synchronize()
        model.addPhysicalGroup(3, [tag for _, tag in found], name=f"ball {number}")
        for dim, tag in model.getBoundary(found, combined=True, oriented=False):
            side = "lower" if model.occ.getCenterOfMass(dim, tag)[2] < middle[2] else "upper"
            model.addPhysicalGroup(2, [tag], name=f"ball {number} {side}")
        growth = (coarse - fine) / radius
        for pole in (low, low + 2 * radius):
            fields.append(graded_field((0.0, 0.0, pole), fine, 0.15 * radius, growth))
    use_sizes(*fields)
    gmsh.option.setNumber("Mesh.Algorithm3D", HXT)
    model.mesh.generate(3)
    partition(partitions)
    return model


if __name__ == "__main__":
    script(__doc__, build)
