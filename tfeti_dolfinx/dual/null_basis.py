"""Free motions of bodies in kernel coordinates: an orthonormal basis of null(Gᵀ)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.sparse import block_array, csc_array, csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.bodies import Bodies
from tfeti_dolfinx.dual.motions import Motions, block_diagonal


@dataclass(frozen=True)
class NullBasis:
    """A null space of sparse vectors.

    Attributes:
        vectors: Orthonormal, as columns, shape ``(r, count)``.
        pins: As many entries, on which the vectors are independent.
    """

    vectors: csr_array
    pins: Array

    def removed(self, x: Array) -> Array:
        """x less its part in the space."""
        if len(self.pins) == 0:
            return x
        return np.asarray(x - self.vectors @ (self.vectors.T @ x))


def null_basis(bodies: Bodies, motions: Motions) -> NullBasis:
    """Orthonormal basis of motions in kernel coordinates, and entries that determine it.

    Motions of single bodies stay what they are, so their part is sparse. Those of several
    bodies are few.
    """
    alone = csc_array(bodies.modes @ _orthonormal(bodies, motions))
    body = np.repeat(np.arange(bodies.count), motions.free.sum(axis=1))
    pins = _pins_of_bodies(alone, body)
    if motions.joint.shape[1] == 0:
        return NullBasis(csr_array(alone), pins)
    joint = bodies.modes @ motions.joint
    for _ in range(2):  # once more: the first time leaves rounding of the larger part
        joint = np.linalg.qr(joint - alone @ (alone.T @ joint))[0]
    more = _joint_pins(alone, body, pins, joint)
    vectors = csr_array(block_array([[alone, csr_array(joint)]]))
    return NullBasis(vectors, np.concatenate((pins, more)))


def _orthonormal(bodies: Bodies, motions: Motions) -> csr_array:
    """Motions of single bodies, combined so that they are orthonormal in kernel coordinates."""
    V, free = motions.single, motions.free
    gram = np.swapaxes(V, 1, 2) @ bodies.size @ V
    both = free[:, :, None] & free[:, None, :]
    gram = np.where(both, gram, np.eye(bodies.k))
    combined = V @ np.linalg.inv(np.swapaxes(np.linalg.cholesky(gram), 1, 2))
    return csr_array(block_diagonal(combined)[:, np.flatnonzero(free.ravel())])


def _pins_of_bodies(alone: csc_array, body: Array) -> Array:
    """Entries on which the columns of each body are independent."""
    pins = []
    for own in _by_body(body):
        part = csr_array(alone[:, own])
        rows = np.flatnonzero(np.diff(part.indptr))
        pins.append(rows[_independent(part[rows].toarray())])
    return np.concatenate([np.empty(0, dtype=np.int64), *pins])


def _joint_pins(alone: csc_array, body: Array, pins: Array, joint: Array) -> Array:
    """Entries on which the joint motions are independent once the pins of bodies hold."""
    rest = joint.copy()
    at_pins = csr_array(alone)[pins]
    for own in _by_body(body):
        inside = at_pins[own][:, own].toarray()
        rest -= alone[:, own] @ np.linalg.solve(inside, joint[pins[own]])
    return _independent(rest)


def _by_body(body: Array) -> list[Array]:
    """Places of equal neighbours, of those that are there."""
    if len(body) == 0:
        return []
    return np.split(np.arange(len(body)), np.flatnonzero(np.diff(body)) + 1)


def _independent(columns: Array) -> Array:
    """As many rows as columns, chosen by pivoting, on which the columns are independent."""
    return np.asarray(qr(columns.T, pivoting=True, mode="r")[1][: columns.shape[1]])
