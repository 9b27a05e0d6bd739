"""Clusters of subdomains, and the averages over common faces that glue those of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.linalg import lapack
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array, joined, parts_of
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.kernel import candidate_modes

# Of the largest singular value of the modes of a face: less is no motion of its own (an edge has
# no turn about itself); and of an average's square, what is left of it beside the others.
FLAT, DEPENDENT = 1e-6, 1e-8
# METIS's: parts may have so many thousandths more than their share
UNEVEN = 30
# of the mean size of subdomains: smaller ones, such as are split off, stay with a neighbour
CRUMB = 0.3


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


def clusters_of(dofs: TornDofs, decomposition: Decomposition, wanted: int) -> Clusters | None:
    """About as many clusters as wanted, None for 0. Collective.

    A cluster is a part of one body on one rank that hangs together by faces, so that there may be
    more of them than wanted, or fewer.

    Raises:
        InputError: More are wanted than there are subdomains.
    """
    if wanted == 0:
        return None
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
    """Number of components, and that of each of n subdomains."""
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
    crumbs = np.flatnonzero((sizes < CRUMB * mean[whole]) & (np.asarray(graph.sum(axis=1)) > 0))
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
    options = pymetis.Options(seed=1, ufactor=UNEVEN, ncuts=20)
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
    """Orthonormal rigid motions of a face, None where it is only an edge or a vertex."""
    centre = x.mean(axis=0)
    length = float(np.linalg.norm(x - centre, axis=1).max())
    modes = candidate_modes(x, bs, centre, length)
    U, sizes, _ = np.linalg.svd(modes, full_matrices=False)
    whole = len(sizes) == modes.shape[1] and sizes[-1] > FLAT * sizes[0]
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
    """Rows that are independent and span the same, ascending."""
    if len(rows) == 0:
        return rows
    own = averages[rows]
    sizes = diags_array(1.0 / np.sqrt(own.multiply(own).sum(axis=1)))
    gram = (sizes @ own @ own.T @ sizes).toarray()
    _, pivots, rank, _ = lapack.dpstrf(gram, tol=DEPENDENT)
    return np.sort(rows[pivots[:rank] - 1])
