"""Ladders: a scene with one number that becomes harder; the first rung is the friendly case."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.stress.scene import GDIM, Body, Held, Load, Pair, Scene, Wall

CELLS = ("quadrilateral", "triangle", "hexahedron", "tetrahedron")
SIMPLICES = ("triangle", "tetrahedron")
MODULI = (1.0, 1e2, 1e4, 1e6, 1e8)
NU = (0.3, 0.49, 0.499, 0.4999)
ASPECTS = (1.0, 10.0, 1e2, 1e3, 1e4)
THIN = (1.0, 10.0, 1e2, 1e3)
RTOL = (1e-6, 1e-2, 1e-4, 1e-8, 1e-10, 1e-12)
STEEL, PRESSURE = 2.1e11, 1e5
FAR = (1e-3, 1e-6, 1.0, 1e6)
UNITS = [(1.0, 1.0)] + [(m, Pa) for m in (1e-9, 1e-3, 1e3) for Pa in (1e3, 1e9, 1e12)]


@dataclass(frozen=True)
class Ladder:
    """A scene with one thing that becomes harder, rung by rung."""

    group: str  # what it is about
    name: str  # name of the scene
    rung: Callable[[str, float], Scene]  # from a cell type and a value to the scene
    values: Sequence[float]  # the values, the friendly one first
    cells: Sequence[str] = CELLS  # cell types that it makes sense for


def up(cell: str, vertical: float, across: float = 0.0) -> tuple[float, ...]:
    return (across,) * (GDIM[cell] - 1) + (vertical,)


def cells(cell: str, n: int = 4) -> tuple[int, ...]:
    return (n,) * 2 if GDIM[cell] == 2 else (max(2, n - 1),) * 3


def block(
    cell: str, bottom: float = 0.0, E: float = STEEL, nu: float = 0.3, jump: float = 1.0
) -> Body:
    """A unit cube, or square, above a height."""
    return Body(up(cell, bottom), up(cell, bottom + 1.0, 1.0), cells(cell), E, nu, jump)


def clamp(cell: str, body: int = 0, axis: int = 0, end: int = 0) -> Held:
    """A side that does not move, by default the low end of x; axis −1 is the last one."""
    return Held((body, axis % GDIM[cell], end), tuple(range(GDIM[cell])))


def rollers(cell: str, body: int) -> Held:
    """The low end of x moves up and down alone."""
    return Held((body, 0, 0), tuple(range(GDIM[cell] - 1)))


def press(cell: str, force: float, body: int = 0, push: float = 0.0) -> Load:
    """A traction downwards, and along x, on the top."""
    last = GDIM[cell] - 1
    return Load((body, last, 1), (push,) + (0.0,) * (last - 1) + (-force,))


def on(cell: str, upper: int, lower: int) -> Pair:
    """A body on another one; the upper one carries the multipliers."""
    last = GDIM[cell] - 1
    return Pair((upper, last, 0), (lower, last, 1))


def floor(cell: str, at: float = 0.0, body: int = 0) -> Wall:
    return Wall((body, GDIM[cell] - 1, 0), "plane", (up(cell, at), up(cell, 1.0)))


def far_wall(cell: str, gap: float, body: int = 0, at: float = 1.0) -> Wall:
    """Beyond the high end of x."""
    rest = (0.0,) * (GDIM[cell] - 1)
    return Wall((body, 0, 1), "plane", ((at + gap, *rest), (-1.0, *rest)))


def far_obstacle(cell: str, gap: float) -> Scene:
    """A steel block on the ground, pushed towards an obstacle that it does not reach."""
    push = Load((0, 0, 0), (PRESSURE,) + (0.0,) * (GDIM[cell] - 1))
    return Scene(cell, (block(cell),), (clamp(cell, axis=-1),), (push,), (far_wall(cell, gap),))


def pressed(
    cell: str,
    nu: float = 0.3,
    order: int = 1,
    at: float = 0.0,
    push: float = 0.0,
    jump: float = 1.0,
) -> Scene:
    """A block that is clamped at one end, pressed on a floor, and maybe pushed along it."""
    body, load = block(cell, E=1.0, nu=nu, jump=jump), press(cell, 1e-2, push=push)
    return Scene(cell, (body,), (clamp(cell),), (load,), (floor(cell, at),), order=order)


def jumping(scene: Scene, jump: float) -> Scene:
    """The scene with a jump of moduli between odd and even subdomains."""
    return replace(scene, subdomains=8, subdomain_jump=jump)


def two_bodies(cell: str, lower: float, upper: float) -> Scene:
    """A block that only rollers and contact hold, on a clamped one, pressed and pushed sideways."""
    bodies = block(cell, E=lower), block(cell, 1.0, E=upper)
    held, loads = (clamp(cell, axis=-1), rollers(cell, 1)), (press(cell, 1e-2, 1, push=-1e-3),)
    return Scene(cell, bodies, held, loads, pairs=(on(cell, 1, 0),), subdomains=6)


def loose_stack(cell: str, jump: float, nu: float = 0.3) -> Scene:
    """Three blocks on the floor, held by contact alone, stiff and soft."""
    bodies = tuple(block(cell, float(k), E, nu) for k, E in enumerate((1.0, jump, 1.0)))
    pairs = on(cell, 1, 0), on(cell, 2, 1)
    loads, walls = (press(cell, 1e-2, 2),), (floor(cell),)
    return Scene(cell, bodies, (), loads, walls, pairs, subdomains=6)


def flat_block(cell: str, aspect: float) -> Scene:
    """A plate on the floor, clamped at one end, pressed."""
    plate = Body(up(cell, 0.0), up(cell, 1.0 / aspect, 1.0), cells(cell))
    return Scene(cell, (plate,), (clamp(cell),), (press(cell, 1e-3),), (floor(cell),))


def strips(cell: str, aspect: float) -> Scene:
    """Two strips, one on the other, clamped at one end; the upper bends onto the lower."""
    last, t = GDIM[cell] - 1, 1.0 / aspect
    n = (12,) + (2,) * last
    low, high = (0.0,) * (last + 1), (1.0,) + (t,) * last
    above, top = ((*x[:-1], x[-1] + t) for x in (low, high))
    bodies, held = (Body(low, high, n), Body(above, top, n)), (clamp(cell), clamp(cell, 1))
    load = press(cell, 0.1 * t**3, 1)
    return Scene(cell, bodies, held, (load,), pairs=(on(cell, 1, 0),), subdomains=8)


def beam(cell: str, aspect: float) -> Scene:
    """A cantilever without contact."""
    last, t = GDIM[cell] - 1, 1.0 / aspect
    body = Body((0.0,) * (last + 1), (1.0,) + (t,) * last, (16,) + (2,) * last)
    return Scene(cell, (body,), (clamp(cell),), (press(cell, 0.1 * t**3),), subdomains=8)


def with_friction(scene: Scene, law: str, number: float) -> Scene:
    """The scene with a law of friction on all its contacts."""
    walls, pairs = (
        tuple(replace(contact, friction=(law, number)) for contact in contacts)
        for contacts in (scene.walls, scene.pairs)
    )
    return replace(scene, walls=walls, pairs=pairs)


def layered(cell: str, aspect: float) -> Scene:
    """The same with layers of flat cells at the floor."""
    return replace(pressed(cell), bent=("layers", aspect))


def slivers(cell: str, strength: float) -> Scene:
    """The same with cells of hardly any volume."""
    scene = pressed(cell)
    body = replace(scene.bodies[0], cells=(4,) * scene.gdim)
    return replace(scene, bodies=(body,), bent=("slivers", strength))


def thin(cell: str, slenderness: float, radius: float | None = None) -> Scene:
    """A plate above a floor that it bends down to, clamped at one end; or an arch on it."""
    t = 1.0 / slenderness
    plate = Body(up(cell, 0.0), up(cell, t, 1.0), (8,) + (4,) * (GDIM[cell] - 2) + (1,))
    if radius is None:
        load, walls = press(cell, 0.1 * t**3), (floor(cell, -0.01),)
        return Scene(cell, (plate,), (clamp(cell),), (load,), walls)
    held, walls = (clamp(cell), clamp(cell, end=1)), (floor(cell, -1e-3),)
    return Scene(cell, (plate,), held, (press(cell, 0.02 * t),), walls, bent=("arch", radius))


def hanging(cell: str, hangs: float) -> Scene:
    """Subdomains of quarters or eighths that meet in corners and edges alone."""
    scene = two_bodies(cell, 1.0, 1.0)
    bodies = tuple(replace(b, cells=(4,) * scene.gdim) for b in scene.bodies)
    return replace(scene, bodies=bodies, hanging=bool(hangs))


def scattered(cell: str, seed: float) -> Scene:
    """Random subdomains, but for the seed 0."""
    return replace(two_bodies(cell, 1.0, 1.0), scattered=int(seed) or None)


def hinge(cell: str, joined: float) -> Scene:
    """A block beside a clamped one: 0 clamped, 1 also hanging by a corner or edge, 2 by that alone.

    The package takes them for two bodies that are not joined, and must say so.
    """
    rest = (0.0,) * (GDIM[cell] - 2)
    beside = Body((1.0, *rest, 1.0), (2.0, *(1.0 for _ in rest), 2.0), cells(cell))
    held = (clamp(cell, 0, -1), clamp(cell, 1, -1))[: 2 if joined < 2.0 else 1]
    bodies, walls = (block(cell, E=1.0), beside), (far_wall(cell, 0.0, 1, 2.0),)
    return Scene(cell, bodies, held, (press(cell, 1e-3, 1),), walls, joined=bool(joined))


def two_obstacles(cell: str, gap: float) -> Scene:
    """Two obstacles on the same nodes; 0: one, below 0: both at once."""
    scene = pressed(cell)
    more = () if gap == 0.0 else (floor(cell, -max(gap, 0.0)),)
    return replace(scene, walls=(*scene.walls, *more))


def three_pairs(cell: str, count: float) -> Scene:
    """A block on as many blocks, beside or behind each other, that share its lower side."""
    n = int(count)
    bodies = [Body(up(cell, 1.0), up(cell, 2.0, 1.0), (6, *cells(cell)[1:]))]
    for k in range(n):
        # all of them reach to the middle of the block, so that nodes there meet them all
        low, high = (-0.1 * k, *up(cell, 0.0)[1:]), (1.0 + 0.1 * k, *up(cell, 1.0, 1.0)[1:])
        bodies.append(Body(low, high, cells(cell)))
    held = (*(clamp(cell, k + 1, -1) for k in range(n)), rollers(cell, 0))
    pairs, load = tuple(on(cell, 0, k + 1) for k in range(n)), press(cell, 1e-2)
    return Scene(cell, tuple(bodies), held, (load,), (), pairs, subdomains=2 + 2 * n)


def grazing(cell: str, more: float) -> Scene:
    """A block that its own stretching just brings to the floor, and a share more of the load."""
    last = GDIM[cell] - 1
    body, held = block(cell, 1e-3, E=1.0, nu=0.0), (clamp(cell, 0, -1, 1),)
    load = Load((0, last, 0), up(cell, -1e-3 * (1.0 + more)))
    return Scene(cell, (body,), held, (load,), (floor(cell),))


def everywhere(cell: str, which: float) -> Scene:
    """0: one wall is met; 1: walls on all sides but the pressed one; 2: none is reached."""
    last, scene = GDIM[cell] - 1, pressed(cell)
    if which == 2.0:
        return replace(scene, walls=(floor(cell, -1.0), far_wall(cell, 1.0)))
    walls = [floor(cell)]
    for axis, end in [(axis, end) for axis in range(last) for end in (0, 1)]:
        point, normal = [0.0] * (last + 1), [0.0] * (last + 1)
        point[axis], normal[axis] = (1.0, -1.0) if end else (-0.0, 1.0)
        walls.append(Wall((0, axis, end), "plane", (tuple(point), tuple(normal))))
    return scene if which == 0.0 else replace(scene, held=(), walls=tuple(walls))


def in_units(cell: str, metre: float, pascal: float, law: str = "") -> Scene:
    """Two blocks of moduli 1 and 10, with another metre and pascal."""
    scene = two_bodies(cell, 1.0, 10.0).in_units(metre, pascal)
    number = 0.3 if law == "coulomb" else 1e-3 * pascal
    return with_friction(scene, law, number) if law else scene


def to_rtol(cell: str, rtol: float, law: str = "") -> Scene:
    """Two blocks, to a tolerance."""
    return replace(in_units(cell, 1.0, 1.0, law), options={"tfeti_rtol": rtol})


def rubbing(of: Callable[[str, float], Scene], law: str, number: float) -> Any:
    """Rungs of scenes with a law of friction."""
    return lambda c, v: with_friction(of(c, v), law, number)


def soft(cell: str, value: float) -> Scene:
    return two_bodies(cell, value, 1.0)


IN_UNITS = range(len(UNITS))
LADDERS = [
    Ladder("moduli", "soft on stiff", soft, MODULI),
    Ladder("moduli", "stiff on soft", lambda c, v: two_bodies(c, 1.0, v), MODULI),
    Ladder("moduli", "loose stack", loose_stack, MODULI),
    Ladder("moduli", "subdomains of a body", lambda c, v: jumping(pressed(c, at=-1e-3), v), MODULI),
    Ladder("moduli", "subdomains of a pair", lambda c, v: jumping(two_bodies(c, 1, 1), v), MODULI),
    Ladder("moduli", "cells", lambda c, v: pressed(c, at=-1e-3, jump=v), MODULI),
    Ladder("nu", "P1", pressed, NU),
    Ladder("nu", "P1, loose", lambda c, v: loose_stack(c, 1.0, v), NU),
    Ladder("nu", "P2", lambda c, v: pressed(c, v, 2), NU),
    Ladder("aspect", "layers at contact", layered, ASPECTS),
    Ladder("aspect", "flat block", flat_block, ASPECTS),
    Ladder("aspect", "slivers", slivers, ASPECTS, SIMPLICES),
    Ladder("thin", "plate", thin, THIN),
    Ladder("thin", "arch", lambda c, v: thin(c, v, 1.0), (10.0, 1e2, 1e3)),
    Ladder("thin", "strips", strips, (*THIN, 1e4)),
    Ladder("thin", "beam", beam, (*THIN, 1e4)),
    Ladder("parts", "hang at corners", hanging, (0.0, 1.0)),
    Ladder("parts", "random", scattered, tuple(map(float, range(6)))),
    Ladder("parts", "hinge", hinge, (0.0, 1.0, 2.0)),
    Ladder("rows", "two obstacles", two_obstacles, (0.0, -1.0, 1e-6, 1e-3)),
    Ladder("rows", "pairs of a node", three_pairs, (1.0, 2.0, 3.0)),
    Ladder("rows", "far obstacle", far_obstacle, FAR),
    Ladder("rows", "grazing", grazing, (1.0, 1e-3, 1e-6, 1e-9, 0.0, -1e-6)),
    Ladder("rows", "all or nothing", everywhere, (0.0, 1.0, 2.0)),
    Ladder("units", "frictionless", lambda c, v: in_units(c, *UNITS[int(v)]), IN_UNITS),
    Ladder("rtol", "frictionless", to_rtol, RTOL),
]
WITH_FRICTION = (
    ("Tresca, moduli", rubbing(soft, "tresca", 1e-3), MODULI),
    ("Coulomb, moduli", rubbing(soft, "coulomb", 0.3), MODULI),
    (
        "Coulomb, coefficient",
        lambda c, v: with_friction(pressed(c, push=-2e-3), "coulomb", v),
        (0.1, 1e-3, 0.5, 1.0, 10.0),
    ),
    ("Coulomb, nu", rubbing(pressed, "coulomb", 0.3), NU),
    ("Coulomb, layers", rubbing(layered, "coulomb", 0.3), ASPECTS),
    ("Coulomb, units", lambda c, v: in_units(c, *UNITS[int(v)], "coulomb"), IN_UNITS),
    ("Coulomb, rtol", lambda c, v: to_rtol(c, v, "coulomb"), RTOL),
)
LADDERS += [Ladder("friction", *given, ("triangle", "hexahedron")) for given in WITH_FRICTION]


def label(ladder: Ladder, value: float) -> str:
    """A value as it stands in a table."""
    if ladder.name.endswith(("units", "frictionless")) and ladder.values == IN_UNITS:
        return "{:g} m, {:g} Pa".format(*UNITS[int(value)])
    return f"{value:g}"
