"""Meshes of gmsh: physical groups, partitions, names and split files, read and torn."""

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count, takewhile
from os import PathLike
from pathlib import Path
from typing import Any

import basix.ufl
import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import cell_permutation
from tfeti_dolfinx.common.logging import stage
from tfeti_dolfinx.common.parallel import box_over_ranks
from tfeti_dolfinx.common.validation import checked_type, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.partition import DEFAULT, GivenSubdomains, check_partitioner
from tfeti_dolfinx.mesh.tearing import decomposed
from tfeti_dolfinx.mesh.untorn import (
    NO_TAG,
    PhysicalNames,
    UntornMesh,
    equal_pairs,
    exchange_by_key,
    facet_keys,
    facet_vertices,
    mix,
    set_key,
)

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


# --- Split files of gmsh ----------------------------------------------------------------------

ONE_MODEL = "expected files that gmsh has written from one model with Mesh.PartitionSplitMeshFiles"


def find_split_files(source: str | PathLike[str] | Any, comm: MPI.Intracomm) -> list[Path]:
    """Return the files ``name_1.msh``, ``name_2.msh``, ... of a mesh; none of a model or one file.

    Collective. Only rank 0 looks, at the source that it was given.
    """
    files: list[Path] = []
    with raised_on_all_ranks(comm):
        if comm.rank == 0 and isinstance(source, (str, PathLike)):
            path = Path(source)
            parts = (path.parent / f"{path.stem}_{k}{path.suffix}" for k in count(1))
            files = [] if path.is_file() else list(takewhile(Path.is_file, parts))
    return comm.bcast(files, root=0)


def read_split_files(files: Sequence[Path], comm: MPI.Intracomm) -> list[ModelContent]:
    """Read this rank's files, a cell's partition being its file's number. Collective."""
    contents = []
    with raised_on_all_ranks(comm):
        for number, file in enumerate(files, start=1):
            if (number - 1) * comm.size // len(files) != comm.rank:
                continue
            # a partition may hold no element in a physical group: gmsh then writes no nodes
            with open_model(file, may_be_empty=True) as model:
                content = read_content(model, file.name)
            for elements in content.elements.values():
                elements.partitions[:] = number
            contents.append(content)
    known = comm.allreduce(max((c.num_partitions for c in contents), default=0), op=MPI.MAX)
    if known > len(files):
        stem = files[-1].stem.removesuffix(f"_{len(files)}")
        missing = files[-1].with_stem(f"{stem}_{len(files) + 1}")
        raise InputError(
            f"{missing}: no such file; expected one file for each of the {known} partitions"
        )
    return contents


def check_shared(
    mesh: UntornMesh,
    node_ids: Array,
    x: Array,
    extent: float,
    comm: MPI.Intracomm,
    same_place: float = 1e-9,
) -> None:
    """Raise an InputError unless the files are of one mesh. Collective.

    Nodes of one id, and cells of the same nodes, meet on the rank that the id or key names: a node
    may not lie at different places, nor a cell in two files. Ids and places are those of each file,
    one after the other; files in text keep fewer digits than gmsh has, so places are the same up to
    a share of the mesh's extent.
    """
    exchange = exchange_by_key(comm, node_ids)
    node_ids, x = exchange.send(node_ids), exchange.send(x)
    keys = set_key(mesh.node_ids[mesh.vertices])
    exchange = exchange_by_key(comm, keys)
    keys, cell_ids = exchange.send(keys), exchange.send(mesh.cell_ids)
    with raised_on_all_ranks(comm):
        first, second = equal_pairs(mix(node_ids))
        apart = np.abs(x[first] - x[second]).max(axis=1, initial=0.0) > same_place * extent
        if np.any(apart):
            i, j = first[apart][0], second[apart][0]
            raise InputError(
                f"node {node_ids[i]} lies at {x[i].tolist()} in one file and at {x[j].tolist()} "
                f"in another; {ONE_MODEL}"
            )
        first, second = equal_pairs(keys)
        if len(first):
            raise InputError(
                f"cells {cell_ids[first[0]]} and {cell_ids[second[0]]} have the same nodes; "
                f"{ONE_MODEL}"
            )


# --- Assembly of an untorn mesh from models on any ranks --------------------------------------

# gmsh's element types: DOLFINx's cell type and degree
CELLS = {
    "Triangle 3": ("triangle", 1),
    "Quadrilateral 4": ("quadrilateral", 1),
    "Tetrahedron 4": ("tetrahedron", 1),
    "Hexahedron 8": ("hexahedron", 1),
    "Triangle 6": ("triangle", 2),
    "Quadrilateral 9": ("quadrilateral", 2),
    "Tetrahedron 10": ("tetrahedron", 2),
    "Hexahedron 27": ("hexahedron", 2),
}


