"""Shapes of obstacles, and checks of those that a user brings."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import (
    POSITIVE,
    checked_callable,
    checked_flag,
    checked_number,
    checked_vector,
    real_numbers,
    shown,
    values_at,
)
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mortar.tolerances import SEARCH

# --- Shapes of rigid obstacles: signed distances ----------------------------------------------

Vector = tuple[float, ...] | list[float] | Array


class Shape(Protocol):
    """A rigid shape. Points come as in DOLFINx, shape ``(3, n)``, in 2D with z = 0.

    A node's gap is φ/‖∇φ‖ along −∇φ, so φ may be any level function; where ‖∇φ‖ ≠ 1 the gap is the
    distance to first order, exact where the shape is touched. Curvature is not asked for. A shape
    may have ``check_dimension(gdim, whose)``, which raises where it is not one of that dimension.
    """

    def distance(self, x: Array) -> Array:
        """Signed distance, positive on the free side, shape ``(n,)``."""

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""


def _vector(values: Vector, what: str) -> Array:
    """Return a vector of three components from two or three."""
    array = checked_vector(values, what, [2, 3], "two or three finite numbers")
    return np.pad(array, (0, 3 - len(array)))


def _direction(values: Vector, what: str) -> Array:
    vector = _vector(values, what)
    length = np.linalg.norm(vector)
    if length == 0.0:
        raise InputError(f"{what}={values}: expected a vector that is not zero")
    return vector / length


class Placed:
    """A shape that is placed by vectors of two or three components."""

    _vectors: dict[str, Vector]

    def check_dimension(self, gdim: int, whose: str) -> None:
        """Raise an InputError where a vector is plane in 3D, or points out of the plane in 2D."""
        for what, values in self._vectors.items():
            if len(values) == 2 and gdim == 3:
                raise InputError(f"{whose}: {what}={values}, expected three components in 3D")
            if len(values) == 3 and gdim == 2 and values[2] != 0.0 and what != "axis":
                raise InputError(f"{whose}: {what}={values}, expected two components in 2D")


class Plane(Placed):
    """A half space behind a plane.

    Args:
        point: A point of the plane.
        normal: Its normal, towards the free side; any length.

    Example:
        >>> floor = tfeti.Plane((0, -1), normal=(0, 2))
        >>> floor.distance(np.array([[0.5], [0.25], [0.0]])).tolist()
        [1.25]
    """

    def __init__(self, point: Vector, normal: Vector) -> None:
        self.point = _vector(point, "point")
        self.normal = _direction(normal, "normal")
        self._vectors = {"point": point, "normal": normal}

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        return self.normal @ (x - self.point[:, None])

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""
        return np.repeat(self.normal[:, None], x.shape[1], axis=1)


class Sphere(Placed):
    """A ball (in 2D: a disc), or with ``inside`` a spherical cavity.

    Args:
        centre: The centre.
        radius: The radius.
        inside: Whether the bodies are inside the sphere.

    Example:
        >>> x = np.array([[3.0], [4.0], [0.0]])
        >>> tfeti.Sphere((0, 0, 0), radius=2.0).distance(x).tolist()
        [3.0]
        >>> tfeti.Sphere((0, 0, 0), radius=6.0, inside=True).distance(x).tolist()
        [1.0]
    """

    def __init__(self, centre: Vector, radius: float, inside: bool = False) -> None:
        self.centre = _vector(centre, "centre")
        self.radius = checked_number(radius, "radius", POSITIVE)
        self.sign = -1.0 if checked_flag(inside, "inside") else 1.0
        self._across = np.eye(3)  # what counts of an offset
        self._vectors = {"centre": centre}

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        offset = self._across @ (x - self.centre[:, None])
        return self.sign * (np.linalg.norm(offset, axis=0) - self.radius)

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``; zero at the centre."""
        offset = self._across @ (x - self.centre[:, None])
        length = np.linalg.norm(offset, axis=0)
        return self.sign * offset / np.where(length > 0.0, length, 1.0)


class Cylinder(Sphere):
    """An infinite cylinder, or with ``inside`` a cylindrical bore.

    Args:
        point: A point of the axis.
        axis: Direction of the axis, any length.
        radius: The radius.
        inside: Whether the bodies are inside the cylinder.

    Example:
        >>> bore = tfeti.Cylinder((0, 0, 0), axis=(0, 0, 1), radius=6.0, inside=True)
        >>> bore.distance(np.array([[3.0], [4.0], [9.0]])).tolist()
        [1.0]
    """

    def __init__(self, point: Vector, axis: Vector, radius: float, inside: bool = False) -> None:
        super().__init__(_vector(point, "point"), radius, inside)
        self.axis = _direction(axis, "axis")
        self._across = np.eye(3) - np.outer(self.axis, self.axis)
        self._vectors = {"point": point, "axis": axis}


