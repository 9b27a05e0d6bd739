"""What gmsh models on any ranks hold, joined to one untorn mesh."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.compat import cell_permutation, coordinate_element
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.entities import NO_TAG, cell_dim, facet_keys, facet_vertices, set_key
from tfeti_dolfinx.mesh.gmsh.model import Elements, ModelContent, concatenated
from tfeti_dolfinx.mesh.gmsh.names import physical_names
from tfeti_dolfinx.mesh.gmsh.split import check_shared
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import Exchange, box_over_ranks

# of the mesh's size: what rounding of coordinates leaves of a plane mesh's height
FLAT = 1e-12
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


def untorn_mesh(
    contents: Sequence[ModelContent], comm: MPI.Intracomm, shared: bool
) -> tuple[UntornMesh, Array | None]:
    """The untorn mesh, and the partition of each cell if all cells have one. Collective.

    Args:
        contents: What this rank has read, maybe nothing.
        comm: Communicator.
        shared: Whether models of different ranks may have nodes and facets in common.

    Raises:
        InputError: There are no physical groups of cells, the cells are of several types or
            of one that is not supported, plane cells do not lie in a plane, names contradict
            each other, or the models do not fit together.
    """
    top = comm.allreduce(max((content.top for content in contents), default=0), op=MPI.MAX)
    with_cells = [content for content in contents if top in content.elements]
    kind, kind_name = _one_kind(with_cells, top, comm)
    shape, degree = CELLS[kind]
    cell_type = dmesh.to_type(shape)
    gdim = cell_dim(cell_type)
    element = coordinate_element(cell_type, degree, gdim)
    empty = _no_elements(kind, kind_name, element.dim // gdim)
    found = concatenated([empty, *(content.elements[top] for content in with_cells)])
    cells = found.nodes[:, cell_permutation(cell_type, found.nodes.shape[1])]
    facets = [content.elements[top - 1] for content in contents if top - 1 in content.elements]
    all_ids = np.concatenate([empty.ids, *(content.node_ids for content in with_cells)])
    all_x = np.concatenate([np.empty((0, 3)), *(content.x for content in with_cells)])
    node_ids, first = np.unique(all_ids, return_index=True)
    mesh = UntornMesh(
        cell_type=cell_type,
        element=element,
        cells=cells,
        cell_ids=found.ids,
        cell_tags=found.tags,
        facet_tags=_facet_tags(cells, cell_type, facets, comm if shared else MPI.COMM_SELF),
        node_ids=node_ids,
        x=np.ascontiguousarray(all_x[first, :gdim]),
        names=physical_names(contents, top, comm),
    )
    extent = _checked_extent(all_x, gdim, comm)
    if shared:
        check_shared(mesh, all_ids, all_x, extent, comm)
    partitioned = comm.allreduce(bool(np.all(found.partitions >= 0)), op=MPI.LAND)
    return mesh, found.partitions if partitioned else None


def _one_kind(contents: Sequence[ModelContent], top: int, comm: MPI.Intracomm) -> tuple[int, str]:
    """Number and name of gmsh's type of all cells of all ranks."""
    cells = [(content.elements[top], content.where) for content in contents]
    own = [(found.kind, found.kind_name, where) for found, where in cells]
    first_of_kind = {kind: (name, where) for kind, name, where in reversed(own)}
    kinds: dict[int, tuple[str, str]] = {}
    for of_rank in comm.allgather(first_of_kind):
        kinds = {**of_rank, **kinds}
    if not kinds:
        raise InputError(
            "the mesh has no physical groups of cells; give the bodies (3D: volumes, 2D: "
            "surfaces) and the surfaces physical groups in gmsh"
        )
    if len(kinds) > 1:
        found = " and ".join(f"{name!r} in {where}" for _, (name, where) in sorted(kinds.items()))
        raise InputError(f"cells of several types, {found}; expected one type of cell")
    ((kind, (name, _)),) = kinds.items()
    if kind not in CELLS:
        raise InputError(
            f"cells of type {name!r} are not supported; expected triangles, quadrilaterals, "
            "tetrahedra or hexahedra of first or (complete) second order"
        )
    return kind, name


def _no_elements(kind: int, kind_name: str, num_nodes: int) -> Elements:
    none = np.empty(0, dtype=np.int64)
    return Elements(
        kind=kind,
        kind_name=kind_name,
        nodes=none.reshape(0, num_nodes),
        ids=none,
        tags=none.astype(np.int32),
        partitions=none,
    )


def _checked_extent(x: Array, gdim: int, comm: MPI.Intracomm) -> float:
    """Longest side of the box of all points; raises if plane cells do not lie in a plane."""
    low, high = box_over_ranks(comm, x)
    sides = high - low
    if gdim == 2 and sides[2] > FLAT * sides.max():
        raise InputError("plane cells that do not lie in a plane z = constant: shells are not")
    return float(sides.max())


def _facet_tags(
    cells: Array, cell_type: dmesh.CellType, facets: Sequence[Elements], comm: MPI.Intracomm
) -> Array:
    """Tag of each facet of each cell, shape ``(n, facets_per_cell)``. Collective.

    A facet of a cell and the element that tags it meet on the rank that their key names.
    """
    keys = facet_keys(cells, cell_type)
    corners = facet_vertices(cell_type).shape[1]
    tagged = [set_key(elements.nodes[:, :corners]) for elements in facets]
    known = np.concatenate([np.empty(0, dtype=np.uint64), *tagged])
    tags = np.concatenate([np.empty(0, dtype=np.int32), *(elements.tags for elements in facets)])
    asking = _to_named_rank(keys.ravel(), comm)
    telling = _to_named_rank(known, comm)
    asked = asking.send(keys.ravel())
    answers = _looked_up(asked, telling.send(known), telling.send(tags))
    return asking.answer(answers).reshape(keys.shape)


def _to_named_rank(keys: Array, comm: MPI.Intracomm) -> Exchange:
    return Exchange(comm, (keys % np.uint64(comm.size)).astype(np.int64))


def _looked_up(keys: Array, known: Array, tags: Array) -> Array:
    """Tag of each key, the first one if there are several, NO_TAG where it is not known."""
    found = np.full(len(keys), NO_TAG, dtype=np.int32)
    if len(known) == 0:
        return found
    known, first = np.unique(known, return_index=True)
    position = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    hit = known[position] == keys
    found[hit] = tags[first[position[hit]]]
    return found
