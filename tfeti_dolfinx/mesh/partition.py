"""Which subdomain a cell belongs to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array, ArrayLike
from tfeti_dolfinx.checks import is_whole, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.untorn import UntornMesh

Subdomains = int | ArrayLike | Callable[[Array], ArrayLike]

# displacement unknowns: a factor of that size is cheap, and kernels and interfaces are still few
UNKNOWNS_PER_SUBDOMAIN = 4000


def default_count(mesh: UntornMesh, comm: MPI.Intracomm) -> int:
    """Number of subdomains that leaves each about 4000 displacement unknowns. Collective."""
    per_cell = 0.5 if mesh.cell_type.name == "triangle" else 1.0
    per_cell = 0.2 if mesh.cell_type.name == "tetrahedron" else per_cell
    unknowns = comm.allreduce(len(mesh.cells)) * per_cell * mesh.gdim * mesh.degree**mesh.gdim
    return max(1, round(unknowns / UNKNOWNS_PER_SUBDOMAIN))


def assign_subdomains(
    mesh: UntornMesh,
    subdomains: Subdomains,
    comm: MPI.Intracomm,
    partition: Callable[[UntornMesh, int, MPI.Intracomm], Array],
) -> Array:
    """Subdomain of each local cell, numbered 0, 1, ... without holes. Collective.

    Args:
        mesh: The untorn mesh.
        subdomains: Their number; or one id per local cell; or a callable that gets cell
            midpoints, shape ``(3, n)``, and returns one id per cell.
        comm: Communicator.
        partition: Partitions a mesh into a number of parts.

    Raises:
        InputError: The number is not between 1 and the number of cells, the ids are not one
            whole number per cell, or an id is negative.
    """
    total = comm.allreduce(len(mesh.cells))
    if is_whole(subdomains):
        if not 1 <= subdomains <= total:
            raise InputError(
                f"subdomains={subdomains}: expected between 1 and {total}, the number of cells"
            )
        return partition(mesh, int(subdomains), comm)
    with raised_on_all_ranks(comm):
        if callable(subdomains):
            midpoints = np.zeros((3, len(mesh.cells)))
            midpoints[: mesh.gdim] = mesh.midpoints().T
            with named("callable subdomains"):
                found = subdomains(midpoints)
            ids = _checked_ids(found, len(mesh.cells), "callable subdomains")
        else:
            ids = _checked_ids(subdomains, len(mesh.cells), "array subdomains")
    return without_holes(ids, comm)


def _checked_ids(ids: ArrayLike, num_cells: int, what: str) -> Array:
    with named(what):
        array = np.asarray(ids)
    if array.ndim == 0 or array.dtype.kind not in "biuf":
        raise InputError(
            f"{what}: expected a number of subdomains, one whole number for each cell or a "
            f"callable that returns them, got {shown(ids)}"
        )
    if array.shape != (num_cells,):
        raise InputError(
            f"{what}: expected one id for each of the {num_cells} cells of this rank, "
            f"got an array of shape {array.shape}"
        )
    whole = np.where(np.isfinite(array), array, -1).astype(np.int64)
    if np.any(whole != array) or np.any(whole < 0):
        wrong = array[(whole != array) | (whole < 0)][0]
        raise InputError(f"{what}: expected whole numbers from 0 up, got {wrong}")
    return whole


def without_holes(ids: Array, comm: MPI.Intracomm) -> Array:
    """Renumber ids to 0, 1, ... in their order."""
    used = np.unique(np.concatenate(comm.allgather(np.unique(ids))))
    return np.searchsorted(used, ids)


def coordinate_bisection(mesh: UntornMesh, num_parts: int, comm: MPI.Intracomm) -> Array:
    """Recursive coordinate bisection of a distributed mesh, along its layers. Collective.

    The parts depend on the cells' vertices only, not on how ranks share the cells.
    """
    part = bisect_points(mesh.midpoints(), num_parts, comm, mesh.extents())
    return without_holes(part, comm)
