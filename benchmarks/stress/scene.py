"""A scene of boxes as plain data: nothing here knows the package or DOLFINx."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

Vector = tuple[float, ...]
Side = tuple[int, int, int]  # body, axis, end (0 low, 1 high)

GDIM = {"triangle": 2, "quadrilateral": 2, "tetrahedron": 3, "hexahedron": 3}


@dataclass(frozen=True)
class Body:
    """A box of cells, with Young's modulus E on one colour of a checkerboard, E·jump on others."""

    low: Vector
    high: Vector
    cells: tuple[int, ...]
    E: float = 1.0  # Young's modulus
    nu: float = 0.3  # Poisson's ratio
    jump: float = 1.0  # ratio of moduli between the colours


@dataclass(frozen=True)
class Held:
    """Prescribed displacement of some components on a side."""

    side: Side
    components: tuple[int, ...]
    value: float = 0.0


@dataclass(frozen=True)
class Load:
    """A traction on a side of a body, or with ``axis`` −1 a force per volume."""

    side: Side
    value: Vector


@dataclass(frozen=True)
class Wall:
    """A rigid obstacle of a side."""

    side: Side
    # plane (point, normal); ball or bowl (centre, radius); bump, the graph of a paraboloid
    # (point, normal, curvature)
    kind: str
    data: tuple[Vector, ...]  # what the kind needs
    # A law, tresca or coulomb, and its number; None where it slides freely
    friction: tuple[str, float] | None = None


@dataclass(frozen=True)
class Pair:
    """Two parallel sides that may not enter each other; the first carries the multipliers."""

    secondary: Side
    primary: Side
    friction: tuple[str, float] | None = None


@dataclass(frozen=True)
class Scene:
    """Boxes, what holds them, what drives them, what they meet."""

    cell: str
    bodies: tuple[Body, ...]
    held: tuple[Held, ...] = ()  # Dirichlet conditions
    loads: tuple[Load, ...] = ()
    walls: tuple[Wall, ...] = ()
    pairs: tuple[Pair, ...] = ()
    subdomains: int = 4  # their number, by coordinate bisection
    scattered: int | None = None  # seed of a random partition into as many; None for the bisection
    hanging: bool = False  # whether subdomains hang together at corners and edges alone
    subdomain_jump: float = 1.0  # ratio of moduli between odd and even subdomains
    order: int = 1  # degree of the displacements, 1 or 2; 2 for walls of one plane each only
    joined: bool = False  # whether bodies share the points that they have in common: hinges
    # what becomes of the boxes' points, layers, slivers or arch, and a number
    bent: tuple[str, float] | None = None
    options: dict[str, float] = field(default_factory=lambda: {"tfeti_rtol": 1e-6})
    note: str = ""  # what the scene is about

    @property
    def gdim(self) -> int:
        """2 or 3."""
        return GDIM[self.cell]

    def in_units(self, length: float, modulus: float, strain: float = 1.0) -> Scene:
        """The scene with other units of length and of stress; loads times a strain."""

        def scaled(values: Vector, power: float = 1) -> Vector:
            return tuple(length**power * v for v in values)

        powers = {"plane": (1, 0), "ball": (1, 1), "bowl": (1, 1), "bump": (1, 0, -1)}
        loads, walls = [], []
        for p in self.loads:
            factor = modulus * strain / (1.0 if p.side[1] >= 0 else length)
            loads.append(replace(p, value=tuple(factor * v for v in p.value)))
        for w in self.walls:
            data = zip(w.data, powers[w.kind], strict=True)
            walls.append(replace(w, data=tuple(scaled(vector, k) for vector, k in data)))
        return replace(
            self,
            bodies=tuple(
                replace(b, low=scaled(b.low), high=scaled(b.high), E=modulus * b.E)
                for b in self.bodies
            ),
            held=tuple(replace(h, value=h.value * length) for h in self.held),
            loads=tuple(loads),
            walls=tuple(walls),
        )

    @property
    def surfaces(self) -> dict[str, int]:
        """Names of all sides of all bodies, with their tags."""
        sides = product(range(len(self.bodies)), range(self.gdim), (0, 1))
        return {side_name(side): tag for tag, side in enumerate(sides, start=1)}


def side_name(side: Side) -> str:
    """Name of a side, such as ``0+z``: at the high end of z of the first body."""
    body, axis, end = side
    return f"{body}{'-+'[end]}{'xyz'[axis]}"


def wall_distance(wall: Wall, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance (or a level function) and its gradient at points of shape (3, n)."""
    vectors = [np.pad(np.array(v, dtype=float), (0, 3 - min(3, len(v)))) for v in wall.data]
    offset = x - vectors[0][:, None]
    if wall.kind in ("ball", "bowl"):
        sign = 1.0 if wall.kind == "ball" else -1.0
        length = np.linalg.norm(offset, axis=0)
        return sign * (length - wall.data[1][0]), sign * offset / length
    normal = vectors[1] / np.linalg.norm(vectors[1])
    height, curvature = normal @ offset, wall.data[2][0] if wall.kind == "bump" else 0.0
    along = offset - np.outer(normal, height)
    gradient = normal[:, None] + curvature * along  # the bump falls off on all sides
    return height + 0.5 * curvature * np.sum(along**2, axis=0), gradient
