"""Physical groups, partitions and names of a gmsh model."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import named, shown
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.untorn import PhysicalNames

# --- Content of one gmsh model as arrays ------------------------------------------------------

# what gmsh calls the physical groups that it makes for partitions
PARTITION_GROUP = re.compile(r"_part\{\d+\}_physical\{(\d+)\}_dim\{(\d+)\}")


@dataclass(frozen=True)
class Elements:
    """Elements of one gmsh type: its number and name, nodes, ids, tags, partitions.

    The partition is -1 where gmsh has none.
    """

    kind: int
    kind_name: str
    nodes: Array
    ids: Array
    tags: Array
    partitions: Array


@dataclass(frozen=True)
class ModelContent:
    """Content of one gmsh model: elements in physical groups, names, nodes.

    Attributes:
        where: What messages call the model.
        top: Highest dimension of the physical groups, 0 if there are none.
        elements: Elements in physical groups, of this dimension and the one below.
        names: Names of the physical groups of each dimension.
        node_ids: Ids of the nodes of the elements of the highest dimension, ascending.
        x: Their coordinates, shape ``(p, 3)``.
        num_partitions: Number of partitions that gmsh knows of.
    """

    where: str
    top: int
    elements: dict[int, Elements]
    names: dict[int, dict[str, int]]
    node_ids: Array
    x: Array
    num_partitions: int


@contextmanager
def open_model(source: str | PathLike[str] | Any, may_be_empty: bool = False) -> Iterator[Any]:
    """The gmsh model of a file, closed afterwards; or the model itself.

    Args:
        source: A file, or a model.
        may_be_empty: Whether a file without nodes is a mesh.

    Raises:
        InputError: The file is missing or not a mesh.
    """
    import gmsh

    if not isinstance(source, (str, PathLike)):
        if not hasattr(source, "getPhysicalGroups"):
            raise InputError(
                f"source is {shown(source)}; expected a .msh file, or a gmsh model: gmsh.model"
            )
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
        if len(gmsh.model.mesh.getNodes()[0]) == 0 and not may_be_empty:
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


def read_content(model: Any, where: str) -> ModelContent:
    """Read the elements in physical groups, names and nodes of a gmsh model.

    Args:
        model: The gmsh model.
        where: What messages call it.

    Raises:
        InputError: An element lies in several physical groups, or the elements of a dimension
            are of several types.
    """
    with named("gmsh.model (is gmsh initialised, with a model in it?)"):
        top = max((dim for dim, _ in model.getPhysicalGroups()), default=0)
    elements = {}
    for dim in range(max(top - 1, 1), top + 1):
        found = _elements(model, dim)
        if found is not None:
            elements[dim] = found
    cells = elements.get(top)
    used = np.unique(cells.nodes if cells else np.empty(0, dtype=np.int64))
    return ModelContent(
        where=where,
        top=top,
        elements=elements,
        names={dim: _names(model, dim) for dim in (1, 2, 3)},
        node_ids=used,
        x=_coordinates(model, used),
        num_partitions=int(model.getNumberOfPartitions()),
    )


def concatenated(found: Sequence[Elements]) -> Elements:
    """Elements of one type in one; at least one."""
    arrays = {
        name: np.concatenate([getattr(elements, name) for elements in found])
        for name in ("nodes", "ids", "tags", "partitions")
    }
    return replace(found[0], **arrays)


def _names(model: Any, dim: int) -> dict[str, int]:
    """Return names of the physical groups of a dimension; without a name, their number."""
    names = {}
    for _, tag in model.getPhysicalGroups(dim):
        name = model.getPhysicalName(dim, tag)
        if not PARTITION_GROUP.fullmatch(name):
            names[name or str(tag)] = int(tag)
        elif tag_of := _original_physical_group(model, dim, tag):
            names.setdefault(model.getPhysicalName(dim, tag_of) or str(tag_of), tag_of)
    return names


def _original_physical_group(model: Any, dim: int, tag: int) -> int:
    """Return the group that a partition's group stands for, or the group itself."""
    match = PARTITION_GROUP.fullmatch(model.getPhysicalName(dim, tag))
    return int(match[1]) if match else int(tag)


