"""Strips of quadrilaterals: what belts, drums, blocks and profiles of plates are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

Point = tuple[float, float]


@dataclass(frozen=True)
class Strip:
    """Tags of gmsh's entities of a strip, one of each kind for every piece.

    Attributes:
        surfaces: The pieces.
        low: Their sides along the low points.
        high: Their sides along the high points.
        ends: First and last line across.
    """

    surfaces: list[int]
    low: list[int]
    high: list[int]
    ends: tuple[int, int]


def strip(
    geo: Any,
    low: Sequence[Point],
    high: Sequence[Point],
    cells: Sequence[int],
    across: int,
    centre: Point | None = None,
    straight: Sequence[int] = (),
    level: float = 0.0,
) -> Strip:
    """Make a strip of pieces with quadrilaterals on grids, between stations.

    Args:
        geo: ``gmsh.model.geo``; the caller synchronises it.
        low: A corner of each station.
        high: The other corner.
        cells: Quadrilaterals along each piece; as many pieces as stations: the last one closes a
            ring.
        across: Quadrilaterals across the strip.
        centre: The sides of pieces are arcs about this point; default straight lines.
        straight: Indices of pieces that are straight all the same.
        level: The strip's z.
    """
    points = [[geo.addPoint(x, y, level) for x, y in side] for side in (low, high)]
    middle = None if centre is None else geo.addPoint(*centre, level)
    cross = [geo.addLine(a, b) for a, b in zip(*points, strict=True)]
    sides: list[list[int]] = [[], []]
    surfaces = []
    for i, count in enumerate(cells):
        j, arc = (i + 1) % len(cross), middle is not None and i not in straight
        for side, at in zip(sides, points, strict=True):
            ends = (at[i], middle, at[j]) if arc else (at[i], at[j])
            side.append(geo.addCircleArc(*ends) if arc else geo.addLine(*ends))
            geo.mesh.setTransfiniteCurve(side[-1], count + 1)
        loop = [sides[0][i], cross[j], -sides[1][i], -cross[i]]
        surfaces.append(geo.addPlaneSurface([geo.addCurveLoop(loop)]))
        geo.mesh.setTransfiniteSurface(surfaces[-1])
        geo.mesh.setRecombine(2, surfaces[-1])
    for line in cross:
        geo.mesh.setTransfiniteCurve(line, across + 1)
    return Strip(surfaces, sides[0], sides[1], (cross[0], cross[-1]))
