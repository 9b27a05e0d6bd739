"""Decomposition of a mesh that was made in DOLFINx."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap, original_cells
from tfeti_dolfinx.common.logging import stage
from tfeti_dolfinx.common.parallel import any_rank
from tfeti_dolfinx.common.validation import checked_type, is_whole, named
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition, check_tags, checked_names, flags_of
from tfeti_dolfinx.mesh.partition import DEFAULT, GivenSubdomains, check_partitioner
from tfeti_dolfinx.mesh.tearing import TORN, decomposed
from tfeti_dolfinx.mesh.untorn import NO_TAG, PhysicalNames, UntornMesh, cell_facets

CELL_TYPES = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")


# from coordinates, shape ``(3, n)``, to flags, as ``dolfinx.mesh.locate_entities`` takes it
Marker = Callable[[Array], Array]


class GmshData(Protocol):
    """Mesh with its tags and their names, as DOLFINx 0.10's ``dolfinx.io.gmsh`` returns it."""

    mesh: dmesh.Mesh
    cell_tags: dmesh.MeshTags | None
    facet_tags: dmesh.MeshTags | None
    physical_groups: Mapping[str, tuple[int, int]]


def decompose(
    mesh: dmesh.Mesh | GmshData,
    subdomains: GivenSubdomains | None = None,
    cell_tags: dmesh.MeshTags | None = None,
    facet_tags: dmesh.MeshTags | None = None,
    *,
    surfaces: Mapping[str, int | Marker] | None = None,
    volumes: Mapping[str, int | Marker] | None = None,
    partitioner: str = DEFAULT,
) -> Decomposition:
    """Tear a DOLFINx mesh into subdomains. Collective.

    Args:
        mesh: The mesh, distributed in any way; or the ``MeshData`` of ``dolfinx.io.gmsh``, whose
            tags and physical names are taken where none are given.
        subdomains: Number of subdomains; or one id for each cell owned by this rank; or a
            callable that gets cell midpoints, shape ``(3, n)``, and returns one id per cell.
            Default: about 4000 unknowns per subdomain.
        cell_tags: Material tags.
        facet_tags: Surface tags.
        surfaces: Names of surface tags; a tag that has none is named by its number. In the place
            of a tag a marker: it gets points, shape ``(3, n)``, and returns flags; the facets of
            the boundary all of whose vertices it flags become the surface.
        volumes: Names of cell tags, or markers of cells.
        partitioner: What makes a number of subdomains: ``"round"``, balanced k-means, where cells
            are flat bisection; ``"bisection"`` along coordinates; or one of those that DOLFINx was
            built with, ``"scotch"``, ``"parmetis"``, ``"kahip"``, whose cuts have few facets.

    Returns:
        The torn mesh. Which subdomain a cell belongs to does not depend on the number of ranks,
        but with DOLFINx's partitioners.

    Raises:
        InputError: The cells are not triangles, quadrilaterals, tetrahedra or hexahedra, or
            tags, names, subdomains or the partitioner do not fit.

    Example:
        >>> square = dmesh.create_unit_square(MPI.COMM_WORLD, 8, 8)
        >>> decomposition = tfeti.decompose(square, 4)
        >>> decomposition.num_subdomains, decomposition.num_bodies
        (4, 1)
        >>> named = tfeti.decompose(square, 4, surfaces={"top": lambda x: np.isclose(x[1], 1)})
        >>> named.surface("top")
        1
        >>> halves = tfeti.decompose(square, lambda x: x[0] > 0.5)
        >>> halves.num_subdomains
        2
    """
    if not isinstance(mesh, dmesh.Mesh) and hasattr(mesh, "physical_groups"):
        data, dim = mesh, mesh.mesh.topology.dim
        mesh = data.mesh
        cell_tags = data.cell_tags if cell_tags is None else cell_tags
        facet_tags = data.facet_tags if facet_tags is None else facet_tags
        groups = [(of, name, tag) for name, (of, tag) in data.physical_groups.items() if name]
        if surfaces is None:
            surfaces = {name: tag for of, name, tag in groups if of == dim - 1} or None
        if volumes is None:
            volumes = {name: tag for of, name, tag in groups if of == dim} or None
    mesh = _checked_mesh(mesh)
    tagged = ((cell_tags, True, "cell_tags"), (facet_tags, False, "facet_tags"))
    with agreeing(mesh.comm, "decompose") as given:
        check_partitioner(partitioner)
        for tags, of_cells, what in tagged:
            given[what] = "not given" if tags is None else "given"
            if tags is not None:
                check_tags(tags, mesh, of_cells, what, f"expected the {what} of the mesh given")
        number = subdomains if subdomains is None or is_whole(subdomains) else "for each cell"
        given |= {"surfaces": surfaces, "volumes": volumes, "number of subdomains": number}
        given["partitioner"] = partitioner
    surfaces, facet_tags = _located(mesh, surfaces, facet_tags, "surfaces")
    volumes, cell_tags = _located(mesh, volumes, cell_tags, "volumes")
    surfaces = checked_names(surfaces, "surfaces", facet_tags, "facet_tags")
    volumes = checked_names(volumes, "volumes", cell_tags, "cell_tags")
    seconds: dict[str, float] = {}
    with stage("mesh", seconds):
        topology = mesh.topology
        owned = topology.index_map(topology.dim).size_local
        untorn = UntornMesh(
            cell_type=topology.cell_type,
            element=mesh.ufl_domain().ufl_coordinate_element(),
            cells=geometry_dofmap(mesh)[:owned],
            cell_ids=original_cells(mesh)[:owned],
            cell_tags=_values(cell_tags, np.arange(owned)),
            facet_tags=_values(facet_tags, cell_facets(mesh)),
            node_ids=np.asarray(mesh.geometry.input_global_indices),
            x=mesh.geometry.x[:, : mesh.geometry.dim],
            names=PhysicalNames(
                _names(mesh, facet_tags, surfaces), _names(mesh, cell_tags, volumes)
            ),
        )
        decomposition = decomposed(untorn, subdomains, partitioner, mesh.comm)
    return replace(decomposition, seconds=seconds, untorn=mesh)


