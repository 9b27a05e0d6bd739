"""Meshes that gmsh made: physical groups, partitions, and the nodes' own numbers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import cell_permutation, coordinate_element
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.entities import NO_TAG, cell_dim, facet_keys, facet_vertices, set_key
from tfeti_dolfinx.mesh.partition import Subdomains, assign_subdomains, default_count, metis
from tfeti_dolfinx.mesh.tearing import tear
from tfeti_dolfinx.mesh.untorn import GroupNames, UntornMesh
from tfeti_dolfinx.timing import stage

# gmsh's element types: DOLFINx's cell type and degree
CELLS = {
    2: ("triangle", 1),
    3: ("quadrilateral", 1),
    4: ("tetrahedron", 1),
    5: ("hexahedron", 1),
    9: ("triangle", 2),
    10: ("quadrilateral", 2),
    11: ("tetrahedron", 2),
    12: ("hexahedron", 2),
}
# what gmsh calls the physical groups that it makes for partitions
PARTITION_GROUP = re.compile(r"_part\{\d+\}_physical\{(\d+)\}_dim\{(\d+)\}")


@dataclass(frozen=True)
class _Elements:
    """Elements of one dimension in physical groups: gmsh type, nodes, tags, partitions."""

    kind: int
    nodes: Array
    ids: Array
    tags: Array
    partitions: Array


def read_gmsh(
    source: str | PathLike[str] | Any,
    comm: MPI.Intracomm,
    subdomains: Subdomains | None = None,
) -> Decomposition:
    """Read a gmsh mesh and tear it into subdomains. Collective.

    Rank 0 reads; no other rank ever holds more than its own subdomains.

    Args:
        source: A ``.msh`` file, or a gmsh model (``gmsh.model``) that is meshed on rank 0.
        comm: Communicator of the torn mesh.
        subdomains: Their number (METIS); or one id per cell on rank 0, in gmsh's order, and
            empty arrays elsewhere; or a callable of cell midpoints, shape ``(3, n)``. Default:
            gmsh's own partitions if the mesh has them, else about 4000 unknowns each.

    Returns:
        The torn mesh, its tags and names those of the physical groups.

    Raises:
        InputError: The file is missing or not a mesh, there are no physical groups of cells,
            the cells are of several types, or the subdomains do not fit.
    """
    seconds: dict[str, float] = {}
    with stage("mesh", seconds):
        decomposition = _read_and_tear(source, comm, subdomains)
    return replace(decomposition, seconds=seconds)


def _read_and_tear(
    source: Any, comm: MPI.Intracomm, subdomains: Subdomains | None
) -> Decomposition:
    partitions: Array | None = None
    untorn = None
    with raised_on_all_ranks(comm):
        if comm.rank == 0:
            with _model(source) as model:
                untorn, partitions = _read(model)
    description = comm.bcast(None if untorn is None else _describe(untorn), root=0)
    untorn = untorn or _empty(*description)
    if subdomains is None and comm.bcast(partitions is not None, root=0):
        subdomains = np.empty(0, dtype=np.int64) if partitions is None else partitions
    elif subdomains is None:
        subdomains = default_count(untorn, comm)
    return tear(untorn, assign_subdomains(untorn, subdomains, comm, metis), comm)


@contextmanager
def _model(source: str | PathLike[str] | Any) -> Iterator[Any]:
    """The gmsh model of a file, closed afterwards; or the model itself."""
    import gmsh

    if not isinstance(source, (str, PathLike)):
        yield source
        return
    path = Path(source)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a gmsh mesh")
    started = not gmsh.isInitialized()
    if started:
        gmsh.initialize(interruptible=False)
    verbose = gmsh.option.getNumber("General.Terminal")
    previous = gmsh.model.getCurrent()
    gmsh.option.setNumber("General.Terminal", 0)
    name = f"tfeti:{path}"
    gmsh.model.add(name)
    try:
        try:
            gmsh.merge(str(path))
        except Exception as error:
            raise InputError(f"{path}: gmsh cannot read it as a mesh ({error})") from error
        if len(gmsh.model.mesh.getNodes()[0]) == 0:
            raise InputError(f"{path}: not a mesh, gmsh finds no nodes in it")
        yield gmsh.model
    finally:
        gmsh.model.setCurrent(name)
        gmsh.model.remove()
        gmsh.option.setNumber("General.Terminal", verbose)
        if started:
            gmsh.finalize()
        else:
            gmsh.model.setCurrent(previous)


def _read(model: Any) -> tuple[UntornMesh, Array | None]:
    """The whole mesh, and gmsh's partition of each cell if it has partitions."""
    cells = _elements(model, _top_dimension(model))
    if cells is None:
        raise InputError(
            "the mesh has no physical groups of cells; give the bodies (3D: volumes, 2D: "
            "surfaces) and the surfaces physical groups in gmsh"
        )
    if cells.kind not in CELLS:
        name = model.mesh.getElementProperties(cells.kind)[0]
        raise InputError(
            f"cells of type {name!r} are not supported; expected triangles, quadrilaterals, "
            "tetrahedra or hexahedra of first or (complete) second order"
        )
    shape, degree = CELLS[cells.kind]
    cell_type = dmesh.to_type(shape)
    tdim = cell_dim(cell_type)
    nodes = cells.nodes[:, cell_permutation(cell_type, cells.nodes.shape[1])]
    node_ids, x = _nodes(model, np.unique(nodes), tdim)
    facets = _elements(model, tdim - 1)
    untorn = UntornMesh(
        cell_type=cell_type,
        element=coordinate_element(cell_type, degree, x.shape[1]),
        cells=nodes,
        cell_ids=cells.ids,
        cell_tags=cells.tags,
        facet_tags=_facet_tags(nodes, cell_type, facets),
        node_ids=node_ids,
        x=x,
        names=GroupNames(surfaces=_names(model, tdim - 1), volumes=_names(model, tdim)),
    )
    return untorn, cells.partitions if np.all(cells.partitions >= 0) else None


