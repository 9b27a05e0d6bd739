"""Scenes of ``time_against_error.py``: those of the demos on any mesh, with their closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

import tfeti_dolfinx as tfeti
from benchmarks.elastic import Elastic
from benchmarks.pressures import Array, LineContact, PointContact, RoundedPunch, Samples
from meshes import cylinder_on_block, half_ball, half_cylinder, half_planes, rings

UNIFORM, GRADED, ADAPTIVE = "uniform", "graded", "adaptive"
# no zone of fine elements, but fine elements everywhere
EVERYWHERE = 1e6


@dataclass(frozen=True)
class Scene:
    """A scene that can be meshed and set up at any size."""

    # from elements along a (around the shaft) and the kind of mesh to gmsh's model
    build: Callable[[float, str], Any]
    # from a torn mesh and the degree to the arguments of ``ContactProblem``
    make: Callable[[tfeti.Decomposition, int], dict[str, Any]]
    samples: Samples  # where pressures are compared
    exact: Array  # the closed form there
    # from points of the contact, shape ``(n, 3)``, to places along it
    place: Callable[[Array], Array] = lambda points: points[:, :1]
    # Young's modulus at points
    young: Callable[[Array], Array] = lambda points: np.ones(len(points))
    # what is compared there, of the contact's data
    force: Callable[[Any], Array] = lambda data: data.pressure
    # solves the problem, in load steps where it takes some
    solve: Callable[[tfeti.ContactProblem], None] = lambda problem: problem.solve()


def grading(elements: float, mesh: str, a: float, rate: float = 3.6) -> dict[str, float]:
    """Sizes of elements: halved everywhere if ``elements``, along a, are doubled."""
    wide = EVERYWHERE if mesh == UNIFORM else 1.5
    return {"fine": a / elements, "fine_radius": wide * a, "growth": rate / elements}


def against(closed: Any, samples: Callable[[float], Samples] = Samples.line) -> dict[str, Any]:
    """Where pressures are compared with a closed form, and that there."""
    places = samples(closed.half_width)
    return {"samples": places, "exact": closed.pressure(places.distance)}


# --- Scenes -------------------------------------------------------------------------------------

R, NU = 1.0, 0.3
LINE = LineContact.from_half_width(0.04, R, 1 / (1 - NU**2))
POINT = PointContact.from_half_width(0.05, R, 1 / (1 - NU**2))


def _line() -> Scene:
    """``hertz_2d.py``."""
    a = LINE.half_width

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        body = Elastic(d, 1.0, NU, "plane_strain", degree)
        body.hold("axis", 0)
        body.load("top", body.constant(0.0, -LINE.load / (2 * R)))
        return body.parts([tfeti.Obstacle("contact", tfeti.Plane((0, 0), (0, 1)), reach=2 * a**2)])

    return Scene(
        build=lambda n, mesh: half_cylinder.build(R, **grading(n, mesh, a)),
        make=make,
        **against(LINE),
    )


def _ball() -> Scene:
    """``hertz_3d.py``."""
    a = POINT.half_width

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        body = Elastic(d, 1.0, NU, "3d", degree)
        area = fem.assemble_scalar(fem.form(body.constant(1.0) * body.ds("top")))
        body.load("top", body.constant(0.0, 0.0, -POINT.load / d.comm.allreduce(area)))
        plane = tfeti.Plane((0, 0, 0), (0, 0, 1))
        return body.parts([tfeti.Obstacle("contact", plane, reach=2 * a**2)])

    return Scene(
        build=lambda n, mesh: half_ball.build(R, **grading(n, mesh, a, 1.5)),
        make=make,
        **against(POINT, Samples.disc),
        place=lambda points: points[:, :2],
    )


def _cylinder() -> Scene:
    """``cylinder_on_block_2d.py --exchange``."""
    radius, force, young = 50.0, 35e3, {"cylinder": 2.1e5, "block": 7e4}
    modulus = 1 / sum((1 - NU**2) / E for E in young.values())
    hertz = LineContact.from_load(force, radius, modulus)
    a = hertz.half_width

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        bodies = Elastic(d, young, NU, "plane_strain", degree)
        bodies.hold("axis", 0)
        bodies.hold("bottom", 0)
        bodies.hold("bottom", 1)
        bodies.load("load", bodies.constant(0.0, -force / (2 * radius)))
        pair = tfeti.Contact("top", "arc", secondary="top", reach=0.75 * a**2 / radius)
        return bodies.parts([pair])

    return Scene(
        build=lambda n, mesh: cylinder_on_block.build(radius, 4 * radius, **grading(n, mesh, a)),
        make=make,
        **against(hertz),
        young=lambda points: np.where(points[:, 1] > 0.0, young["cylinder"], young["block"]),
    )


L, MU = 1.0, 0.3
PUSH = 0.5  # of the force at which all slips
PAIR = LineContact.from_half_width(0.04, R, 1 / (1 - NU**2) / 2)
PUNCH = RoundedPunch(0.02, 0.04, R, 1 / (1 - NU**2) / 2)


def half_planes_pushed(
    d: tfeti.Decomposition, degree: int, gap: Callable[[Array], Array], friction: Any = None
) -> tuple[fem.Constant, fem.Constant, dict[str, Any]]:
    """Forces P and Q, and arguments of the problem of ``cattaneo_mindlin_2d.py``."""
    bodies = Elastic(d, 1.0, NU, "plane_strain", degree)
    V, v = bodies.V, bodies.v
    P, Q = bodies.constant(0.0), bodies.constant(0.0)
    side = (Q * v[0] - P * v[1]) / (2 * L)
    tilt = 1.5 / L**2 * Q * ufl.SpatialCoordinate(d.mesh)[0] * v[1]
    top, bottom = bodies.ds("top"), bodies.ds("bottom")
    bodies.L = side * top - side * bottom + tilt * (top + bottom)
    middle = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], 0))
    corner, _ = fem.locate_dofs_geometrical(
        (V.sub(1), V.sub(1).collapse()[0]), lambda x: np.isclose(x[1], -L) & np.isclose(x[0], L)
    )
    bodies.bcs = [fem.dirichletbc(np.zeros(2), middle, V), fem.dirichletbc(0.0, corner, V.sub(1))]
    faces, reach = ("upper face", "lower face"), 1.3 * PAIR.half_width**2 / R
    pair = tfeti.Contact(*faces, secondary=faces[0], gap=gap, friction=friction, reach=reach)
    return P, Q, bodies.parts([pair])


def _punch() -> Scene:
    """The identical bodies of the demo, their shape in the gap, without friction."""

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        P, _, parts = half_planes_pushed(
            d, degree, lambda x: np.maximum(np.abs(x[0]) - PUNCH.flat, 0.0) ** 2 / (2 * R)
        )
        P.value = PUNCH.load
        return parts

    return Scene(
        build=lambda n, mesh: half_planes.build(L, **grading(n, mesh, PUNCH.half_width)),
        make=make,
        **against(PUNCH),
    )


def _slip() -> Scene:
    """The demo in two steps; what friction leaves, μp − |q|, is Hertz's pressure on |x| < c."""
    loads: list[fem.Constant] = []
    left = LineContact.from_half_width(PAIR.half_width * np.sqrt(1 - PUSH), R, MU / (1 - NU**2) / 2)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        friction = tfeti.Coulomb(MU)
        *loads[:], parts = half_planes_pushed(d, degree, lambda x: x[0] ** 2 / (2 * R), friction)
        return parts

    def solve(problem: tfeti.ContactProblem) -> None:
        P, Q = loads
        P.value = PAIR.load
        problem.solve()
        problem.accept()
        Q.value = PUSH * MU * PAIR.load
        problem.solve()

    return Scene(
        build=lambda n, mesh: half_planes.build(L, **grading(n, mesh, PAIR.half_width)),
        make=make,
        **against(left),
        force=lambda data: MU * data.pressure - np.linalg.norm(data.tangential_traction, axis=1),
        solve=solve,
    )


def _rings() -> Scene:
    """Soft springs hold two rings; nothing loads them but that they overlap."""
    samples, overlap, spring = Samples.circle(rings.MIDDLE), rings.MIDDLE / 1500, 1e-6

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        bodies = Elastic(d, 1.0, NU, "plane_strain", degree)
        dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 4 * degree - 2})
        parts = bodies.parts([tfeti.Contact("shaft", "hub", gap=-overlap)])
        return {**parts, "a": parts["a"] + spring * ufl.dot(bodies.u, bodies.v) * dx}

    return Scene(
        build=lambda n, mesh: rings.build((3 * round(n), 4 * round(n)), triangles=True),
        make=make,
        samples=samples,
        exact=np.full(len(samples.points), rings.lame_pressure(overlap)),
        place=lambda points: rings.MIDDLE * np.arctan2(points[:, 1], points[:, 0])[:, None],
    )


SCENES: dict[str, Callable[[], Scene]] = {
    "half cylinder": _line,
    "half ball": _ball,
    "rounded punch": _punch,
    "partial slip": _slip,
    "shrink fit": _rings,
    "cylinder on block": _cylinder,
}
