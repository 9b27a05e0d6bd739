"""Unknowns of the torn mesh: spaces, copies of nodes, their groups."""

from functools import cached_property
from typing import Any

import basix
import numpy as np
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import first_component, geometry_dofmap
from tfeti_dolfinx.common.parallel import Exchange, chunk_offsets, owner_of
from tfeti_dolfinx.common.validation import checked_type
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.untorn import cell_entities, cells_at, exchange_by_key, mix, set_key

# the exchange with the owners of groups, and which of theirs each row asks
Owners = tuple[Exchange, Array]

# --- Function spaces on a torn mesh -----------------------------------------------------------


def check_space(V: fem.FunctionSpace, decomposition: Decomposition) -> None:
    """Raise an InputError unless V is a Lagrange space for displacements on the torn mesh."""
    checked_type(V, fem.FunctionSpace, "the space", "a dolfinx.fem.FunctionSpace")
    if V.mesh is not decomposition.mesh:
        raise InputError(
            "the space is on another mesh (the one before decompose?); expected it on "
            "decomposition.mesh, the torn mesh"
        )
    try:
        element = V.element.basix_element
    except RuntimeError as error:
        raise InputError("mixed spaces are not supported, expected a Lagrange space") from error
    if element.family != basix.ElementFamily.P or element.discontinuous or element.degree < 1:
        raise InputError(
            f"space {V.ufl_element()}: expected a continuous Lagrange space of degree 1 or more"
        )
    shape, gdim = tuple(V.ufl_element().reference_value_shape), V.mesh.geometry.dim
    if shape not in ((), (gdim,)):
        raise InputError(
            f"the space has values of shape {shape}; expected displacements of {gdim} components "
            f"in {gdim}D, shape ({gdim},), or a scalar space"
        )


def is_same_space(V: Any, W: Any) -> bool:
    """Return whether two C++ spaces have the same mesh, element and numbering on this rank."""
    return V is W or bool(
        V.mesh is W.mesh
        and V.element == W.element
        and V.dofmap.bs == W.dofmap.bs
        and np.array_equal(V.dofmap.map(), W.dofmap.map())
    )


def space_in_words(V: Any) -> str:
    """A C++ space for messages."""
    try:
        degree = V.element.basix_element.degree
    except RuntimeError:
        return "a mixed space"
    kind = "a component of a space" if V.component() else "a space"
    return f"{kind} of degree {degree} with {V.dofmap.index_map_bs} unknowns per node"


# --- Keys of nodes, common to all torn copies -------------------------------------------------


def node_keys(V: fem.FunctionSpace, decomposition: Decomposition) -> tuple[Array, Array]:
    """For each DOLFINx node its lowest original vertex, and a key that all copies share.

    The key comes from the vertices of the mesh entity that the node belongs to; where an entity
    has several nodes, their relative distances to its vertices tell them apart.
    """
    mesh = V.mesh
    cell_type = mesh.topology.cell_type
    geometry = geometry_dofmap(mesh)[:, : len(cell_entities(cell_type, 0))]
    ids = decomposition.original_nodes[geometry]
    dofs, x = np.asarray(V.dofmap.list), V.tabulate_dof_coordinates()
    origin = np.empty(V.dofmap.index_map.size_local, dtype=np.int64)
    key = np.empty(len(origin), dtype=np.uint64)
    for dim, entity_dofs in enumerate(V.element.basix_element.entity_dofs):
        for vertices, entity in zip(cell_entities(cell_type, dim), entity_dofs, strict=True):
            for j in entity:
                nodes = dofs[:, j]
                origin[nodes] = ids[:, vertices].min(axis=1)
                key[nodes] = set_key(ids[:, vertices])
                if len(entity) == 1:
                    continue
                corners = mesh.geometry.x[geometry[:, vertices]]
                distance = np.linalg.norm(corners - x[nodes][:, None], axis=2)
                order = np.argsort(ids[:, vertices], axis=1)
                distance = np.take_along_axis(distance, order, axis=1)
                share = np.rint(1e6 * distance / distance.sum(axis=1, keepdims=True))
                place = (share * (1 + np.arange(len(vertices)))).sum(axis=1)
                key[nodes] = mix(key[nodes] + place.astype(np.uint64))
    return origin, key


# --- Dof maps: DOLFINx, primal and group numbering --------------------------------------------


