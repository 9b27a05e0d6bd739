"""Mistakes in contacts, obstacles and shapes."""

import numpy as np

import tfeti_dolfinx as tfeti
from mistakes.scene import raising

UP = lambda x: np.stack((0.0 * x[0], 0.0 * x[0] + 1.0, 0.0 * x[0]))  # noqa: E731
HEIGHT = lambda x: x[1] + 0.01  # noqa: E731
BOTTOM = "obstacle of surface 'bottom'"


def list_of(says, contacts):
    """The problem with these for contacts."""
    return lambda s: s.problem(contacts=contacts), says


def surface(says, name):
    """Solve with an obstacle of this surface."""
    return lambda s: s.with_contacts(tfeti.Obstacle(name, tfeti.Plane((0, 0), (0, 1)))), says


def shape(says, make):
    """Make a shape."""
    return lambda s: make(), says


def obstacle(says, of):
    """Make an obstacle of something."""
    return lambda s: tfeti.Obstacle("bottom", of), says


def distance(says, distance, gradient=UP):
    """Solve with an obstacle of two callables."""
    return lambda s: s.with_distance(distance, gradient), says


CONTACTS = {
    "contacts is None": list_of(r"contacts: expected a list, got None", None),
    "the depth of a contact that has a name": (
        lambda s: s.with_contacts(tfeti.Contact("left", "left", name="joint")),
        r"^joint: both are the same surface",
    ),
    "an obstacle of a surface without facets": surface(
        r"surface 'nothing' has no facets; expected a part of the boundary", "nothing"
    ),
    "an obstacle on the other side": surface(
        r"obstacle of surface 'top': the surface faces away from it; expected", "top"
    ),
    "a pair twice": (
        lambda s: s.with_contacts(tfeti.Contact("left", "right"), tfeti.Contact("left", "right")),
        r"contacts: the pair of \('left', 'right'\) is there twice",
    ),
}

VECTORS = {
    "a normal of zeros": shape(
        r"normal=\(0, 0\): expected a vector that is not zero", lambda: tfeti.Plane((0, 0), (0, 0))
    ),
    "a normal that is text": shape(
        r"normal='up'.*expected two or three finite numbers", lambda: tfeti.Plane((0, 0), "up")
    ),
    "a radius of 0": shape(
        r"radius=0: expected a positive number", lambda: tfeti.Sphere((0, 0), 0)
    ),
    "an inside that is text": shape(
        r"inside='yes': expected True or False", lambda: tfeti.Sphere((0, 0), 1, inside="yes")
    ),
    "a normal of two components in 3D": (
        lambda s: s.cube.with_shape(tfeti.Plane((0, 0, 0), (0, 1))),
        rf"{BOTTOM}: normal=\(0, 1\), expected three components in 3D",
    ),
    "a normal out of the plane in 2D": (
        lambda s: s.with_shape(tfeti.Plane((0, 0, 0), (0, 0, 1))),
        rf"{BOTTOM}: normal=\(0, 0, 1\), expected two components in 2D",
    ),
}

SHAPES = {
    "a shape that is None": obstacle(rf"{BOTTOM}: shape is None; expected a Plane", None),
    "a distance that is a number": shape(
        r"distance_of is 0.1; expected a callable", lambda: tfeti.SignedDistance(0.1, UP)
    ),
    "a distance of each coordinate": distance(
        rf"{BOTTOM}: the distance at points of shape \(3, \d\) has the shape \(3, \d\)",
        lambda x: x,
    ),
    "a distance that returns None": distance(
        rf"{BOTTOM} has no distance and normal at the node .*: distance nan", lambda x: None
    ),
    "a distance that fails": distance(
        rf"{BOTTOM}: the distance at points of shape .*: ZeroDivisionError: no such", raising
    ),
    "a gradient of the other sign": distance(
        rf"{BOTTOM}: the gradient does not fit the distance; at \[", HEIGHT, lambda x: -UP(x)
    ),
}

TABLES = ("CONTACTS", "VECTORS", "SHAPES")
