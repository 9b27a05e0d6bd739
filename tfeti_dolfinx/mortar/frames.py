"""Orthonormal frames of contact nodes: a normal, then tangents."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array

# |n_x| from which on the first tangent follows the y axis, not the x axis. By the hairy ball
# theorem no choice of tangents is continuous everywhere; here the switch is where hardly a plane
# surface lies (26° from the x axis), far from coordinate planes, diagonals and simple slopes, so
# that rounding of a normal does not turn its tangents.
SWITCH = 0.9


def frames(normal: Array) -> Array:
    """Right-handed orthonormal frames whose axis 0 is the normal.

    They depend on the normal alone, so they are the same on every rank.

    Args:
        normal: Unit vectors, shape ``(n, gdim)``.

    Returns:
        Shape ``(n, gdim, gdim)``: normal, then ``tangents``.
    """
    return np.concatenate((normal[:, None], tangents(normal)), axis=1)


def aligned(frame: Array, direction: Array) -> tuple[Array, Array]:
    """Frames of space whose first tangent is along a direction, as far as it is tangential.

    Args:
        frame: Shape ``(n, 3, 3)``.
        direction: Unit vector, shape ``(3,)``.

    Returns:
        The frames, and how long the direction's tangential part is, shape ``(n,)``; where it is
        0 the frame is as it was.
    """
    normal = frame[:, 0]
    first = direction - np.sum(direction * normal, axis=1, keepdims=True) * normal
    length = np.linalg.norm(first, axis=1)
    known = (length > 0.0)[:, None]
    first = np.where(known, first / np.where(known, length[:, None], 1.0), frame[:, 1])
    # what rounding has left of the normal in a short tangent
    first -= np.sum(first * normal, axis=1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((normal, first, np.cross(normal, first)), axis=1), length


def tangents(normal: Array) -> Array:
    """Orthonormal tangents of unit normals, as close to coordinate axes as they can be.

    In 2D the normal turned left by a right angle. In 3D the x axis without its normal part (the
    y axis where the normal is within 26° of the x axis), and the normal times that. They are
    continuous in the normal but for this switch. A scalar space has none.

    Args:
        normal: Unit vectors, shape ``(n, gdim)``.

    Returns:
        Shape ``(n, gdim - 1, gdim)``.
    """
    gdim = normal.shape[1]
    if gdim == 1:
        return np.empty((len(normal), 0, 1))
    if gdim == 2:
        return np.stack((-normal[:, 1], normal[:, 0]), axis=1)[:, None]
    axis = np.eye(3)[(np.abs(normal[:, 0]) >= SWITCH).astype(np.int64)]
    first = axis - np.sum(axis * normal, axis=1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(normal, first)), axis=1)
