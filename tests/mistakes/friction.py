"""Mistakes in laws of friction."""

import numpy as np
import ufl
from dolfinx import fem

import tfeti_dolfinx as tfeti

FLOOR = "obstacle of surface 'bottom'"


def law(make):
    """Make an obstacle with a law."""
    return lambda s: tfeti.Obstacle("bottom", s.floor.shape, friction=make(s))


def on_floor(make, scene=lambda s: s):
    """Solve with an obstacle that has a law."""

    def do(s):
        s = scene(s)
        friction = make(s)
        s.with_contacts(tfeti.Obstacle("bottom", s.floor.shape, friction=friction))

    return do


def rough(s, bound, **given):
    return tfeti.Obstacle("bottom", s.floor.shape, friction=tfeti.Tresca(bound), **given)


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


LAWS = {
    rf"{FLOOR}: friction is 0.3; expected Tresca\(bound\), Coulomb": law(lambda s: 0.3),
    r"Coulomb: coefficient=-0.3: expected a number, 0 or more": law(lambda s: tfeti.Coulomb(-0.3)),
    r"Tresca: bound has 2 values and direction=None; expected one value, or two and the dir": law(
        lambda s: tfeti.Tresca((1.0, 2.0))
    ),
    r"Tresca: bound is a \w+; expected a number, a function of points": law(
        lambda s: tfeti.Tresca(ufl.SpatialCoordinate(s.d.mesh)[0])
    ),
    r"Tresca: bound has the shape \(2,\); expected a scalar": law(
        lambda s: tfeti.Tresca(fem.Function(s.V))
    ),
}

AT_NODES = {
    rf"{FLOOR}: bound is nan at the point \[.*; expected a number, 0 or more": on_floor(
        lambda s: tfeti.Tresca(lambda x: np.nan * x[0])
    ),
    rf"{FLOOR}: bound at points of shape \(3, \d+\) has the shape \(3, \d+\); expected": on_floor(
        lambda s: tfeti.Tresca(lambda x: x)
    ),
    rf"{FLOOR}: direction \(0, 0, 1\) is along the normal at the node \[": on_floor(
        lambda s: tfeti.Tresca((1.0, 2.0), direction=(0, 0, 1)), lambda s: s.cube
    ),
    rf"{FLOOR}: bound has two values; expected one in the plane": on_floor(
        lambda s: tfeti.Tresca((1.0, 2.0), direction=(1, 0, 0))
    ),
    r"^lid: friction on a scalar space; expected disp": membrane,
    r"^sand: the same surface has another law of friction in ice; expected one law": lambda s: (
        s.with_contacts(rough(s, 1.0, name="ice"), rough(s, 2.0, name="sand"))
    ),
    r"-tfeti_qp_type pcpg: the model has friction, \d+ tangential constraints, which PCPG cannot "
    r"keep; expected auto or smalse or newton": lambda s: s.with_contacts(
        rough(s, 1.0), qp_type="pcpg"
    ),
}

TABLES = ("LAWS", "AT_NODES")
