"""What averages make of the generalised inverses of a rank's subdomains, see ``clusters``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import inv
from scipy.sparse import csr_array, hstack

from tfeti_dolfinx.arrays import Array


class Glue:
    """Z and W of all clusters of a rank, W dense for each.

    Args:
        given: B_c, K⁺B_cᵀ and R on the trace, shapes ``(a, t)``, ``(t, a)``, ``(t, r)``.
        null: null(G_cᵀ), shape ``(r, r̃)``.
        places: Rows of B_c and kernel coordinates of each cluster.

    Attributes:
        Z: [Y, −R] on the trace, scipy CSR.
        entries: Number of entries of W.
    """

    def __init__(
        self,
        given: tuple[csr_array, csr_array, csr_array],
        null: csr_array,
        places: Sequence[tuple[Array, Array]],
    ) -> None:
        B, Y, R = given
        F, G = csr_array(B @ Y), csr_array((B @ R).T)
        self.Z = csr_array(hstack((Y, -R)))
        self._of_cluster: list[tuple[Array, Array]] = []
        for at, kernel in places:
            F_c = F[at][:, at].toarray()
            F_c, G_c = (F_c + F_c.T) / 2.0, G[kernel][:, at].toarray()
            N = null[kernel].toarray()
            N = N[:, np.any(N != 0.0, axis=0)]
            W = _inverse(F_c, -G_c, N)
            self._of_cluster.append((np.concatenate((at, F.shape[0] + kernel)), W))

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


def _scales(F: Array, G: Array) -> tuple[Array, Array]:
    """Scales that make the diagonals of F and of G diag(F)⁻¹Gᵀ 1."""
    mu = np.diag(F) ** -0.5
    size = np.sum((G * mu) ** 2, axis=1)
    return mu, np.where(size > 0.0, size, 1.0) ** -0.5


def _inverse(F: Array, G: Array, N: Array) -> Array:
    """The inverse of [F Gᵀ; G 0] beside null(Gᵀ), whose basis N is.

    Unknowns are scaled, since moduli of subdomains may differ by powers of ten.
    """
    mu, alpha = _scales(F, G)
    scale, G = np.concatenate((mu, alpha)), alpha[:, None] * G * mu
    free, _ = np.linalg.qr(N / alpha[:, None])
    free = free @ free.T
    A = np.block([[mu[:, None] * F * mu, G.T], [G, free]])
    W = inv(A, overwrite_a=True)
    W[len(mu) :, len(mu) :] -= free
    W = scale[:, None] * W * scale
    return np.asarray((W + W.T) / 2.0)
