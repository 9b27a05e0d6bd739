"""Half of a deep groove ball bearing, cut by its mid plane, tetrahedra graded to the contacts.

python3 meshes/ball_bearing.py ball_bearing.msh --partitions 32
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import gmsh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.tools import partition, script, started_model

HXT = 10
AXIS = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Bearing:
    """Measures of a bearing about the y axis, lengths in mm; the defaults are near type 6205.

    Attributes:
        balls: Number of balls, the first at the lowest point (−z).
        ball: Radius of a ball.
        pitch: Radius of the circle of their centres.
        bore: Inner radius of the inner ring.
        outside: Outer radius of the outer ring.
        width: Width of the rings, of which half is meshed.
        conformity: Radius of the grooves' section over a ball's diameter.
        clearance: Gap between a ball and each groove.
        shoulder: Height of the rings' shoulders above the bottom of the groove.
    """

    balls: int = 8
    ball: float = 4.0
    pitch: float = 19.5
    bore: float = 12.5
    outside: float = 26.0
    width: float = 15.0
    conformity: float = 0.53
    clearance: float = 0.004
    shoulder: float = 1.6

    @property
    def groove(self) -> float:
        """Radius of the grooves' section."""
        return 2.0 * self.conformity * self.ball

    def angle(self, ball: int) -> float:
        """Angle of a ball from the x axis, in the x-z plane."""
        return 2.0 * pi * ball / self.balls - 0.5 * pi


def build(
    bearing: Bearing | None = None,
    fine: float = 0.2,
    growth: float = 0.35,
    coarse: float = 2.0,
    partitions: int = 0,
) -> Any:
    """Mesh the half y ≤ 0 of a bearing on this rank and return gmsh's model.

    Physical groups: the volumes "inner ring", "outer ring", "ball 1", ...; the surfaces "inner
    groove", "outer groove", "bore", "outside", "ball 1", ... (each ball's sphere), "mid plane".

    Args:
        bearing: Measures; default those of ``Bearing``.
        fine: Element size where the lowest ball meets the rings; twice that at the highest one.
        growth: Growth of the element size with the distance from the contacts.
        coarse: Largest element size.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    bearing = bearing or Bearing()
    model = started_model("ball_bearing")
    bottom = bearing.pitch - bearing.ball - bearing.clearance
    top = bearing.pitch + bearing.ball + bearing.clearance
    inner = _ring(bearing, bearing.bore, bottom + bearing.shoulder, bottom + bearing.groove)
    outer = _ring(bearing, top - bearing.shoulder, bearing.outside, top - bearing.groove)
    balls = [_ball(bearing, bearing.angle(i)) for i in range(bearing.balls)]
    model.occ.synchronize()
    names = ["inner ring", "outer ring", *(f"ball {i + 1}" for i in range(bearing.balls))]
    for name, volume in zip(names, [inner, outer, *balls], strict=True):
        model.addPhysicalGroup(3, [volume], name=name)
    _name_surfaces(model, bearing, inner, outer, dict(zip(names[2:], balls, strict=True)))
    _size(bearing, fine, growth, coarse)
    gmsh.option.setNumber("Mesh.Algorithm3D", HXT)
    gmsh.model.mesh.generate(3)
    partition(partitions)
    return model


def _ring(bearing: Bearing, low: float, high: float, centre: float) -> int:
    """Half ring between two radii with a groove whose section is centred at a radius."""
    occ, half = gmsh.model.occ, 0.5 * bearing.width
    whole = occ.addCylinder(0, 0, 0, 0, -half, 0, high)
    hole = occ.addCylinder(0, 0, 0, 0, -half, 0, low)
    groove = occ.addTorus(0, 0, 0, centre, bearing.groove, zAxis=AXIS)
    ring, _ = occ.cut([(3, whole)], [(3, hole), (3, groove)])
    return int(ring[0][1])


def _ball(bearing: Bearing, angle: float) -> int:
    """Half ball, y ≤ 0, its pole on the bearing's axis direction."""
    occ = gmsh.model.occ
    ball = occ.addSphere(0, 0, 0, bearing.ball, angle1=0.0, angle2=0.5 * pi)
    occ.rotate([(3, ball)], 0, 0, 0, 1, 0, 0, 0.5 * pi)
    occ.translate([(3, ball)], bearing.pitch * cos(angle), 0, bearing.pitch * sin(angle))
    return int(ball)


def _name_surfaces(
    model: Any, bearing: Bearing, inner: int, outer: int, balls: dict[str, int]
) -> None:
    """Physical groups of the surfaces."""

    def surfaces(volume: int) -> dict[int, str]:
        tags = (tag for _, tag in model.getBoundary([(3, volume)], oriented=False))
        return {tag: model.getType(2, tag) for tag in tags}

    def in_mid_plane(tag: int) -> bool:
        return bool(abs(model.occ.getCenterOfMass(2, tag)[1]) < 1e-6)

    def radius(tag: int) -> float:
        return float(model.getBoundingBox(2, tag)[3])

    for name, ring in (("inner", inner), ("outer", outer)):
        kinds = surfaces(ring)
        torus = [tag for tag, kind in kinds.items() if kind == "Torus"]
        model.addPhysicalGroup(2, torus, name=f"{name} groove")
        walls = [tag for tag, kind in kinds.items() if kind == "Cylinder"]
        wanted, wall = (min, "bore") if name == "inner" else (max, "outside")
        model.addPhysicalGroup(2, [wanted(walls, key=radius)], name=wall)
    for name, ball in balls.items():
        sphere = [tag for tag, kind in surfaces(ball).items() if kind == "Sphere"]
        model.addPhysicalGroup(2, sphere, name=name)
    bodies = [surfaces(volume) for volume in (inner, outer, *balls.values())]
    plane = [tag for kinds in bodies for tag in kinds if in_mid_plane(tag)]
    model.addPhysicalGroup(2, plane, name="mid plane")


def _size(bearing: Bearing, fine: float, growth: float, coarse: float) -> None:
    """Element size: fine at the points of contact, growing away from them and upwards.

    With r the distance from the axis and s the arc to the nearest ball's middle, the contacts lie
    on |c| = ball radius, c = (s, r − pitch, y), at small s; they are long in y.
    """
    n, ball = bearing.balls, bearing.ball
    r = "sqrt(x^2+z^2+1e-12)"
    s = f"{r}*acos(0.999999999*cos({n}*acos(-0.999999999*z/{r})))/{n}"
    sphere = f"(sqrt(({s})^2+({r}-{bearing.pitch})^2+y^2)-{ball})"
    distance = f"sqrt({sphere}^2+({s})^2+(y/4)^2)"
    lowest = f"{fine}*(1.5+0.5*z/{r})"
    field = gmsh.model.mesh.field.add("MathEval")
    grown = f"{lowest}+{growth}*max(0,{distance}-{0.1 * ball})"
    gmsh.model.mesh.field.setString(field, "F", f"min({coarse},{grown})")
    gmsh.model.mesh.field.setAsBackgroundMesh(field)
    for name in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
        gmsh.option.setNumber(f"Mesh.MeshSize{name}", 0)


if __name__ == "__main__":
    script(__doc__, build)
