"""Parts of a mesh: by a partitioner or as given, each connected."""

from collections.abc import Callable

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.common.arrays import Array, ArrayLike
from tfeti_dolfinx.common.compat import GRAPH_PARTITIONERS, parts_of_graph
from tfeti_dolfinx.common.parallel import offset_of
from tfeti_dolfinx.common.validation import named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.cell_graph import CellGraph, Pieces
from tfeti_dolfinx.mesh.round_parts import round_parts
from tfeti_dolfinx.mesh.untorn import UntornMesh

GivenSubdomains = int | ArrayLike | Callable[[Array], ArrayLike]
# unknowns of a subdomain where nobody gives a number: its factor is cheap, and kernels and
# interfaces are still few
UNKNOWNS = 4000

# --- Partitioners -----------------------------------------------------------------------------


PARTITIONERS: dict[str, Callable[[UntornMesh, CellGraph, int], Array]] = {
    "round": round_parts,
    "bisection": lambda mesh, graph, num_parts: bisect_points(
        mesh.midpoints(), num_parts, graph.comm, mesh.extents()
    ),
}
DEFAULT = "round"


def check_partitioner(name: str) -> None:
    """Raise an InputError unless there is such a partitioner."""
    known = [*PARTITIONERS, *GRAPH_PARTITIONERS]
    if name not in known:
        raise InputError(f"partitioner={shown(name)}: expected one of {', '.join(known)}")


def make_parts(mesh: UntornMesh, graph: CellGraph, num_parts: int, partitioner: str) -> Array:
    """Part of each cell by a partitioner of that name; some may not be connected. Collective."""
    if partitioner in PARTITIONERS:
        return without_holes(PARTITIONERS[partitioner](mesh, graph, num_parts), graph.comm)
    comm, n = graph.comm, graph.num_cells
    number = graph.with_ghosts(offset_of(comm, n) + np.arange(n))
    across = np.sort(graph.across, axis=1)
    other = across != np.arange(n)[:, None]
    lists = number[across[other]], np.concatenate(([0], np.cumsum(other.sum(axis=1))))
    return without_holes(parts_of_graph(comm, partitioner, num_parts, *lists), comm)


# --- Connected subdomains ---------------------------------------------------------------------


def connected_parts(pieces: Pieces, absorb: bool) -> tuple[Array, dict[int, list[int]], Array]:
    """Give each subdomain one piece, from the pieces of subdomains that may have several.

    ``absorb`` lets smaller pieces of a subdomain join the neighbour they share most facets with.
    Pieces that stay get ids after the last, in the order of their subdomains. Return the subdomain
    of each piece, for each that was split its ids, and the body of each subdomain: what hangs
    together by facets, numbered by their lowest subdomains.
    """
    subdomain = np.array(pieces.colour)
    settled = np.ones(len(subdomain), dtype=bool)
    settled[1:] = subdomain[1:] != subdomain[:-1]
    while absorb:
        a, b = pieces.links.T
        useful = ~settled[a] & settled[b]
        fragment, into = a[useful], subdomain[b[useful]]
        if len(fragment) == 0:
            break
        keys, place = np.unique(np.stack((fragment, into)), axis=1, return_inverse=True)
        most = np.bincount(place.ravel(), pieces.facets[useful])
        best = np.lexsort((-keys[1], most, keys[0]))
        subdomain[keys[0, best]] = keys[1, best]  # the last of each piece counts
        settled[keys[0]] = True
    last, rest = int(subdomain.max(initial=-1)) + 1, np.flatnonzero(~settled)
    split: dict[int, list[int]] = {int(s): [int(s)] for s in subdomain[rest]}
    for number, piece in enumerate(rest):
        split[int(subdomain[piece])].append(last + number)
    subdomain[rest] = last + np.arange(len(rest))
    n = last + len(rest)
    edges = subdomain[pieces.links]
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, body = connected_components(graph, directed=False)
    _, first = np.unique(body, return_index=True)
    return subdomain, split, np.argsort(np.argsort(first))[body]


# --- Assignment of cells to subdomains --------------------------------------------------------


def given_subdomains(mesh: UntornMesh, subdomains: GivenSubdomains, comm: MPI.Intracomm) -> Array:
    """Subdomain of each local cell, numbered 0, 1, ... without holes. Collective.

    Given is one id per local cell; or a callable that gets cell midpoints, shape ``(3, n)``, and
    returns one id per cell. Raise an InputError where these are not whole numbers from 0 up.
    """
    what = f"{'callable' if callable(subdomains) else 'array'} subdomains"
    num_cells = len(mesh.cells)
    with raised_on_all_ranks(comm):
        with named(what):
            ids = subdomains
            if callable(subdomains):
                midpoints = np.zeros((3, num_cells))
                midpoints[: mesh.x.shape[1]] = mesh.midpoints().T
                ids = subdomains(midpoints)
            array = np.asarray(ids)
        if array.ndim == 0 or array.dtype.kind not in "biuf":
            what = what.removeprefix("array ")  # it is none
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
        if np.any(wrong := (whole != array) | (whole < 0)):
            raise InputError(f"{what}: expected whole numbers from 0 up, got {array[wrong][0]}")
    return without_holes(whole, comm)


def without_holes(ids: Array, comm: MPI.Intracomm) -> Array:
    """Renumber ids to 0, 1, ... in their order."""
    return np.searchsorted(np.unique(np.concatenate(comm.allgather(np.unique(ids)))), ids)
