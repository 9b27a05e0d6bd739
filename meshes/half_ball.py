"""Lower half of a ball, tetrahedra graded towards its lowest point."""

from __future__ import annotations

from math import pi
from typing import Any

import gmsh

from meshes.tools import graded_size, started_model

HXT = 10


def build(
    radius: float = 1.0, fine: float = 0.01, fine_radius: float = 0.06, growth: float = 0.3
) -> Any:
    """Mesh the half ball |x − (0, 0, R)| ≤ R, z ≤ R on this rank and return gmsh's model.

    Physical groups: the volume "body"; the surfaces "contact" (the cap) and "top".

    Args:
        radius: R.
        fine: Element size within ``fine_radius`` of the lowest point.
        fine_radius: Size of the fine zone.
        growth: Growth of the element size with the distance from that zone.
    """
    model = started_model("half_ball")
    ball = model.occ.addSphere(0.0, 0.0, radius, radius, angle1=-pi / 2, angle2=0.0)
    model.occ.synchronize()
    surfaces = [tag for _, tag in model.getBoundary([(3, ball)], oriented=False)]
    heights = {tag: model.occ.getCenterOfMass(2, tag)[2] for tag in surfaces}
    top = max(surfaces, key=heights.__getitem__)
    model.addPhysicalGroup(3, [ball], name="body")
    model.addPhysicalGroup(2, [tag for tag in surfaces if tag != top], name="contact")
    model.addPhysicalGroup(2, [top], name="top")
    graded_size((0.0, 0.0, 0.0), fine, fine_radius, growth)
    gmsh.option.setNumber("Mesh.Algorithm3D", HXT)
    gmsh.model.mesh.generate(3)
    return model
