"""Scenes of ``time_against_error.py``: from the demos, with their closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

import tfeti_dolfinx as tfeti
from benchmarks.profiles import Array, Samples
from demos import adaptive_2d, cylinder_on_block_2d, hertz_3d
from demos import cattaneo_mindlin_2d as half_planes_2d
from demos.partial_slip import pushed
from meshes import cylinder_on_block, half_ball, half_cylinder, half_planes, rings

UNIFORM, GRADED, ADAPTIVE = "uniform", "graded", "adaptive"
# no zone of fine elements, but fine elements everywhere
EVERYWHERE = 1e6
SPRING = 1e-6


@dataclass(frozen=True)
class Scene:
    """A scene that can be meshed and set up at any size.

    Attributes:
        build: From elements along a (around the shaft) and the kind of mesh to gmsh's model.
        make: From a torn mesh and the degree to the arguments of ``ContactProblem``.
        samples: Where pressures are compared.
        exact: The closed form there.
        place: From points of the contact, shape ``(n, 3)``, to places along it.
        young: Young's modulus at points.
        force: What is compared there, of the contact's data.
        solve: Solves the problem, in load steps where it takes some.
    """

    build: Callable[[float, str], Any]
    make: Callable[[tfeti.Decomposition, int], dict[str, Any]]
    samples: Samples
    exact: Array
    place: Callable[[Array], Array] = lambda points: points[:, :1]
    young: Callable[[Array], Array] = lambda points: np.ones(len(points))
    force: Callable[[Any], Array] = lambda data: data.pressure
    solve: Callable[[tfeti.ContactProblem], None] = lambda problem: problem.solve()


def grading(elements: float, mesh: str, a: float, rate: float) -> dict[str, float]:
    """Sizes of elements: halved everywhere if ``elements``, along a, are doubled."""
    wide = EVERYWHERE if mesh == UNIFORM else 1.5
    return {"fine": a / elements, "fine_radius": wide * a, "growth": rate / elements}


def _line() -> Scene:
    a, R = adaptive_2d.a, adaptive_2d.R
    samples = Samples.line(a)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        """The demo's scene with the reach of ``hertz_2d.py``."""
        plane = tfeti.Plane((0, 0), normal=(0, 1))
        contacts = [tfeti.Obstacle("contact", plane, reach=2 * a**2 / R)]
        return {**adaptive_2d.scene(d, degree), "contacts": contacts}

    return Scene(
        build=lambda n, mesh: half_cylinder.build(R, **grading(n, mesh, a, 3.6)),
        make=make,
        samples=samples,
        exact=samples.exact(adaptive_2d.hertz.pressure),
    )


def _ball() -> Scene:
    a, R = hertz_3d.a, hertz_3d.R
    samples = Samples.disc(a)
    return Scene(
        build=lambda n, mesh: half_ball.build(R, **grading(n, mesh, a, 1.5)),
        make=hertz_3d.scene,
        samples=samples,
        exact=samples.exact(hertz_3d.HERTZ.pressure),
        place=lambda points: points[:, :2],
    )


def _cylinder() -> Scene:
    hertz, R = cylinder_on_block_2d.closed_form(), cylinder_on_block_2d.R
    young = cylinder_on_block_2d.young
    samples = Samples.line(hertz.half_width)
    return Scene(
        build=lambda n, mesh: cylinder_on_block.build(
            R, 4 * R, **grading(n, mesh, hertz.half_width, 3.6)
        ),
        make=lambda d, degree: cylinder_on_block_2d.scene(d, degree, exchange=True),
        samples=samples,
        exact=samples.exact(hertz.pressure),
        young=lambda points: np.where(points[:, 1] > 0.0, young["cylinder"], young["block"]),
    )


