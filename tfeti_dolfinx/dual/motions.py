"""Spaces of motions of bodies: what rows leave free, body by body and of several together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_array, csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.sparse_columns import side_by_side, spread
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

# Stiffness, as a share of the stiffest motion of the same body, that counts as none: rounding
# makes 1e-15 of it, and pins on neighbouring nodes of a fine mesh hold a turn by 1e-9.
NULL = 1e-13
# Components of more coordinates than this are looked at by a sparse factor: the time of a dense
# eigenproblem grows with the cube of its size.
DENSE = 500
# Shift of that factor: above rounding, below the softest chain of a thousand bodies.
SHIFT = 1e-12
# Inverse iterations, each of which damps what is not null by SHIFT over its stiffness, so that
# even the softest chain is gone after a few; and vectors at first, doubled if all are null.
SWEEPS, BLOCK = 4, 32
# Eigenvalue of a projector, 0 or 1 but for rounding, from which on it is 1.
HALF = 0.5
# Stiffness given to directions outside the space, and where those inside, at most 1, end.
OUTSIDE, INSIDE = 2.0, 1.5


@dataclass(frozen=True)
class Motions:
    """A space of motions of bodies, each of k coordinates.

    Attributes:
        single: Orthonormal directions of each body, as columns, shape ``(bodies, k, k)``.
        free: Which of them the body can take alone, shape ``(bodies, k)``.
        stiffness: What holds each of them, as a share of the body's stiffest motion, its
            neighbours at rest, shape ``(bodies, k)``.
        joint: Motions of several bodies together, scipy CSR, shape ``(bodies * k, c)``.
    """

    single: Array
    free: Array
    stiffness: Array
    joint: csr_array

    @cached_property
    def alone(self) -> csr_array:
        """The motions of single bodies as columns, shape ``(bodies * k, a)``."""
        return csr_array(block_diagonal(self.single)[:, np.flatnonzero(self.free.ravel())])

    @property
    def none(self) -> Motions:
        """The space without motions."""
        nothing, held = np.zeros_like(self.free), np.full(self.free.shape, OUTSIDE)
        return Motions(self.single, nothing, held, csr_array((self.free.size, 0)))

    @property
    def count(self) -> int:
        """How many they are."""
        return int(self.free.sum()) + self.joint.shape[1]


def block_diagonal(blocks: Array) -> csr_array:
    """Square blocks of shape ``(n, k, k)`` as one sparse matrix."""
    n, k = blocks.shape[:2]
    index = np.arange(n + 1)
    return csr_array(bsr_array((blocks, index[:-1], index), shape=(n * k, n * k)))


def diagonal_blocks(A: csr_array, k: int) -> Array:
    """Diagonal blocks of a sparse matrix, shape ``(n, k, k)``."""
    n = A.shape[0] // max(k, 1)
    entries = A.tocoo()
    row, column = entries.coords
    inside = row // max(k, 1) == column // max(k, 1)
    blocks = np.zeros((n, k, k))
    row, column = row[inside], column[inside]
    np.add.at(blocks, (row // max(k, 1), row % max(k, 1), column % max(k, 1)), entries.data[inside])
    return blocks


def unsprung(springs: Array) -> Motions:
    """Motions that springs do not resist.

    Args:
        springs: Projector onto what they resist, shape ``(bodies, k, k)``.
    """
    values, vectors = np.linalg.eigh(springs)
    none = csr_array((springs.shape[0] * springs.shape[1], 0))
    return Motions(vectors, values < HALF, values, none)


def unresisted(gram: csr_array, within: Motions, below: float = NULL) -> Motions:
    """Motions of a space of single bodies' motions that rows do not resist.

    What a body can do alone is found body by body. On what is left the rows' Gram matrix has
    unit diagonal blocks; its null space is that of connected components of bodies.

    Args:
        gram: JᵀJ of the rows, shape ``(bodies * k,) * 2``.
        within: The space to look in; its joint motions are not looked at.
        below: Motions of a single body held by less than this share of its stiffest motion are
            taken in too; those of several bodies must be free (and may have parts in those).
    """
    k = within.free.shape[1]
    V = block_diagonal(within.single)
    kept = diags_array(within.free.ravel().astype(float))
    whole = csr_array(V.T @ gram @ V)
    A = csr_array(kept @ whole @ kept)
    largest, at_all = (_largest(matrix, k) for matrix in (A, whole))
    # rows that hold only what is not in the space leave their rounding here
    grip = largest > NULL * at_all
    scale = diags_array(np.repeat(np.where(grip, np.where(grip, largest, 1.0) ** -0.5, 0.0), k))
    A = csr_array(scale @ A @ scale)
    blocks = diagonal_blocks(A, k)
    # what is not in the space is held; twice the stiffest motion keeps it apart in the order
    blocks[:, np.arange(k), np.arange(k)] += np.where(within.free, 0.0, OUTSIDE)
    stiffness, vectors = np.linalg.eigh(blocks)
    held = (stiffness > NULL) & (stiffness < INSIDE)
    # coordinates in which every body alone resists all its motions alike
    U = block_diagonal(vectors * (np.where(held, stiffness, 1.0) ** -0.5)[:, None, :])
    U = csr_array(U[:, np.flatnonzero(held.ravel())])
    joint = scale @ (U @ _null_space(csr_array(U.T @ A @ U), np.nonzero(held)[0]))
    single = within.single @ vectors
    return Motions(single, stiffness <= below, np.maximum(stiffness, 0.0), csr_array(V @ joint))


def _largest(A: csr_array, k: int) -> Array:
    """Largest eigenvalue of each diagonal block."""
    return np.asarray(np.linalg.eigvalsh(diagonal_blocks(A, k)).max(axis=1, initial=0.0))


def _null_space(A: csr_array, body: Array) -> csr_array:
    """Null space of a Gram matrix with unit blocks, by components of bodies."""
    if A.shape[0] == 0:
        return csr_array((0, 0))
    members = csr_array(
        (np.ones(len(body)), (body, np.arange(len(body)))), shape=(body.max() + 1, len(body))
    )
    strong = csr_array((abs(A.data) > NULL, A.indices, A.indptr), shape=A.shape)
    _, label = connected_components(members @ strong @ members.T, directed=False)
    component = label[body]
    order = np.argsort(component, kind="stable")
    cuts = np.flatnonzero(np.diff(component[order])) + 1
    columns = []
    for own in np.split(order, cuts):
        if body[own[0]] == body[own[-1]]:
            continue  # a body alone: nothing is left free of it
        null = _component_null(csr_array(A[own][:, own]))
        columns.append(spread(own, null, A.shape[0]))
    return side_by_side(columns, A.shape[0])


def _component_null(A: csr_array) -> Array:
    """Null space of a Gram matrix: dense if it is small, else by inverse iteration on blocks."""
    n = A.shape[0]
    if n <= DENSE:
        values, vectors = np.linalg.eigh(A.toarray())
        return np.asarray(vectors[:, values <= NULL * n])
    factor, size = CholeskyFactor(csr_array(A + SHIFT * eye_array(n))), BLOCK
    while True:
        X = np.random.default_rng(0).standard_normal((n, size))
        for _ in range(SWEEPS):
            X = np.linalg.qr(np.stack([factor.solve(x) for x in X.T], axis=1))[0]
        values, vectors = np.linalg.eigh(X.T @ (A @ X))
        null = values <= NULL * n
        if not null[-1] or size == n:  # the block holds more than the null space
            factor.destroy()
            return np.asarray(X @ vectors[:, null])
        size = min(2 * size, n)
