"""Blocks of all subdomains of a rank."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.block import Block, Counters, SubdomainData
from tfeti_dolfinx.subdomains.clusters import ClusteredSubdomains, Clusters
from tfeti_dolfinx.subdomains.factor import say_if_not_cholmod
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.local_operators import LocalChoice
from tfeti_dolfinx.subdomains.sparse_block import EqualSubdomains, SparseBlock
from tfeti_dolfinx.subdomains.subdomains import Subdomains

MakeBlock = Callable[[SubdomainData], Block]


def subdomain_data(
    dofs: TornDofs,
    decomposition: Decomposition,
    K: Any,
    f: Array,
    trace: Array,
    added: Array | None = None,
) -> Iterator[SubdomainData]:
    """Return the data of each subdomain's Block on this rank, one at a time. Collective.

    Args:
        dofs: Dof maps.
        decomposition: The torn mesh.
        K: This rank's stiffness in DOLFINx's numbering, scipy CSR; not needed any more after it.
        f: Its load in DOLFINx's numbering.
        trace: Local primal unknowns that rows of B touch, ascending.
        added: What the diagonal of K is to get, in DOLFINx's numbering; None: nothing.
    """
    gdim = decomposition.mesh.geometry.dim
    x = dofs.points()[:, :gdim]
    shares = 1.0 / dofs.spread(dofs.multiplicity)
    frames = _body_frames(dofs, decomposition, x, shares)
    loads, starts = dofs.to_primal(f), dofs.node_offsets * dofs.bs
    more = None if added is None else dofs.to_primal(added)
    cuts = np.searchsorted(trace, starts)

    def data() -> Iterator[SubdomainData]:
        pairs = zip(submatrices(dofs, K), dofs.subdomains, strict=True)
        for s, (K_s, subdomain) in enumerate(pairs):
            nodes = slice(dofs.node_offsets[s], dofs.node_offsets[s + 1])
            own = None if more is None else more[starts[s] : starts[s + 1]]
            yield SubdomainData(
                name=f"subdomain {subdomain}",
                K=K_s,
                f=loads[starts[s] : starts[s + 1]],
                x=x[nodes],
                trace_dofs=trace[cuts[s] : cuts[s + 1]] - starts[s],
                body_frame=frames[decomposition.body_of_subdomain[subdomain]],
                node_shares=shares[nodes],
                added=own if own is not None and np.any(own) else None,
            )

    return data()


def submatrices(dofs: TornDofs, K: Any) -> Iterator[csr_array]:
    """Stiffness of each subdomain of this rank in primal order, from that of all of them.

    Its entries are a part of K's own, in their place, where DOLFINx numbers the subdomain without
    holes and no other one might be equal to it; else a copy. K is not to be used afterwards.
    """
    dolfinx = dofs.dolfinx_dofs()
    primal = np.empty(len(dolfinx), dtype=np.int32)
    primal[dolfinx] = np.arange(len(dolfinx))
    starts = dofs.node_offsets * dofs.bs
    lone = _lone(starts, np.diff(K.indptr)[dolfinx])
    for s, (first, last) in enumerate(pairwise(starts.tolist())):
        rows = dolfinx[first:last]
        if np.all(np.diff(rows) == 1):
            yield _part(K, slice(rows[0], rows[-1] + 1), copied=not lone[s])
        else:
            yield submatrix(K, rows, primal, first)


def _lone(starts: Array, entries_of_row: Array) -> Array:
    """Flags of the subdomains that none other is equal to, by sizes and numbers of entries."""
    entries = np.diff(np.append(0, np.cumsum(entries_of_row))[starts])
    sizes = np.stack((np.diff(starts), entries), axis=1)
    _, which, count = np.unique(sizes, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[which.ravel()] == 1)


def sparse_blocks(how: InverseFactory, choice: LocalChoice) -> MakeBlock:
    """Return the factory of a rank's Blocks, which share a stiffness if the choice says so."""
    equals = EqualSubdomains(how) if choice.shares else None
    return lambda data: SparseBlock(data, how, equals)


def make_subdomains(
    data: Iterable[SubdomainData],
    make_block: MakeBlock,
    decomposition: Decomposition,
    counters: Counters | None = None,
    choice: LocalChoice | None = None,
    clusters: Clusters | None = None,
) -> Subdomains:
    """A Block for each subdomain of this rank. Collective.

    Args:
        data: The subdomains; each is let go when its Block is made.
        make_block: Makes one, say ``SparseBlock`` or a class of one's own; what it raises is
            raised on all ranks.
        decomposition: The torn mesh.
        counters: Counts solves.
        choice: Which form local operators take.
        clusters: Clusters of them, if any.
    """
    comm = decomposition.comm
    say_if_not_cholmod(comm)
    with raised_on_all_ranks(comm):
        blocks = [make_block(item) for item in data]
    bodies = decomposition.body_of_subdomain[decomposition.subdomains]
    given = (blocks, bodies, decomposition.num_bodies, comm, counters, choice)
    return ClusteredSubdomains(clusters, *given) if clusters is not None else Subdomains(*given)


def _part(K: Any, rows: slice, copied: bool) -> csr_array:
    """Stiffness of one subdomain whose unknowns are consecutive, in the same order."""
    indptr = K.indptr[rows.start : rows.stop + 1]
    entries, n = slice(indptr[0], indptr[-1]), rows.stop - rows.start
    data, indices = K.data[entries], K.indices[entries] - rows.start
    if copied:
        data = data.copy()
    A = csr_array((data, indices, (indptr - indptr[0]).astype(indices.dtype)), shape=(n, n))
    A.sort_indices()
    return A


def submatrix(K: Any, rows: Array, primal: Array, first: int) -> csr_array:
    """Stiffness of one subdomain, in primal order."""
    K_s = K[rows]
    n = len(rows)
    A = csr_array((K_s.data, primal[K_s.indices] - first, K_s.indptr), shape=(n, n))
    A.sort_indices()
    return A


def _body_frames(
    dofs: TornDofs, decomposition: Decomposition, x: Array, shares: Array
) -> list[tuple[Array, float]]:
    """Centre and size of each body, the same on all ranks and for all subdomains."""
    body = decomposition.body_of_subdomain[dofs.node_subdomain]
    sums = np.zeros((decomposition.num_bodies, 1 + x.shape[1]))
    np.add.at(sums, body, shares[:, None] * np.column_stack((np.ones(len(x)), x)))
    dofs.comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    centre = sums[:, 1:] / sums[:, :1]
    length = np.zeros(decomposition.num_bodies)
    np.maximum.at(length, body, np.linalg.norm(x - centre[body], axis=1))
    dofs.comm.Allreduce(MPI.IN_PLACE, length, op=MPI.MAX)
    return list(zip(centre, length.tolist(), strict=True))
