"""Scenes of ``time_against_error.py``: those of the demos on any mesh, with their closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

import tfeti_dolfinx as tfeti
from benchmarks.hertz import LineContact, PointContact
from benchmarks.profiles import Array, Samples
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


R, NU = 1.0, 0.3
LINE = LineContact.from_half_width(0.04, R, 1 / (1 - NU**2))
POINT = PointContact.from_half_width(0.05, R, 1 / (1 - NU**2))


def half_cylinder_on_plane(
    d: tfeti.Decomposition, degree: int = 1, reach: float | None = None
) -> dict[str, Any]:
    """Arguments of the problem of ``hertz_2d.py``; without a reach contact may be anywhere."""
    elastic = tfeti.Elasticity(d, E=1.0, nu=NU, model="plane_strain")
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    traction = fem.Constant(d.mesh, (0.0, -LINE.load / (2 * R)))
    axis = fem.locate_dofs_topological(V.sub(0), 1, d.facets("axis"))
    return {
        "a": elastic.a(u, v),
        "L": ufl.dot(traction, v) * ds(d.surface("top")),
        "bcs": [fem.dirichletbc(0.0, axis, V.sub(0))],
        "contacts": [tfeti.Obstacle("contact", tfeti.Plane((0, 0), (0, 1)), reach=reach)],
        "decomposition": d,
        "stress": elastic.stress,
    }


def half_ball_on_plane(
    d: tfeti.Decomposition, degree: int = 1, reach: float | None = 2 * 0.05**2
) -> dict[str, Any]:
    """Arguments of the problem of ``hertz_3d.py``; without a reach contact may be anywhere."""
    elastic = tfeti.Elasticity(d, E=1.0, nu=NU)
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (3,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    top = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)(d.surface("top"))
    area = d.comm.allreduce(fem.assemble_scalar(fem.form(fem.Constant(d.mesh, 1.0) * top)))
    return {
        "a": elastic.a(u, v),
        "L": -POINT.load / area * v[2] * top,
        "bcs": [],
        "contacts": [tfeti.Obstacle("contact", tfeti.Plane((0, 0, 0), (0, 0, 1)), reach=reach)],
        "decomposition": d,
        "stress": elastic.stress,
    }


def _line() -> Scene:
    a = LINE.half_width
    samples = Samples.line(a)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        return half_cylinder_on_plane(d, degree, 2 * a**2 / R)

    return Scene(
        build=lambda n, mesh: half_cylinder.build(R, **grading(n, mesh, a, 3.6)),
        make=make,
        samples=samples,
        exact=samples.exact(LINE.pressure),
    )


def _ball() -> Scene:
    a = POINT.half_width
    samples = Samples.disc(a)
    return Scene(
        build=lambda n, mesh: half_ball.build(R, **grading(n, mesh, a, 1.5)),
        make=half_ball_on_plane,
        samples=samples,
        exact=samples.exact(POINT.pressure),
        place=lambda points: points[:, :2],
    )


def _cylinder() -> Scene:
    radius, force, young = 50.0, 35e3, {"cylinder": 2.1e5, "block": 7e4}
    modulus = 1 / sum((1 - NU**2) / E for E in young.values())
    hertz = LineContact.from_load(force, radius, modulus)
    samples = Samples.line(hertz.half_width)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        """The problem of ``cylinder_on_block_2d.py --exchange``."""
        elastic = tfeti.Elasticity(d, E=young, nu=NU, model="plane_strain")
        V = fem.functionspace(d.mesh, ("Lagrange", degree, (2,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        traction = fem.Constant(d.mesh, (0.0, -force / (2 * radius)))
        axis = fem.locate_dofs_topological(V.sub(0), 1, d.facets("axis"))
        bottom = fem.locate_dofs_topological(V, 1, d.facets("bottom"))
        reach = 0.75 * hertz.half_width**2 / radius
        return {
            "a": elastic.a(u, v),
            "L": ufl.dot(traction, v) * ds(d.surface("load")),
            "bcs": [fem.dirichletbc(0.0, axis, V.sub(0)), fem.dirichletbc(np.zeros(2), bottom, V)],
            "contacts": [tfeti.Contact("top", "arc", secondary="top", reach=reach)],
            "decomposition": d,
            "stress": elastic.stress,
        }

    return Scene(
        build=lambda n, mesh: cylinder_on_block.build(
            radius, 4 * radius, **grading(n, mesh, hertz.half_width, 3.6)
        ),
        make=make,
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


L, MU = 1.0, 0.3
PAIR = LineContact.from_half_width(0.04, R, 1 / (1 - NU**2) / 2)
PUNCH = RoundedPunch(0.02, 0.04, R, 1 / (1 - NU**2) / 2)


def half_planes_pushed(
    d: tfeti.Decomposition, degree: int
) -> tuple[fem.Constant, fem.Constant, dict[str, Any]]:
    """Forces P and Q, and arguments of the problem of ``cattaneo_mindlin_2d.py``."""
    elastic = tfeti.Elasticity(d, E=1.0, nu=NU, model="plane_strain")
    V = fem.functionspace(d.mesh, ("Lagrange", degree, (2,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
    top, bottom = (ds(d.surface(name)) for name in ("top", "bottom"))
    P, Q = fem.Constant(d.mesh, 0.0), fem.Constant(d.mesh, 0.0)
    side = (Q * v[0] - P * v[1]) / (2 * L)
    tilt = 1.5 / L**2 * Q * ufl.SpatialCoordinate(d.mesh)[0] * v[1]
    middle = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[1], -L) & np.isclose(x[0], 0))
    corner, _ = fem.locate_dofs_geometrical(
        (V.sub(1), V.sub(1).collapse()[0]), lambda x: np.isclose(x[1], -L) & np.isclose(x[0], L)
    )
    contact = tfeti.Contact(
        "upper face",
        "lower face",
        secondary="upper face",
        gap=lambda x: x[0] ** 2 / (2 * R),
        friction=tfeti.Coulomb(MU),
        reach=1.3 * PAIR.half_width**2 / R,
    )
    return (
        P,
        Q,
        {
            "a": elastic.a(u, v),
            "L": side * top - side * bottom + tilt * (top + bottom),
            "bcs": [
                fem.dirichletbc(np.zeros(2), middle, V),
                fem.dirichletbc(0.0, corner, V.sub(1)),
            ],
            "contacts": [contact],
            "decomposition": d,
            "stress": elastic.stress,
        },
    )


def _punch() -> Scene:
    a = PUNCH.half_width
    samples = Samples.line(a)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        """The identical bodies of the demo, their shape in the gap, without friction."""
        P, _, parts = half_planes_pushed(d, degree)
        P.value = PUNCH.load
        contact = tfeti.Contact(
            "upper face",
            "lower face",
            secondary="upper face",
            gap=lambda x: np.maximum(np.abs(x[0]) - PUNCH.flat, 0.0) ** 2 / (2 * PUNCH.radius),
            reach=1.3 * a**2 / PUNCH.radius,
        )
        return {**parts, "contacts": [contact]}

    return Scene(
        build=lambda n, mesh: half_planes.build(L, **grading(n, mesh, a, 3.6)),
        make=make,
        samples=samples,
        exact=samples.exact(PUNCH.pressure),
    )


# of the force at which all slips
PUSH = 0.5


def _slip() -> Scene:
    """The demo in two steps; what friction leaves, μp − |q|, is Hertz's pressure on |x| < c."""
    loads: list[fem.Constant] = []
    left = LineContact.from_half_width(PAIR.half_width * np.sqrt(1 - PUSH), R, MU / (1 - NU**2) / 2)
    samples = Samples.line(left.half_width)

    def make(d: tfeti.Decomposition, degree: int) -> dict[str, Any]:
        P, Q, parts = half_planes_pushed(d, degree)
        loads[:] = [P, Q]
        return parts

    def solve(problem: tfeti.ContactProblem) -> None:
        P, Q = loads
        P.value = PAIR.load
        problem.solve()
        problem.accept()
        Q.value = PUSH * MU * PAIR.load
        problem.solve()

    def unused(data: Any) -> Array:
        return MU * data.pressure - np.linalg.norm(data.tangential_traction, axis=1)

    return Scene(
        build=lambda n, mesh: half_planes.build(L, **grading(n, mesh, PAIR.half_width, 3.6)),
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
