"""The torn mesh with its subdomains, bodies and tags."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem, la
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array, ArrayLike
from tfeti_dolfinx.common.compat import original_cells
from tfeti_dolfinx.common.parallel import Exchange
from tfeti_dolfinx.common.validation import checked_callable, checked_type, is_whole, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.untorn import PhysicalNames, facet_points

# --- Functions on the mesh before and the torn one --------------------------------------------


class CellExchange:
    """Rows of values that travel between the cells of two meshes. All is collective.

    The torn mesh has the cells of the one before on other ranks and in another order, but each with
    its vertices in the same order: a reference cell's points are those of the other's. ``ids`` are
    the original ids of the cells of the torn mesh, shape ``(n,)``.
    """

    def __init__(self, untorn: dmesh.Mesh, ids: Array) -> None:
        comm, topology = untorn.comm, untorn.topology
        self._num_cells = topology.index_map(topology.dim).size_local
        known = original_cells(untorn)[: self._num_cells]
        asking, telling = Exchange(comm, ids % comm.size), Exchange(comm, known % comm.size)
        known, cell = telling.send(known), telling.send(np.arange(self._num_cells))
        order = np.argsort(known)
        found = order[np.searchsorted(known, asking.send(ids), sorter=order)]
        self._from_owner = Exchange(comm, asking.answer(telling.source[found]))
        self._cell = self._from_owner.send(asking.answer(cell[found]))

    def to_torn(self, rows: Array) -> Array:
        """Return rows of the owned cells of the untorn mesh as those of the torn one's cells."""
        return self._from_owner.answer(rows[self._cell])

    def to_untorn(self, rows: Array) -> Array:
        """Return rows of the cells of the torn mesh as those of the untorn one's owned cells."""
        out = np.empty((self._num_cells, *rows.shape[1:]), dtype=rows.dtype)
        out[self._cell] = self._from_owner.send(rows)
        return out


def check_function(f: Any, mesh: dmesh.Mesh, name: str, expected: str) -> None:
    """Raise an InputError unless f is a function on a mesh whose unknowns are values.

    Those of a cell are then those of a cell like it. ``name`` and ``expected`` are for messages.
    """
    checked_type(f, fem.Function, name, f"a dolfinx.fem.Function on {expected}")
    if f.function_space.mesh._cpp_object is not mesh._cpp_object:
        raise InputError(f"{name} is on another mesh; expected a function on {expected}")
    if f.function_space.element.needs_dof_transformations:
        raise InputError(
            f"{name} is from {f.function_space.ufl_element()}, whose unknowns depend on the "
            "directions of edges and facets; expected a Lagrange, DG or quadrature space"
        )


def carried(
    given: fem.Function, mesh: dmesh.Mesh, exchange: Callable[[Array], Array]
) -> fem.Function:
    """Return a function on the other mesh, in a space of the same element. Collective.

    The exchange takes rows of its cells to those of the other mesh, where the result has the same
    unknowns in the cells, or their means.
    """
    g = given.collapse() if given.function_space.component() else given
    V, source = g.function_space, g.copy().x
    source.scatter_forward()
    values = exchange(source.array.reshape(-1, V.dofmap.bs)[_owned_dofs(V)])
    W = fem.functionspace(mesh, V.ufl_element())
    f, apart, number = (fem.Function(W, dtype=values.dtype) for _ in range(3))
    x, sums, counts = (h.x.array.reshape(-1, W.dofmap.bs) for h in (f, apart, number))
    dofs = _owned_dofs(W)
    x[dofs] = values
    f.x.scatter_forward()
    np.add.at(sums, dofs, values - x[dofs])  # 0 but for rounding where f is continuous
    np.add.at(counts, dofs, 1.0)
    for h in (apart, number):
        h.x.scatter_reverse(la.InsertMode.add)
        h.x.scatter_forward()
    x += sums / counts
    f.name = given.name
    return f


def _owned_dofs(V: fem.FunctionSpace) -> Array:
    """Return the blocks of unknowns of each owned cell, shape ``(n, m)``."""
    topology = V.mesh.topology
    return np.asarray(V.dofmap.list)[: topology.index_map(topology.dim).size_local]


# --- Checks of tags and names -----------------------------------------------------------------


def check_tags(tags: Any, mesh: dmesh.Mesh, of_cells: bool, what: str, expected: str) -> None:
    """Raise an InputError unless tags are those of a mesh's cells, or of its facets."""
    checked_type(tags, dmesh.MeshTags, what, "dolfinx.mesh.MeshTags")
    if tags.topology is not mesh.topology._cpp_object:
        raise InputError(f"{what} are tags of another mesh; {expected}")
    dim = mesh.topology.dim - (0 if of_cells else 1)
    if tags.dim != dim:
        raise InputError(
            f"{what} are tags of entities of dimension {tags.dim}, not {dim}; {expected}"
        )