class TornDofs:
    """Numberings of the nodes of a Lagrange space on a torn mesh.

    A *node* is a point with ``bs`` unknowns. *Primal* numbering sorts a rank's nodes by subdomain.
    A *group* is the set of all torn copies of a node, on any rank; it is owned by the rank of its
    lowest subdomain. Creation and all methods that say so are collective. Creation raises an
    InputError where ``V`` is not a space for displacements on the torn mesh. The space is scalar or
    blocked.

    Attributes:
        bs: Unknowns per node.
        num_nodes: Primal nodes of this rank, n.
        num_groups: Groups owned by this rank, g.
        multiplicity: Number of copies in each owned group, shape ``(g,)``.
        subdomains: Subdomains of this rank, ascending, shape ``(S,)``.
        node_offsets: First primal node of each subdomain, shape ``(S + 1,)``.
        dolfinx_node: DOLFINx's node for each primal node, primal_node the reverse, shapes ``(n,)``.
        offsets: First global primal node of each rank, shape ``(size + 1,)``.
        group_offsets: First global group of each rank, shape ``(size + 1,)``.
        group: Global group of each local primal node, shape ``(n,)``.
        copy_offsets: First copy of each owned group, shape ``(g + 1,)``.
        copies: Global primal nodes of the owned groups, by subdomain, shape ``(c,)``.
        copy_subdomains: Their subdomains, shape ``(c,)``.
        nodes: Places of DOLFINx's nodes in finite strain, and at rest, shape ``(2, n, 3)``; None:
            on the mesh.
        axisymmetric: Whether x[0] is a radius, which integrals over contact surfaces have for a
            weight.
    """

    def __init__(self, V: fem.FunctionSpace, decomposition: Decomposition) -> None:
        check_space(V, decomposition)
        self.V, self.decomposition, self.comm = V, decomposition, decomposition.comm
        self.bs, self.num_nodes = V.dofmap.index_map_bs, V.dofmap.index_map.size_local
        # sorted by subdomain, in DOLFINx's order within each
        subdomain = np.empty(self.num_nodes, dtype=np.int64)
        subdomain[np.asarray(V.dofmap.list)] = decomposition.cell_subdomain[:, None]
        self.dolfinx_node = np.argsort(subdomain, kind="stable")
        self.primal_node = np.empty_like(self.dolfinx_node)
        self.primal_node[self.dolfinx_node] = np.arange(self.num_nodes)
        self.subdomains = decomposition.subdomains
        self.node_subdomain = subdomain[self.dolfinx_node]
        starts = np.searchsorted(self.node_subdomain, self.subdomains)
        self.node_offsets = np.append(starts, self.num_nodes)
        self.nodes: Array | None = None
        self.axisymmetric = False
        self.offsets = chunk_offsets(self.comm, self.num_nodes)
        origin, key = node_keys(V, decomposition)
        self._find_groups(origin[self.dolfinx_node], key[self.dolfinx_node])

    def points(self, at_rest: bool = False) -> Array:
        """Return the place of each primal node, shape ``(n, 3)``, in finite strain also at rest."""
        x = self.V.tabulate_dof_coordinates() if self.nodes is None else self.nodes[int(at_rest)]
        return np.asarray(x.take(self.dolfinx_node, axis=0))

    def facet_nodes(self, facets: Array) -> Array:
        """Return the primal nodes of local exterior facets, vertices first, shape ``(n, t)``."""
        cell, place = cells_at(self.V.mesh, facets)
        on_facet = np.array(self.V.element.basix_element.entity_closure_dofs[-2])[place]
        nodes = np.take_along_axis(np.asarray(self.V.dofmap.list)[cell], on_facet, axis=1)
        return self.primal_node[nodes]

    def to_primal(self, values: Array) -> Array:
        """Unrolled dof values from DOLFINx's order to primal order, shape ``(n * bs,)``."""
        return values.reshape(-1, self.bs).take(self.dolfinx_node, axis=0).ravel()

    def to_dolfinx(self, values: Array) -> Array:
        """Unrolled dof values from primal order to DOLFINx's order, shape ``(n * bs,)``."""
        return values.reshape(-1, self.bs).take(self.primal_node, axis=0).ravel()

    def dolfinx_dofs(self) -> Array:
        """DOLFINx's unrolled dof for each primal dof, shape ``(n * bs,)``."""
        return (self.dolfinx_node[:, None] * self.bs + np.arange(self.bs)).ravel()

    def reduce(self, values: Array, op: np.ufunc) -> Array:
        """Combine the values of all copies of a node: ``(n, ...)`` to ``(g, ...)``. Collective.

        ``op`` is ``np.add``, ``np.maximum``, ``np.minimum`` or ``np.logical_or``.
        """
        return np.asarray(op.reduceat(self.gather_copies(values), self.copy_offsets[:-1]))

    def spread(self, values: Array) -> Array:
        """Give every copy its group's value: shape ``(g, ...)`` to ``(n, ...)``. Collective."""
        return self._to_owner.answer(values.take(self._to_owner_slot, axis=0))

    def lookup(self, groups: Array, *tables: Array) -> tuple[Array, ...]:
        """Rows for any groups, ``(k,)``, of tables with a row per owned group. Collective."""
        exchange, asked = self.owners_of(groups)
        return tuple(exchange.answer(table.take(asked, axis=0)) for table in tables)

    def reduce_on_owners(
        self, groups: Array, values: Array, op: np.ufunc = np.add, initial: Any = 0
    ) -> Array:
        """Combine what all ranks give for any groups: ``(k,)`` and ``(k, ...)`` to ``(g, ...)``.

        ``op`` is as in ``reduce``, ``initial`` its neutral element. Collective.
        """
        return self.reduced(self.owners_of(groups), values, op, initial)

    def reduced(
        self, owners: Owners, values: Array, op: np.ufunc = np.add, initial: Any = 0
    ) -> Array:
        """Do the same for groups whose ``owners_of`` are known. Collective."""
        exchange, slot = owners
        out = np.full((self.num_groups, *values.shape[1:]), initial, dtype=values.dtype)
        op.at(out, slot, exchange.send(values))
        return out

    def owners_of(self, groups: Array) -> Owners:
        """Return the exchange with the owners of groups, and which of theirs it asks. Collective.

        Those are positions among the groups that this rank owns, one for each row received.
        """
        exchange = Exchange(self.comm, owner_of(self.group_offsets, groups))
        return exchange, exchange.send(groups) - self.group_offsets[self.comm.rank]

    @cached_property
    def scalar(self) -> tuple[fem.FunctionSpace, Array]:
        """Scalar space of V's element, its dof for each primal node. Collective at first use."""
        if self.bs == 1:
            return self.V, self.dolfinx_node
        S, parent = first_component(self.V)
        dof = np.empty(len(parent), dtype=np.int64)
        dof[parent // self.bs] = np.arange(len(parent))
        return S, dof[self.dolfinx_node]

    @cached_property
    def hats(self) -> tuple[fem.FunctionSpace, Array]:
        """Scalar space of degree 1, primal node of each of its dofs. Collective at first use."""
        W = fem.functionspace(self.V.mesh, ("Lagrange", 1))
        cells = np.asarray(W.dofmap.list)
        node = np.empty(W.dofmap.index_map.size_local, dtype=np.int64)
        node[cells] = np.asarray(self.V.dofmap.list)[:, : cells.shape[1]]
        return W, self.primal_node[node]

    def gather_copies(self, values: Array) -> Array:
        """Give values of nodes, ``(n, ...)``, to the owned ``copies``, ``(c, ...)``. Collective."""
        return self._to_owner.send(values).take(self._copy_order, axis=0)

    def lookup_copies(self, groups: Array, *tables: Array) -> tuple[Array, ...]:
        """Find all copies of groups, ``(k,)``, and their rows of tables. Collective.

        Return the position in ``groups`` of each copy, and for ``copies`` and each table its row.
        """
        position, columns = np.arange(len(groups)), (self.copies, *tables)
        (count,) = self.lookup(groups, self.multiplicity)
        last = np.maximum(self.copy_offsets[1:] - 1, 0)
        found: list[tuple[Array, ...]] = []
        for j in range(self.comm.allreduce(int(count.max(initial=1)), op=MPI.MAX)):
            asked = position[count > j]
            jth = np.minimum(self.copy_offsets[:-1] + j, last)
            found.append((asked, *self.lookup(groups[asked], *(c[jth] for c in columns))))
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))

    def _find_groups(self, origin: Array, key: Array) -> None:
        """Find all copies of each node, which meet on the rank that their key names.

        It tells each, of those on boundaries of subdomains, the owner: that of the lowest.
        """
        decomposition = self.decomposition
        body = decomposition.body_of_subdomain[self.node_subdomain].astype(np.uint64)
        key = mix(mix(key) + body)  # a sum of both mixed is the same where numbers change places
        owner = np.full(self.num_nodes, self.comm.rank, dtype=np.int64)
        facets = np.union1d(decomposition.tears, decomposition.boundary).astype(np.int32)
        fdim = decomposition.mesh.topology.dim - 1
        on_facets = fem.locate_dofs_topological(self.V, fdim, facets, remote=False)
        shared = self.primal_node[on_facets]
        meeting = exchange_by_key(self.comm, key[shared])
        met, subdomain = meeting.send(key[shared]), meeting.send(self.node_subdomain[shared])
        order = np.lexsort((subdomain, met))
        _, start, inverse = np.unique(met[order], return_index=True, return_inverse=True)
        lowest = np.empty(len(met), dtype=np.int64)
        lowest[order] = meeting.source[order][start][inverse]
        owner[shared] = meeting.answer(lowest)
        exchange = Exchange(self.comm, owner)
        node = exchange.send(self.offsets[self.comm.rank] + np.arange(self.num_nodes))
        subdomain = exchange.send(self.node_subdomain)
        origin, key = exchange.send(origin), exchange.send(key)
        order = np.lexsort((subdomain, key, origin))
        first = np.ones(len(order), dtype=bool)
        first[1:] = key[order[1:]] != key[order[:-1]]
        slot = np.empty(len(order), dtype=np.int64)
        slot[order] = np.cumsum(first) - 1
        self.copies, self.copy_subdomains = node[order], subdomain[order]
        self.copy_offsets = np.append(np.flatnonzero(first), len(order))
        self.multiplicity = np.diff(self.copy_offsets)
        self.num_groups = len(self.multiplicity)
        self._to_owner, self._to_owner_slot, self._copy_order = exchange, slot, order
        self.group_offsets = chunk_offsets(self.comm, self.num_groups)
        self.group = exchange.answer(self.group_offsets[self.comm.rank] + slot)
