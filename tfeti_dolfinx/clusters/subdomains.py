"""Clusters: subdomains glued by averages over their faces, and their generalised inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.sparse import block_diag, coo_array, csc_array, csr_array, diags_array, hstack
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from tfeti_dolfinx.common.arrays import Array, joined, parts_of
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.block import TOLERANCES as ROUNDING
from tfeti_dolfinx.subdomains.block import OperatorKind, candidate_modes, outside_motions
from tfeti_dolfinx.subdomains.local_operators import LocalOperator
from tfeti_dolfinx.subdomains.subdomains import Subdomains

# --- Clusters of subdomains and averages over their faces -------------------------------------


@dataclass(frozen=True)
class ClusterParameters:
    """Parameters of clusters and of averages over their faces.

    Attributes:
        flat: Singular value of a motion of a face, over the largest, below which it is no motion
            of its own (an edge has no turn about itself).
        dependent: What is left of an average's square beside the others that counts as nothing.
        uneven: Thousandths by which parts may exceed their share, for METIS.
        crumb: Of the mean size of subdomains: smaller ones stay with a neighbour.
        null: Of the largest eigenvalue of G_cG_cᵀ: less is a motion that no average resists.
    """

    flat: float = 1e-6
    dependent: float = 1e-8
    uneven: int = 30
    crumb: float = 0.3
    null: float = 1e-9


PARAMETERS = ClusterParameters()


@dataclass(frozen=True)
class Clusters:
    """Clusters of this rank's subdomains.

    Attributes:
        of_subdomain: Cluster of each, 0, 1, …, shape ``(S,)``.
        averages: B_c, scipy CSR, shape ``(a, n)``: u = v on a face as far as rigid motions of the
            face show it, for faces within a cluster; independent rows.
        of_row: Cluster of each of its rows, ascending, shape ``(a,)``.
        total: Number of clusters on all ranks.
    """

    of_subdomain: Array
    averages: csr_array
    of_row: Array
    total: int

    @property
    def count(self) -> int:
        """Number of clusters on this rank."""
        return int(self.of_subdomain.max(initial=-1)) + 1


def clusters_of(dofs: TornDofs, decomposition: Decomposition, wanted: int) -> Clusters:
    """Make about as many clusters as wanted. Collective.

    A cluster is a part of one body on one rank that hangs together by faces, so that there may be
    more of them than wanted, or fewer.

    Raises:
        InputError: More are wanted than there are subdomains.
    """
    if wanted > decomposition.num_subdomains:
        raise InputError(
            f"{wanted} clusters of {decomposition.num_subdomains} subdomains; expected at most "
            "as many clusters as subdomains"
        )
    gdim = decomposition.mesh.geometry.dim
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, :gdim]
    faces = _faces(dofs, x)
    pairs = np.array([face.pair for face in faces], dtype=np.int64).reshape(-1, 2)
    nodes = np.array([len(face.first) for face in faces], dtype=np.int64)
    whole = _connected(pairs, len(decomposition.subdomains))[1]
    owner = np.searchsorted(dofs.subdomains, dofs.node_subdomain)
    sizes = np.bincount(owner, minlength=len(whole))
    part = _parts(pairs, nodes, sizes, whole, wanted / decomposition.num_subdomains)
    within = part[pairs[:, 0]] == part[pairs[:, 1]]
    count, cluster = _connected(pairs[within], len(part))
    chosen = np.flatnonzero(within)
    chosen = chosen[np.argsort(cluster[pairs[chosen, 0]], kind="stable")]
    averages, of_row = _averages([faces[int(i)] for i in chosen], cluster, dofs)
    rows = [_independent(averages, np.flatnonzero(of_row == c)) for c in range(count)]
    kept = joined(rows).astype(np.int64)
    total = dofs.comm.allreduce(count, op=MPI.SUM)
    return Clusters(cluster, csr_array(averages[kept]), of_row[kept], total)


def _connected(pairs: Array, n: int) -> tuple[int, Array]:
    """Return the number of components, and that of each of n subdomains."""
    if n == 0:
        return 0, np.zeros(0, dtype=np.int64)
    graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(n, n))
    count, found = connected_components(graph, directed=False)
    return int(count), found


def _parts(pairs: Array, nodes: Array, sizes: Array, whole: Array, share: float) -> Array:
    """Part of each subdomain: each whole gets its share of parts, at least one.

    METIS bisects them so that few nodes of faces are cut: slender parts would have soft motions.
    Its other method makes two parts of 16, and 14 empty ones, of 32 subdomains.

    Args:
        pairs: Subdomains that share a face, shape ``(p, 2)``.
        nodes: How many nodes the faces have, shape ``(p,)``.
        sizes: How many nodes the subdomains have.
        whole: What each subdomain hangs together with, on this rank.
        share: Wanted clusters for each subdomain.
    """
    n, part, first = len(whole), np.zeros(len(whole), dtype=np.int64), 0
    graph = coo_array((nodes, tuple(pairs.T)), shape=(n, n)).tocsr()
    graph = csr_array(graph + graph.T)
    piece = _with_crumbs(graph, sizes, whole)
    for which in np.unique(whole):
        members = np.flatnonzero(whole == which)
        count = max(1, round(share * len(members)))
        _, own = np.unique(piece[members], return_inverse=True)
        of_piece = csr_array((np.ones(len(own)), (own, np.arange(len(own)))))
        between = csr_array(of_piece @ graph[members][:, members] @ of_piece.T)
        between.setdiag(0)
        between.eliminate_zeros()
        weights = of_piece @ sizes[members]
        parts = _metis_of(between, min(count, len(weights)), weights)
        part[members] = first + _hanging_together(between, parts, weights)[own]
        first += count
    return part


def _with_crumbs(graph: csr_array, sizes: Array, whole: Array) -> Array:
    """Piece of each subdomain: crumbs go to the neighbour with which they share most nodes."""
    if len(sizes) == 0:
        return np.zeros(0, dtype=np.int64)
    mean = np.bincount(whole, sizes) / np.maximum(np.bincount(whole), 1)
    crumbs = np.flatnonzero(
        (sizes < PARAMETERS.crumb * mean[whole]) & (np.asarray(graph.sum(axis=1)) > 0)
    )
    nearest = np.asarray(graph.argmax(axis=1)).ravel()
    return _connected(np.stack((crumbs, nearest[crumbs]), axis=1), len(sizes))[1]


def _hanging_together(graph: csr_array, part: Array, sizes: Array) -> Array:
    """Parts that hang together: of each the largest piece stays.

    The others go, the smallest first, to the part with which they share most nodes, if any.
    """
    part = part.copy()
    first, second = (np.asarray(i) for i in graph.tocoo().coords)
    while True:
        same = part[first] == part[second]
        count, piece = _connected(np.stack((first[same], second[same]), axis=1), len(part))
        order = np.argsort(np.bincount(piece, sizes, minlength=count), kind="stable")
        part_of, largest = np.zeros(count, dtype=np.int64), np.zeros(len(part), dtype=np.int64)
        part_of[piece] = part
        largest[part_of[order]] = order
        held = np.bincount(piece[first[~same]], minlength=count) > 0
        loose = order[(largest[part_of[order]] != order) & held[order]]
        if len(loose) == 0:
            return part
        inside = piece == loose[0]
        shared = np.bincount(part, graph[inside].sum(axis=0) * ~inside)
        part[inside] = np.argmax(shared)


def _metis_of(graph: csr_array, count: int, sizes: Array) -> Array:
    import pymetis

    if count == 1:
        return np.zeros(graph.shape[0], dtype=np.int64)
    options = pymetis.Options(seed=1, ufactor=PARAMETERS.uneven, ncuts=20)
    adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
    edges, vertices = (w.astype(np.int64) for w in (graph.data, sizes))
    found = pymetis.part_graph(
        count, adjacency, eweights=edges, vweights=vertices, options=options, recursive=True
    )
    return np.asarray(found[1], dtype=np.int64)


@dataclass(frozen=True)
class _Face:
    """A face that two subdomains share: its nodes in both, and rigid motions of them."""

    pair: Array
    first: Array
    second: Array
    motions: Array


def _faces(dofs: TornDofs, x: Array) -> list[_Face]:
    """All faces between two subdomains of this rank; copies are of one body."""
    first, second = _copies(dofs)
    owner = np.searchsorted(dofs.subdomains, dofs.node_subdomain)
    pairs = np.stack((owner[first], owner[second]), axis=1)
    unique, which = np.unique(pairs, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    cuts = np.searchsorted(which.ravel()[order], np.arange(1, len(unique)))
    found = []
    for at, nodes in zip(range(len(unique)), np.split(order, cuts), strict=False):
        motions = _motions(x[first[nodes]], dofs.bs)
        if motions is not None:
            found.append(_Face(unique[at], first[nodes], second[nodes], motions))
    return found


def _copies(dofs: TornDofs) -> tuple[Array, Array]:
    """All pairs of copies of a node on this rank."""
    order = np.argsort(dofs.group, kind="stable")
    group = dofs.group[order]
    firsts, seconds = [np.empty(0)], [np.empty(0)]
    apart = 1
    while np.any(same := group[apart:] == group[:-apart]):
        firsts.append(order[:-apart][same])
        seconds.append(order[apart:][same])
        apart += 1
    return joined(firsts).astype(np.int64), joined(seconds).astype(np.int64)


def _motions(x: Array, bs: int) -> Array | None:
    """Return orthonormal rigid motions of a face, None where it is only an edge or a vertex."""
    centre = x.mean(axis=0)
    length = float(np.linalg.norm(x - centre, axis=1).max())
    modes = candidate_modes(x, bs, centre, length)
    U, sizes, _ = np.linalg.svd(modes, full_matrices=False)
    whole = len(sizes) == modes.shape[1] and sizes[-1] > PARAMETERS.flat * sizes[0]
    return U if whole else None


def _averages(faces: list[_Face], cluster: Array, dofs: TornDofs) -> tuple[csr_array, Array]:
    """Uᵀ(u − v) of each face, U its motions; the cluster of each row."""
    sizes = [face.motions.shape[1] for face in faces]
    rows, columns, values = list[Array](), list[Array](), list[Array]()
    for face, part in zip(faces, parts_of(sizes), strict=True):
        weights = face.motions.T
        row = part.start + np.indices(weights.shape)[0]
        for nodes, sign in ((face.first, 1.0), (face.second, -1.0)):
            column = (nodes[:, None] * dofs.bs + np.arange(dofs.bs)).ravel()
            rows.append(row.ravel())
            columns.append(np.tile(column, len(weights)))
            values.append(sign * weights.ravel())
    places = tuple(joined(entries).astype(np.int64) for entries in (rows, columns))
    shape = (sum(sizes), dofs.num_nodes * dofs.bs)
    owner = cluster[np.array([face.pair[0] for face in faces], dtype=np.int64)]
    return csr_array(coo_array((joined(values), places), shape=shape)), np.repeat(owner, sizes)


def _independent(averages: csr_array, rows: Array) -> Array:
    """Return rows that are independent and span the same, ascending."""
    if len(rows) == 0:
        return rows
    own = averages[rows]
    sizes = diags_array(1.0 / np.sqrt(own.multiply(own).sum(axis=1)))
    gram = (sizes @ own @ own.T @ sizes).toarray()
    _, pivots, rank, _ = lapack.dpstrf(gram, tol=PARAMETERS.dependent)
    return np.sort(rows[pivots[:rank] - 1])


# --- Generalised inverses under averages ------------------------------------------------------


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
        # the diagonals of F and of G diag(F)⁻¹Gᵀ become 1
        self._mu = np.diag(F) ** -0.5
        size = np.sum((G * self._mu) ** 2, axis=1)
        self._alpha = np.where(size > 0.0, size, 1.0) ** -0.5
        G = self._alpha[:, None] * G * self._mu
        self._free, _ = np.linalg.qr(N / self._alpha[:, None])
        try:
            self._L = cholesky(self._mu[:, None] * F * self._mu, lower=True)
            self._M = solve_triangular(self._L, G.T, lower=True)
            self._T = cholesky(self._M.T @ self._M + self._free @ self._free.T, lower=True)
        except np.linalg.LinAlgError as error:
            raise FactorError(
                "rounding makes averages over interfaces in a cluster depend on each other, as in "
                "thin parts; expected -tfeti_clusters 0, thicker parts or fewer subdomains"
            ) from error

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


# --- Subdomains of a rank in clusters ---------------------------------------------------------
# Hybrid TFETI: Klawonn, Rheinbach, Z. Angew. Math. Mech. 90 (2010) 5–32. In a cluster u minimises
# ½uᵀKu − bᵀu under B_c u = 0:
#
#     u = K⁺(b − B_cᵀμ) + Rα,    [F_c −G_cᵀ; −G_c 0][μ; α] = [B_cK⁺b; −Rᵀb],
#
# F_c = B_cK⁺B_cᵀ, G_c = RᵀB_cᵀ, so that K̃⁺ = K⁺ − ZWZᵀ, Z = [K⁺B_cᵀ, −R], W the inverse of that
# matrix beside its kernel null(G_cᵀ), and R̃ = R null(G_cᵀ) are the motions of whole clusters.


@dataclass(frozen=True)
class InnerMotions:
    """Rigid motions R̂ of the subdomains in the clusters of a rank.

    Attributes:
        rows: R̂ on the trace, scipy CSR, shape ``(t, k)``.
        energy: The diagonal R̂ᵀKR̂, of springs, shape ``(k,)``.
        cluster: Cluster of each, shape ``(k,)``.
        whole: Motions of whole clusters, which averages leave free, in their kernels or not,
            shape ``(k, w)``.
    """

    rows: csr_array
    energy: Array
    cluster: Array
    whole: csr_array


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

    def retrace(self, trace: Array) -> None:
        """Change the trace as ``Subdomains.retrace`` does."""
        super().retrace(trace)
        self._glued = None

    @property
    def null(self) -> csr_array:
        """Motions of clusters, which averages leave free: a basis of ker G_cᵀ, ``(r, r̃)``."""
        if self._null is None:
            G = (self._clusters.averages[:, self.trace] @ super().kernel_rows).T
            self._null = _nulls(csr_array(G), self._places())
        return self._null

    def _places(self) -> list[tuple[Array, Array]]:
        """Return rows of B_c, and kernel coordinates of the subdomains, of each cluster."""
        sizes = [part.stop - part.start for part in self.kernel_parts]
        return self._of_clusters(np.repeat(self._clusters.of_subdomain, sizes))

    def _of_clusters(self, owner: Array) -> list[tuple[Array, Array]]:
        """Return rows of B_c, and coordinates, of each cluster."""
        of_row = self._clusters.of_row
        return [
            (np.flatnonzero(of_row == c), np.flatnonzero(owner == c))
            for c in range(self._clusters.count)
        ]

    # ------------------------------------------------------------------ kernels

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
        return np.where(np.abs(part) > ROUNDING.balanced * allowed, part, 0.0)

    def kernel_motion(self, alpha: Array) -> Array:
        """R̃α on all unknowns, shape ``(n,)``, for α of shape ``(r̃,)``."""
        return super().kernel_motion(self.null @ alpha)

    @property
    def modes_in_kernel(self) -> csr_array:
        """R̃ᵀC, C the candidate modes of all bodies, shape ``(r̃, b * k)``."""
        return csr_array(self.null.T @ super().modes_in_kernel)

    def _held_motions(self) -> tuple[csr_array, Array]:
        """Return motions R̂ of Blocks that springs hold, on the trace, and diagonal R̂ᵀKR̂."""
        parts, energies = list[Array](), list[Array]()
        for block in self.blocks:
            U = outside_motions(block.modes, block.kernel)
            KU = np.array([block.multiply(u) for u in U.T]).reshape(U.T.shape).T
            energy, V = np.linalg.eigh(U.T @ KU)
            parts.append((U @ V)[block.trace_dofs])
            energies.append(np.maximum(energy, 0.0))
        rows = csr_array(block_diag(parts)) if parts else csr_array((0, 0))
        return rows, joined(energies)

    def inner_motions(self) -> InnerMotions:
        """Rigid motions of the subdomains, those first that are in their kernels."""
        R, (held, energy) = super().kernel_rows, self._held_motions()
        rows = csr_array(hstack((R, held)))
        energy = np.concatenate((np.zeros(R.shape[1]), energy))
        sizes = [part.stop - part.start for part in self.trace_parts]
        at = np.repeat(self._clusters.of_subdomain, sizes)
        entries = rows.tocoo()
        cluster = np.zeros(rows.shape[1], dtype=np.int64)
        cluster[entries.coords[1]] = at[entries.coords[0]]
        G = csr_array((self._clusters.averages[:, self.trace] @ rows).T)
        whole = _nulls(G, self._of_clusters(cluster))
        return InnerMotions(rows, energy, cluster, whole)

    # ---------------------------------------------------------------- operators

    def local_operator(self, kind: OperatorKind, once: bool = False) -> LocalOperator:
        """K̃⁺ of the clusters, K_bb or S of their subdomains, on the trace."""
        inner = super().local_operator(kind, once)
        return ClusterPinv(self, inner) if kind == "pinv" else inner

    def solve(self, b: Array) -> Array:
        """K̃⁺b on all unknowns, shape ``(n,)``."""
        B, glue, b = self._clusters.averages, self._glue(), np.array(b)
        b[self.trace] = glue.beside(b[self.trace])
        x = super().solve(b)
        pairs = zip(self.blocks, self.dof_parts, strict=True)
        in_kernels = [-(block.kernel.T @ b[part]) for block, part in pairs]
        z = glue.apply(np.concatenate((B @ x, *in_kernels)))
        mu, alpha = z[: B.shape[0]], z[B.shape[0] :]
        x = np.asarray(x - super().solve(B.T @ mu) + super().kernel_motion(alpha))
        x[self.trace] = glue.beside(x[self.trace])
        return x

    def _glue(self) -> Glue:
        """Z and W of the present trace."""
        if self._glued is not None:
            return self._glued
        inner = super().local_operator("pinv", once=True)
        inner.prepare()
        return self.glue(inner)

    def glue(self, inner: LocalOperator) -> Glue:
        """Z and W, made with K⁺ of the subdomains on the trace."""
        B, R = csr_array(self._clusters.averages[:, self.trace]), super().kernel_rows
        Y = self._responses(B, inner)
        self._glued = Glue((B, Y, R), self.null, self._places())
        return self._glued

    def _responses(self, B: csr_array, inner: LocalOperator) -> csr_array:
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

    def __init__(self, subdomains: ClusteredSubdomains, inner: LocalOperator) -> None:
        self._subdomains, self._inner = subdomains, inner
        self.forms: Any = getattr(inner, "forms", None)

    def prepare(self) -> None:
        """Make K⁺, Z and W."""
        self._inner.prepare()
        self._glue = self._subdomains.glue(self._inner)

    def mult(self, w: Array, out: Array) -> None:
        """out = K̃⁺w, shapes ``(t,)``."""
        w = self._glue.beside(w)
        self._inner.mult(w, out)
        out -= self._glue.Z @ self._glue.apply(self._glue.Z.T @ w)
        out[:] = self._glue.beside(out)


def _nulls(G: csr_array, places: list[tuple[Array, Array]]) -> csr_array:
    """null(Gᵀ) of all clusters, G of motions × averages; of each an orthonormal basis."""
    parts = list[Array]()
    for rows, motions in places:
        G_c = G[motions][:, rows].toarray()
        values, vectors = np.linalg.eigh(G_c @ G_c.T)
        parts.append(vectors[:, values <= PARAMETERS.null * values.max(initial=0.0)])
    order = joined([motions for _, motions in places]).astype(np.int64)
    stacked = csr_array(block_diag(parts)) if parts else csr_array((0, 0))
    return csr_array(stacked[np.argsort(order)])
