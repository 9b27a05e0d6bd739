"""The only place that knows versions of DOLFINx (0.9 to 0.11) and of PETSc."""

import ctypes
from typing import Any

import numpy as np
from dolfinx import fem, graph, la
from dolfinx import mesh as dmesh
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.errors import InputError

try:  # 0.10 renamed the module
    from dolfinx.io import gmsh as _gmshio
except ImportError:
    from dolfinx.io import gmshio as _gmshio


# graph partitioners that this DOLFINx was built with
GRAPH_PARTITIONERS = [
    name for name in ("scotch", "parmetis", "kahip") if hasattr(graph, f"partitioner_{name}")
]


def require_real_petsc() -> None:
    """Raise unless PETSc was built for real numbers."""
    if np.issubdtype(PETSc.ScalarType, np.complexfloating):
        raise InputError(
            "this PETSc is built for complex numbers; contact needs a real build "
            "(Debian: python3-petsc4py-real, conda: petsc=*=real_*)"
        )


def is_read(option: str) -> bool:
    """Return whether PETSc has asked for an option, its name without the dash."""
    database = PETSc.Options()
    if hasattr(database, "used"):
        return bool(database.used(option))
    read = ctypes.c_int(0)  # petsc4py older than 3.24 does not tell, its library does
    if ctypes.CDLL(PETSc.__file__).PetscOptionsUsed(None, option.encode(), ctypes.byref(read)):
        raise RuntimeError(f"PetscOptionsUsed failed for -{option}")
    return bool(read.value)


def cell_permutation(cell_type: dmesh.CellType, num_nodes: int) -> Array:
    """Permutation ``p`` from gmsh's node order: ``dolfinx_cell[i] = gmsh_cell[p[i]]``."""
    return np.asarray(_gmshio.cell_perm_array(cell_type, num_nodes))


def create_mesh_in_place(comm: MPI.Intracomm, cells: Array, x: Array, element: Any) -> dmesh.Mesh:
    """Return a mesh whose cells stay on the rank that gives them. Collective.

    ``cells`` are global nodes of this rank's cells, shape ``(n, nodes)``, x this rank's chunk of
    the nodes, shape ``(p, gdim)``. It is the one call of DOLFINx's partitioner hook.
    """

    def stay(*_: Any) -> Any:
        destinations = np.full(len(cells), comm.rank, dtype=np.int32)
        lists = graph.adjacencylist(destinations, np.arange(len(cells) + 1, dtype=np.int32))
        return getattr(lists, "_cpp_object", lists)

    partitioner = stay if comm.size > 1 else None  # one rank pays for none
    return dmesh.create_mesh(comm, cells=cells, x=x, e=element, partitioner=partitioner)


def parts_of_graph(
    comm: MPI.Intracomm, name: str, num_parts: int, neighbours: Array, start: Array
) -> Array:
    """Parts of this rank's nodes of a graph by one of DOLFINx's partitioners. Collective.

    ``neighbours`` are global numbers of the neighbours of all of them, those of one from its
    ``start`` to the next.
    """
    lists = graph.adjacencylist(neighbours.astype(np.int64), start.astype(np.int32))
    partitioner = getattr(graph, f"partitioner_{name}")()
    found = partitioner(comm, num_parts, getattr(lists, "_cpp_object", lists), False)
    return np.asarray(found.array, dtype=np.int64)[np.asarray(found.offsets[:-1])]


def geometry_dofmap(mesh: dmesh.Mesh) -> Array:
    """Geometry nodes of the local cells, shape ``(num_cells, nodes_per_cell)``."""
    geometry = mesh.geometry
    return np.asarray(geometry.dofmaps[0] if hasattr(geometry, "dofmaps") else geometry.dofmap)


def geometry_degree(mesh: dmesh.Mesh) -> int:
    """Degree of the coordinate element: 1 on straight cells."""
    geometry = mesh.geometry
    return int((geometry.cmaps[0] if hasattr(geometry, "cmaps") else geometry.cmap).degree)


def original_cells(mesh: dmesh.Mesh) -> Array:
    """Ids of the local cells before DOLFINx moved them; of a submesh their global indices."""
    topology = mesh.topology
    try:
        return np.asarray(topology.original_cell_index, dtype=np.int64)
    except RuntimeError:  # a submesh has none
        cells = topology.index_map(topology.dim)
        here = np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)
        return np.asarray(cells.local_to_global(here), dtype=np.int64)


def interpolation_points(V: fem.FunctionSpace) -> Array:
    """Return points of the reference cell at which the element of ``V`` is interpolated."""
    points = V.element.interpolation_points
    return np.asarray(points() if callable(points) else points)


def first_component(V: fem.FunctionSpace) -> tuple[fem.FunctionSpace, Array]:
    """Space of the first component of a blocked space, and the dof of ``V`` of each of its dofs."""
    S, parent = V.sub(0).collapse()
    # 0.11 wraps the map in a list; without cells it is empty, and numpy's type would be float
    return S, np.ravel(parent).astype(np.int64)


def assemble_csr(form: fem.Form, A: la.MatrixCSR | None = None) -> Any:
    """Return this rank's diagonal block of a bilinear form, as a scipy CSR matrix.

    Needs a mesh whose vertices are never shared between ranks, so nothing is communicated. It is
    on the data of A, whose entries are those of the form; without it on new data.
    """
    A = fem.create_matrix(form, la.BlockMode.expanded) if A is None else A
    A.set_value(0.0)
    fem.assemble_matrix(A, form)
    return A.to_scipy()


def space_of(bc: fem.DirichletBC) -> Any:
    """C++ space of a Dirichlet condition."""
    space = bc.function_space
    return getattr(space, "_cpp_object", space)
