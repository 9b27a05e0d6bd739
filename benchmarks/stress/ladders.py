"""Ladders: a scene with one number that rises, rung by rung; its name ends in that number."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from benchmarks.stress.scene import GDIM, Body, Held, Load, Pair, Scene, Wall

STEEL, PRESSURE = 2.1e11, 1e5
FAR = (1e-6, 1e-4, 1e-3, 0.1, 1.0, 1e2, 1e4, 1e6)
JUMPS = (1e2, 1e4, 1e6, 1e8)
ASPECTS = (10.0, 100.0, 500.0, 1000.0, 10000.0)
NU = (0.4, 0.49, 0.499, 0.4999)

Rung = Callable[[str, float], Scene]


def ladder_scenes() -> dict[str, Scene]:
    """All rungs by name."""
    return dict(_rungs())


def _rungs() -> Iterator[tuple[str, Scene]]:
    table: list[tuple[str, Rung, tuple[float, ...]]] = [
        ("far obstacle", far_obstacle, FAR),
        ("far beside touching", far_beside_touching, FAR),
        ("far, held by contact", far_held_by_contact, FAR),
        ("far pair", far_pair, FAR),
        ("checkerboard, open", checkerboard_open, JUMPS),
        ("checkerboard, touching", checkerboard_touching, JUMPS),
        ("subdomains", subdomain_jumps, JUMPS),
        ("subdomains, pair", subdomain_jumps_pair, JUMPS),
        ("soft on stiff", lambda cell, jump: two_bodies(cell, 1.0, jump), JUMPS),
        ("stiff on soft", lambda cell, jump: two_bodies(cell, jump, 1.0), JUMPS),
        ("loose stack", loose_stack, JUMPS),
        ("flat block", flat_block, ASPECTS),
        ("strips", strips, ASPECTS),
        ("beam", beam, ASPECTS),
        ("nu", nearly_incompressible, NU),
        ("nu, loose", nearly_incompressible_loose, NU),
        ("units", in_units, (1e-9, 1e-6, 1e-3, 1e3, 1e6)),
        ("cradle", cradle, (2.0, 10.0, 100.0, 1000.0)),
        ("beam over far plane", beam_over_far_plane, (1.0, 2.0, 8.0)),
    ]
    for name, rung, values in table:
        for cell in ("quadrilateral", "triangle", "hexahedron", "tetrahedron"):
            for value in values:
                yield f"{name} {cell} {value:g}", rung(cell, value)


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


def far_beside_touching(cell: str, gap: float) -> Scene:
    """The block stands on a plane, held at its left; the other obstacle is far."""
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, -PRESSURE)),),
        walls=(floor(cell), far_wall(cell, gap)),
    )


def far_held_by_contact(cell: str, gap: float) -> Scene:
    """Nothing but the floor holds the block upright."""
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell),),
        held=(Held((0, 0, 0), tuple(range(last))),),
        loads=(Load((0, last, 1), up(cell, -PRESSURE)),),
        walls=(floor(cell), far_wall(cell, gap)),
    )


def far_pair(cell: str, gap: float) -> Scene:
    """Two blocks that are clamped, one above the other."""
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell), block(cell, 1.0 + gap)),
        held=(Held((0, last, 0), all_of(cell)), Held((1, last, 1), all_of(cell))),
        loads=(Load((0, 0, 0), (PRESSURE,) + (0.0,) * last), Load((1, -1, 0), up(cell, -PRESSURE))),
        pairs=(Pair((1, last, 0), (0, last, 1)),),
        subdomains=6,
    )


def checkerboard_open(cell: str, jump: float) -> Scene:
    """A checkerboard of stiffness, and one obstacle that stays open."""
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell, E=1.0, jump=jump),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, 1e-3)),),
        walls=(floor(cell, -0.01),),
    )


def checkerboard_touching(cell: str, jump: float) -> Scene:
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell, E=1.0, jump=jump),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, -1e-2)),),
        walls=(floor(cell, -1e-3),),
    )


def subdomain_jumps(cell: str, jump: float) -> Scene:
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell, E=1.0),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, -1e-2)),),
        walls=(floor(cell, -1e-3),),
        subdomains=8,
        subdomain_jump=jump,
    )


def subdomain_jumps_pair(cell: str, jump: float) -> Scene:
    return replace(two_bodies(cell, 1.0, 1.0), subdomains=8, subdomain_jump=jump)


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


def loose_stack(cell: str, jump: float) -> Scene:
    """Three blocks on the floor, held by contact alone, stiff and soft."""
    last = GDIM[cell] - 1
    E = (1.0, jump, 1.0)
    return Scene(
        cell,
        tuple(block(cell, float(k), E=E[k]) for k in range(3)),
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


def nearly_incompressible(cell: str, nu: float) -> Scene:
    last = GDIM[cell] - 1
    return Scene(
        cell,
        (block(cell, E=1.0, nu=nu),),
        held=(Held((0, 0, 0), all_of(cell)),),
        loads=(Load((0, last, 1), up(cell, -1e-2)),),
        walls=(floor(cell),),
    )


def nearly_incompressible_loose(cell: str, nu: float) -> Scene:
    bodies = tuple(block(cell, float(k), E=1.0, nu=nu) for k in range(3))
    return replace(loose_stack(cell, 1.0), bodies=bodies)


def in_units(cell: str, length: float) -> Scene:
    """``two_bodies`` with rollers, in another unit of length, pressures in GPa or kPa with it."""
    scene = two_bodies(cell, 1.0, 10.0)
    pascal = length**-1

    def scaled(b: Body) -> Body:
        low, high = (tuple(length * v for v in corner) for corner in (b.low, b.high))
        return Body(low, high, b.cells, b.E * pascal, b.nu)

    loads = tuple(Load(p.side, tuple(pascal * v for v in p.value)) for p in scene.loads)
    return replace(scene, bodies=tuple(map(scaled, scene.bodies)), loads=loads)


def beam_over_far_plane(cell: str, n: float) -> Scene:
    """A far obstacle below a slender cantilever of n subdomains: nothing touches."""
    return replace(beam(cell, 20.0), walls=(floor(cell, -1.0),), subdomains=int(n))


def cradle(cell: str, radius: float) -> Scene:
    """A block pressed into a shallow bowl that alone holds it against a push from the side."""
    last = GDIM[cell] - 1
    depth = (radius**2 - 0.25 * last) ** 0.5
    centre = (0.5,) * last + (depth,)
    push = (1e-4 / radius,) + (0.0,) * last
    return Scene(
        cell,
        (block(cell, E=1.0),),
        held=(Held((0, last, 1), (last,), -1e-3),),
        loads=(Load((0, -1, 0), push),),
        walls=(Wall((0, last, 0), "bowl", (centre, (radius,))),),
    )
