"""Mistakes in contacts, obstacles and shapes."""

import numpy as np

import tfeti_dolfinx as tfeti
from mistakes.scene import raising

INF, NAN = float("inf"), float("nan")
UP = lambda x: np.stack((0.0 * x[0], 0.0 * x[0] + 1.0, 0.0 * x[0]))  # noqa: E731
HEIGHT = lambda x: x[1] + 0.01  # noqa: E731
BOTTOM = "obstacle of surface 'bottom'"


def list_of(says, contacts):
    """The problem with these for contacts."""
    return lambda s: s.problem(contacts=contacts), says


def surface(says, name):
    """Solve with an obstacle of this surface."""
    return lambda s: s.with_contacts(tfeti.Obstacle(name, tfeti.Plane((0, 0), (0, 1)))), says


def pair(says, *names):
    """Solve with a pair of these surfaces."""
    return lambda s: s.with_contacts(tfeti.Contact(*names)), says


def shape(says, make):
    """Make a shape."""
    return lambda s: make(), says


def obstacle(says, of):
    """Make an obstacle of something."""
    return lambda s: tfeti.Obstacle("bottom", of), says


def distance(says, distance, gradient=UP):
    """Solve with an obstacle of two callables."""
    return lambda s: s.with_distance(distance, gradient), says


def ball_of_radius(radius, says):
    return lambda s: tfeti.Sphere((0, 0), radius), rf"radius={says}: expected a positive number"


CONTACTS = {
    "contacts is None": list_of(r"contacts: expected a list, got None", None),
    "contacts is one obstacle": (
        lambda s: s.problem(contacts=s.floor),
        r"contacts: expected a list, got a Obstacle",
    ),
    "contacts is a dictionary": list_of(r"contacts: expected a list, got {'bot", {"bottom": 0}),
    "contacts is a text": list_of(r"contacts: expected obstacles and pairs, got 'b'", "bottom"),
    "contacts has None": list_of(r"expected obstacles and pairs, got None", [None]),
    "a contact whose name is a number": (
        lambda s: tfeti.Contact("left", "right", name=1),
        r"contact of 'left' with 'right': name is 1; expected a text",
    ),
    "an obstacle whose name is None": (
        lambda s: tfeti.Obstacle("bottom", s.floor.shape, name=None),
        rf"{BOTTOM}: name is None; expected a text",
    ),
    "the depth of a contact that has a name": (
        lambda s: s.with_contacts(tfeti.Contact("left", "left", name="joint")),
        r"^joint: both are the same surface",
    ),
    "contacts has names": list_of(r"expected obstacles and pairs, got \('a', 'b'\)", [("a", "b")]),
    "contacts has a shape": list_of(
        r"expected obstacles and pairs, got a Plane", [tfeti.Plane((0, 0), (0, 1))]
    ),
    "contacts has a class": list_of(
        r"expected obstacles and pairs, got the class Obstacle", [tfeti.Obstacle]
    ),
    "an obstacle of an unknown surface": surface(
        r"no surface 'lid' in the mesh; its surfaces are: 'left'", "lid"
    ),
    "an obstacle of an unknown tag": surface(r"no surface 77 in the mesh", 77),
    "an obstacle of None": surface(r"surface None: expected the name or the tag of one", None),
    "an obstacle of two surfaces": surface(
        r"surface \['left', 'right'\]: expected the name or the tag", ["left", "right"]
    ),
    "an obstacle of True": surface(r"surface True: expected the name or the tag of one", True),
    "an obstacle of a volume": surface(r"no surface 'steel' in the mesh", "steel"),
    "an obstacle of a surface without facets": surface(
        r"surface 'nothing' has no facets; expected a part of the boundary", "nothing"
    ),
    "an obstacle of a surface inside a body": (
        lambda s: s.inner.problem(
            bcs=[], contacts=[tfeti.Obstacle("middle", tfeti.Plane((0, 0), (0, 1)))]
        ).solve(),
        r"surface 'middle': \d of its facets lie inside a body",
    ),
    "an obstacle on the other side": surface(
        r"obstacle of surface 'top': the surface faces away from it; expected", "top"
    ),
    "a pair of which one is unknown": pair(
        r"contact of 'top' with 'lid': no surface 'lid' in the mesh", "top", "lid"
    ),
    "a pair of which the first is unknown": pair(
        r"contact of 'lid' with 'top': no surface 'lid' in the mesh", "lid", "top"
    ),
    "a pair of a surface with itself": pair(
        r"contact of 'top' with 'top': both are the same surface", "top", "top"
    ),
    "a pair of a surface with its own tag": pair(r"both are the same surface", "top", 4),
    "a pair with None": pair(r"contact of 'top' with None: surface None: expected", "top", None),
    "a pair of lists": pair(r"surface \['left'\]: expected the name", ["left"], ["right"]),
    "a pair with a shape": pair(
        r"contact of 'bottom' with .*: surface a Plane: expected the name or the tag",
        "bottom",
        tfeti.Plane((0, 0), (0, 1)),
    ),
    "a pair with a surface without facets": pair(
        r"contact of 'top' with 'nothing': surface 'nothing' has no facets", "top", "nothing"
    ),
    "a pair twice": (
        lambda s: s.with_contacts(tfeti.Contact("left", "right"), tfeti.Contact("left", "right")),
        r"contacts: the pair of \('left', 'right'\) is there twice",
    ),
    "a pair twice, the other way round": (
        lambda s: s.with_contacts(tfeti.Contact("left", "right"), tfeti.Contact("right", 1)),
        r"contacts: the pair of \('right', 1\) is there twice",
    ),
}

