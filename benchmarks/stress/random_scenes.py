"""Scenes drawn from a seed: single boxes, stacks, rows, bridges, boxes apart, in any units."""

from __future__ import annotations

import numpy as np

from benchmarks.stress.draw import Draw
from benchmarks.stress.scene import Scene


def random_scene(seed: int) -> Scene:
    """The scene of a seed, the same everywhere."""
    draw = Draw(np.random.default_rng([seed, 2006]))
    kind = draw.one("single", "stack", "row", "bridge", "apart")
    draw.note = kind
    {
        "single": _single,
        "stack": _stack,
        "row": _row,
        "bridge": _bridge,
        "apart": _apart,
    }[kind](draw)
    return draw.scene()


def _single(draw: Draw) -> None:
    draw.box(np.zeros(draw.gdim), draw.size())
    if draw.chance(0.75):
        draw.hold(draw.free_side(0), None if draw.chance(0.5) else tuple(range(draw.gdim)))
    for k in range(int(draw.rng.integers(0, 4))):
        draw.wall(
            (0, draw.up, 0) if k == 0 and not draw.used((0, draw.up, 0)) else draw.free_side(0)
        )
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
        low = (
            low
            + np.r_[size[0] + 10 ** draw.real(-4, 0 if draw.mild else 5), np.zeros(draw.gdim - 1)]
        )
