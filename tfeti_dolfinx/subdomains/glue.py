"""What averages make of the generalised inverses of a rank's subdomains, see ``clusters``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.sparse import coo_array, csc_array, csr_array, hstack
from scipy.sparse.linalg import splu

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.soft_motions import SoftMotions

# Of what the stiffness of outer unknowns would make of a motion: one of less energy is soft.
# Compact clusters of 2 × 2 × 2 cubes have 0.1 and more, chains and hooks 0.01.
SOFT = 0.05


class Glue:
    """Z and W of all clusters of a rank, W by dense factors for each.

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
        Z: [Y, −R] on the trace, scipy CSR.
        entries: Number of entries of the factors of W.
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
        self.Z = csr_array(hstack((Y, -R)))
        self._B, self._BBt = B, splu(csc_array(B @ B.T)) if B.shape[0] else None
        self._of_cluster: list[tuple[Array, Saddle]] = []
        self._soft = [csr_array((len(stiffness), 0))]
        shapes = R.tocsc(), Y.tocsc()
        for at, kernel in places:
            if not len(at):
                continue
            F_c = F[at][:, at].toarray()
            F_c, G_c = (F_c + F_c.T) / 2.0, G[kernel][:, at].toarray()
            N = null[kernel].toarray()
            N = N[:, np.any(N != 0.0, axis=0)]
            W = Saddle(F_c, G_c, N)
            self._of_cluster.append((np.concatenate((at, F.shape[0] + kernel)), W))
            own = shapes[0][:, kernel], shapes[1][:, at]
            self._soft.append(_softer(F_c, G_c, N, own, stiffness))

    def soft_motions(self, blocks: int) -> SoftMotions:
        """The softer motions of the subdomains, as many, in their clusters."""
        rows = csr_array(hstack(self._soft))
        return SoftMotions(rows, np.ones(rows.shape[1]), [0.0] * blocks, np.inf)

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


def _softer(F: Array, G: Array, N: Array, shapes: tuple[Any, Any], stiffness: Array) -> csr_array:
    """Softer motions of a cluster on the trace of the rank, of energy 1.

    They are those of the largest R̂ᵀDR̂ for their energy, D the stiffness of outer unknowns, without
    their part in N, the motions of the whole cluster, which have no energy.
    """
    there = np.unique(shapes[0].indices)
    R, Y = (csr_array(part)[there] for part in shapes)
    mu = cho_solve(cho_factor(F), G.T)
    _, alpha = _scales(F, G)
    T = alpha[:, None] * (G @ mu) * alpha
    values, Q = np.linalg.eigh((T + T.T) / 2.0)
    free = N.shape[1]
    Q = alpha[:, None] * Q[:, free:] / np.sqrt(values[free:])
    Q -= N @ (N.T @ Q)
    outer = np.flatnonzero(stiffness[there])
    far = R[outer] @ Q - Y[outer] @ (mu @ Q)
    sizes, V = np.linalg.eigh(far.T @ (stiffness[there[outer], None] * far))
    V = Q @ V[:, sizes * SOFT > 1.0]
    entries = R @ V - Y @ (mu @ V)
    rows, columns = np.repeat(there, V.shape[1]), np.tile(np.arange(V.shape[1]), len(there))
    shape = (len(stiffness), V.shape[1])
    return csr_array(coo_array((entries.ravel(), (rows, columns)), shape=shape))


def _scales(F: Array, G: Array) -> tuple[Array, Array]:
    """Scales that make the diagonals of F and of G diag(F)⁻¹Gᵀ 1."""
    mu = np.diag(F) ** -0.5
    size = np.sum((G * mu) ** 2, axis=1)
    return mu, np.where(size > 0.0, size, 1.0) ** -0.5