def untorn_mesh(
    contents: Sequence[ModelContent], comm: MPI.Intracomm, shared: bool
) -> tuple[UntornMesh, Array | None]:
    """Return the untorn mesh, and the partition of each cell if all cells have one. Collective.

    ``contents`` is what this rank has read, maybe nothing; shared models may have nodes and facets
    in common with those of other ranks.
    """
    top = comm.allreduce(max((content.top for content in contents), default=0), op=MPI.MAX)
    with_cells = [content for content in contents if top in content.elements]
    kind = _one_kind(with_cells, top, comm)
    shape, degree = CELLS[kind]
    cell_type = dmesh.to_type(shape)
    gdim = dmesh.cell_dim(cell_type)
    variant = basix.LagrangeVariant.equispaced  # as gmsh numbers the nodes
    element = basix.ufl.element("Lagrange", shape, degree, variant, shape=(gdim,))
    none = np.empty(0, dtype=np.int64)
    nodes = none.reshape(0, element.dim // gdim)
    empty = Elements(kind, nodes, none, none.astype(np.int32), none)
    found = concatenated([empty, *(content.elements[top] for content in with_cells)])
    facets = [content.elements[top - 1] for content in contents if top - 1 in content.elements]
    all_ids = np.concatenate([empty.ids, *(content.node_ids for content in with_cells)])
    all_x = np.concatenate([np.empty((0, 3)), *(content.x for content in with_cells)])
    node_ids, first = np.unique(all_ids, return_index=True)
    order = cell_permutation(cell_type, found.nodes.shape[1])
    cells = places(node_ids, found.nodes[:, order])
    mesh = UntornMesh(
        cell_type=cell_type,
        element=element,
        cells=cells,
        cell_ids=found.ids,
        cell_tags=found.tags,
        facet_tags=_facet_tags(cells, node_ids, cell_type, facets, comm if shared else None),
        node_ids=node_ids,
        x=np.ascontiguousarray(all_x[first, :gdim]),
        names=physical_names(contents, top, comm),
    )
    low, high = box_over_ranks(comm, all_x)
    sides = high - low
    if gdim == 2 and sides[2] > 1e-12 * sides.max():  # more than rounding
        raise InputError(
            "the physical groups have surfaces that do not lie in a plane z = constant, and no "
            "volumes; expected a group of the bodies, too (shells are not supported)"
        )
    if shared:
        check_shared(mesh, all_ids, all_x, float(sides.max()), comm)
    partitioned = comm.allreduce(bool(np.all(found.partitions >= 0)), op=MPI.LAND)
    return mesh, found.partitions if partitioned else None


def places(known: Array, ids: Array, wide: int = 4) -> Array:
    """Return where ids stand among those known, which ascend and have them all.

    Where most numbers in between are known, a table of them all says it; else a search, since the
    table might be ``wide`` times as long as what this rank has, or more.
    """
    least = int(known[0]) if len(known) else 0
    width = int(known[-1]) - least + 1 if len(known) else 0
    if width > wide * len(known):
        return np.searchsorted(known, ids)
    table = np.zeros(width, dtype=np.int64)
    table[known - least] = np.arange(len(known))
    return table[ids - least]


def _one_kind(contents: Sequence[ModelContent], top: int, comm: MPI.Intracomm) -> str:
    """Return gmsh's type of all cells of all ranks."""
    kinds: dict[str, str] = {}  # where each is
    own = [(content.elements[top].kind, content.where) for content in contents]
    for kind, where in (pair for of_rank in comm.allgather(own) for pair in of_rank):
        kinds.setdefault(kind, where)
    if not kinds or top < 2:
        raise InputError(
            "the mesh has no physical groups of cells; give the bodies (3D: volumes, 2D: "
            "surfaces) and the surfaces physical groups in gmsh"
        )
    if len(kinds) > 1:
        text = " and ".join(f"{kind!r} in {where}" for kind, where in kinds.items())
        raise InputError(f"cells of several types, {text}; expected one type of cell")
    (kind,) = kinds
    if kind not in CELLS:
        raise InputError(
            f"cells of type {kind!r} are not supported; expected triangles, quadrilaterals, "
            "tetrahedra or hexahedra of first or (complete) second order"
        )
    return kind


def _facet_tags(
    cells: Array,
    node_ids: Array,
    cell_type: dmesh.CellType,
    facets: Sequence[Elements],
    comm: MPI.Intracomm | None,
) -> Array:
    """Tag of each facet of each cell, ``(n, facets_per_cell)``, by the first element there.

    Both meet on the rank that their key names, without a communicator here. Collective.
    """
    width = facet_vertices(cell_type).shape[1]
    none = np.empty(0, dtype=np.uint64)
    known = np.concatenate([none, *(set_key(e.nodes[:, :width]) for e in facets)])
    tags = np.concatenate([np.empty(0, dtype=np.int32), *(elements.tags for elements in facets)])
    keys, meeting = facet_keys(cells, node_ids, cell_type), comm or MPI.COMM_SELF
    asking, telling = exchange_by_key(meeting, keys.ravel()), exchange_by_key(meeting, known)
    asked, known, tags = asking.send(keys.ravel()), telling.send(known), telling.send(tags)
    hits: Array = np.full(len(asked), NO_TAG, dtype=np.int32)
    if len(known):
        known, first = np.unique(known, return_index=True)
        # most facets have no tag: few of them share the lowest bits of their keys with one that has
        seen = np.zeros(16 << len(known).bit_length(), dtype=bool)
        low = np.uint64(len(seen) - 1)
        seen[known & low] = True
        some = np.flatnonzero(seen[asked & low])
        position = np.minimum(np.searchsorted(known, asked[some]), len(known) - 1)
        tagged = known[position] == asked[some]
        hits[some[tagged]] = tags[first[position[tagged]]]
    return asking.answer(hits).reshape(keys.shape)


# --- Meshes of gmsh: physical groups, partitions, node numbers --------------------------------


def read_gmsh(
    source: str | PathLike[str] | Any,
    comm: MPI.Intracomm,
    subdomains: GivenSubdomains | None = None,
    *,
    partitioner: str = DEFAULT,
) -> Decomposition:
    """Read a gmsh mesh and tear it into subdomains. Collective.

    Rank 0 reads; no other rank ever holds more than its own subdomains. If there is no file
    ``name.msh`` but there are the files ``name_1.msh``, ``name_2.msh``, ... that gmsh writes
    with ``Mesh.PartitionSplitMeshFiles``, one for each partition, then these are shared out
    evenly: of ``count`` files, rank ``floor((p - 1) * comm.size / count)`` reads the p-th, and
    no rank ever holds the whole mesh.

    Args:
        source: A ``.msh`` file, or a gmsh model (``gmsh.model``) that is meshed on rank 0.
        comm: Communicator of the torn mesh.
        subdomains: Their number; or one id per cell on rank 0, in gmsh's order, and empty arrays
            on others (for split files one id per cell of the files that this rank reads, in the
            order of the files and within a file in gmsh's order, without ghost cells); or a
            callable of cell midpoints, shape ``(3, n)``. Default: gmsh's own partitions if the
            mesh has them (split files: one subdomain per file), else about 4000 unknowns each.
        partitioner: What makes a number of subdomains, as for ``decompose``.

    Returns:
        The torn mesh, its tags and names those of the physical groups. Split files give the
        same as the partitioned mesh in one file.

    Raises:
        InputError: The file is missing or not a mesh, there are no physical groups of cells,
            the cells are of several types, or the subdomains do not fit. Of split files: one
            is missing, a name or a tag means different groups, a node has different
            coordinates, or a cell lies in two files.

    Example:
        gmsh meshes on rank 0; the other ranks give None.

        >>> import gmsh
        >>> comm, model = MPI.COMM_WORLD, None
        >>> if comm.rank == 0:
        ...     gmsh.initialize(interruptible=False)
        ...     gmsh.option.setNumber("General.Terminal", 0)
        ...     model = gmsh.model
        ...     plate = model.occ.addRectangle(0, 0, 0, 2, 1)
        ...     model.occ.synchronize()
        ...     steel = model.addPhysicalGroup(2, [plate], name="steel")
        ...     edges = model.addPhysicalGroup(1, [1, 2, 3, 4], name="edges")
        ...     model.mesh.generate(2)
        >>> decomposition = tfeti.read_gmsh(model, comm, subdomains=3)
        >>> decomposition.num_subdomains, decomposition.body_names
        (3, ["body 0 (volume 'steel')"])
    """
    checked_type(comm, MPI.Intracomm, "comm", "a communicator such as MPI.COMM_WORLD")
    with agreeing(comm, "read_gmsh") as given:
        check_partitioner(partitioner)
        given["partitioner"] = partitioner
    seconds: dict[str, float] = {}
    with stage("mesh", seconds):
        files, contents = find_split_files(source, comm), list[ModelContent]()
        if files:
            contents = read_split_files(files, comm)
        else:
            with raised_on_all_ranks(comm):
                if comm.rank == 0:
                    with open_model(source) as model:
                        contents.append(read_content(model, "the mesh"))
        untorn, partitions = untorn_mesh(contents, comm, shared=bool(files))
        subdomains = partitions if subdomains is None else subdomains
        decomposition = decomposed(untorn, subdomains, partitioner, comm, spread=not files)
    return replace(decomposition, seconds=seconds)
