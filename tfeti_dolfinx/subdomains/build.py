"""Blocks of all subdomains of a rank."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.factor import say_if_not_cholmod
from tfeti_dolfinx.subdomains.sparse_block import Counters, SparseBlock


def sparse_blocks(
    dofs: TornDofs,
    decomposition: Decomposition,
    K: Any,
    f: Array,
    trace: Array,
    counters: Counters,
    kplus_type: str,
    prefix: str = "tfeti_sub_",
) -> list[SparseBlock]:
    """One SparseBlock for each subdomain of this rank. Collective.

    Args:
        dofs: Dof maps.
        decomposition: The torn mesh.
        K: This rank's stiffness in DOLFINx's numbering, scipy CSR.
        f: Its load in DOLFINx's numbering.
        trace: Local primal unknowns that rows of B touch, ascending.
        counters: Counts factorisations.
        kplus_type: Kind of the generalised inverse.
        prefix: Prefix of the factors' PETSc options.
    """
    say_if_not_cholmod(dofs.comm)
    gdim = decomposition.mesh.geometry.dim
    x = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, :gdim]
    shares = 1.0 / dofs.spread(dofs.multiplicity)
    frames = _body_frames(dofs, decomposition, x, shares)
    loads = dofs.to_primal(f)
    dolfinx = dofs.dolfinx_dofs()
    primal = np.empty(len(dolfinx), dtype=np.int32)
    primal[dolfinx] = np.arange(len(dolfinx))
    parts = trace_parts(dofs, trace)
    blocks = []
    with raised_on_all_ranks(dofs.comm):
        for s, subdomain in enumerate(dofs.subdomains):
            nodes = slice(dofs.node_offsets[s], dofs.node_offsets[s + 1])
            first, last = nodes.start * dofs.bs, nodes.stop * dofs.bs
            blocks.append(
                SparseBlock(
                    name=f"subdomain {subdomain}",
                    K=_submatrix(K, dolfinx[first:last], primal, first),
                    f=loads[first:last],
                    x=x[nodes],
                    trace_dofs=parts[s],
                    body_frame=frames[decomposition.body_of_subdomain[subdomain]],
                    counters=counters,
                    kplus_type=kplus_type,
                    prefix=prefix,
                    shares=shares[nodes],
                )
            )
    return blocks


def trace_parts(dofs: TornDofs, trace: Array) -> list[Array]:
    """Trace unknowns of each subdomain of this rank, counted from its own first unknown."""
    starts = dofs.node_offsets * dofs.bs
    cuts = np.searchsorted(trace, starts)
    return [trace[a:b] - start for (a, b), start in zip(pairwise(cuts), starts, strict=False)]


def _submatrix(K: Any, rows: Array, primal: Array, first: int) -> csr_array:
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
