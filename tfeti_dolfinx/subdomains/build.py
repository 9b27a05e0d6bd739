"""From the forms to the Blocks of all subdomains of a rank."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array, entries_of_rows, node_blocks
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.forms.assembly import Forms
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.block import Block, Counters, RigidBlock, SubdomainData
from tfeti_dolfinx.subdomains.factor import say_if_not_cholmod
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.local_operators import LocalChoice
from tfeti_dolfinx.subdomains.subdomains import Subdomains

MakeBlock = Callable[[SubdomainData], Block]


class FiniteElements:
    """Stiffness and load of a rank's subdomains as the forms give them; base of other methods.

    Creation and all methods are collective.
    """

    replaces = False  # whether something takes the place of finite elements

    def __init__(self, dofs: TornDofs) -> None:
        self._dofs = dofs

    def node_blocks(self, K: Any, how: InverseFactory) -> Array:
        """Return the stiffness's block of each primal node, shape ``(num_nodes, bs, bs)``.

        K is the stiffness of finite elements in DOLFINx's numbering, scipy CSR.
        """
        return node_blocks(K, self._dofs.bs)[self._dofs.dolfinx_node]

    def load(self, forms: Forms) -> Array:
        """Return this rank's load in DOLFINx's numbering."""
        return forms.load()

    def blocks(self, make_block: MakeBlock) -> MakeBlock:
        """Return the factory of this rank's Blocks, those of finite elements as given."""
        return make_block

    def solved(self, u: Array) -> Any:
        """Return what the method knows of the solution, in primal order, or None."""
        return None

    def inside(self) -> int:
        """Return the number of unknowns of all ranks that the method does without."""
        return 0


@runtime_checkable
class SubdomainMethod(Protocol):
    """Another method than finite elements on some volumes.

    Attributes:
        volumes: Their names or tags; none: all.
    """

    volumes: tuple[str | int, ...]

    def assembly(self, dofs: TornDofs, decomposition: Decomposition) -> FiniteElements:
        """Return stiffness and load of the subdomains. Collective."""
        ...


def subdomain_data(
    dofs: TornDofs,
    decomposition: Decomposition,
    K: Any,
    f: Array,
    trace: Array,
) -> Iterator[SubdomainData]:
    """Return the data of each subdomain's Block on this rank, made one at a time. Collective.

    K, scipy CSR, and f are this rank's, in DOLFINx's numbering; ``trace`` are the local primal
    unknowns that rows of B touch, ascending.
    """
    gdim = decomposition.mesh.geometry.dim
    x = dofs.points()[:, :gdim]
    shares = 1.0 / dofs.spread(dofs.multiplicity)
    frames = _body_frames(dofs, decomposition, x, shares)
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


def make_subdomains(
    data: Iterable[SubdomainData],
    make_block: MakeBlock,
    decomposition: Decomposition,
    counters: Counters | None = None,
    choice: LocalChoice | None = None,
    kind: Callable[..., Subdomains] = Subdomains,
    rigid: Sequence[RigidBlock] = (),
    num_rigid: int = 0,
) -> Subdomains:
    """Make a Block of each subdomain of this rank, whose data is let go then. Collective.

    What ``make_block`` raises, say a class of one's own, is raised on all ranks. Of ``num_rigid``
    rigid bodies the last rank has the Blocks.
    """
    comm = decomposition.comm
    say_if_not_cholmod(comm)
    with raised_on_all_ranks(comm):
        blocks = [make_block(item) for item in data]
    bodies, count = (
        decomposition.body_of_subdomain[decomposition.subdomains],
        decomposition.num_bodies,
    )
    bodies = np.append(bodies, count + np.arange(len(rigid)))
    return kind([*blocks, *rigid], bodies, count + num_rigid, comm, counters, choice)


def subdomain_stiffness(K: Any, rows: Array, primal: Array, first: int) -> csr_array:
    """Stiffness of one subdomain, in primal order."""
    entries, table = entries_of_rows(K, rows)
    columns = primal[K.indices[entries]] - first
    A = csr_array((K.data[entries], columns, table), shape=(len(rows),) * 2)
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
