"""Mistakes with moduli, models and thicknesses."""

import numpy as np
import ufl
from dolfinx import fem
from scenes import box

import tfeti_dolfinx as tfeti


def elastic(s, **changes):
    """Elasticity of the square in one volume, "steel", with some arguments changed."""
    usual = {"on": s.d, "E": 1.0, "nu": 0.3, "model": "plane_strain"}
    return tfeti.Elasticity(**{**usual, **changes})


def given(**changes):
    """Elasticity with some arguments changed."""
    return lambda s: elastic(s, **changes)


def made(**changes):
    """The same with arguments that are made from the scene."""
    return lambda s: elastic(s, **{name: make(s) for name, make in changes.items()})


MODULI = {
    r"E=-2.0: expected a positive number": made(E=lambda s: fem.Constant(s.d.mesh, -2.0)),
    r"E is of shape \(2,\); expected a scalar": made(E=lambda s: fem.Function(s.V)),
    r"E: the function 'stiff' is on another mesh \(the one before decompose\?\)": made(
        E=lambda s: fem.Function(s.untorn_space("DG", 0), name="stiff")
    ),
    r"E: no volume 'stel' in the mesh; its volumes are: 'steel' \(5\)": given(E={"stel": 1.0}),
    r"E: 4 cells have no value; expected one for every volume, w.* are: 'steel'": given(E={}),
    r"E: 2 cells have no value; expected every cell in a volume": lambda s: elastic(
        s, on=tfeti.decompose(s.mesh, 2, volumes={"low": lambda x: x[1] < 0.6}), E={"low": 1.0}
    ),
    r"E: the volume 5 is there twice": given(E={"steel": 1.0, 5: 1.0}),
    r"E by volumes: expected a Decomposition, which knows their names": lambda s: elastic(
        s, on=s.d.mesh, E={"steel": 1.0}
    ),
}

MODELS = {
    r"model=None: expected in 2D one of 'plane_strain', 'plane_stress', 'axisymmetric'": given(
        model=None
    ),
    r"axisymmetric.*points with the radius x\[0\] = -0.5; expected 0 or more": lambda s: elastic(
        s, on=beside_its_axis(s), model="axisymmetric"
    ),
    r"dx is 2; expected a measure of UFL, or None": lambda s: elastic(s).a(s.u, s.v, 2),
    r"u is an array of shape \(2,\).*; expected a displacement of 2 components": lambda s: elastic(
        s
    ).stress(np.zeros(2)),
}


def beside_its_axis(s):
    """The square with its middle on x = 0."""
    mesh, tags, names = box(s.cell, 2)
    mesh.geometry.x[:, 0] -= 0.5
    return tfeti.decompose(mesh, 2, facet_tags=tags, surfaces=names)


FLOOR = tfeti.Obstacle("bottom", tfeti.Plane((0, 0), normal=(0, 1)))
THICKNESS = {
    r"thickness is -0\.\d+ in the cell around \[.*; expected a positive number everywhere": made(
        thickness=lambda s: ufl.SpatialCoordinate(s.d.mesh)[0] - 0.3
    ),
    r"thickness: \w+: ": lambda s: s.problem(thickness=ufl.FacetNormal(s.d.mesh)[0]),
    r"thickness=0.5: expected none with model='axi": given(thickness=0.5, model="axisymmetric"),
    r"E = 2.0 of .* a new value of that, as in": lambda s: setattr(elastic(s), "E", 2.0),
    r"thickness=0: expected a positive number": lambda s: s.problem(thickness=0),
    r"a divides a displacement .* axisymmetric body does, and thickness is 1": lambda s: s.problem(
        a=s.a + s.u[0] * (1 / ufl.SpatialCoordinate(s.d.mesh)[0]) * s.v[0] * s.dx, contacts=[FLOOR]
    ),
    r"thickness is of shape \(2,\)": lambda s: s.problem(thickness=fem.Function(s.V)),
    r"thickness has a test or trial function": lambda s: s.problem(thickness=s.v[0]),
}

TABLES = ("MODULI", "MODELS", "THICKNESS")
