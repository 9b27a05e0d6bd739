"""All Blocks of a rank as one, made from the forms."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import (
    Array,
    entries_of_rows,
    joined,
    node_blocks,
    node_means,
    parts_of,
)
from tfeti_dolfinx.common.parallel import count_over
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.forms.assembly import Forms, Load
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.block import (
    TOLERANCES,
    Block,
    OperatorKind,
    RigidBlock,
    SubdomainData,
    candidate_modes,
)
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.local_operators import GroupedOperator, LocalChoice, LocalOperator

# --- All subdomains of a rank -----------------------------------------------------------------


class Subdomains:
    """The Blocks of a rank, one after the other.

    n, t and r are sums over this rank's Blocks: of their unknowns, of their trace unknowns and of
    the dimensions of their kernels; b is the number of bodies of all ranks and k that of candidate
    modes of each. A rank may have no Block. Blocks of rigid bodies stand behind all others.
    Creation is collective, and what its docstring calls so.

    Attributes:
        elastic: The Blocks that have nodes, which are no rigid bodies, and num_nodal the number of
            their unknowns; those behind are of rigid bodies.
        num_modes: k; num_springs and num_clusters: springs and clusters on all ranks.
        is_tangent: Whether stiffnesses are tangents of Newton's method.
        trace: Trace unknowns among this rank's, ascending, shape ``(t,)``.
        elastic_parts: Each of the Blocks that have nodes, with its part of the n unknowns.
        size: n.
        load_rounding: What rounding may have made of each entry of the load, shape ``(n,)``.
        trace_parts: Where the trace unknowns of each Block lie among the t, dof_parts its unknowns
            among the n, kernel_parts its kernel coordinates among the r, and spring_parts its
            springs among the k.
        diagonal: On the trace, the mean of the diagonal of K at each node, shape ``(t,)``.
    """

    num_clusters = 0
    is_tangent = False

    def __init__(
        self,
        blocks: Sequence[Block],
        body_of_block: Array,
        num_bodies: int,
        comm: MPI.Intracomm,
        choice: LocalChoice | None = None,
    ) -> None:
        self._choice = choice or LocalChoice()
        self.blocks, self.body_of_block = list(blocks), body_of_block
        self.elastic = [block for block in self.blocks if not isinstance(block, RigidBlock)]
        self.num_nodal = sum(len(block.load) for block in self.elastic)
        self.num_bodies, self.comm = num_bodies, comm
        own = max((block.modes.shape[1] for block in self.blocks), default=0)
        self.num_modes = int(comm.allreduce(own, op=MPI.MAX))
        springs = [block.springs for block in self.blocks]
        of_springs = [0 if own is None else len(own.stiffness) for own in springs]
        self.spring_parts = parts_of(of_springs)
        self.num_springs = count_over(comm, sum(of_springs))
        self.dof_parts = parts_of([len(block.load) for block in self.blocks])
        self.kernel_parts = parts_of([block.kernel.shape[1] for block in self.blocks])
        self.block_parts = list(zip(self.blocks, self.dof_parts, strict=True))
        self.elastic_parts = list(zip(self.elastic, self.dof_parts, strict=False))
        self.size = sum(len(block.load) for block in self.blocks)
        self.load_rounding: Array = np.zeros(self.size)
        self._read_trace()
        self._pinv_load: Array | None = None

    def _read_trace(self) -> None:
        traces = [block.trace_dofs for block in self.blocks]
        self.trace_parts = parts_of([len(dofs) for dofs in traces])
        shifted = [part.start + dofs for part, dofs in zip(self.dof_parts, traces, strict=True)]
        self.trace = joined(shifted).astype(np.int64)
        means = [node_means(block.diagonal, block.bs) for block in self.blocks]
        self.diagonal = joined([x[dofs] for x, dofs in zip(means, traces, strict=True)])

    def retrace(self, trace: Array) -> None:
        """Let other rows act, on these trace unknowns, ascending."""
        if np.array_equal(trace, self.trace):
            return
        for block, part in self.block_parts:
            own = slice(*np.searchsorted(trace, (part.start, part.stop)))
            block.retrace(trace[own] - part.start)
        self._read_trace()

    def update(self, f: Array) -> None:
        """Replace the load, shape ``(n,)``; raise an InputError if it does not fit. Collective."""
        self._pinv_load = None
        with raised_on_all_ranks(self.comm):
            for block, part in self.block_parts:
                block.update(f=f[part])

    def local_operator(self, kind: OperatorKind, once: bool = False) -> LocalOperator:
        """K⁺, K_bb or S of all Blocks on the trace; to be made again after ``retrace``.

        Applied once, or a few times, no dense matrix pays.
        """
        choice = LocalChoice("implicit") if once else self._choice
        return GroupedOperator(self.blocks, kind, choice)

    def destroy(self) -> None:
        """Free the factors of the Blocks."""
        for block in self.blocks:
            block.destroy()

    # ------------------------------------------------------------------ kernels

    @property
    def kernel_rows(self) -> csr_array:
        """R on the trace, shape ``(t, r)``."""
        parts = [block.kernel[block.trace_dofs] for block in self.blocks]
        return self._on_kernels(parts)

    @property
    def spring_rows(self) -> csr_array:
        """√D PᵀR of the springs, shape ``(k, r)``."""
        parts = [
            block.springs.stretched(block.kernel) if block.springs else block.kernel[:0]
            for block in self.blocks
        ]
        return self._on_kernels(parts)

    def _on_kernels(self, parts: Sequence[Array]) -> csr_array:
        """Parts of the Blocks, with their kernels' coordinates as columns."""
        first = [part.start for part in self.kernel_parts]
        return _assembled(parts, first, sum(part.shape[1] for part in parts))

    @property
    def kernel_load(self) -> Array:
        """Rᵀ f, shape ``(r,)``; 0 where it is rounding of f, as of stresses that are given."""
        parts = []
        for block in self.blocks:
            part = block.kernel.T @ block.load
            moves = np.linalg.norm(part) > TOLERANCES.balanced * np.linalg.norm(block.load)
            parts.append(np.where(moves, part, 0.0))
        return joined(parts)

    def kernel_motion(self, alpha: Array) -> Array:
        """R α on all unknowns, shape ``(n,)``, for α of shape ``(r,)``."""
        pairs = zip(self.blocks, self.kernel_parts, strict=True)
        return joined([block.kernel @ alpha[part] for block, part in pairs])

    # ------------------------------------------------------------------- bodies

    @property
    def modes_in_kernel(self) -> csr_array:
        """Rᵀ C, C the candidate modes of all bodies, shape ``(r, b * k)``."""
        parts = [block.kernel.T @ block.modes for block in self.blocks]
        k = self.num_modes
        return _assembled(parts, k * self.body_of_block, k * self.num_bodies)

    def modes_outside(self) -> Array:
        """Σ Cᵀ(I − R Rᵀ)C / tr CᵀC over the Blocks of a body, shape ``(b, k, k)``. Collective.

        What springs hold of the modes lies outside the kernels, and what guides hold of a rigid
        body.
        """
        found = []
        for i, block in enumerate(self.blocks):
            inside = block.kernel.T @ block.modes
            rest = block.modes - block.kernel @ inside
            gram = rest.T @ rest
            if i >= len(self.elastic):
                gram = np.diag(1.0 - np.diag(inside.T @ inside))
            found.append(gram / (float(np.trace(inside.T @ inside + gram)) or 1.0))
        return self._on_bodies(found, (self.num_modes, self.num_modes))

    def modes_metric(self) -> Array:
        """Cᵀ W C of each body, W the shares, shape ``(b, k, k)``. Collective."""
        found = [block.modes.T @ (block.shares[:, None] * block.modes) for block in self.blocks]
        return self._on_bodies(found, (self.num_modes, self.num_modes))

    def modes_as_one(self) -> Array:
        """Candidate modes of all bodies with nodes as one, shape ``(n, k)``."""
        found = np.zeros((self.size, self.num_modes))
        for block, part in self.elastic_parts:
            found[part] = candidate_modes(block.x, block.bs, np.zeros(block.x.shape[1]), 1.0)
        return found

    def moments(self, u: Array) -> Array:
        """Cᵀ W u of each body, shape ``(b, k)``, u on all unknowns. Collective."""
        found = [block.modes.T @ (block.shares * u[part]) for block, part in self.block_parts]
        return self._on_bodies(found, (self.num_modes,))

    def modes_motion(self, amounts: Array) -> Array:
        """C times amounts of each body's modes, of shape ``(b, k)``, shape ``(n,)``."""
        pairs = zip(self.blocks, self.body_of_block, strict=True)
        return joined([block.modes @ amounts[body] for block, body in pairs])

    def turned_beyond(self, amounts: Array) -> Array:
        """Return what finite turns add to ``modes_motion`` at nodes, shape ``(num_nodal,)``."""
        pairs = zip(self.elastic, self.body_of_block, strict=False)
        return joined([block.turned_beyond(amounts[body]) for block, body in pairs])

    def of_bodies(self, values: Sequence[Sequence[float]] | Array, largest: bool = False) -> Array:
        """Sums over the Blocks of each body of q values each, or the largest. Collective.

        Shape ``(q, b)``. Values may be given of elastic Blocks alone: those of rigid bodies are 0
        then; no largest one is less.
        """
        found = self._on_bodies(np.array(values, dtype=float).T, (len(values),), largest)
        return np.ascontiguousarray(found.T)

    # ------------------------------------------------------------ displacements

    def with_rigid(self, u: Array) -> Array:
        """Return a displacement of nodes on all unknowns, 0 of rigid bodies, shape ``(n,)``."""
        return np.append(u, np.zeros(self.size - len(u)))

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shape ``(n,)``."""
        x = np.zeros(len(b))
        for block, part in self.block_parts:
            if b[part].any():  # most bear no load of their own
                x[part] = block.solve(b[part])
        return x

    @property
    def pinv_load(self) -> Array:
        """K⁺ f on all unknowns, shape ``(n,)``; solved for once."""
        if self._pinv_load is None:
            load = joined([block.load for block in self.blocks])
            self._pinv_load = self.solve(load)
        return self._pinv_load

    def energies(self, u: Array) -> list[float]:
        """uᵀKu of each Block."""
        return [float(u[part] @ block.multiply(u[part])) for block, part in self.block_parts]

    def extended(self, v: Array) -> Array:
        """Return a trace vector, shape ``(t,)``, on all unknowns, 0 elsewhere, shape ``(n,)``."""
        u = np.zeros(self.size)
        u[self.trace] = v
        return u

    def body_sizes(self, displacements: Sequence[Array]) -> Array:
        """Longest displacement of a node of each body, shape ``(q, b)``. Collective.

        Of q displacements, each of shape ``(n,)``.
        """
        u, found = np.array(displacements), np.zeros((len(self.blocks), len(displacements)))
        for at, (block, part) in enumerate(self.block_parts):
            nodes = u[:, part].reshape(len(u), -1, block.bs)
            found[at] = sum(np.moveaxis(nodes**2, 2, 0)).max(axis=1, initial=0.0)
        return self.of_bodies(np.sqrt(found).T, largest=True)

    def _on_bodies(
        self, values: Sequence[Array] | Array, shape: tuple[int, ...], largest: bool = False
    ) -> Array:
        """Values of the Blocks, each of this shape, combined by bodies from 0 on. Collective."""
        total, body = np.zeros((self.num_bodies, *shape)), self.body_of_block[: len(values)]
        combine, op = (np.maximum, MPI.MAX) if largest else (np.add, MPI.SUM)
        combine.at(total, body, np.reshape(values, (len(values), *shape)))
        self.comm.Allreduce(MPI.IN_PLACE, total, op=op)
        return total


def _assembled(parts: Sequence[Array], first: Sequence[int] | Array, width: int) -> csr_array:
    """Dense parts one below the other as a sparse matrix, with the first column of each."""
    rows, columns = np.array([p.shape for p in parts], dtype=np.int64).reshape(-1, 2).T
    table = np.concatenate(([0], np.cumsum(np.repeat(columns, rows))))
    pairs = zip(parts, first, strict=True)
    indices = joined([np.tile(a + np.arange(p.shape[1]), len(p)) for p, a in pairs])
    data = joined([p.ravel() for p in parts])
    return csr_array((data, indices.astype(np.int64), table), shape=(rows.sum(), width))


# --- From the forms to the Blocks -------------------------------------------------------------

MakeBlock = Callable[[SubdomainData], Block]


class FiniteElements:
    """Stiffness and load of a rank's subdomains as the forms give them; base of other methods.

    Creation and all methods are collective.
    """

    replaces = False  # whether something takes the place of finite elements
    inside = 0  # unknowns of all ranks that the method does without
    # makes the factory of this rank's Blocks from that of finite elements; None: it is that
    blocks: Callable[[MakeBlock], MakeBlock] | None = None

    def __init__(self, dofs: TornDofs) -> None:
        self._dofs = dofs

    def node_blocks(self, K: Any, factory: InverseFactory) -> Array:
        """Return the stiffness's block of each primal node, shape ``(num_nodes, bs, bs)``.

        K is the stiffness of finite elements in DOLFINx's numbering, scipy CSR.
        """
        return node_blocks(K, self._dofs.bs)[self._dofs.dolfinx_node]

    def load(self, forms: Forms) -> Load:
        """Return this rank's load."""
        return forms.load()

    def solved(self, u: Array) -> Any:
        """Return what the method knows of the solution, in primal order, or None."""
        return None


