"""Physical groups, partitions and names of a gmsh model."""

import logging
import re
from collections.abc import Iterator, Sequence
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

log = logging.getLogger(__name__)

# --- Content of one gmsh model as arrays ------------------------------------------------------

# what gmsh calls the physical groups that it makes for partitions
PARTITION_GROUP = re.compile(r"_part\{\d+\}_physical\{(\d+)\}_dim\{(\d+)\}")


@dataclass(frozen=True)
class Elements:
    """Elements of one gmsh type: its name, as "Triangle 3", nodes, ids, tags, partitions.

    The partition is -1 where gmsh has none.
    """

    kind: str
    nodes: Array
    ids: Array
    tags: Array
    partitions: Array


@dataclass(frozen=True)
class ModelContent:
    """Content of one gmsh model: elements in physical groups, names, nodes."""

    where: str  # what messages call the model
    top: int  # highest dimension of the physical groups, 0 if there are none
    # elements in physical groups, of this dimension and the one below
    elements: dict[int, Elements]
    names: dict[int, dict[str, int]]  # names of the physical groups of each dimension
    node_ids: Array  # ids of the nodes of the elements of the highest dimension, ascending
    x: Array  # their coordinates, shape (p, 3)
    num_partitions: int  # number of partitions that gmsh knows of


@contextmanager
def open_model(source: str | PathLike[str] | Any, may_be_empty: bool = False) -> Iterator[Any]:
    """Give the gmsh model of a file, closed afterwards; or the model itself.

    Raise an InputError where the file is missing or not a mesh, as without nodes unless it may be.
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
    """Read the elements in physical groups, names and nodes of a gmsh model."""
    with named("gmsh.model (is gmsh initialised, with a model in it?)"):
        top = max((dim for dim, _ in model.getPhysicalGroups()), default=0)
    found = {dim: _elements(model, dim) for dim in range(max(top - 1, 1), top + 1)}
    elements = {dim: of_dim for dim, of_dim in found.items() if of_dim is not None}
    used: Array = np.empty(0, dtype=np.int64)
    x: Array = np.empty((0, 3))
    if top in elements:
        used = np.unique(elements[top].nodes)
        ids, coordinates, _ = model.mesh.getNodes()
        order = np.argsort(ids)
        x = coordinates.reshape(-1, 3)[order[np.searchsorted(ids, used, sorter=order)]]
    return ModelContent(
        where=where,
        top=top,
        elements=elements,
        names={dim: _names(model, dim) for dim in (1, 2, 3)},
        node_ids=used,
        x=x,
        num_partitions=int(model.getNumberOfPartitions()),
    )


def concatenated(found: Sequence[Elements]) -> Elements:
    """Elements of one type in one; at least one."""
    names = ("nodes", "ids", "tags", "partitions")
    return replace(
        found[0], **{name: np.concatenate([getattr(e, name) for e in found]) for name in names}
    )


def _names(model: Any, dim: int) -> dict[str, int]:
    """Return names of the physical groups of a dimension; without a name, their number."""
    names = {}
    for _, tag in model.getPhysicalGroups(dim):
        name = model.getPhysicalName(dim, tag)
        if not (match := PARTITION_GROUP.fullmatch(name)):
            names[name or str(tag)] = int(tag)
        elif tag_of := int(match[1]):
            names.setdefault(model.getPhysicalName(dim, tag_of) or str(tag_of), tag_of)
    return names


def _elements(model: Any, dim: int) -> Elements | None:
    """All elements of a dimension that lie in physical groups, no ghost cells; None if none do."""
    found: list[Elements] = []
    for _, entity in model.getEntities(dim):
        of_entity = model.getPhysicalGroupsForEntity(dim, entity)
        if len(of_entity) == 0:  # of a partition the entity that it was cut from may have one
            parent_dim, parent = model.getParent(dim, entity)
            if parent_dim == dim:
                of_entity = model.getPhysicalGroupsForEntity(dim, parent)
        matches = [PARTITION_GROUP.fullmatch(model.getPhysicalName(dim, t)) for t in of_entity]
        groups = {int(m[1] if m else t) for m, t in zip(matches, of_entity, strict=True)}
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
                    kind=model.mesh.getElementProperties(kind)[0],
                    nodes=np.asarray(kind_nodes, dtype=np.int64).reshape(n, -1),
                    ids=np.asarray(kind_ids, dtype=np.int64),
                    tags=np.full(n, min(groups), dtype=np.int32),
                    partitions=np.full(n, parts[0] if len(parts) == 1 else -1, dtype=np.int64),
                )
            )
    kinds = list(dict.fromkeys(elements.kind for elements in found))
    if len(kinds) > 1:
        raise InputError(f"elements of several types, {kinds}; expected one type of cell")
    return concatenated(found) if found else None


# --- Names of physical groups, merged over ranks ----------------------------------------------


def physical_names(
    contents: Sequence[ModelContent], top: int, comm: MPI.Intracomm
) -> PhysicalNames:
    """Return the names of the groups of cells and facets in all models of all ranks. Collective.

    A model may know only some of them. One that a model knows only by its number has the name
    that another gives it. Raise an InputError where a name of surfaces or of volumes has different
    tags in the models, or a tag different names.
    """
    own = [
        {(t, n) for c in contents for n, t in c.names.get(d, {}).items()} for d in (top - 1, top)
    ]
    gathered = comm.allgather(own)
    surfaces, volumes = (
        _merged_names(sorted(set().union(*(names[k] for names in gathered))), top - 1 + k)
        for k in (0, 1)
    )
    for what, names in (("facets", surfaces), ("cells", volumes)):
        nameless = [tag for name, tag in names.items() if name == str(tag)]
        if comm.rank == 0 and 0 < len(nameless) < len(names):
            log.warning(
                "physical groups of %s without a name, where others have one: %s; a name that is "
                "given to a second group is lost in gmsh: put all entities into one group",
                what,
                nameless,
            )
    return PhysicalNames(surfaces, volumes)


def _merged_names(pairs: list[tuple[int, str]], dim: int) -> dict[str, int]:
    """Return the names of all groups of a dimension, from tags and names of some models each."""
    given = [(tag, name) for tag, name in pairs if name != str(tag)]
    name_of, tag_of = dict(given), {name: tag for tag, name in given}
    for tag, name in given:
        group = f"dimension {dim} and tag {tag}"
        if name_of[tag] != name:
            raise InputError(
                f"the physical group of {group} is named {name!r} in one file and "
                f"{name_of[tag]!r} in another; expected one name"
            )
        if tag_of[name] != tag:
            raise InputError(
                f"the name {name!r} stands for the physical groups of {group} and dimension {dim} "
                f"and tag {tag_of[name]} in different files; expected one tag"
            )
    return {name_of.get(tag, name): tag for tag, name in pairs}
