"""K on a trace and on what is next to it: of all subdomains of a rank at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import block_diag, csr_array

from tfeti_dolfinx.arrays import Array, joined, node_means, parts_of
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock

# equal subdomains from which on they share a matrix: products with several are slow for few
SHARED = 16


class NearStiffness:
    """K between the trace unknowns of each subdomain and those that share a cell with them.

    Its vectors are the t trace unknowns of a rank, as ``Subdomains`` has them, and after them the
    t_n ones next to them. Many equal subdomains with equal traces share a matrix, all others have
    one together.

    Args:
        blocks: This rank's Blocks.

    Attributes:
        diagonal: Next to the trace, the mean of the diagonal of K at each node, shape ``(t_n,)``.
    """

    def __init__(self, blocks: Sequence[SparseBlock]) -> None:
        seen = [block for block in blocks if len(block.trace_dofs)]
        members: dict[int, list[int]] = {}
        for i, block in enumerate(seen):
            members.setdefault(id(block.traced), []).append(i)
        next_to = {of: _next_to(seen[first]) for of, (first, *_) in members.items()}
        own = [next_to[id(block.traced)] for block in seen]
        pairs = zip(seen, own, strict=True)
        means = [node_means(b.stiffness.diagonal, b.bs)[dofs] for b, dofs in pairs]
        self.diagonal = joined(means)
        traces = parts_of([len(block.trace_dofs) for block in seen])
        parts = parts_of([*([traces[-1].stop] if seen else []), *map(len, own)])[1:]
        places = [
            np.concatenate((trace.start + np.argsort(b.trace_place), np.arange(p.start, p.stop)))
            for b, trace, p in zip(seen, traces, parts, strict=True)
        ]
        self._products: list[tuple[csr_array, Array]] = []
        alone: list[tuple[csr_array, Array]] = []
        for of, equal in members.items():
            K = _restricted(seen[equal[0]], next_to[of])
            if len(equal) < SHARED:
                alone += [(K, places[i]) for i in equal]
            else:
                self._products.append((K, np.stack([places[i] for i in equal], axis=1)))
        if alone:
            K = csr_array(block_diag([K for K, _ in alone], format="csr"))
            self._products.append((K, np.concatenate([place for _, place in alone])))

    def mult(self, u: Array, out: Array) -> None:
        """out = K u, shapes ``(t + t_n,)``; all of out is set."""
        for K, place in self._products:
            out[place] = K @ u[place]


def _next_to(block: SparseBlock) -> Array:
    """Unknowns of the stiffness that are not in the trace, of nodes that share a cell with it."""
    trace, bs = block.traced.trace, block.bs
    rows = block.stiffness.K[trace]
    rows.eliminate_zeros()  # entries between fixing nodes
    nodes = np.unique(rows.indices // bs)
    reached = (bs * nodes[:, None] + np.arange(bs)).ravel()
    return np.setdiff1d(reached, trace, assume_unique=True)


def _restricted(block: SparseBlock, next_to: Array) -> csr_array:
    """K on the trace, ascending, and on these unknowns."""
    kept = np.concatenate((block.traced.trace, next_to))
    return csr_array(block.stiffness.K[kept][:, kept])