def _located(
    mesh: dmesh.Mesh, names: Any, tags: dmesh.MeshTags | None, what: str
) -> tuple[Any, dmesh.MeshTags | None]:
    """Give what markers locate tags of their own, above those that are there. Collective."""
    markers = {k: v for k, v in names.items() if callable(v)} if isinstance(names, Mapping) else {}
    if not markers:
        return names, tags
    facets, dim = what == "surfaces", mesh.topology.dim - (what == "surfaces")
    mesh.topology.create_entities(dim)
    mesh.topology.create_connectivity(dim, mesh.topology.dim)
    sizes = mesh.topology.index_map(dim)
    values = np.full(sizes.size_local + sizes.num_ghosts, NO_TAG, dtype=np.int32)
    if tags is not None:
        values[tags.indices] = tags.values
    names, taken = dict(names), [tag for tag in names.values() if is_whole(tag)]
    own = max([0, *taken, *([] if tags is None else tags.values.tolist())])
    tag = int(mesh.comm.allreduce(own, op=MPI.MAX))
    locate = dmesh.locate_entities_boundary if facets else dmesh.locate_entities
    for name in mesh.comm.bcast(list(markers)):  # ranks may order them differently
        flags = partial(flags_of, markers[name], what=f"{what}[{name!r}]")
        with raised_on_all_ranks(mesh.comm), named(f"{what}[{name!r}]"):
            found = locate(mesh, dim, flags)
        if not any_rank(mesh.comm, len(found) > 0):
            where = "facet of the boundary" if facets else "cell"
            raise InputError(f"{what}[{name!r}]: the marker finds no {where}")
        others = values[found][values[found] != NO_TAG]
        if any_rank(mesh.comm, len(others) > 0):
            other = int(mesh.comm.allreduce(int(others.max(initial=NO_TAG)), op=MPI.MAX))
            known = next((k for k, t in names.items() if not callable(t) and t == other), other)
            raise InputError(
                f"{what}[{name!r}]: the marker finds some that are {known!r}; expected each once: "
                "bodies that lie on each other are meshed a little apart, or come with tags"
            )
        tag += 1
        values[found], names[name] = tag, tag
    indices = np.flatnonzero(values != NO_TAG).astype(np.int32)
    return names, dmesh.meshtags(mesh, dim, indices, values[indices])


def _checked_mesh(mesh: Any) -> dmesh.Mesh:
    checked_type(mesh, dmesh.Mesh, "mesh", "a dolfinx.mesh.Mesh")
    topology, gdim = mesh.topology, mesh.geometry.dim
    if topology.cell_type.name not in CELL_TYPES or topology.dim != gdim:
        raise InputError(
            f"mesh of {topology.cell_type.name}s in {gdim}D: expected one of "
            f"{', '.join(CELL_TYPES)} in its own dimension"
        )
    if topology.index_map(topology.dim).size_global == 0:
        raise InputError("the mesh has no cells")
    with raised_on_all_ranks(mesh.comm):
        if mesh in TORN:
            raise InputError("mesh is torn already; expected the one before, of whole bodies")
        x = mesh.geometry.x
        if x.dtype != np.float64:
            raise InputError(f"mesh with coordinates of type {x.dtype}; expected float64")
        if not np.all(np.isfinite(x)):
            raise InputError(f"mesh with {np.sum(~np.isfinite(x))} coordinates that are not finite")
    return mesh


def _values(tags: dmesh.MeshTags | None, entities: Array) -> Array:
    """Tag of each entity, NO_TAG where there is none."""
    size = max(entities.max(initial=-1), -1 if tags is None else tags.indices.max(initial=-1)) + 1
    values = np.full(size, NO_TAG, dtype=np.int32)
    if tags is not None:
        values[tags.indices] = tags.values
    return values[entities]


def _names(mesh: dmesh.Mesh, tags: dmesh.MeshTags | None, given: dict[str, int]) -> dict[str, int]:
    """Return the names given, and for tags without a name their numbers."""
    local = set() if tags is None else set(np.unique(tags.values).tolist())
    present = set().union(*mesh.comm.allgather(local))
    return {**given, **{str(tag): tag for tag in sorted(present - set(given.values()))}}