@dataclass(frozen=True)
class SignedDistance:
    """Any shape, by two callables of points of shape ``(3, n)``.

    Args:
        distance_of: Signed distance, positive on the free side, shape ``(n,)``.
        gradient_of: Its gradient, shape ``(3, n)`` (or ``(2, n)`` in 2D).

    Example:
        >>> bowl = tfeti.SignedDistance(
        ...     lambda x: x[1] - x[0] ** 2, lambda x: np.stack((-2 * x[0], np.ones_like(x[1])))
        ... )
        >>> bowl.gradient(np.array([[0.5], [1.0], [0.0]])).ravel().tolist()
        [-1.0, 1.0, 0.0]
    """

    distance_of: Callable[[Array], Array]
    gradient_of: Callable[[Array], Array]

    def __post_init__(self) -> None:
        expected = "a callable of points of shape (3, n)"
        checked_callable(self.distance_of, "distance_of", expected)
        checked_callable(self.gradient_of, "gradient_of", expected)

    def distance(self, x: Array) -> Array:
        """Signed distance, shape ``(n,)``."""
        return real_numbers(self.distance_of(x))

    def gradient(self, x: Array) -> Array:
        """Gradient of the signed distance, shape ``(3, n)``."""
        gradient = real_numbers(self.gradient_of(x))
        if gradient.ndim == 2 and len(gradient) == 2:
            return np.pad(gradient, ((0, 1), (0, 0)))
        return gradient


# --- Checks of a shape's callables ------------------------------------------------------------


def check_shape(shape: Any, what: str) -> None:
    """Raise an InputError unless an object has the two methods of a shape."""
    methods = [getattr(shape, name, None) for name in ("distance", "gradient")]
    if isinstance(shape, type) or not all(callable(method) for method in methods):
        raise InputError(
            f"{what}: shape is {shown(shape)}; expected a Plane, Sphere, Cylinder, SignedDistance, "
            "or an object with distance and gradient"
        )


def distance_and_gradient(shape: Shape, x: Array, what: str) -> tuple[Array, Array]:
    """Signed distance, ``(n,)``, and gradient, ``(n, 3)``, at points, ``(n, gdim)``."""
    n, gdim = x.shape
    if n == 0:
        return np.zeros(0), np.zeros((0, 3))
    points = np.zeros((n, 3))
    points[:, :gdim] = x
    distance = values_at(shape.distance, points.T, (n,), f"{what}: the distance at")
    return distance, values_at(shape.gradient, points.T, (3, n), f"{what}: the gradient at").T


def check_placement(
    shape: Shape, x: Array, gdim: int, what: str, size: float, comm: MPI.Intracomm
) -> None:
    """Raise if a shape is not one of this dimension, or its gradient not that of its distance.

    Collective. The gradient is compared with central differences of the distance at a few points of
    each rank: it is wrong where they differ by more than 60° or a factor of 100, since it may be
    rounded off or of any length. Wrong are most of them, or none. Points are those of the surface
    on this rank, shape ``(n, gdim)``; the size is that of the scene.
    """
    if callable(check := getattr(shape, "check_dimension", None)):
        check(gdim, what)
    with raised_on_all_ranks(comm), np.errstate(invalid="ignore"):  # of what is not finite
        phi, gradient = distance_and_gradient(shape, x, what)
        nearest = np.argsort(np.abs(phi))[: SEARCH.samples]
        x, gradient, step = x[nearest], gradient[nearest, :gdim], SEARCH.difference * size
        shifts = step * np.vstack((np.eye(gdim), -np.eye(gdim)))
        around, _ = distance_and_gradient(shape, (x + shifts[:, None]).reshape(-1, gdim), what)
        ahead, behind = around.reshape(2, gdim, len(x))
        slope = (ahead - behind).T / (2.0 * step)
        lengths = np.linalg.norm(gradient, axis=1), np.linalg.norm(slope, axis=1)
        product = lengths[0] * lengths[1]
        known = np.isfinite(product) & (product > 0.0)
        turned = np.sum(gradient * slope, axis=1) < SEARCH.same_direction * product
        scaled = np.maximum(*lengths) > SEARCH.same_length * np.minimum(*lengths)
        differs = known & (turned | scaled)
    wrong, compared = comm.allreduce(np.array([np.sum(differs), np.sum(known)]))
    with raised_on_all_ranks(comm):
        if 2 * wrong > compared and np.any(differs):
            i = int(np.argmax(differs))
            raise InputError(
                f"{what}: the gradient does not fit the distance; at {x[i].tolist()} "
                f"it is {gradient[i].tolist()}, expected about {slope[i].tolist()}"
            )