def _elements(model: Any, dim: int) -> Elements | None:
    """All elements of a dimension that lie in physical groups; None if there are none.

    The ghost cells of gmsh's partitions lie in entities of their own, without a group.
    """
    found: list[Elements] = []
    for _, entity in model.getEntities(dim):
        of_entity = model.getPhysicalGroupsForEntity(dim, entity)
        if len(of_entity) == 0:  # of a partition the entity that it was cut from may have one
            parent_dim, parent = model.getParent(dim, entity)
            if parent_dim == dim:
                of_entity = model.getPhysicalGroupsForEntity(dim, parent)
        groups = {_original_physical_group(model, dim, tag) for tag in of_entity}
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
        for kind, kind_ids, kind_nodes in zip(kinds, ids, nodes, strict=True):
            n = len(kind_ids)
            found.append(
                Elements(
                    kind=int(kind),
                    kind_name=model.mesh.getElementProperties(kind)[0],
                    nodes=np.asarray(kind_nodes, dtype=np.int64).reshape(n, -1),
                    ids=np.asarray(kind_ids, dtype=np.int64),
                    tags=np.full(n, groups.copy().pop(), dtype=np.int32),
                    partitions=np.full(n, parts[0] if len(parts) == 1 else -1, dtype=np.int64),
                )
            )
    kind_names = {elements.kind: elements.kind_name for elements in found}
    if len(kind_names) > 1:
        raise InputError(
            f"elements of several types, {list(kind_names.values())}; expected one type of cell"
        )
    return concatenated(found) if found else None


def _coordinates(model: Any, node_ids: Array) -> Array:
    """Return coordinates of nodes, shape ``(p, 3)``."""
    if len(node_ids) == 0:
        return np.empty((0, 3))
    ids, x, _ = model.mesh.getNodes()
    order = np.argsort(ids)
    return x.reshape(-1, 3)[order[np.searchsorted(ids, node_ids, sorter=order)]]


# --- Names of physical groups, merged over ranks ----------------------------------------------

PhysicalGroup = tuple[int, int]  # dimension and tag


def physical_names(
    contents: Sequence[ModelContent], top: int, comm: MPI.Intracomm
) -> PhysicalNames:
    """Names of the physical groups of cells and facets in all models of all ranks. Collective.

    A model may know only some of them. One that a model knows only by its number has the name
    that another gives it.

    Args:
        contents: What this rank has read.
        top: Dimension of the cells.
        comm: Communicator.

    Raises:
        InputError: A name has different tags or dimensions in the models (unless one model has
            them all: gmsh lets a surface and a volume have the same name), or a tag different
            names.
    """
    # equal sets of names count once, so that what is gathered stays small
    own = {
        frozenset(
            (name, (d, tag))
            for d in (top - 1, top)
            for name, tag in content.names.get(d, {}).items()
        )
        for content in contents
    }
    every = set[frozenset[tuple[str, PhysicalGroup]]]().union(*comm.allgather(own))
    names = _checked_names(every)
    return PhysicalNames(
        surfaces={name: tag for (dim, tag), name in names.items() if dim == top - 1},
        volumes={name: tag for (dim, tag), name in names.items() if dim == top},
    )


def _checked_names(
    every: Iterable[frozenset[tuple[str, PhysicalGroup]]],
) -> dict[PhysicalGroup, str]:
    """Return the name of each physical group, sorted by dimension and tag."""
    pairs = sorted(set[tuple[str, PhysicalGroup]]().union(*every))
    names = {group: name for name, group in pairs if name == str(group[1])}
    given: dict[PhysicalGroup, str] = {}
    groups: dict[str, set[PhysicalGroup]] = {}
    for name, group in pairs:
        if name == str(group[1]):
            continue
        groups.setdefault(name, set()).add(group)
        if given.setdefault(group, name) != name:
            raise InputError(
                f"the physical group of {_described(group)} is named {given[group]!r} in one file "
                f"and {name!r} in another; expected one name"
            )
    for name, its_groups in groups.items():
        if not any(all((name, group) in content for group in its_groups) for content in every):
            said = " and ".join(_described(group) for group in sorted(its_groups))
            raise InputError(
                f"the name {name!r} stands for the physical groups of {said} in different "
                "files; expected one dimension and tag"
            )
    return dict(sorted({**names, **given}.items()))


def _described(group: PhysicalGroup) -> str:
    return f"dimension {group[0]} and tag {group[1]}"
