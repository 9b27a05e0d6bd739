"""A basis of the kernel of K in which the bodies' motions are coordinates of their own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.sparse import block_diag, csc_array, csr_array, diags_array, hstack, vstack

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.bodies import Bodies
from tfeti_dolfinx.dual.motions import Motions, block_diagonal

# what holds a direction, in the order of the coordinates
CONTACT, EQUALITIES, SPRINGS = 1, 2, 5


@dataclass(frozen=True)
class KernelBasis:
    """T = [M, E]: motions M of bodies, and unit vectors E of the subdomains' other coordinates.

    Gluing rows of a stiff body are larger than the contact rows that hold it by the root of the
    ratio of stiffnesses, and so may be rows of conditions on it. In the subdomains' own
    coordinates GGᵀ would be a sum of both, and rounding of the one could exceed the other.
    Columns GᵀM know nothing of gluing, and those of motions that only contact holds nothing of
    conditions.

    Attributes:
        combined: Directions of each body as columns, so that M = bodies.motions @ combined, shape
            ``(bodies * k, a)``.
        motions: M, orthonormal, shape ``(r, a)``.
        pins: Coordinates that M takes the place of.
        rest: The others.
        inverse: Inverse of M's rows at the pins.
        unheld: Flags of the motions that no equality row resists, shape ``(a,)``.
        free: Flags of the motions that no row resists, shape ``(a,)``.
    """

    combined: csr_array
    motions: csr_array
    pins: Array
    rest: Array
    inverse: csr_array
    unheld: Array
    free: Array

    def products(self, x: Array) -> Array:
        """Tᵀx."""
        return np.concatenate((self.motions.T @ x, x[self.rest]))

    def kernel(self, y: Array) -> Array:
        """T y."""
        x = self.motions @ y[: len(self.pins)]
        x[self.rest] += y[len(self.pins) :]
        return np.asarray(x)

    def coordinates(self, X: csr_array) -> csr_array:
        """T⁻¹X."""
        first = self.inverse @ X[self.pins]
        return csr_array(vstack([first, X[self.rest] - self.motions[self.rest] @ first]))

    def rows(self, Gt: csr_array, J: csr_array, equalities: Array) -> csr_array:
        """Gᵀ T, what is known to be zero left out.

        Args:
            Gt: Gᵀ in the subdomains' coordinates.
            J: The same rows on motions of bodies.
            equalities: Flags of the rows.
        """
        of_equalities = diags_array(equalities.astype(float)) @ J
        GtM = of_equalities @ self.combined.multiply(~self.unheld)
        GtM = GtM + (J - of_equalities) @ self.combined.multiply(~self.free)
        return csr_array(hstack([GtM, csc_array(Gt)[:, self.rest]]))


def kernel_basis(bodies: Bodies, unheld: Motions, free: Motions) -> KernelBasis:
    """The basis with all motions of bodies that no springs resist, the free ones apart.

    Args:
        bodies: The bodies.
        unheld: Motions that neither springs nor equality rows resist.
        free: Motions that nothing resists.
    """
    directions, held_by = _directions(bodies, unheld, free)
    kept = held_by < SPRINGS
    combined = csr_array(block_diagonal(directions)[:, np.flatnonzero(kept.ravel())])
    motions = csr_array(bodies.motions @ combined)
    body = np.repeat(np.arange(bodies.count), kept.sum(axis=1))
    pins, inverse = _pins(csc_array(motions), body)
    rest = np.setdiff1d(np.arange(motions.shape[0]), pins)
    unheld_of, free_of = held_by[kept] < EQUALITIES, held_by[kept] < CONTACT
    return KernelBasis(combined, motions, pins, rest, inverse, unheld_of, free_of)


def _directions(bodies: Bodies, unheld: Motions, free: Motions) -> tuple[Array, Array]:
    """Directions of each body that are orthonormal in the kernel, and what holds each.

    Each is a combination of those before it: free ones, those that contact holds, those that
    equality rows hold, those that springs resist.
    """
    order = 3.0 * bodies.springs - _projector(unheld) - _projector(free)
    values, V = np.linalg.eigh(order)
    held_by = np.rint(values) + EQUALITIES
    kept = held_by < SPRINGS
    gram = np.swapaxes(V, 1, 2) @ bodies.size @ V
    gram = np.where(kept[:, :, None] & kept[:, None, :], gram, np.eye(bodies.k))
    return V @ np.linalg.inv(np.swapaxes(np.linalg.cholesky(gram), 1, 2)), held_by


def _projector(motions: Motions) -> Array:
    """Projectors onto the motions of single bodies, shape ``(bodies, k, k)``."""
    F = motions.single * motions.free[:, None, :]
    return np.asarray(F @ np.swapaxes(F, 1, 2))


def _pins(motions: csc_array, body: Array) -> tuple[Array, csr_array]:
    """Coordinates on which the motions of each body are independent, and the inverse there."""
    if len(body) == 0:
        return np.empty(0, dtype=np.int64), csr_array((0, 0))
    pins, inverses = [], []
    for own in np.split(np.arange(len(body)), np.flatnonzero(np.diff(body)) + 1):
        part = csr_array(motions[:, own])
        rows = np.flatnonzero(np.diff(part.indptr))
        dense = part[rows].toarray()
        chosen = independent(dense)
        pins.append(rows[chosen])
        inverses.append(np.linalg.inv(dense[chosen]))
    return np.concatenate(pins), csr_array(block_diag([csr_array(X) for X in inverses]))


def independent(columns: Array) -> Array:
    """As many rows as columns, chosen by pivoting, on which the columns are independent."""
    if columns.shape[1] == 0:
        return np.empty(0, dtype=np.int64)
    return np.asarray(qr(columns.T, pivoting=True, mode="r")[1][: columns.shape[1]])