VECTORS = {
    "a normal of zeros": shape(
        r"normal=\(0, 0\): expected a vector that is not zero", lambda: tfeti.Plane((0, 0), (0, 0))
    ),
    "a normal of one number": shape(
        r"normal=1.0: expected two or three finite numbers", lambda: tfeti.Plane((0, 0), 1.0)
    ),
    "a normal of four numbers": shape(
        r"normal=\(0, 0, 0, 1\): expected two or three", lambda: tfeti.Plane((0, 0), (0, 0, 0, 1))
    ),
    "a normal that is text": shape(
        r"normal='up'.*expected two or three finite numbers", lambda: tfeti.Plane((0, 0), "up")
    ),
    "a normal of texts": shape(
        r"normal=\('0', 'z'\).*expected two or three", lambda: tfeti.Plane((0, 0), ("0", "z"))
    ),
    "a normal with nan": shape(
        r"normal=\(0, nan\): expected two or three finite", lambda: tfeti.Plane((0, 0), (0, NAN))
    ),
    "a normal of complex numbers": shape(
        r"normal=\(0, 1j\).*expected two or three finite", lambda: tfeti.Plane((0, 0), (0, 1j))
    ),
    "a point that is None": shape(
        r"point=None.*expected two or three finite", lambda: tfeti.Plane(None, (0, 1))
    ),
    "a point at infinity": shape(
        r"point=\(0, inf\): expected two or three finite", lambda: tfeti.Plane((0, INF), (0, 1))
    ),
    "points in a list": shape(
        r"point=\[.*: expected two or three", lambda: tfeti.Plane([(0, 0), (0, 1)], (0, 1))
    ),
    "a centre of one number": shape(
        r"centre=0: expected two or three finite numbers", lambda: tfeti.Sphere(0, 1)
    ),
    "centre and radius exchanged": shape(
        r"centre=1.0: expected two or three finite numbers", lambda: tfeti.Sphere(1.0, (0, 0))
    ),
    "a radius of 0": ball_of_radius(0, "0"),
    "a radius below 0": ball_of_radius(-1, "-1"),
    "a radius that is nan": ball_of_radius(NAN, "nan"),
    "an infinite radius": ball_of_radius(INF, "inf"),
    "a radius that is text": ball_of_radius("1", "'1'"),
    "a radius that is None": ball_of_radius(None, "None"),
    "a radius that is True": ball_of_radius(True, "True"),
    "radii in a list": ball_of_radius([1.0, 2.0], r"\[1.0, 2.0\]"),
    "an inside that is text": shape(
        r"inside='yes': expected True or False", lambda: tfeti.Sphere((0, 0), 1, inside="yes")
    ),
    "an axis of zeros": shape(
        r"axis=\(0, 0, 0\): expected a vector that is not zero",
        lambda: tfeti.Cylinder((0, 0, 0), (0, 0, 0), 1),
    ),
    "axis and radius exchanged": shape(
        r"radius=\(0, 0, 1\): expected a positive number",
        lambda: tfeti.Cylinder((0, 0, 0), 1, (0, 0, 1)),
    ),
    "a normal of two components in 3D": (
        lambda s: s.cube.with_shape(tfeti.Plane((0, 0, 0), (0, 1))),
        rf"{BOTTOM}: normal=\(0, 1\), expected three components in 3D",
    ),
    "a centre of two components in 3D": (
        lambda s: s.cube.with_shape(tfeti.Sphere((0.5, -1.0), 1)),
        rf"{BOTTOM}: centre=\(0.5, -1.0\), expected three components in 3D",
    ),
    "an axis of two components in 3D": (
        lambda s: s.cube.with_shape(tfeti.Cylinder((0, 0, -1), (1, 0), 1)),
        rf"{BOTTOM}: axis=\(1, 0\), expected three components in 3D",
    ),
    "a normal out of the plane in 2D": (
        lambda s: s.with_shape(tfeti.Plane((0, 0, 0), (0, 0, 1))),
        rf"{BOTTOM}: normal=\(0, 0, 1\), expected two components in 2D",
    ),
    "a centre off the plane in 2D": (
        lambda s: s.with_shape(tfeti.Sphere((0.5, 0.0, -1.0), 1)),
        rf"{BOTTOM}: centre=\(0.5, 0.0, -1.0\), expected two components in 2D",
    ),
}

