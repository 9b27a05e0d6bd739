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
