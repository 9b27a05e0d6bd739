"""Two U-profiles that overlap in bolted clamps: hexahedra on grids that do not match.

python3 meshes/clamped_connection.py clamped_connection.msh --partitions 32
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise
from math import cos, hypot, pi, sin
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from meshes.strips import Point, Strip, strip
from meshes.tools import partition, script, started_model

CLAMPS = 2


@dataclass(frozen=True)
class Connection:
    """Measures of the connection, lengths in mm; the profiles' axis is z.

    The section is a U with lips. The upper profile is narrower and lies in the lower one, bottom
    on bottom. A clamp is two bars: one under the lower profile, one on the lips of the upper one.

    Attributes:
        bottom: Width of the lower profile's bottom, in the middle of the plate.
        flank: Length of its flanks.
        slope: Angle between flanks and bottom, in degrees.
        narrower: By how much the upper profile's bottom is narrower.
        higher: By how much its flanks are longer, so that the lips do not touch.
        lip: Width of the lips.
        plate: Thickness of the plates.
        length: Length of each profile.
        overlap: Length over which they overlap.
        bar: Width of the bars, along z.
        height: Height of the bars.
        bolt: Length of the bars' ends, beyond the lips, on which the bolts pull.
    """

    bottom: float = 90.0
    flank: float = 60.0
    slope: float = 70.0
    narrower: float = 40.0
    higher: float = 8.0
    lip: float = 30.0
    plate: float = 15.0
    length: float = 300.0
    overlap: float = 200.0
    bar: float = 50.0
    height: float = 40.0
    bolt: float = 30.0

    def middle(self, upper: bool) -> list[Point]:
        """The line through the middle of a profile's plate, from left to right."""
        angle, half = self.slope * pi / 180.0, 0.5 * (self.bottom - upper * self.narrower)
        flank, rise = self.flank + upper * self.higher, upper * self.plate
        x, y = half + flank * cos(angle), rise + flank * sin(angle)
        right = [(half, rise), (x, y), (x + self.lip, y)]
        return [*((-x, y) for x, y in reversed(right)), *right]

    @property
    def clamps(self) -> list[float]:
        """Where the bars begin along z."""
        first, share = self.length - self.overlap, self.overlap / CLAMPS
        return [first + (i + 0.5) * share - 0.5 * self.bar for i in range(CLAMPS)]


def build(connection: Connection | None = None, size: float = 12.0, partitions: int = 0) -> Any:
    """Mesh profiles and clamps on this rank and return gmsh's model.

    Physical groups: the volumes "lower profile", "upper profile", "lower bar 1", "upper bar 1", …;
    the surfaces "lower end" and "upper end" (of the whole, along z), "lower inside" and
    "upper outside" (the sides of the bottoms that touch), "bottom" (of the lower profile, outside),
    "lips" (of the upper one, on top), "lower bar 1", "upper bar 1", … (the side of a bar that
    touches a profile), "bolts below" and "bolts above" (where the bolts press on the bars).

    Args:
        connection: Measures; default those of ``Connection``.
        size: Edge length of the hexahedra, about; there are at least two through a plate.
        partitions: Number of gmsh's partitions, 0 for none.
    """
    connection = connection or Connection()
    model, n = started_model("clamped_connection"), connection
    lower = _profile(model, n, n.middle(False), 0.0, size)
    # cells of the upper profile are a tenth smaller, so that the meshes do not match
    upper = _profile(model, n, n.middle(True), n.length - n.overlap, 0.9 * size)
    below, above = -0.5 * n.plate - n.height, n.middle(True)[0][1] + 0.5 * n.plate
    bars = [
        (f"{side} bar {i + 1}", _bar(model, n, y, z, size))
        for i, z in enumerate(n.clamps)
        for side, y in (("lower", below), ("upper", above))
    ]
    model.geo.synchronize()
    for name, body in [("lower profile", lower), ("upper profile", upper), *bars]:
        model.addPhysicalGroup(3, body.volumes, name=name)
    surfaces = {
        "lower end": lower.strip.surfaces,
        "upper end": upper.far,
        "lower inside": lower.high[2:3],
        "upper outside": upper.low[2:3],
        "bottom": lower.low[2:3],
        "lips": [upper.high[0], upper.high[4]],
        "bolts below": [s for name, bar in bars if "lower" in name for s in bar.low[::2]],
        "bolts above": [s for name, bar in bars if "upper" in name for s in bar.high[::2]],
    }
    surfaces |= {name: [bar.high[1] if "lower" in name else bar.low[1]] for name, bar in bars}
    for name, tags in surfaces.items():
        model.addPhysicalGroup(2, tags, name=name)
    model.mesh.generate(3)
    partition(partitions)
    return model


@dataclass(frozen=True)
class _Body:
    """A strip drawn along z: tags of its volumes, its far end, its low and its high sides."""

    strip: Strip
    volumes: list[int]
    far: list[int]
    low: list[int]
    high: list[int]


def _drawn(model: Any, section: Strip, length: float, size: float) -> _Body:
    """Hexahedra from a section's quadrilaterals."""
    layers = max(2, round(length / size))
    found = model.geo.extrude(
        [(2, s) for s in section.surfaces], 0, 0, length, [layers], recombine=True
    )
    # of each piece: far end, volume, and the sides in the order of its loop
    tags = [tag for _, tag in found]
    return _Body(section, tags[1::6], tags[0::6], tags[2::6], tags[4::6])


def _profile(model: Any, n: Connection, line: list[Point], start: float, size: float) -> _Body:
    """A profile: its section with mitred corners, drawn along z."""
    ways = []
    for (x, y), (x_next, y_next) in pairwise(line):
        length = hypot(x_next - x, y_next - y)
        ways.append(((x_next - x) / length, (y_next - y) / length, length))
    low, high = [], []
    for i, (x, y) in enumerate(line):
        a, b = ways[max(i - 1, 0)], ways[min(i, len(ways) - 1)]
        share = 0.5 * n.plate / (1.0 + a[0] * b[0] + a[1] * b[1])
        across = (-share * (a[1] + b[1]), share * (a[0] + b[0]))
        low.append((x - across[0], y - across[1]))
        high.append((x + across[0], y + across[1]))
    cells = [max(2, round(length / size)) for _, _, length in ways]
    through = max(2, round(n.plate / size))
    section = strip(model.geo, low, high, cells, through, level=start)
    return _drawn(model, section, n.length, size)


def _bar(model: Any, n: Connection, y: float, start: float, size: float) -> _Body:
    """A bar above y: its middle, and its ends on which the bolts pull."""
    inner = n.middle(False)[-1][0]
    stations = [-inner - n.bolt, -inner, inner, inner + n.bolt]
    low, high = ([(x, y + up) for x in stations] for up in (0.0, n.height))
    cells = [max(2, round((b - a) / size)) for a, b in pairwise(stations)]
    section = strip(model.geo, low, high, cells, max(2, round(n.height / size)), level=start)
    return _drawn(model, section, n.bar, size)


if __name__ == "__main__":
    script(__doc__, build)
