"""Whether a shape is one: what its callables return, and whether they agree with each other."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import named, real_numbers, shown
from tfeti_dolfinx.contact.shapes import Placed, Shape
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks

# Differences over 1e-5 of the scene: curvature and rounding are both far below what is looked for
STEP = 1e-5
# points of each rank, those next to the shape: a wrong gradient is wrong nearly everywhere
SAMPLE = 16
# More than 60 degrees, or a factor of 100: a gradient may be rounded off or of any length
COSINE, FACTOR = 0.5, 100.0


def check_shape(shape: Any, what: str) -> None:
    """Raise unless an object is a shape.

    Raises:
        InputError: It has not the two methods of a shape.
    """
    methods = [getattr(shape, name, None) for name in ("distance", "gradient")]
    if isinstance(shape, type) or not all(callable(method) for method in methods):
        raise InputError(
            f"{what}: shape is {shown(shape)}; expected a Plane, Sphere, Cylinder, SignedDistance, "
            "or an object with distance and gradient"
        )


def distance_and_gradient(shape: Shape, x: Array, what: str) -> tuple[Array, Array]:
    """Signed distance and its gradient at points.

    Args:
        shape: The shape.
        x: Points of this rank, shape ``(n, 2)`` or ``(n, 3)``.
        what: Begins messages.

    Returns:
        Shapes ``(n,)`` and ``(n, 3)``.

    Raises:
        InputError: A callable fails, or returns arrays of another shape.
    """
    if len(x) == 0:
        return np.zeros(0), np.zeros((0, 3))
    points = np.zeros((3, len(x)))
    points[: x.shape[1]] = x.T
    found = []
    for name, size in (("distance", (len(x),)), ("gradient", (3, len(x)))):
        with named(f"{what}: the {name} at points of shape {points.shape}"):
            values = real_numbers(getattr(shape, name)(points))
        try:
            found.append(np.broadcast_to(values, size))
        except ValueError:
            raise InputError(
                f"{what}: the {name} at points of shape {points.shape} has the shape "
                f"{values.shape}; expected {size}"
            ) from None
    return found[0], found[1].T


def check_placement(
    shape: Shape, x: Array, gdim: int, what: str, size: float, comm: MPI.Intracomm
) -> None:
    """Raise if a shape is not one of this dimension, or its gradient not that of its distance.

    Collective. The gradient is compared with differences of the distance at a few points of each
    rank; wrong are most of them, or none.

    Args:
        shape: The shape.
        x: Points of the surface on this rank, shape ``(n, gdim)``.
        gdim: Dimension of the space.
        what: Begins messages.
        size: Length of the scene.
        comm: Communicator.

    Raises:
        InputError: Says what does not fit.
    """
    if isinstance(shape, Placed):
        shape.check_dimension(gdim, what)
    with raised_on_all_ranks(comm):
        phi, gradient = distance_and_gradient(shape, x, what)
        nearest = np.argsort(np.abs(phi))[:SAMPLE]
        slope = _differences(shape, x[nearest], STEP * size, what)
        gradient = gradient[nearest, : x.shape[1]]
        differs, says_something = _compared(gradient, slope)
    wrong, compared = comm.allreduce(np.array([np.sum(differs), np.sum(says_something)]))
    with raised_on_all_ranks(comm):
        if 2 * wrong > compared and np.any(differs):
            i = int(np.argmax(differs))
            raise InputError(
                f"{what}: the gradient does not fit the distance; at {x[nearest[i]].tolist()} "
                f"it is {gradient[i].tolist()}, expected about {slope[i].tolist()}"
            )


def _differences(shape: Shape, x: Array, step: float, what: str) -> Array:
    """Central differences of the distance, shape of x."""
    shifts = step * np.eye(x.shape[1])
    columns = []
    for shift in shifts:
        ahead, _ = distance_and_gradient(shape, x + shift, what)
        behind, _ = distance_and_gradient(shape, x - shift, what)
        with np.errstate(invalid="ignore"):  # what is not finite is named elsewhere
            columns.append((ahead - behind) / (2.0 * step))
    return np.stack(columns, axis=1)


def _compared(gradient: Array, slope: Array) -> tuple[Array, Array]:
    """Where both differ grossly, and where there is something to compare."""
    sizes = np.linalg.norm(gradient, axis=1), np.linalg.norm(slope, axis=1)
    product = sizes[0] * sizes[1]
    says_something = np.isfinite(product) & (product > 0.0)
    turned = np.sum(gradient * slope, axis=1) < COSINE * product
    scaled = np.maximum(*sizes) > FACTOR * np.minimum(*sizes)
    return says_something & (turned | scaled), says_something