def _top_dimension(model: Any) -> int:
    return max((dim for dim, _ in model.getPhysicalGroups()), default=0)


def _names(model: Any, dim: int) -> dict[str, int]:
    """Names of the physical groups of a dimension; without a name, their number."""
    names = {}
    for _, tag in model.getPhysicalGroups(dim):
        name = model.getPhysicalName(dim, tag)
        if not PARTITION_GROUP.fullmatch(name):
            names[name or str(tag)] = int(tag)
        elif tag_of := _original_group(model, dim, tag):
            names.setdefault(model.getPhysicalName(dim, tag_of) or str(tag_of), tag_of)
    return names


def _original_group(model: Any, dim: int, tag: int) -> int:
    """The group that a partition's group stands for, or the group itself."""
    match = PARTITION_GROUP.fullmatch(model.getPhysicalName(dim, tag))
    return int(match[1]) if match else int(tag)


def _groups(model: Any, dim: int, entity: int) -> set[int]:
    """Physical groups of an entity, or of the entity that gmsh partitioned it from."""
    groups = model.getPhysicalGroupsForEntity(dim, entity)
    if len(groups) == 0:
        parent_dim, parent = model.getParent(dim, entity)
        if parent_dim == dim:
            groups = model.getPhysicalGroupsForEntity(dim, parent)
    return {_original_group(model, dim, tag) for tag in groups}


def _elements(model: Any, dim: int) -> _Elements | None:
    """All elements of a dimension that lie in physical groups; None if there are none."""
    found: list[_Elements] = []
    for _, entity in model.getEntities(dim):
        groups = _groups(model, dim, entity)
        kinds, ids, nodes = model.mesh.getElements(dim, entity)
        if not groups or len(kinds) == 0:
            continue
        if len(groups) > 1:
            names = sorted(model.getPhysicalName(dim, tag) or str(tag) for tag in groups)
            raise InputError(
                f"elements of dimension {dim} lie in several physical groups, {names}; "
                "expected at most one, since a cell or facet has one tag"
            )
        parts = model.getPartitions(dim, entity)
        partition = int(parts[0]) if len(parts) == 1 else -1
        for kind, kind_ids, kind_nodes in zip(kinds, ids, nodes, strict=True):
            n = len(kind_ids)
            found.append(
                _Elements(
                    kind=int(kind),
                    nodes=np.asarray(kind_nodes, dtype=np.int64).reshape(n, -1),
                    ids=np.asarray(kind_ids, dtype=np.int64),
                    tags=np.full(n, groups.copy().pop(), dtype=np.int32),
                    partitions=np.full(n, partition, dtype=np.int64),
                )
            )
    return _joined(model, found) if found else None


def _joined(model: Any, found: list[_Elements]) -> _Elements:
    kinds = sorted({part.kind for part in found})
    if len(kinds) > 1:
        names = [model.mesh.getElementProperties(kind)[0] for kind in kinds]
        raise InputError(f"elements of several types, {names}; expected one type of cell")
    arrays = {
        name: np.concatenate([getattr(part, name) for part in found])
        for name in ("nodes", "ids", "tags", "partitions")
    }
    return _Elements(kind=kinds[0], **arrays)


def _nodes(model: Any, used: Array, tdim: int) -> tuple[Array, Array]:
    """Ids of the nodes used, ascending, and their coordinates, in 2D without z."""
    ids, x, _ = model.mesh.getNodes()
    order = np.argsort(ids)
    x = x.reshape(-1, 3)[order[np.searchsorted(ids, used, sorter=order)]]
    if tdim == 2 and np.ptp(x[:, 2]) > 1e-12 * np.ptp(x, axis=0).max():
        raise InputError("plane cells that do not lie in a plane z = constant: shells are not")
    return used.astype(np.int64), np.ascontiguousarray(x[:, :tdim])


def _facet_tags(cells: Array, cell_type: dmesh.CellType, facets: _Elements | None) -> Array:
    """Tag of each facet of each cell, shape ``(n, facets_per_cell)``."""
    keys = facet_keys(cells, cell_type)
    tags = np.full(keys.shape, NO_TAG, dtype=np.int32)
    if facets is None:
        return tags
    corners = facet_vertices(cell_type).shape[1]
    known, first = np.unique(set_key(facets.nodes[:, :corners]), return_index=True)
    position = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    hit = known[position] == keys
    tags[hit] = facets.tags[first[position[hit]]]
    return tags


def _describe(untorn: UntornMesh) -> tuple[str, int, int, GroupNames]:
    """What the ranks that do not read must know."""
    return untorn.cell_type.name, untorn.degree, untorn.gdim, untorn.names


def _empty(shape: str, degree: int, gdim: int, names: GroupNames) -> UntornMesh:
    """A share without cells."""
    cell_type = dmesh.to_type(shape)
    element = coordinate_element(cell_type, degree, gdim)
    no_tags = np.empty(0, dtype=np.int32)
    return UntornMesh(
        cell_type=cell_type,
        element=element,
        cells=np.empty((0, element.dim // gdim), dtype=np.int64),
        cell_ids=np.empty(0, dtype=np.int64),
        cell_tags=no_tags,
        facet_tags=no_tags.reshape(0, len(facet_vertices(cell_type))),
        node_ids=np.empty(0, dtype=np.int64),
        x=np.empty((0, gdim)),
        names=names,
    )
