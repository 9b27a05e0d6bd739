"""Kernels of subdomain stiffnesses, found among candidate modes."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array

# Energy of a mode, as a share of what its terms may be without their signs, that counts as none:
# rounding makes 2e-16 of it, a spring of 1e-10 of the stiffness 1e-14 and more.
NULL = 2e-15
# Of the largest singular value of the modes, whose entries are of the size 1: what a mode has on
# its own beside the others. Nodes on a line or in one point make it 0 but for rounding.
DEPENDENT = 1e-10
# of a distance: what is nearer to it counts as equal
EQUAL = 1e-9


def candidate_modes(x: Array, bs: int, centre: Array, length: float) -> Array:
    """Rigid motions for vectors of the space's dimension, constants otherwise.

    Args:
        x: Points of the nodes, shape ``(n, gdim)``.
        bs: Unknowns per node.
        centre: Point that the rotations turn about, shape ``(gdim,)``.
        length: Length that makes rotations comparable to translations; 0 for a body of one node.

    Returns:
        Modes as columns, shape ``(n * bs, k)``; k = 3 in 2D, 6 in 3D, bs for other fields.
    """
    gdim = x.shape[1]
    modes = [np.tile(np.eye(bs)[i], len(x)) for i in range(bs)]
    if bs == gdim and gdim > 1:
        y = (x - centre) / (length or 1.0)
        for i in range(gdim):
            for j in range(i):
                turn = np.zeros((len(x), bs))
                turn[:, j], turn[:, i] = -y[:, i], y[:, j]
                modes.append(turn.ravel())
    return np.stack(modes, axis=1)


MODE_NAMES = {
    (2, 2): ("translation in x", "translation in y", "rotation in the plane"),
    (3, 3): (
        "translation in x",
        "translation in y",
        "translation in z",
        "rotation about z",
        "rotation about y",
        "rotation about x",
    ),
}


def mode_names(gdim: int, bs: int) -> tuple[str, ...]:
    """Names of the candidate modes of a field with bs components, in their order."""
    constants = tuple(f"constant in component {i}" for i in range(bs))
    return MODE_NAMES.get((gdim, bs), constants)


def kernel_of(K: Any, modes: Array) -> Array:
    """Orthonormal basis of the kernel of K within the span of the candidate modes.

    The null space of R₀ᵀ K R₀, R₀ an orthonormal basis of the modes; it is smaller than the
    span, or empty, where springs or mass terms hold the subdomain.

    Args:
        K: Stiffness, shape ``(n, n)``.
        modes: Candidate modes, shape ``(n, k)``.

    Returns:
        R, shape ``(n, r)``, r ≤ k.
    """
    R0 = orthonormal(modes)
    R = R0 @ np.linalg.eigh(R0.T @ (K @ R0))[1]
    energy = np.sum(R * (K @ R), axis=0)
    return R[:, energy <= NULL * _terms(csr_array(K), R)]


def _terms(K: csr_array, R: Array) -> Array:
    """What the terms of RᵀKR may be, without their signs, for each mode.

    In flat cells entries are differences of far larger numbers, which are as large as those that
    other unknowns of the cell have: the largest diagonal entry that a row meets bounds them.
    """
    meets = K.diagonal()[K.indices]
    largest = np.maximum.reduceat(meets, K.indptr[:-1])
    pattern = csr_array((np.ones_like(K.data), K.indices, K.indptr), shape=K.shape)
    sizes = np.sqrt(largest)[:, None] * np.abs(R)
    return np.asarray(np.sum(sizes * (pattern @ sizes), axis=0))


def orthonormal(modes: Array) -> Array:
    """Orthonormal basis of the span of the columns (few of them, maybe dependent)."""
    U, s, _ = np.linalg.svd(modes, full_matrices=False)
    return U[:, s > DEPENDENT * s.max(initial=0.0)]


def fixing_nodes(x: Array, count: int) -> Array:
    """Well-spread nodes: farthest-point sampling (Gonzalez 1985), from the node farthest out.

    Of equal distances, as of the corners of a cube, the first: rounding must not choose.

    Args:
        x: Points of the nodes, shape ``(n, gdim)``.
        count: How many are wanted.

    Returns:
        Their indices, ascending, at most ``count``.
    """
    distance = np.linalg.norm(x - x.mean(axis=0), axis=1)
    chosen = [_farthest(distance)]
    distance = np.linalg.norm(x - x[chosen[0]], axis=1)
    while len(chosen) < min(count, len(x)):
        chosen.append(_farthest(distance))
        distance = np.minimum(distance, np.linalg.norm(x - x[chosen[-1]], axis=1))
    return np.unique(chosen)


def _farthest(distance: Array) -> int:
    return int(np.argmax(distance >= (1.0 - EQUAL) * distance.max()))


def fixing_dofs(x: Array, node_of_dof: Array) -> Array:
    """Positions of the unknowns at well-spread nodes, given the node of each unknown."""
    nodes = np.unique(node_of_dof)
    chosen = nodes[fixing_nodes(x[nodes], 2 ** x.shape[1])]
    return np.flatnonzero(np.isin(node_of_dof, chosen))