def checked_names(names: Any, what: str, tags: Any, tags_name: str) -> dict[str, int]:
    """Return names of tags as a dictionary; raise an InputError unless they are such names."""
    if names is None:
        return {}
    checked_type(names, dict, what, "a dictionary of names and tags, such as {'top': 1}")
    for name, tag in names.items():
        if not isinstance(name, str) or not is_whole(tag):
            raise InputError(
                f"{what} has {shown(name)}: {shown(tag)}; expected a name and its tag, 'top': 1"
            )
    if names and tags is None:
        raise InputError(f"{what}={shown(names)} without {tags_name}; expected the tags they name")
    return {name: int(tag) for name, tag in names.items()}


# --- The decomposition: torn mesh, subdomains, bodies, tags -----------------------------------


@dataclass(frozen=True)
class Decomposition:
    """A mesh torn along its subdomain interfaces.

    A subdomain's cells are all on one rank, and no vertex belongs to two subdomains.

    Attributes:
        mesh: The torn DOLFINx mesh, on the communicator it was read on, without ghosts.
        cell_tags: Material tags.
        facet_tags: Surface tags.
        names: Names of the physical groups.
        cell_subdomain: Subdomain of each local cell, shape ``(num_cells,)``.
        original_cells: Original id of each local cell, shape ``(num_cells,)``.
        original_nodes: Original id of each local geometry node, shape ``(num_nodes,)``.
        body_of_subdomain: Body of every subdomain, the same on all ranks, shape ``(N,)``.
        tears: Local facets on the tears, ascending.
        boundary: Local facets on the true boundary, ascending.
        split: New ids of each subdomain that was not connected and was split.
        seconds: Wall seconds that reading and tearing took.
        untorn: The mesh that was given to ``decompose``; None of ``read_gmsh``.
    """

    mesh: dmesh.Mesh
    cell_tags: dmesh.MeshTags
    facet_tags: dmesh.MeshTags
    names: PhysicalNames
    cell_subdomain: Array
    original_cells: Array
    original_nodes: Array
    body_of_subdomain: Array
    tears: Array
    boundary: Array
    split: dict[int, list[int]]
    seconds: dict[str, float] = field(default_factory=dict)
    untorn: dmesh.Mesh | None = None

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator of the mesh."""
        return self.mesh.comm

    @property
    def num_subdomains(self) -> int:
        """Number of subdomains on all ranks."""
        return len(self.body_of_subdomain)

    @property
    def num_bodies(self) -> int:
        """Number of bodies, parts of the untorn mesh connected through facets."""
        return int(self.body_of_subdomain.max()) + 1

    @property
    def subdomains(self) -> Array:
        """Subdomains of this rank, ascending."""
        return np.unique(self.cell_subdomain)

    @property
    def is_torn(self) -> bool:
        """True if some body consists of more than one subdomain."""
        return self.num_subdomains > self.num_bodies

    @cached_property
    def body_names(self) -> list[str]:
        """A name for each body, with the volumes that it consists of. Collective at first use."""
        body = self.body_of_subdomain[self.cell_subdomain[self.cell_tags.indices]]
        pairs = np.unique(np.stack((body, self.cell_tags.values), axis=1), axis=0)
        volume = {tag: repr(name) for name, tag in self.names.volumes.items()}
        of_body: list[list[str]] = [[] for _ in range(self.num_bodies)]
        for b, tag in np.unique(np.concatenate(self.comm.allgather(pairs)), axis=0).tolist():
            of_body[b].append(volume[tag])
        return [
            f"body {b} (volume {', '.join(own)})" if own else f"body {b}"
            for b, own in enumerate(of_body)
        ]

    def surface(self, name: str | int) -> int:
        """Tag of a surface, given its name or its tag.

        Raises:
            InputError: There is no such surface.
        """
        return _tag(name, self.names.surfaces, "surface")

    def volume(self, name: str | int) -> int:
        """Tag of a volume (in 2D: of a plane region), given its name or its tag.

        Raises:
            InputError: There is no such volume.
        """
        return _tag(name, self.names.volumes, "volume")

    def facets(self, name: str | int) -> Array:
        """Local facets of a surface, ascending."""
        return self.facet_tags.find(self.surface(name))

    def cells(self, name: str | int) -> Array:
        """Local cells of a volume, ascending."""
        return self.cell_tags.find(self.volume(name))

    def locate_facets(self, marker: Callable[[Array], ArrayLike]) -> Array:
        """Return local facets of the true boundary whose vertices are marked. Collective.

        To ``dolfinx.mesh.locate_entities_boundary`` tears are boundary, too. All facets of the
        true boundary are ``boundary``.

        Args:
            marker: From points, shape ``(3, n)``, to flags, shape ``(n,)``.

        Returns:
            The facets, ascending.

        Raises:
            InputError: The marker cannot be called, fails or does not return flags.

        Example:
            >>> square = dmesh.create_unit_square(MPI.COMM_WORLD, 8, 8)
            >>> decomposition = tfeti.decompose(square, 4)
            >>> left = decomposition.locate_facets(lambda x: x[0] < 0.3)
            >>> decomposition.comm.allreduce(len(left))
            12
        """
        with agreeing(self.comm, "locate_facets") as given:
            given["marker"] = marker
            checked_callable(marker, "marker", "a function of points of shape (3, n)")
        facets, nodes = self.boundary.astype(np.int32), facet_points(self.mesh, self.boundary)
        with raised_on_all_ranks(self.comm):
            if len(facets) == 0:
                return facets
            used, corner = np.unique(nodes, return_inverse=True)
            flags = flags_of(marker, self.mesh.geometry.x[used].T, "marker")
        return facets[np.all(flags[corner.reshape(nodes.shape)], axis=1)]

    def from_original(self, f: fem.Function) -> fem.Function:
        """Return on the torn mesh what is on the mesh given to ``decompose``. Collective.

        DOLFINx's ``interpolate`` between the two meshes may give wrong values and no error.

        Args:
            f: A function from any space whose unknowns do not depend on the directions of edges
                and facets: Lagrange, DG, quadrature, of any degree and shape.

        Returns:
            The same function, from a space of the same element. It is a copy.

        Raises:
            InputError: ``f`` is no such function, or the mesh was read by ``read_gmsh``.

        Example:
            >>> square = dmesh.create_unit_square(MPI.COMM_WORLD, 8, 8)
            >>> decomposition = tfeti.decompose(square, 4)
            >>> T = fem.Function(fem.functionspace(square, ("Lagrange", 1)))
            >>> T.interpolate(lambda x: 20.0 + x[0])
            >>> decomposition.from_original(T).function_space.mesh is decomposition.mesh
            True
        """
        expected = "the mesh that was given to decompose"
        with agreeing(self.comm, "from_original") as given:
            given["f"] = f
            check_function(f, self._untorn_mesh(), "f", expected)
        return carried(f, self.mesh, self._cells.to_torn)

    def to_original(self, u: fem.Function) -> fem.Function:
        """Return on the mesh given to ``decompose`` what is on the torn one. Collective.

        Args:
            u: A function as for ``from_original``. Where it jumps at a tear, or two bodies share a
                node that is no tear, a continuous space gets the mean of the cells there.

        Returns:
            The same function, from a space of the same element. It is a copy.

        Raises:
            InputError: ``u`` is no such function, or the mesh was read by ``read_gmsh``.
        """
        with agreeing(self.comm, "to_original") as given:
            given["u"], untorn = u, self._untorn_mesh()
            check_function(u, self.mesh, "u", "decomposition.mesh, the torn mesh")
        return carried(u, untorn, self._cells.to_untorn)

    def _untorn_mesh(self) -> dmesh.Mesh:
        if self.untorn is None:
            raise InputError(
                "there is no mesh before it was torn: read_gmsh makes none; expected a "
                "decomposition that decompose made, of a mesh that DOLFINx has read"
            )
        return self.untorn

    @cached_property
    def _cells(self) -> CellExchange:
        return CellExchange(self._untorn_mesh(), self.original_cells)


def flags_of(marker: Callable[[Array], ArrayLike], x: Array, what: str) -> Array:
    """Return a marker's flags at points, shape ``(3, n)``; DOLFINx would take numbers, too."""
    with named(what):
        flags = np.asarray(marker(x))
    if flags.dtype != bool or flags.shape != x.shape[1:]:
        raise InputError(
            f"{what}: expected flags of shape {x.shape[1:]} for points of shape {x.shape}, "
            f"got {flags.dtype} of shape {flags.shape}"
        )
    return flags


def _tag(name: str | int, names: dict[str, int], kind: str) -> int:
    if is_whole(name) and int(name) in names.values():
        return int(name)
    if isinstance(name, str) and name in names:
        return names[name]
    if not is_whole(name) and not isinstance(name, str):
        hint = "; a shape is met by an Obstacle" if hasattr(name, "distance") else ""
        raise InputError(f"{kind} {shown(name)}: expected the name or the tag of one {kind}{hint}")
    raise InputError(f"no {kind} {name!r} in the mesh; its {kind}s are: {known_tags(names)}")


def known_tags(names: dict[str, int]) -> str:
    """Return names and tags for messages."""
    return ", ".join(f"{n!r} ({t})" for n, t in names.items()) or "none"
