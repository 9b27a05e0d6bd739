"""Scenes that benchmarks set up themselves, from the demos that they are of."""

from demos import cube_3d, hertz_3d

DEMOS = {"cube_3d": cube_3d, "hertz_3d": hertz_3d}
# unknowns and subdomains of the half ball
QUICK, SMALL, MIDDLE, LARGE = (4_000, 4), (60_000, 16), (235_000, 64), (2_090_000, 256)


def sizes(default, large):
    """Arguments of both demos, quick, default and large; those of the half ball are given."""
    cubes = {"quick": (8, 4), "default": (64, 10), "large": (512, 10)}
    balls = {"quick": QUICK, "default": default, "large": large}
    return {
        name: {
            "cube_3d": dict(zip(("subdomains", "cells"), cubes[name], strict=True)),
            "hertz_3d": dict(zip(("unknowns", "subdomains"), balls[name], strict=True)),
        }
        for name in cubes
    }
