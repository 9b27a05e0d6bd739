"""What averages make of the generalised inverses of a rank's subdomains, see ``clusters``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csc_array, csr_array, hstack
from scipy.sparse.linalg import splu

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError


class Glue:
    """Z and W of all clusters of a rank, W by dense factors for each.

    Args:
        given: B_c, K⁺B_cᵀ and R on the trace, shapes ``(a, t)``, ``(t, a)``, ``(t, r)``.
        null: null(G_cᵀ), shape ``(r, r̃)``.
        places: Rows of B_c and kernel coordinates of each cluster.

    Attributes:
        Z: [Y, −R] on the trace, scipy CSR.
        entries: Number of entries of the factors of W.
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
        self._B, self._BBt = B, splu(csc_array(B @ B.T)) if B.shape[0] else None
        self._of_cluster: list[tuple[Array, Saddle]] = []
        for at, kernel in places:
            if not len(at):
                continue
            F_c = F[at][:, at].toarray()
            F_c, G_c = (F_c + F_c.T) / 2.0, G[kernel][:, at].toarray()
            N = null[kernel].toarray()
            N = N[:, np.any(N != 0.0, axis=0)]
            W = Saddle(F_c, G_c, N)
            self._of_cluster.append((np.concatenate((at, F.shape[0] + kernel)), W))

    @property
    def entries(self) -> int:
        """Number of entries of the factors of W."""
        return sum(W.entries for _, W in self._of_cluster)

    def beside(self, w: Array) -> Array:
        """(I − B_cᵀ(B_cB_cᵀ)⁻¹B_c)w, shapes ``(t,)``.

        K̃⁺ is zero on the rest but for rounding, which conjugate gradients would take for curvature.
        """
        if self._BBt is None:
            return w
        return np.asarray(w - self._B.T @ self._BBt.solve(self._B @ w))

    def apply(self, s: Array) -> Array:
        """W s."""
        z = np.zeros(len(s))
        for places, W in self._of_cluster:
            z[places] = W.solve(s[places])
        return z


class Saddle:
    """W of a cluster: the inverse of [F_c −G_cᵀ; −G_c 0] beside null(G_cᵀ), by Cholesky factors.

    W itself, as a matrix, would cost as many digits as the condition number of F_c has, (L/t)⁴ in
    plates of thickness t; what triangular solves lose lies where F_c is small, and so is Y.
    Unknowns are scaled, since moduli of subdomains may differ by powers of ten.

    Args:
        F: F_c, shape ``(a, a)``.
        G: G_c, shape ``(r, a)``.
        N: Basis of null(G_cᵀ), shape ``(r, n)``.

    Attributes:
        entries: Number of entries of the factors.

    Raises:
        FactorError: F_c is definite no more, for rounding.
    """

    def __init__(self, F: Array, G: Array, N: Array) -> None:
        self._mu, self._alpha = _scales(F, G)
        G = self._alpha[:, None] * G * self._mu
        self._free, _ = np.linalg.qr(N / self._alpha[:, None])
        try:
            self._L = cholesky(self._mu[:, None] * F * self._mu, lower=True)
            self._M = solve_triangular(self._L, G.T, lower=True)
            self._T = cholesky(self._M.T @ self._M + self._free @ self._free.T, lower=True)
        except np.linalg.LinAlgError as error:
            raise FactorError(
                "rounding makes averages of faces in a cluster depend on each other, as in thin "
                "parts; expected -tfeti_clusters 0, thicker parts or fewer subdomains"
            ) from error
        self.entries = self._L.size + 2 * self._M.size + self._T.size

    def solve(self, s: Array) -> Array:
        """W s, shapes ``(a + r,)``."""
        a = len(self._mu)
        v = self._lower(self._L, self._mu * s[:a])
        rest = self._alpha * s[a:] + self._M.T @ v
        rest -= self._free @ (self._free.T @ rest)
        alpha = -self._upper(self._T, self._lower(self._T, rest))
        mu = self._upper(self._L, v + self._M @ alpha)
        return np.concatenate((self._mu * mu, self._alpha * alpha))

    @staticmethod
    def _lower(L: Array, b: Array) -> Array:
        return np.asarray(solve_triangular(L, b, lower=True, check_finite=False))

    @staticmethod
    def _upper(L: Array, b: Array) -> Array:
        return np.asarray(solve_triangular(L, b, trans=1, lower=True, check_finite=False))


def _scales(F: Array, G: Array) -> tuple[Array, Array]:
    """Scales that make the diagonals of F and of G diag(F)⁻¹Gᵀ 1."""
    mu = np.diag(F) ** -0.5
    size = np.sum((G * mu) ** 2, axis=1)
    return mu, np.where(size > 0.0, size, 1.0) ** -0.5
