"""What averages make of the generalised inverses of a rank's subdomains, see ``clusters``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, inv
from scipy.sparse import coo_array, csr_array, hstack

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.soft_motions import SoftMotions

# Of the largest energy of a motion that averages hold in a cluster: less is none.
NULL = 1e-9
# Of what the stiffness of outer unknowns would make of a motion: one of less energy is soft.
# Compact clusters of 2 × 2 × 2 cubes have 0.1 and more, chains and hooks 0.01.
SOFT = 0.1


class Glue:
    """Z and W of all clusters of a rank, W dense for each.

    With T = G_cF_c⁻¹G_cᵀ, the energy of motions α of the subdomains of a cluster that averages
    hold, and R̂ = R − YF_c⁻¹G_cᵀ, what they look like: K̃⁺ = K⁺ − YF_c⁻¹Yᵀ + R̂T⁺R̂ᵀ, so that soft
    motions are eigenvectors of T.

    Args:
        given: B_c, K⁺B_cᵀ and R on the trace, shapes ``(a, t)``, ``(t, a)``, ``(t, r)``.
        null: null(G_cᵀ), shape ``(r, r̃)``.
        places: Rows of B_c and kernel coordinates of each cluster.
        stiffness: Diagonal of K on the trace where other rows than those in the cluster act, 0
            elsewhere, shape ``(t,)``.

    Attributes:
        unit: R is measured in it, so that G_c is of the size of F_c.
        Z: [Y, −R] on the trace, scipy CSR.
        entries: Number of entries of W.
    """

    def __init__(
        self,
        given: tuple[csr_array, csr_array, csr_array],
        null: csr_array,
        places: Sequence[tuple[Array, Array]],
        stiffness: Array,
    ) -> None:
        B, Y, R = given
        F, G = csr_array(B @ Y), csr_array((B @ R).T)
        size = float(abs(F).max()) if F.nnz else 1.0
        self.unit = size / (float(abs(G).max()) if G.nnz else 1.0)
        self.Z = csr_array(hstack((Y, -self.unit * R)))
        self._of_cluster: list[tuple[Array, Array]] = []
        self._soft = [csr_array((len(stiffness), 0))]
        shapes = R.tocsc(), Y.tocsc()
        for at, kernel in places:
            F_c = F[at][:, at].toarray()
            F_c, G_c = (F_c + F_c.T) / 2.0, G[kernel][:, at].toarray()
            N = null[kernel].toarray()
            W = _inverse(F_c, -self.unit * G_c, size * (N @ N.T), size)
            self._of_cluster.append((np.concatenate((at, F.shape[0] + kernel)), W))
            if len(at):
                own = shapes[0][:, kernel], shapes[1][:, at]
                self._soft.append(_softer(F_c, G_c, own, stiffness))

    def soft_motions(self, blocks: int) -> SoftMotions:
        """The softer motions of the subdomains, as many, in their clusters."""
        rows = csr_array(hstack(self._soft))
        return SoftMotions(rows, np.ones(rows.shape[1]), [0.0] * blocks, np.inf)

    @property
    def entries(self) -> int:
        """Number of entries of W."""
        return sum(W.size for _, W in self._of_cluster)

    def apply(self, s: Array) -> Array:
        """W s."""
        z = np.zeros(len(s))
        for places, W in self._of_cluster:
            z[places] = W @ s[places]
        return z


def _softer(F: Array, G: Array, shapes: tuple[Any, Any], stiffness: Array) -> csr_array:
    """Softer motions of a cluster on the trace of the rank, of energy 1.

    They are those of the largest R̂ᵀDR̂ for their energy, D the stiffness of outer unknowns.
    """
    there = np.unique(shapes[0].indices)
    R, Y = (csr_array(part)[there] for part in shapes)
    mu = cho_solve(cho_factor(F), G.T)
    T = G @ mu
    values, Q = np.linalg.eigh((T + T.T) / 2.0)
    held = values > NULL * values.max(initial=0.0)
    Q = Q[:, held] / np.sqrt(values[held])
    outer = np.flatnonzero(stiffness[there])
    far = R[outer] @ Q - Y[outer] @ (mu @ Q)
    sizes, V = np.linalg.eigh(far.T @ (stiffness[there[outer], None] * far))
    V = Q @ V[:, sizes * SOFT > 1.0]
    entries = R @ V - Y @ (mu @ V)
    rows, columns = np.repeat(there, V.shape[1]), np.tile(np.arange(V.shape[1]), len(there))
    shape = (len(stiffness), V.shape[1])
    return csr_array(coo_array((entries.ravel(), (rows, columns)), shape=shape))


def _inverse(F: Array, G: Array, free: Array, size: float) -> Array:
    """The inverse of [F Gᵀ; G 0] beside null(Gᵀ), where ``free`` is size times its projector."""
    a = len(F)
    W = inv(np.block([[F, G.T], [G, free]]), overwrite_a=True)
    W[a:, a:] -= free / size**2
    return np.asarray((W + W.T) / 2.0)
