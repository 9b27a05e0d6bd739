"""Lower half of a disc, graded towards its lowest point: half cylinders in plane strain.

python3 meshes/half_cylinder.py half_cylinder.msh --partitions 8
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import gmsh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import graded_size, half_disc, started_model


def build(
    radius: float = 1.0,
    fine: float = 0.002,
    fine_radius: float = 0.06,
    growth: float = 0.15,
    partitions: int = 0,
) -> Any:
    """Mesh the half disc x² + (y − R)² ≤ R², y ≤ R on this rank and return gmsh's model.

    Physical groups: the surface "body"; the curves "contact" (the arc), "top", "axis" (x = 0,
    inside the body).

    Args:
        radius: R.
        fine: Element size within ``fine_radius`` of the lowest point.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    model = started_model("half_cylinder")
    halves, arcs, top, axis = half_disc(model.geo, radius)
    model.geo.synchronize()
    model.addPhysicalGroup(2, halves, name="body")
    model.addPhysicalGroup(1, arcs, name="contact")
    model.addPhysicalGroup(1, top, name="top")
    model.addPhysicalGroup(1, [axis], name="axis")
    graded_size((0.0, 0.0, 0.0), fine, fine_radius, growth)
    gmsh.model.mesh.generate(2)
    if partitions > 1:
        gmsh.model.mesh.partition(partitions)
    return model


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path, help="the .msh file to write")
    parser.add_argument("--partitions", type=int, default=0)
    arguments = parser.parse_args()
    build(partitions=arguments.partitions)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    gmsh.write(str(arguments.output))
    gmsh.finalize()
