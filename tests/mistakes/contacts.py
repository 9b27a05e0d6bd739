"""Mistakes in contacts, obstacles and shapes."""

import numpy as np

import tfeti_dolfinx as tfeti
from mistakes.scene import raising

UP = lambda x: np.stack((0.0 * x[0], 0.0 * x[0] + 1.0, 0.0 * x[0]))  # noqa: E731
HEIGHT = lambda x: x[1] + 0.01  # noqa: E731
BOTTOM = "obstacle of surface 'bottom'"


def surface(name):
    """Solve with an obstacle of this surface."""
    return lambda s: s.with_contacts(tfeti.Obstacle(name, tfeti.Plane((0, 0), (0, 1))))


def shape(make):
    """Make a shape."""
    return lambda s: make()


def distance(distance, gradient=UP):
    """Solve with an obstacle of two callables."""
    return lambda s: s.with_shape(tfeti.SignedDistance(distance, gradient))


CONTACTS = {
    r"contacts: expected a list, got None": lambda s: s.problem(contacts=None),
    r"^joint: both are the same surface": lambda s: s.with_contacts(
        tfeti.Contact("left", "left", name="joint")
    ),
    r"^obstacle of surface a Plane: .* is met by an Obs": surface(tfeti.Plane((0, 0), (0, 1))),
    r"surface 'nothing' has no facets; expected a part of the boundary": surface("nothing"),
    r"obstacle of surface 'top': the surface faces away from it; expected": surface("top"),
    r"contacts: the pair of \('left', 'right'\) is there twice": lambda s: s.with_contacts(
        tfeti.Contact("left", "right"), tfeti.Contact("left", "right")
    ),
}

VECTORS = {
    r"normal=\(0, 0\): expected a vector that is not zero": shape(
        lambda: tfeti.Plane((0, 0), (0, 0))
    ),
    r"normal='up'.*expected two or three finite numbers": shape(lambda: tfeti.Plane((0, 0), "up")),
    r"radius=0: expected a positive number": shape(lambda: tfeti.Sphere((0, 0), 0)),
    r"inside='yes': expected True or False": shape(lambda: tfeti.Sphere((0, 0), 1, inside="yes")),
    rf"{BOTTOM}: normal=\(0, 1\), expected three components in 3D": lambda s: s.cube.with_shape(
        tfeti.Plane((0, 0, 0), (0, 1))
    ),
    rf"{BOTTOM}: normal=\(0, 0, 1\), expected two components in 2D": lambda s: s.with_shape(
        tfeti.Plane((0, 0, 0), (0, 0, 1))
    ),
}

SHAPES = {
    rf"{BOTTOM}: shape is None; expected a Plane": shape(lambda: tfeti.Obstacle("bottom", None)),
    r"distance_of is 0.1; expected a callable": shape(lambda: tfeti.SignedDistance(0.1, UP)),
    rf"{BOTTOM}: the distance at points of shape \(3, \d\) has the shape \(3, \d\)": distance(
        lambda x: x
    ),
    rf"{BOTTOM} has no distance and normal at the node .*: distance nan": distance(lambda x: None),
    rf"{BOTTOM}: the distance at points of shape .*: ZeroDivisionError: no such": distance(raising),
    rf"{BOTTOM}: the gradient does not fit the distance; at \[": distance(HEIGHT, lambda x: -UP(x)),
}

TABLES = ("CONTACTS", "VECTORS", "SHAPES")