@runtime_checkable
class SubdomainMethod(Protocol):
    """Another method than finite elements on some volumes."""

    volumes: tuple[str | int, ...]  # their names or tags; none: all

    def assembly(self, dofs: TornDofs, decomposition: Decomposition) -> FiniteElements:
        """Return stiffness and load of the subdomains. Collective."""


def subdomain_data(dofs: TornDofs, K: Any, f: Array, trace: Array) -> Iterator[SubdomainData]:
    """Return the data of each subdomain's Block on this rank, made one at a time. Collective.

    K, scipy CSR, and f are this rank's, in DOLFINx's numbering; ``trace`` are the local primal
    unknowns that rows of B touch, ascending.
    """
    decomposition, gdim = dofs.decomposition, dofs.decomposition.mesh.geometry.dim
    x = dofs.points()[:, :gdim]
    shares = 1.0 / dofs.spread(dofs.multiplicity)
    # centre and size of each body, the same on all ranks and for all subdomains
    body = decomposition.body_of_subdomain[dofs.node_subdomain]
    sums = np.zeros((decomposition.num_bodies, 1 + gdim))
    np.add.at(sums, body, shares[:, None] * np.column_stack((np.ones(len(x)), x)))
    dofs.comm.Allreduce(MPI.IN_PLACE, sums, op=MPI.SUM)
    centre, length = sums[:, 1:] / sums[:, :1], np.zeros(len(sums))
    np.maximum.at(length, body, np.linalg.norm(x - centre[body], axis=1))
    dofs.comm.Allreduce(MPI.IN_PLACE, length, op=MPI.MAX)
    frames = list(zip(centre, length.tolist(), strict=True))
    loads, starts = dofs.to_primal(f), (dofs.node_offsets * dofs.bs).tolist()
    cuts, dolfinx = np.searchsorted(trace, starts), dofs.dolfinx_dofs()
    primal = np.empty(len(dolfinx), dtype=np.int32)
    primal[dolfinx] = np.arange(len(dolfinx))

    def data_of(s: int) -> SubdomainData:
        nodes = slice(dofs.node_offsets[s], dofs.node_offsets[s + 1])
        own = slice(starts[s], starts[s + 1])
        return SubdomainData(
            name=f"subdomain {dofs.subdomains[s]}",
            K=subdomain_stiffness(K, dolfinx[own], primal, starts[s]),
            f=loads[own],
            x=x[nodes],
            trace_dofs=trace[cuts[s] : cuts[s + 1]] - starts[s],
            body_frame=frames[decomposition.body_of_subdomain[dofs.subdomains[s]]],
            node_shares=shares[nodes],
        )

    return map(data_of, range(len(dofs.subdomains)))


def subdomain_stiffness(K: Any, rows: Array, primal: Array, first: int) -> csr_array:
    """Stiffness of one subdomain, in primal order."""
    entries, table = entries_of_rows(K, rows)
    columns = primal[K.indices[entries]] - first
    # of the type of columns, on whose arrays PETSc's matrix of it is then
    A = csr_array((K.data[entries], columns, table.astype(columns.dtype)), shape=(len(rows),) * 2)
    A.sort_indices()
    return A
