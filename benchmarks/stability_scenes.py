"""Ladders: a scene with one number that becomes harder; the first rung is the friendly case."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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


def all_of(cell: str) -> tuple[int, ...]:
    return tuple(range(GDIM[cell]))


def floor(cell: str, at: float = 0.0, body: int = 0) -> Wall:
    return Wall((body, GDIM[cell] - 1, 0), "plane", (up(cell, at), up(cell, 1.0)))


def far_wall(cell: str, gap: float) -> Wall:
    """Beyond the high end of x."""
    rest = (0.0,) * (GDIM[cell] - 1)
    return Wall((0, 0, 1), "plane", ((1.0 + gap, *rest), (-1.0, *rest)))


def far_obstacle(cell: str, gap: float) -> Scene:
    """A steel block on the ground, pushed towards an obstacle that it does not reach."""
    last = GDIM[cell] - 1
    push = (PRESSURE,) + (0.0,) * last
    return Scene(
        cell,
        (block(cell),),
        held=(Held((0, last, 0), all_of(cell)),),
        loads=(Load((0, 0, 0), push),),
        walls=(far_wall(cell, gap),),
    )


def pressed(
    cell: str,
    nu: float = 0.3,
    order: int = 1,
    at: float = 0.0,
    push: float = 0.0,
    jump: float = 1.0,
) -> Scene:
    """A block that is clamped at one end, pressed on a floor, and maybe pushed along it."""
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell, E=1.0, nu=nu, jump=jump),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), (push,) + (0.0,) * (last - 1) + (-1e-2,)),),
        walls=(floor(cell, at),),
        order=order,
    )


def jumping(scene: Scene, jump: float) -> Scene:
    """The scene with a jump of moduli between odd and even subdomains."""
    return replace(scene, subdomains=8, subdomain_jump=jump)


def two_bodies(cell: str, lower: float, upper: float) -> Scene:
    """A block that only rollers and contact hold, on a clamped one, pressed and pushed sideways."""
    last = GDIM[cell] - 1
    push = (-1e-3,) + (0.0,) * (last - 1) + (-1e-2,)
    return Scene(
        cell,
        (block(cell, E=lower), block(cell, 1.0, E=upper)),
        held=(Held((0, last, 0), all_of(cell)), Held((1, 0, 0), tuple(range(last)))),
        loads=(Load((1, last, 1), push),),
        pairs=(Pair((1, last, 0), (0, last, 1)),),
        subdomains=6,
    )


def loose_stack(cell: str, jump: float, nu: float = 0.3) -> Scene:
    """Three blocks on the floor, held by contact alone, stiff and soft."""
    last = GDIM[cell] - 1
    E = (1.0, jump, 1.0)
    return Scene(
        cell,
        tuple(block(cell, float(k), E=E[k], nu=nu) for k in range(3)),
        loads=(Load((2, last, 1), up(cell, -1e-2)),),
        walls=(floor(cell),),
        pairs=(Pair((1, last, 0), (0, last, 1)), Pair((2, last, 0), (1, last, 1))),
        subdomains=6,
    )


def flat_block(cell: str, aspect: float) -> Scene:
    """A plate on the floor, clamped at one end, pressed."""
    last = GDIM[cell] - 1
    plate = Body(up(cell, 0.0), up(cell, 1.0 / aspect, 1.0), cells(cell), 1.0)
    return Scene(
        cell,
        (plate,),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, -1e-3)),),
        walls=(floor(cell),),
    )


def strips(cell: str, aspect: float) -> Scene:
    """Two strips, one on the other, clamped at one end; the upper bends onto the lower."""
    last, t = GDIM[cell] - 1, 1.0 / aspect
    n = (12,) + (2,) * last
    low, high = (0.0,) * (last + 1), (1.0,) + (t,) * last
    above = tuple(v + (t if k == last else 0.0) for k, v in enumerate(low))
    top = tuple(v + (t if k == last else 0.0) for k, v in enumerate(high))
    return Scene(
        cell,
        (Body(low, high, n), Body(above, top, n)),
        held=(Held((0, 0, 0), all_of(cell)), Held((1, 0, 0), all_of(cell))),
        loads=(Load((1, last, 1), up(cell, -0.1 * t**3)),),
        pairs=(Pair((1, last, 0), (0, last, 1)),),
        subdomains=8,
    )


def beam(cell: str, aspect: float) -> Scene:
    """A cantilever without contact."""
    last, t = GDIM[cell] - 1, 1.0 / aspect
    return Scene(
        cell,
        (Body((0.0,) * (last + 1), (1.0,) + (t,) * last, (16,) + (2,) * last),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, -0.1 * t**3)),),
        subdomains=8,
    )


def with_friction(scene: Scene, law: str, number: float) -> Scene:
    """The scene with a law of friction on all its contacts."""
    walls = tuple(replace(wall, friction=(law, number)) for wall in scene.walls)
    pairs = tuple(replace(pair, friction=(law, number)) for pair in scene.pairs)
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
    last, t = GDIM[cell] - 1, 1.0 / slenderness
    n = (8,) + (4,) * (last - 1) + (1,)
    plate = Body(up(cell, 0.0), up(cell, t, 1.0), n)
    if radius is not None:
        held = (Held((0, 0, 0), all_of(cell)), Held((0, 0, 1), all_of(cell)))
        wall = Wall((0, last, 0), "plane", (up(cell, -1e-3), up(cell, 1.0)))
        load = Load((0, last, 1), up(cell, -0.02 * t))
        return Scene(cell, (plate,), held, (load,), (wall,), bent=("arch", radius))
    load = Load((0, last, 1), up(cell, -0.1 * t**3))
    return Scene(cell, (plate,), (Held((0, 0, 0), all_of(cell)),), (load,), (floor(cell, -0.01),))


def hanging(cell: str, hangs: float) -> Scene:
    """Subdomains of quarters or eighths that meet in corners and edges alone."""
    scene = two_bodies(cell, 1.0, 1.0)
    bodies = tuple(replace(b, cells=(4,) * scene.gdim) for b in scene.bodies)
    return replace(scene, bodies=bodies, hanging=bool(hangs))


def hinge(cell: str, joined: float) -> Scene:
    """A block beside a clamped one: 0 clamped, 1 also hanging by a corner or edge, 2 by that alone.

    The package takes them for two bodies that are not joined, and must say so.
    """
    last = GDIM[cell] - 1
    low = (1.0,) + (0.0,) * (last - 1) + (1.0,)
    high = (2.0,) + (1.0,) * (last - 1) + (2.0,)
    bodies = (block(cell, E=1.0), Body(low, high, cells(cell)))
    held = (Held((0, last, 0), all_of(cell)),)
    wall = Wall((1, 0, 1), "plane", ((2.0,) + (0.0,) * last, (-1.0,) + (0.0,) * last))
    if joined < 2.0:
        held = (*held, Held((1, last, 0), all_of(cell)))
    loads = (Load((1, last, 1), up(cell, -1e-3)),)
    return Scene(cell, bodies, held, loads, (wall,), joined=bool(joined))


def two_obstacles(cell: str, gap: float) -> Scene:
    """Two obstacles on the same nodes; 0: one, below 0: both at once."""
    scene = pressed(cell)
    more = () if gap == 0.0 else (floor(cell, -max(gap, 0.0)),)
    return replace(scene, walls=(*scene.walls, *more))


def three_pairs(cell: str, count: float) -> Scene:
    """A block on as many blocks, beside or behind each other, that share its lower side."""
    last, n = GDIM[cell] - 1, int(count)
    bodies = [Body(up(cell, 1.0), up(cell, 2.0, 1.0), (6, *cells(cell)[1:]))]
    for k in range(n):
        # all of them reach to the middle of the block, so that nodes there meet them all
        low, high = list(up(cell, 0.0)), list(up(cell, 1.0, 1.0))
        low[0], high[0] = -0.1 * k, 1.0 + 0.1 * k
        bodies.append(Body(tuple(low), tuple(high), cells(cell)))
    held = tuple(Held((k + 1, last, 0), all_of(cell)) for k in range(n))
    pairs = tuple(Pair((0, last, 0), (k + 1, last, 1)) for k in range(n))
    rollers = Held((0, 0, 0), tuple(range(last)))
    loads = (Load((0, last, 1), up(cell, -1e-2)),)
    return Scene(cell, tuple(bodies), (*held, rollers), loads, (), pairs, subdomains=2 + 2 * n)


def grazing(cell: str, more: float) -> Scene:
    """A block that its own stretching just brings to the floor, and a share more of the load."""
    last = GDIM[cell] - 1
    body = replace(block(cell, 1e-3, E=1.0), nu=0.0)
    held = (Held((0, last, 1), all_of(cell)),)
    load = Load((0, last, 0), up(cell, -1e-3 * (1.0 + more)))
    return Scene(cell, (body,), held, (load,), (floor(cell),))


def everywhere(cell: str, which: float) -> Scene:
    """0: one wall is met; 1: walls on all sides but the pressed one; 2: none is reached."""
    last = GDIM[cell] - 1
    scene = pressed(cell)
    if which == 0.0:
        return scene
    walls, at = [floor(cell, 0.0 if which == 1.0 else -1.0)], 0.0 if which == 1.0 else 1.0
    for axis in range(last):
        for end in (0, 1):
            point, normal = [0.0] * (last + 1), [0.0] * (last + 1)
            point[axis], normal[axis] = (1.0 + at, -1.0) if end else (-at, 1.0)
            walls.append(Wall((0, axis, end), "plane", (tuple(point), tuple(normal))))
    if which == 1.0:
        return replace(scene, held=(), walls=tuple(walls))
    return replace(scene, walls=(floor(cell, -1.0), far_wall(cell, 1.0)))


def in_units(cell: str, metre: float, pascal: float, law: str = "") -> Scene:
    """Two blocks of moduli 1 and 10, with another metre and pascal."""
    scene = two_bodies(cell, 1.0, 10.0)
    bodies = tuple(
        Body(*(tuple(metre * v for v in x) for x in (b.low, b.high)), b.cells, b.E * pascal, b.nu)
        for b in scene.bodies
    )
    loads = tuple(Load(p.side, tuple(pascal * v for v in p.value)) for p in scene.loads)
    scene = replace(scene, bodies=bodies, loads=loads)
    if law:
        return with_friction(scene, law, 0.3 if law == "coulomb" else 1e-3 * pascal)
    return scene


def to_rtol(cell: str, rtol: float, law: str = "") -> Scene:
    """Two blocks, to a tolerance."""
    return replace(in_units(cell, 1.0, 1.0, law), options={"tfeti_rtol": rtol})


def _ladders() -> list[Ladder]:
    units = range(len(UNITS))
    return [
        Ladder("moduli", "soft on stiff", lambda c, v: two_bodies(c, v, 1.0), MODULI),
        Ladder("moduli", "stiff on soft", lambda c, v: two_bodies(c, 1.0, v), MODULI),
        Ladder("moduli", "loose stack", loose_stack, MODULI),
        Ladder(
            "moduli", "subdomains of a body", lambda c, v: jumping(pressed(c, at=-1e-3), v), MODULI
        ),
        Ladder(
            "moduli", "subdomains of a pair", lambda c, v: jumping(two_bodies(c, 1, 1), v), MODULI
        ),
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
        Ladder(
            "parts",
            "random",
            lambda c, v: replace(two_bodies(c, 1.0, 1.0), scattered=int(v) or None),
            tuple(map(float, range(6))),
        ),
        Ladder("parts", "hinge", hinge, (0.0, 1.0, 2.0)),
        Ladder("rows", "two obstacles", two_obstacles, (0.0, -1.0, 1e-6, 1e-3)),
        Ladder("rows", "pairs of a node", three_pairs, (1.0, 2.0, 3.0)),
        Ladder("rows", "far obstacle", far_obstacle, FAR),
        Ladder("rows", "grazing", grazing, (1.0, 1e-3, 1e-6, 1e-9, 0.0, -1e-6)),
        Ladder("rows", "all or nothing", everywhere, (0.0, 1.0, 2.0)),
        Ladder("units", "frictionless", lambda c, v: in_units(c, *UNITS[int(v)]), units),
        Ladder("rtol", "frictionless", to_rtol, RTOL),
        *_with_friction(),
    ]


def _with_friction() -> list[Ladder]:
    def moduli(law: str) -> Callable[[str, float], Scene]:
        number = 0.3 if law == "coulomb" else 1e-3
        return lambda c, v: with_friction(two_bodies(c, v, 1.0), law, number)

    def rubbing(cell: str, value: float) -> Scene:
        return with_friction(pressed(cell, push=-2e-3), "coulomb", value)

    flat = ("triangle", "hexahedron")
    units = range(len(UNITS))
    return [
        Ladder("friction", "Tresca, moduli", moduli("tresca"), MODULI, flat),
        Ladder("friction", "Coulomb, moduli", moduli("coulomb"), MODULI, flat),
        Ladder("friction", "Coulomb, coefficient", rubbing, (0.1, 1e-3, 0.5, 1.0, 10.0), flat),
        Ladder(
            "friction",
            "Coulomb, nu",
            lambda c, v: with_friction(pressed(c, v), "coulomb", 0.3),
            NU,
            flat,
        ),
        Ladder(
            "friction",
            "Coulomb, layers",
            lambda c, v: with_friction(layered(c, v), "coulomb", 0.3),
            ASPECTS,
            flat,
        ),
        Ladder(
            "friction",
            "Coulomb, units",
            lambda c, v: in_units(c, *UNITS[int(v)], "coulomb"),
            units,
            flat,
        ),
        Ladder("friction", "Coulomb, rtol", lambda c, v: to_rtol(c, v, "coulomb"), RTOL, flat),
    ]


LADDERS = _ladders()


def label(ladder: Ladder, value: float) -> str:
    """A value as it stands in a table."""
    if ladder.name.endswith(("units", "frictionless")) and ladder.values == range(len(UNITS)):
        return "{:g} m, {:g} Pa".format(*UNITS[int(value)])
    return f"{value:g}"
