"""Two rectangles with a common side, graded towards its middle: pieces of two half planes."""

from __future__ import annotations

from typing import Any

import gmsh

from meshes.tools import add_mirror_image, graded_size, started_model


def build(
    size: float = 1.0, fine: float = 0.002, fine_radius: float = 0.06, growth: float = 0.15
) -> Any:
    """Mesh |x| ≤ L, 0 ≤ y ≤ L and its mirror image below y = 0 on this rank.

    Physical groups: the surfaces "upper" and "lower"; the curves "upper face" and "lower face" at
    y = 0, "top" and "bottom".

    Args:
        size: L.
        fine: Element size within ``fine_radius`` of the origin.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.

    Returns:
        gmsh's model.
    """
    model = started_model("half_planes")
    near, far = ([model.geo.addPoint(x, y, 0.0) for x in (-size, 0.0, size)] for y in (0.0, size))
    left, axis, right = (model.geo.addLine(*ends) for ends in zip(near, far, strict=True))
    # from the middle on, so that elements of both halves are of the same sizes
    face, top = ([model.geo.addLine(side[1], side[k]) for k in (0, 2)] for side in (near, far))
    halves = [
        model.geo.addPlaneSurface([model.geo.addCurveLoop([face[k], up, -top[k], -axis])])
        for k, up in enumerate((left, right))
    ]
    model.geo.synchronize()
    graded_size((0.0, 0.0, 0.0), fine, fine_radius, growth)
    gmsh.model.mesh.generate(2)
    image = add_mirror_image(model, axis=1)
    model.addPhysicalGroup(2, halves, name="upper")
    model.addPhysicalGroup(2, [image[2, tag] for tag in halves], name="lower")
    for name, far_name, curves in (
        ("upper face", "top", (face, top)),
        ("lower face", "bottom", [[image[1, tag] for tag in side] for side in (face, top)]),
    ):
        model.addPhysicalGroup(1, curves[0], name=name)
        model.addPhysicalGroup(1, curves[1], name=far_name)
    return model
