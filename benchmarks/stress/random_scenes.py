"""Scenes drawn from a seed: single boxes, stacks, rows, bridges, boxes apart, in any units."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.stress.scene import GDIM, Body, Held, Load, Pair, Scene, Side, Wall

CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
MOST_CELLS = {2: 7, 3: 3}


@dataclass
class Draw:
    """A scene in the making, of boxes of size 1 and E of 1; ``up`` is the last axis."""

    rng: np.random.Generator
    note: str = ""
    bodies: list[Body] = field(default_factory=list)
    held: list[Held] = field(default_factory=list)
    loads: list[Load] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.cell = str(self.rng.choice(CELLS, p=(0.3, 0.3, 0.15, 0.25)))
        self.gdim = GDIM[self.cell]
        self.up = self.gdim - 1
        self.mild = self.chance(0.35)
        self.jumps = self.spice(0.35)
        self.flat = 10 ** -self.real(0, 4) if self.spice(0.2) else 1.0

    def chance(self, p: float) -> bool:
        """True with probability p."""
        return bool(self.rng.uniform() < p)

    def spice(self, p: float) -> bool:
        """The same for what makes a scene hard: never in a mild one."""
        return self.chance(p) and not self.mild

    def real(self, a: float, b: float) -> float:
        """Uniform between a and b."""
        return float(self.rng.uniform(a, b))

    def one(self, *values: Any) -> Any:
        """One of the values."""
        return values[self.rng.integers(len(values))]

    def gap(self) -> float:
        """0, small, of the size of the bodies, or far."""
        p = self.real(0, 0.75 if self.mild else 1)
        if p < 0.5:
            return 0.0
        ends = (-6, -1) if p < 0.75 else (-1, 0) if p < 0.85 else (0, 6)
        return 10 ** self.real(*ends)

    def box(self, low: np.ndarray, size: np.ndarray) -> int:
        """A new body; its number."""
        n = self.rng.integers(1, MOST_CELLS[self.gdim] + 1, self.gdim)
        n = np.maximum(n, 2 if self.gdim == 2 else 1)
        nu = self.one(0.0, 0.49, 0.499, 0.4999) if self.spice(0.2) else self.real(0.1, 0.4)
        E = 10 ** self.real(-8, 0) if self.jumps else 1.0
        jump = 10 ** self.real(1, 8) if self.spice(0.15) else 1.0
        low, high = tuple(low.tolist()), tuple((low + size).tolist())
        self.bodies.append(Body(low, high, tuple(n.tolist()), E, nu, jump))
        return len(self.bodies) - 1

    def size(self) -> np.ndarray:
        """Edges of a box."""
        size = self.rng.uniform(0.4, 1.5, self.gdim)
        size[-1] *= self.flat
        return size

    def free_sides(self, body: int) -> list[Side]:
        """Sides that are not held and meet nothing."""
        used = {c.side for c in (*self.held, *self.walls)}
        used |= {s for p in self.pairs for s in (p.secondary, p.primary)}
        sides = [(body, axis, end) for axis in range(self.gdim) for end in (0, 1)]
        return [side for side in sides if side not in used]

    def free_side(self, body: int) -> Side | None:
        """One of them, if there is one."""
        sides = self.free_sides(body)
        return sides[self.rng.integers(len(sides))] if sides else None

    def hold(self, side: Side | None, components: tuple[int, ...] | None = None) -> None:
        """Prescribe components of a side, random ones by default."""
        if side is None:
            return
        if components is None:
            chosen = np.flatnonzero(self.rng.uniform(size=self.gdim) < 0.6)
            components = tuple(chosen.tolist()) or (side[1],)
        value = self.real(-0.01, 0.01) if self.chance(0.08) else 0.0
        others = [h.value for h in self.held if h.side[0] == side[0]]
        value = others[0] if others else value  # values of sides that meet must agree
        self.held.append(Held(side, components, value))

    def wall(self, side: Side | None, gap: float | None = None) -> None:
        """An obstacle of a random shape at a gap from a side."""
        if side is None:
            return
        body, axis, end = side
        box = self.bodies[body]
        low, high = np.array(box.low), np.array(box.high)
        out = np.zeros(self.gdim)
        out[axis] = 1.0 if end else -1.0
        centre = 0.5 * (low + high)
        centre[axis] = (low, high)[end][axis]
        extent = np.delete(high - low, axis)
        gap = self.gap() if gap is None else gap
        kind, at = self.one("plane", "plane", "slope", "bump", "ball", "bowl"), centre + gap * out
        R = self.real(2, 20) * float(np.linalg.norm(extent))
        if kind == "plane":
            data = at, -out
        elif kind == "slope":
            kind, tilt = "plane", self.rng.uniform(-0.05, 0.05, self.gdim)
            data = at + out * 0.05 * extent.sum(), -out + tilt
        elif kind == "bump":
            data = at, -out, np.array([1.0 / R])
        elif kind == "ball":
            data = at + R * out, np.array([R])
        else:
            depth = np.sqrt(R**2 - 0.25 * np.sum(extent**2))
            data = centre - depth * out, np.array([R + gap])
        self.walls.append(Wall(side, kind, tuple(tuple(v.tolist()) for v in data)))

    def meet(self, a: Side, b: Side) -> None:
        """A pair, either side secondary."""
        self.pairs.append(Pair(a, b) if self.chance(0.5) else Pair(b, a))

    def push(self, body: int, direction: np.ndarray | None, side: Side | None = None) -> None:
        """A traction on a free side, or a force per volume, of about 1."""
        side = self.free_side(body) if side is None and self.chance(0.7) else side
        if direction is None:
            direction = self.rng.normal(size=self.gdim)
            if self.chance(0.3):
                direction *= self.rng.uniform(size=self.gdim) < 0.5
        value = 10 ** self.real(-1, 0) * direction
        self.loads.append(Load(side or (body, -1, 0), tuple(value.tolist())))

    def down(self) -> np.ndarray:
        """Down, sometimes aslant."""
        out = np.zeros(self.gdim)
        out[-1] = -1.0
        if self.chance(0.04):
            out[:-1] = self.rng.normal(size=self.gdim - 1) * 0.3
        return out

    def scene(self) -> Scene:
        """The scene, in units of its own."""
        cells = sum(int(np.prod(b.cells)) for b in self.bodies)
        subdomains = int(self.rng.integers(1, 9))
        scattered = int(self.rng.integers(1000)) if self.chance(0.3) else None
        softest = min(b.E for b in self.bodies)
        strain = 10 ** self.real(-6, -1.5) * softest
        length = 10 ** self.real(-9, 6) if self.spice(0.3) else 1.0
        modulus = 10 ** self.real(0, 12) if self.spice(0.3) else 1.0
        jump = 10 ** self.real(1, 8) if self.spice(0.12) else 1.0
        whole = Scene(
            cell=self.cell,
            bodies=tuple(self.bodies),
            held=tuple(self.held),
            loads=tuple(self.loads),
            walls=tuple(self.walls),
            pairs=tuple(self.pairs),
            subdomains=min(subdomains, cells),
            scattered=scattered,
            subdomain_jump=jump,
            note=self.note,
        )
        return whole.in_units(length, modulus, strain)


def random_scene(seed: int) -> Scene:
    """The scene of a seed, the same everywhere."""
    draw = Draw(np.random.default_rng([seed, 2006]))
    kind = draw.one(_single, _stack, _row, _bridge, _apart)
    draw.note = kind.__name__.removeprefix("_")
    kind(draw)
    return draw.scene()


def _single(draw: Draw) -> None:
    draw.box(np.zeros(draw.gdim), draw.size())
    if draw.chance(0.75):
        draw.hold(draw.free_side(0), None if draw.chance(0.5) else tuple(range(draw.gdim)))
    for k in range(int(draw.rng.integers(0, 4))):
        below = (0, draw.up, 0)
        draw.wall(below if k == 0 and below in draw.free_sides(0) else draw.free_side(0))
    for _ in range(int(draw.rng.integers(1, 3))):
        draw.push(0, draw.down() if draw.chance(0.6) else None)


def _stack(draw: Draw) -> None:
    low = np.zeros(draw.gdim)
    for b in range(int(draw.rng.integers(2, 6 if draw.gdim == 2 else 5))):
        size = draw.size()
        draw.box(low, size)
        if b:
            draw.meet((b - 1, draw.up, 1), (b, draw.up, 0))
        top = low[-1] + size[-1]
        low = low + draw.rng.uniform(-0.3, 0.3, draw.gdim) * (draw.rng.uniform() < 0.8)
        low[-1] = top + draw.gap()
    support = draw.real(0, 1)
    if support < 0.45:
        draw.hold((0, draw.up, 0), tuple(range(draw.gdim)))
    elif support < 0.9:
        draw.wall((0, draw.up, 0))
    for b in range(len(draw.bodies)):
        for axis in range(draw.up):
            if draw.chance(0.55):
                draw.hold((b, axis, 0), None if draw.chance(0.3) else (axis,))
        if draw.chance(0.5):
            draw.push(b, draw.down() if draw.chance(0.95) else None)
    draw.push(len(draw.bodies) - 1, draw.down(), (len(draw.bodies) - 1, draw.up, 1))


def _row(draw: Draw) -> None:
    low, floor = np.zeros(draw.gdim), draw.chance(0.6)
    for b in range(int(draw.rng.integers(2, 5))):
        size = draw.size()
        draw.box(low, size)
        if b:
            draw.meet((b - 1, 0, 1), (b, 0, 0))
        if floor:
            draw.wall((b, draw.up, 0), 0.0 if draw.chance(0.8) else None)
            draw.push(b, draw.down())
        else:
            draw.hold((b, draw.up, 0), (draw.up,))
        low = low + np.r_[size[0] + draw.gap(), np.zeros(draw.gdim - 1)]
    last = len(draw.bodies) - 1
    if draw.chance(0.5):
        draw.hold((last, 0, 1), tuple(range(draw.gdim)))
    elif draw.chance(0.8):
        draw.wall((last, 0, 1))
    along = np.zeros(draw.gdim)
    along[0] = 1.0 if draw.chance(0.9) else -1.0
    draw.push(0, along, (0, 0, 0))


def _bridge(draw: Draw) -> None:
    left, right, beam = draw.size(), draw.size(), draw.size()
    right[-1] = left[-1]
    span = left[0] + 0.5 * right[0] + draw.real(0.05, 1.0)
    draw.box(np.zeros(draw.gdim), left)
    draw.box(np.r_[span, np.zeros(draw.gdim - 1)], right)
    beam[0] = span
    corner = np.zeros(draw.gdim)
    corner[0], corner[-1] = 0.4 * left[0], left[-1] + draw.gap()
    draw.box(corner, beam)
    draw.meet((2, draw.up, 0), (0, draw.up, 1))
    draw.meet((2, draw.up, 0), (1, draw.up, 1))
    for b in (0, 1):
        if draw.chance(0.75):
            draw.hold((b, draw.up, 0), tuple(range(draw.gdim)))
        else:
            draw.wall((b, draw.up, 0), 0.0)
        if draw.chance(0.3):
            draw.push(b, draw.down())
    for axis in range(draw.up):
        if draw.chance(0.6):
            draw.hold((2, axis, 0), (axis,))
    draw.push(2, draw.down(), (2, draw.up, 1))


def _apart(draw: Draw) -> None:
    low = np.zeros(draw.gdim)
    for b in range(int(draw.rng.integers(2, 5))):
        size = draw.size()
        draw.box(low, size)
        if b:
            draw.meet((b - 1, 0, 1), (b, 0, 0))
        draw.hold((b, draw.up, 0), None if draw.chance(0.1) else tuple(range(draw.gdim)))
        if draw.chance(0.5):
            draw.wall(draw.free_side(b))
        draw.push(b, None)
        apart = 10 ** draw.real(-4, 0 if draw.mild else 5)
        low = low + np.r_[size[0] + apart, np.zeros(draw.gdim - 1)]
