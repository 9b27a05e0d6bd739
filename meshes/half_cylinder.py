"""Lower half of a disc, graded towards its lowest point: half cylinders in plane strain.

python3 meshes/half_cylinder.py half_cylinder.msh --partitions 8
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gmsh


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
    if not gmsh.isInitialized():
        gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    model = gmsh.model
    model.add("half_cylinder")
    halves, arcs, top, axis = half_disc(model.geo, radius)
    model.geo.synchronize()
    model.addPhysicalGroup(2, halves, name="body")
    model.addPhysicalGroup(1, arcs, name="contact")
    model.addPhysicalGroup(1, top, name="top")
    model.addPhysicalGroup(1, [axis], name="axis")
    excess = f"(sqrt(x^2+y^2)-{fine_radius})"
    size = model.mesh.field.add("MathEval")
    model.mesh.field.setString(size, "F", f"{fine}+{growth}*0.5*({excess}+fabs{excess})")
    model.mesh.field.setAsBackgroundMesh(size)
    for others in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{others}", 0)
    model.mesh.generate(2)
    if partitions > 1:
        model.mesh.partition(partitions)
    return model


def half_disc(geo: Any, radius: float) -> tuple[list[int], list[int], list[int], int]:
    """Both halves of x² + (y − R)² ≤ R², y ≤ R; arcs, flat top, and the axis between them."""
    lowest, centre, right, left = (
        geo.addPoint(x, y, 0.0)
        for x, y in ((0.0, 0.0), (0.0, radius), (radius, radius), (-radius, radius))
    )
    axis = geo.addLine(lowest, centre)
    arcs = [geo.addCircleArc(lowest, centre, right), geo.addCircleArc(left, centre, lowest)]
    top = [geo.addLine(right, centre), geo.addLine(centre, left)]
    loops = [arcs[0], top[0], -axis], [axis, top[1], arcs[1]]
    return [geo.addPlaneSurface([geo.addCurveLoop(loop)]) for loop in loops], arcs, top, axis


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path, help="the .msh file to write")
    parser.add_argument("--partitions", type=int, default=0)
    arguments = parser.parse_args()
    build(partitions=arguments.partitions)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    gmsh.write(str(arguments.output))
    gmsh.finalize()