SHAPES = {
    "a shape that is None": obstacle(rf"{BOTTOM}: shape is None; expected a Plane", None),
    "a shape that is a normal": obstacle(rf"{BOTTOM}: shape is \(0, 1\); expected", (0, 1)),
    "a shape that is a callable": obstacle(rf"{BOTTOM}: shape is a function; expected", HEIGHT),
    "a shape that is a class": obstacle(
        rf"{BOTTOM}: shape is the class Plane; expected", tfeti.Plane
    ),
    "a shape that is a surface": obstacle(rf"{BOTTOM}: shape is 'top'; expected a Plane", "top"),
    "a shape without a gradient": obstacle(
        rf"{BOTTOM}: shape is a Half; expected", type("Half", (), {"distance": HEIGHT})()
    ),
    "a distance that is a number": shape(
        r"distance_of is 0.1; expected a callable", lambda: tfeti.SignedDistance(0.1, UP)
    ),
    "a gradient that is a vector": shape(
        r"gradient_of is \(0, 1\); expected a callable",
        lambda: tfeti.SignedDistance(HEIGHT, (0, 1)),
    ),
    "a gradient that is None": shape(
        r"gradient_of is None; expected a callable", lambda: tfeti.SignedDistance(HEIGHT, None)
    ),
    "a distance of each coordinate": distance(
        rf"{BOTTOM}: the distance at points of shape \(3, \d\) has the shape \(3, \d\)",
        lambda x: x,
    ),
    "a distance with one value too many": distance(
        rf"{BOTTOM}: the distance at points of shape .*; expected \(\d,\)",
        lambda x: np.append(x[1], 0.0),
    ),
    "a distance of points in rows": distance(
        rf"{BOTTOM}: the distance at points of shape .*", lambda x: x[:, 7]
    ),
    "a distance that returns None": distance(
        rf"{BOTTOM} has no distance and normal at the node .*: distance nan", lambda x: None
    ),
    "a distance that returns text": distance(
        rf"{BOTTOM}: the distance at points of shape .*: ValueError", lambda x: "near"
    ),
    "a distance of complex numbers": distance(
        rf"{BOTTOM}: the distance at points of shape .*", lambda x: x[1] + 1j
    ),
    "a distance that fails": distance(
        rf"{BOTTOM}: the distance at points of shape .*: ZeroDivisionError: no such", raising
    ),
    "a distance of three coordinates": distance(
        rf"{BOTTOM}: the distance at points .*: TypeError: .*missing 2", lambda x, y, z: y
    ),
    "a distance that compares arrays": distance(
        rf"{BOTTOM}: the distance at points of shape .*: ValueError: .*ambiguous",
        lambda x: x[1] if x[1] > 0 else -x[1],
    ),
    "a distance that is nan": distance(
        rf"{BOTTOM} has no distance and normal at the node \[.*: distance nan",
        lambda x: x[1] * NAN,
    ),
    "a distance that is infinite": distance(
        rf"{BOTTOM} has no distance and normal at the node \[.*: distance inf",
        lambda x: np.full(x.shape[1], INF),
    ),
    "a gradient of rows and columns exchanged": distance(
        rf"{BOTTOM}: the gradient at points of shape .*expected \(3, \d\)",
        HEIGHT,
        lambda x: np.tile([0.0, 1.0, 0.0], (x.shape[1] + 3, 1)),
    ),
    "a gradient of four components": distance(
        rf"{BOTTOM}: the gradient at points of shape .* has the shape \(4, \d\); expected \(3",
        HEIGHT,
        lambda x: np.ones((4, x.shape[1])),
    ),
    "a gradient for one point": distance(
        rf"{BOTTOM}: the gradient at points .* has the shape \(1, 1, 3\)",
        HEIGHT,
        lambda x: np.array([[[0.0, 1.0, 0.0]]]),
    ),
    "a gradient that fails": distance(
        rf"{BOTTOM}: the gradient at points of shape .*: ZeroDivisionError: no such place",
        HEIGHT,
        raising,
    ),
    "a gradient that is zero": distance(
        rf"{BOTTOM} has no distance and normal at the node .*gradient \[0. 0.\]",
        HEIGHT,
        np.zeros_like,
    ),
    "a gradient that is nan": distance(
        rf"{BOTTOM} has no distance and normal at the node .*gradient \[nan nan\]",
        HEIGHT,
        lambda x: NAN * x,
    ),
    "a gradient out of the plane": distance(
        rf"{BOTTOM} has no distance and normal at the node .*gradient \[0. 0.\]",
        HEIGHT,
        lambda x: UP(x)[[0, 2, 1]],
    ),
    "a gradient of the other sign": distance(
        rf"{BOTTOM}: the gradient does not fit the distance; at \[", HEIGHT, lambda x: -UP(x)
    ),
    "a gradient along another axis": distance(
        rf"{BOTTOM}: the gradient does not fit the distance; at \[",
        HEIGHT,
        lambda x: UP(x)[[1, 0, 2]],
    ),
    "a distance in other units than its gradient": distance(
        rf"{BOTTOM}: the gradient does not fit the distance; at \[", lambda x: 1e3 * HEIGHT(x)
    ),
    "a distance and its gradient of the other sign": distance(
        rf"{BOTTOM}: the surface faces away from it", lambda x: -HEIGHT(x), lambda x: -UP(x)
    ),
}

TABLES = ("CONTACTS", "VECTORS", "SHAPES")