@dataclass(frozen=True)
class RoundedPunch:
    """A flat of the half width s whose edges are rounded with the radius R, on a half plane.

    Ciavarella, Hills, Monno, Proc. Inst. Mech. Eng. C 212 (1998).

    Attributes:
        flat: s.
        half_width: Half width b > s of the contact.
        radius: R.
        modulus: E*.
    """

    flat: float
    half_width: float
    radius: float
    modulus: float

    @property
    def _angle(self) -> float:
        return float(np.arcsin(self.flat / self.half_width))

    @property
    def load(self) -> float:
        """The force per length."""
        f = self._angle
        share = (np.pi - 2 * f) / (2 * np.sin(f) ** 2) - 1 / np.tan(f)
        return float(self.modulus * self.flat**2 / (2 * self.radius) * share)

    def pressure(self, x: Array) -> Array:
        """p(x) where |x| < b, 0 outside."""
        g, t = self._angle, np.arcsin(np.clip(x / self.half_width, -1.0, 1.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.sin(t) * np.log(np.abs(np.sin(t + g) / np.sin(t - g)))
            logs += np.sin(g) * np.log(np.abs(np.tan((t + g) / 2) * np.tan((t - g) / 2)))
        value = (np.pi - 2 * g) * np.cos(t) + logs
        scale = 2 * self.load / (np.pi * self.half_width * (np.pi - 2 * g - np.sin(2 * g)))
        return np.where(np.abs(x) < self.half_width, scale * value, 0.0)


PUNCH = RoundedPunch(
    0.5 * half_planes_2d.a, half_planes_2d.a, half_planes_2d.R, half_planes_2d.MODULUS
)


def _punch() -> Scene:
    a = PUNCH.half_width
    samples = Samples.line(a)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        """The identical bodies of the demo, their shape in the gap, without friction."""
        loads, parts = half_planes_2d.scene(d, degree)
        loads.set(PUNCH.load, 0.0)
        contact = tfeti.Contact(
            "upper face",
            "lower face",
            secondary="upper face",
            gap=lambda x: np.maximum(np.abs(x[0]) - PUNCH.flat, 0.0) ** 2 / (2 * PUNCH.radius),
            reach=1.3 * a**2 / PUNCH.radius,
        )
        return {**parts, "contacts": [contact]}

    return Scene(
        build=lambda n, mesh: half_planes.build(half_planes_2d.L, **grading(n, mesh, a, 3.6)),
        make=make,
        samples=samples,
        exact=samples.exact(PUNCH.pressure),
    )


# of the force at which all slips
PUSH = 0.5


def _slip() -> Scene:
    """The demo in two steps; what friction leaves, μp − |q|, is Hertz's pressure on |x| < c."""
    closed, loads = half_planes_2d.CLOSED, []
    force = PUSH * closed.capacity
    left = closed.taken(force)
    samples = Samples.line(left.half_width)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        own, parts = half_planes_2d.scene(d, degree)
        loads[:] = [own]
        return parts

    def solve(problem: tfeti.ContactProblem) -> None:
        pushed(problem, loads[0], closed, 0.0)
        loads[0].set(closed.hertz.load, force)
        problem.solve()

    def unused(data: Any) -> Array:
        return closed.mu * data.pressure - np.linalg.norm(data.tangential_traction, axis=1)

    return Scene(
        build=lambda n, mesh: half_planes.build(
            half_planes_2d.L, **grading(n, mesh, closed.hertz.half_width, 3.6)
        ),
        make=make,
        samples=samples,
        exact=samples.exact(left.pressure),
        force=unused,
        solve=solve,
    )


OVERLAP = rings.MIDDLE / 1500


def _rings() -> Scene:
    samples = Samples.circle(rings.MIDDLE)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        """Soft springs hold the rings; nothing loads them but that they overlap."""
        elastic = tfeti.Elasticity(d, E=1.0, nu=0.3, model="plane_strain")
        V = fem.functionspace(d.mesh, ("Lagrange", degree, (2,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        dx = ufl.Measure("dx", domain=d.mesh, metadata={"quadrature_degree": 4 * degree - 2})
        return {
            "a": elastic.a(u, v) + SPRING * ufl.dot(u, v) * dx,
            "L": ufl.dot(fem.Constant(d.mesh, (0.0, 0.0)), v) * dx,
            "bcs": [],
            "contacts": [tfeti.Contact("shaft", "hub", gap=-OVERLAP)],
            "decomposition": d,
            "stress": elastic.stress,
        }

    return Scene(
        build=lambda n, mesh: rings.build((3 * round(n), 4 * round(n)), triangles=True),
        make=make,
        samples=samples,
        exact=np.full(len(samples.points), rings.lame_pressure(OVERLAP)),
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
