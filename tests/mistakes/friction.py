"""Mistakes in laws of friction."""

import numpy as np
import ufl
from dolfinx import fem

import tfeti_dolfinx as tfeti

FLOOR = "obstacle of surface 'bottom'"


def law(says, make):
    """Make an obstacle with a law."""
    return lambda s: tfeti.Obstacle("bottom", s.floor.shape, friction=make(s)), says


def on_floor(says, make, scene=lambda s: s):
    """Solve with an obstacle that has a law."""

    def do(s):
        s = scene(s)
        friction = make(s)
        s.with_contacts(tfeti.Obstacle("bottom", s.floor.shape, friction=friction))

    return do, says


def membrane(s):
    V = s.space("Lagrange", 1)
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    away = tfeti.SignedDistance(
        lambda x: 0.0 * x[0] + 1.0,
        lambda x: np.stack((0.0 * x[0] + 1.0, 0.0 * x[0], 0.0 * x[0])),
    )
    s.problem(
        a=ufl.inner(ufl.grad(u), ufl.grad(v)) * s.dx,
        L=fem.Constant(s.d.mesh, 1.0) * v * s.dx,
        bcs=[fem.dirichletbc(0.0, s.on(V=V), V)],
        contacts=[tfeti.Obstacle("bottom", away, friction=tfeti.Tresca(1.0), name="lid")],
    ).solve()


def two_laws(s, first, second):
    shape = s.floor.shape
    one = tfeti.Obstacle("bottom", shape, friction=first, name="ice")
    s.with_contacts(one, tfeti.Obstacle("bottom", shape, friction=second, name="sand"))


def solved_with(s, qp_type):
    floor = tfeti.Obstacle("bottom", s.floor.shape, friction=tfeti.Tresca(1.0))
    s.with_contacts(floor, qp_type=qp_type)


LAWS = {
    "friction is a number": law(
        rf"{FLOOR}: friction is 0.3; expected Tresca\(bound\), Coulomb", lambda s: 0.3
    ),
    "a negative coefficient": law(
        r"Coulomb: coefficient=-0.3: expected a number, 0 or more", lambda s: tfeti.Coulomb(-0.3)
    ),
    "two bounds without a direction": law(
        r"Tresca: bound has 2 values and direction=None; expected one value, or two and the dir",
        lambda s: tfeti.Tresca((1.0, 2.0)),
    ),
    "a bound in UFL": law(
        r"Tresca: bound is a \w+; expected a number, a function of points",
        lambda s: tfeti.Tresca(ufl.SpatialCoordinate(s.d.mesh)[0]),
    ),
    "a bound that is a vector function": law(
        r"Tresca: bound has the shape \(2,\); expected a scalar function",
        lambda s: tfeti.Tresca(fem.Function(s.V)),
    ),
}

AT_NODES = {
    "a bound that gives nan": on_floor(
        rf"{FLOOR}: bound is nan at the point \[.*; expected a number, 0 or more",
        lambda s: tfeti.Tresca(lambda x: np.nan * x[0]),
    ),
    "a bound of vectors": on_floor(
        rf"{FLOOR}: bound, a function, did not give one number for each of \d points",
        lambda s: tfeti.Tresca(lambda x: x),
    ),
    "a direction along the normal": on_floor(
        rf"{FLOOR}: direction \(0, 0, 1\) is along the normal at the node \[",
        lambda s: tfeti.Tresca((1.0, 2.0), direction=(0, 0, 1)),
        lambda s: s.cube,
    ),
    "two bounds in the plane": on_floor(
        rf"{FLOOR}: bound has two values; expected one in the plane",
        lambda s: tfeti.Tresca((1.0, 2.0), direction=(1, 0, 0)),
    ),
    "friction on a scalar space": (membrane, r"^lid: friction on a scalar space; expected disp"),
    "two laws on one surface": (
        lambda s: two_laws(s, tfeti.Tresca(1.0), tfeti.Tresca(2.0)),
        r"^sand: the same surface has another law of friction in ice; expected one law",
    ),
    "pcpg with friction": (
        lambda s: solved_with(s, "pcpg"),
        r"-tfeti_qp_type pcpg: the scene has friction, \d+ tangential rows, which PCPG cannot "
        r"keep; expected auto or smalse or newton",
    ),
}

TABLES = ("LAWS", "AT_NODES")
