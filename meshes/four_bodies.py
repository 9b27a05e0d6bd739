"""A wedge between two blocks on a base: four bodies of quadrilaterals.

python3 meshes/four_bodies.py four_bodies.msh --partitions 8
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.strips import strip
from meshes.tools import partition, script, started_model

# corners of each body, from station to station: low, high, and what the sides are called
BASE = ([(-2.0, -1.0), (0.0, -1.0), (2.0, -1.0)], [(-2.0, 0.0), (0.0, 0.0), (2.0, 0.0)])
LEFT = ([(-1.6, 0.0), (-1.6, 0.8), (-1.6, 1.6)], [(-0.4, 0.0), (-0.6, 0.8), (-0.8, 1.6)])
WEDGE = ([(-0.55, 0.6), (-0.7, 1.2), (-0.85, 1.8)], [(0.55, 0.6), (0.7, 1.2), (0.85, 1.8)])


def build(cells: int = 64, partitions: int = 0) -> Any:
    """Mesh base, blocks and wedge on this rank and return gmsh's model.

    Each body is two pieces of ``cells`` × ``cells`` quadrilaterals, but for the blocks and the
    wedge, which have a few more or less, so that no meshes match.

    Physical groups: the surfaces "base", "left", "right", "wedge"; the curves "base bottom",
    "base top"; of the blocks "left wall", "right wall" (outside), "left bottom", "right bottom",
    "left side", "right side" (towards the wedge); "wedge left", "wedge right" and "wedge top".

    Args:
        cells: Quadrilaterals along each side of a piece.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    model = started_model("four_bodies")
    geo = model.geo
    right = tuple([(-x, y) for x, y in side] for side in LEFT)
    fewer = max(2, round(0.95 * cells))
    base = strip(geo, *BASE, [cells] * 2, cells)
    left = strip(geo, *LEFT, [fewer] * 2, fewer)
    other = strip(geo, *right, [fewer] * 2, fewer)
    wedge = strip(geo, *WEDGE, [cells] * 2, cells)
    geo.synchronize()
    names = {"base": base, "left": left, "right": other, "wedge": wedge}
    for name, body in names.items():
        model.addPhysicalGroup(2, body.surfaces, name=name)
    curves = {
        "base bottom": base.low,
        "base top": base.high,
        "left wall": left.low,
        "right wall": other.low,
        "left bottom": left.ends[:1],
        "right bottom": other.ends[:1],
        "left side": left.high,
        "right side": other.high,
        "wedge left": wedge.low,
        "wedge right": wedge.high,
        "wedge top": wedge.ends[1:],
    }
    for name, tags in curves.items():
        model.addPhysicalGroup(1, list(tags), name=name)
    model.mesh.generate(2)
    partition(partitions)
    return model


if __name__ == "__main__":
    script(__doc__, build)
