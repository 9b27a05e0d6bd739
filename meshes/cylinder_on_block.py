"""Lower half of a disc on a block, both graded towards the point where they touch."""

from __future__ import annotations

from typing import Any

import gmsh

from meshes.half_cylinder import half_disc
from meshes.tools import graded_field, started_model, use_sizes


def build(
    radius: float = 50.0,
    block: float = 200.0,
    fine: float = 0.4,
    fine_radius: float = 10.0,
    growth: float = 0.15,
    coarser: float = 1.3,
) -> Any:
    """Mesh the half disc x² + (y − R)² ≤ R², y ≤ R on the block |x| ≤ b/2, −b ≤ y ≤ 0.

    Physical groups: the surfaces "cylinder" and "block"; the curves "arc" and "load" (the
    cylinder's flat top), "top" and "bottom" (of the block), "axis" (x = 0, inside both).

    Args:
        radius: R.
        block: Width and height b of the block.
        fine: Element size of the cylinder within ``fine_radius`` of the origin.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.
        coarser: How much larger the block's elements are.
    """
    model = started_model("cylinder_on_block")
    cylinder, arcs, load, upper_axis = half_disc(model.geo, radius)
    blocks, top, bottom, lower_axis = _block(model.geo, block)
    model.geo.synchronize()
    model.addPhysicalGroup(2, cylinder, name="cylinder")
    model.addPhysicalGroup(2, blocks, name="block")
    model.addPhysicalGroup(1, arcs, name="arc")
    model.addPhysicalGroup(1, load, name="load")
    model.addPhysicalGroup(1, top, name="top")
    model.addPhysicalGroup(1, bottom, name="bottom")
    model.addPhysicalGroup(1, [upper_axis, lower_axis], name="axis")
    origin = (0.0, 0.0, 0.0)
    use_sizes(
        graded_field(origin, fine, fine_radius, growth, (2, cylinder)),
        graded_field(origin, coarser * fine, fine_radius, growth, (2, blocks)),
    )
    gmsh.model.mesh.generate(2)
    return model


def _block(geo: Any, b: float) -> tuple[list[int], list[int], list[int], int]:
    """Surfaces, top, bottom and axis."""
    left, middle, right = (
        [geo.addPoint(x, y, 0.0) for y in (-b, 0.0)] for x in (-b / 2, 0.0, b / 2)
    )
    axis = geo.addLine(*middle)
    halves, top, bottom = [], [], []
    for side in (left, right):
        bottom.append(geo.addLine(middle[0], side[0]))
        top.append(geo.addLine(side[1], middle[1]))
        up = geo.addLine(*side)
        halves.append(geo.addPlaneSurface([geo.addCurveLoop([bottom[-1], up, top[-1], -axis])]))
    return halves, top, bottom, axis
