"""Subdomains of a rank in clusters: one kernel for each, K⁺ with its subdomains glued by averages.

Hybrid TFETI: Klawonn, Rheinbach, Z. Angew. Math. Mech. 90 (2010) 5–32. In a cluster u minimises
½uᵀKu − bᵀu under B_c u = 0:

    u = K⁺(b − B_cᵀμ) + Rα,    [F_c −G_cᵀ; −G_c 0][μ; α] = [B_cK⁺b; −Rᵀb],

F_c = B_cK⁺B_cᵀ, G_c = RᵀB_cᵀ, so that K̃⁺ = K⁺ − ZWZᵀ, Z = [K⁺B_cᵀ, −R], W the inverse of that
matrix beside its kernel null(G_cᵀ), and R̃ = R null(G_cᵀ) are the motions of whole clusters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import block_diag, csr_array, hstack

from tfeti_dolfinx.arrays import Array, joined
from tfeti_dolfinx.subdomains.averages import Clusters
from tfeti_dolfinx.subdomains.block import OperatorKind
from tfeti_dolfinx.subdomains.cost import BANDWIDTH, sparse_products, sparse_traffic
from tfeti_dolfinx.subdomains.factor import REAL
from tfeti_dolfinx.subdomains.glue import Glue
from tfeti_dolfinx.subdomains.local import ModelledOperator
from tfeti_dolfinx.subdomains.subdomains import BALANCED, Subdomains

# of the largest eigenvalue of G_cG_cᵀ: less is a motion that no average resists
NULL = 1e-9


@dataclass(frozen=True)
class InnerMotions:
    """Rigid motions R̂ of the subdomains in the clusters of a rank.

    Attributes:
        rows: R̂ on the trace, scipy CSR, shape ``(t, k)``.
        energy: The diagonal R̂ᵀKR̂, of springs, shape ``(k,)``.
        cluster: Cluster of each, shape ``(k,)``.
        whole: Motions of whole clusters, which averages leave free, in their kernels or not,
            shape ``(k, w)``.
        amplification: As of ``SoftMotions``.
    """

    rows: csr_array
    energy: Array
    cluster: Array
    whole: csr_array
    amplification: list[float]


class ClusteredSubdomains(Subdomains):
    """The Blocks of a rank in clusters.

    Args:
        clusters: The clusters.
        given: Arguments of ``Subdomains``.
    """

    def __init__(self, clusters: Clusters, *given: Any) -> None:
        super().__init__(*given)
        self._clusters, self.num_clusters = clusters, clusters.total
        self._null: csr_array | None = None
        self._glued: Glue | None = None

    def update(self, K: Sequence[object] | None = None, f: Array | None = None) -> None:
        """As for subdomains. Collective."""
        if K is not None:
            self._null = self._glued = None
        super().update(K, f)

    def retrace(self, trace: Array, span: Array | None = None) -> None:
        """As for subdomains."""
        super().retrace(trace, span)
        self._glued = None

    @property
    def null(self) -> csr_array:
        """Motions of clusters, which averages leave free: a basis of ker G_cᵀ, ``(r, r̃)``."""
        if self._null is None:
            G = (self._clusters.averages[:, self.trace] @ super().kernel_rows).T
            self._null = _nulls(csr_array(G), self._places())
        return self._null

    def _places(self) -> list[tuple[Array, Array]]:
        """Rows of B_c, and kernel coordinates of the subdomains, of each cluster."""
        sizes = [part.stop - part.start for part in self.kernel_parts]
        return self._of_clusters(np.repeat(self._clusters.of_subdomain, sizes))

    def _of_clusters(self, owner: Array) -> list[tuple[Array, Array]]:
        """Rows of B_c, and coordinates, of each cluster."""
        of_row = self._clusters.of_row
        return [
            (np.flatnonzero(of_row == c), np.flatnonzero(owner == c))
            for c in range(self._clusters.count)
        ]

    # ------------------------------------------------------------------ kernels

    @property
    def kernel_size(self) -> int:
        """r̃."""
        return int(self.null.shape[1])

    @property
    def kernel_rows(self) -> csr_array:
        """R̃ on the trace, shape ``(t, r̃)``."""
        return csr_array(super().kernel_rows @ self.null)

    @property
    def kernel_load(self) -> Array:
        """R̃ᵀf, shape ``(r̃,)``; 0 where it is rounding of f."""
        part = self.null.T @ super().kernel_load
        sizes = [float(np.linalg.norm(block.load)) for block in self.blocks]
        counts = [kernel.stop - kernel.start for kernel in self.kernel_parts]
        allowed = abs(self.null).T @ np.repeat(sizes, counts)
        return np.where(np.abs(part) > BALANCED * allowed, part, 0.0)

    def kernel_part(self, b: Array) -> Array:
        """R̃ᵀb, shape ``(r̃,)``, for b on all unknowns, shape ``(n,)``."""
        return np.asarray(self.null.T @ super().kernel_part(b))

    def kernel_motion(self, alpha: Array) -> Array:
        """R̃α on all unknowns, shape ``(n,)``, for α of shape ``(r̃,)``."""
        return super().kernel_motion(self.null @ alpha)

    @property
    def modes_in_kernel(self) -> csr_array:
        """R̃ᵀC, C the candidate modes of all bodies, shape ``(r̃, b * k)``."""
        return csr_array(self.null.T @ super().modes_in_kernel)

    def inner_motions(self) -> InnerMotions:
        """Rigid motions of the subdomains, those first that are in their kernels."""
        R, held = super().kernel_rows, self.soft_motions()
        rows = csr_array(hstack((R, held.rows)))
        energy = np.concatenate((np.zeros(R.shape[1]), held.energy))
        sizes = [part.stop - part.start for part in self.trace_parts]
        at = np.repeat(self._clusters.of_subdomain, sizes)
        entries = rows.tocoo()
        cluster = np.zeros(rows.shape[1], dtype=np.int64)
        cluster[entries.coords[1]] = at[entries.coords[0]]
        G = csr_array((self._clusters.averages[:, self.trace] @ rows).T)
        whole = _nulls(G, self._of_clusters(cluster))
        return InnerMotions(rows, energy, cluster, whole, held.amplification)

    # ---------------------------------------------------------------- operators

    def local_operator(self, kind: OperatorKind, once: bool = False) -> ModelledOperator:
        """K̃⁺ of the clusters, K_bb or S of their subdomains, on the trace."""
        inner = super().local_operator(kind, once)
        return ClusterPinv(self, inner) if kind == "pinv" else inner

    def solve(self, b: Array) -> Array:
        """K̃⁺b on all unknowns, shape ``(n,)``."""
        B, glue, b = self._clusters.averages, self._glue(), np.array(b)
        b[self.trace] = glue.beside(b[self.trace])
        x = super().solve(b)
        z = glue.apply(np.concatenate((B @ x, -super().kernel_part(b))))
        mu, alpha = z[: B.shape[0]], z[B.shape[0] :]
        x = np.asarray(x - super().solve(B.T @ mu) + super().kernel_motion(alpha))
        x[self.trace] = glue.beside(x[self.trace])
        return x

    def _glue(self) -> Glue:
        """Z and W of the present trace."""
        if self._glued is None:
            inner = super().local_operator("pinv", once=True)
            inner.prepare()
            self.glue(inner)
        assert self._glued is not None
        return self._glued

    def glue(self, inner: ModelledOperator) -> Glue:
        """Z and W, made with K⁺ of the subdomains on the trace."""
        B, R = csr_array(self._clusters.averages[:, self.trace]), super().kernel_rows
        Y = self._responses(B, inner)
        self._glued = Glue((B, Y, R), self.null, self._places())
        return self._glued

    def _responses(self, B: csr_array, inner: ModelledOperator) -> csr_array:
        """K⁺B_cᵀ on the trace: the i-th average of each subdomain goes with those of all others."""
        owner = np.repeat(np.arange(len(self.blocks)), [p.stop - p.start for p in self.trace_parts])
        entries = B.tocoo()
        row, column = (part.astype(np.int64) for part in entries.coords)
        pairs = np.unique(owner[column] * B.shape[0] + row)
        subdomain, of_row = np.divmod(pairs, max(B.shape[0], 1))
        counts = np.bincount(subdomain, minlength=len(self.blocks))
        starts = np.cumsum(counts) - counts
        place = np.arange(len(pairs)) - starts[subdomain]
        turn = place[np.searchsorted(pairs, owner[column] * B.shape[0] + row)]
        width = int(counts.max(initial=0))
        responses = np.empty((width, len(owner)))
        for i, response in enumerate(responses):
            w = np.bincount(column[turn == i], entries.data[turn == i], minlength=len(owner))
            inner.mult(w.astype(float), response)
        table = np.zeros((len(self.blocks), width), dtype=np.int64)
        table[subdomain, place] = of_row
        there = np.arange(width) < counts[owner][:, None]
        indptr = np.append(0, np.cumsum(counts[owner]))
        found = (responses.T[there], table[owner][there], indptr)
        return csr_array(found, shape=(len(owner), B.shape[0]))


class ClusterPinv:
    """K̃⁺ = K⁺ − ZWZᵀ on the trace of a rank.

    Args:
        subdomains: The clusters.
        inner: K⁺ of their subdomains.
    """

    def __init__(self, subdomains: ClusteredSubdomains, inner: ModelledOperator) -> None:
        self._subdomains, self._inner = subdomains, inner
        self.predicted, self.traffic, self.forms = 0.0, 0.0, inner.forms

    def prepare(self) -> None:
        """Make K⁺, Z and W."""
        self._inner.prepare()
        self._glue = glue = self._subdomains.glue(self._inner)
        dense = REAL * glue.entries
        self.traffic = self._inner.traffic + 2.0 * sparse_traffic(glue.Z.nnz, 1) + dense
        seconds = 2.0 * sparse_products(glue.Z.nnz, 1) + dense / BANDWIDTH
        self.predicted = self._inner.predicted + seconds

    def mult(self, w: Array, out: Array) -> None:
        """out = K̃⁺w, shapes ``(t,)``."""
        w = self._glue.beside(w)
        self._inner.mult(w, out)
        out -= self._glue.Z @ self._glue.apply(self._glue.Z.T @ w)
        out[:] = self._glue.beside(out)

    def destroy(self) -> None:
        """The factors are the Blocks'."""
        self._inner.destroy()


def _nulls(G: csr_array, places: list[tuple[Array, Array]]) -> csr_array:
    """null(Gᵀ) of all clusters, G of motions × averages."""
    parts = [_null_of(G[motions][:, rows].toarray()) for rows, motions in places]
    order = joined([motions for _, motions in places]).astype(np.int64)
    stacked = csr_array(block_diag(parts)) if parts else csr_array((0, 0))
    return csr_array(stacked[np.argsort(order)])


def _null_of(G: Array) -> Array:
    """Orthonormal basis of null(Gᵀ)."""
    values, vectors = np.linalg.eigh(G @ G.T)
    return np.asarray(vectors[:, values <= NULL * values.max(initial=0.0)])
