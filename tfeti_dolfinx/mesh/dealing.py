"""Which rank a subdomain belongs to."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import agreed, summed

# Of the time and memory of a subdomain that has a factor of its own: what one more costs that
# shares it. 0.32 was measured for plane squares of 10 000 nodes, 0.26 for cubes of 2197.
SHARED = 0.3
# Of the size of a subdomain, in what is measured of its shape: less is rounding of coordinates,
# more another shape. The root keeps regular grids, which are rational, off the middle between
# two roundings.
SHAPE = 1e-6 * np.sqrt(2.0)


def dealt(mesh: UntornMesh, subdomain: Array, comm: MPI.Intracomm) -> Array:
    """Rank of each subdomain, by what it is likely to cost. Collective.

    Subdomains that look equal but for a translation will share a factor, unless a modulus that
    only the forms know tells them apart, or options do; then ranks are balanced less well.

    Args:
        mesh: This rank's share of the untorn mesh.
        subdomain: Subdomain of each local cell, shape ``(n,)``.
        comm: Communicator.

    Returns:
        Ranks, shape ``(N,)``, the same on all ranks.
    """
    num = comm.allreduce(int(subdomain.max(initial=-1)), op=MPI.MAX) + 1
    cells, centres, shapes = measured(mesh.midpoints(), mesh.cell_tags, subdomain, num, comm)
    return agreed(comm, deal(costs(cells, shapes), centres, comm.size))


def measured(
    x: Array, tags: Array, subdomain: Array, num: int, comm: MPI.Intracomm
) -> tuple[Array, Array, Array]:
    """Number of cells of each subdomain, centre and shape. Collective.

    Args:
        x: Midpoints of this rank's cells, shape ``(n, gdim)``.
        tags: Their material tags.
        subdomain: Their subdomains.
        num: Number of subdomains, N.
        comm: Communicator.

    Returns:
        Shapes ``(N,)``, ``(N, gdim)`` and ``(N, q)``; what is in the last depends neither on the
        place nor on the order of the cells.
    """
    sums = _sums(np.column_stack((np.ones(len(x)), x)), subdomain, num, comm)
    cells, centres = sums[:, 0], sums[:, 1:] / sums[:, :1]
    moments = _sums(_moments(x - centres[subdomain], tags), subdomain, num, comm)
    return cells, centres, _scaled(moments / sums[:, :1], x.shape[1])


def costs(cells: Array, shapes: Array) -> Array:
    """What subdomains cost, in cells: one of several that are equal pays its part of the factor.

    Args:
        cells: Cells of each subdomain, shape ``(N,)``.
        shapes: What must agree, up to ``SHAPE``, where subdomains are equal, shape ``(N, q)``.
    """
    keys = np.column_stack((cells, np.rint(shapes / SHAPE))).astype(np.int64)
    _, which, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    equal = count[which.ravel()]
    return np.asarray(cells * (SHARED + (1.0 - SHARED) / equal))


def _moments(d: Array, tags: Array) -> Array:
    """Of cells at d from the centre of their subdomain: sums of them tell shapes apart.

    Degrees 2 and 3 tell mirrored ones from each other, the degree 4 more; tags stand for moduli.
    """
    gdim = d.shape[1]
    pairs = [d[:, i] * d[:, j] for i in range(gdim) for j in range(i, gdim)]
    square = np.sum(d**2, axis=1)
    material = np.sin(tags.astype(float))  # any number of its own for each tag
    return np.column_stack((*pairs, square[:, None] * d, square**2, material, material * square))


def _scaled(moments: Array, gdim: int) -> Array:
    """Mean moments without their units; lengths are those of the largest subdomain."""
    pairs = gdim * (gdim + 1) // 2
    degree = np.array([2] * pairs + [3] * gdim + [4, 0, 2])
    length = np.sqrt(np.max(np.abs(moments[:, :pairs]), initial=0.0)) or 1.0  # of single cells 0
    return np.asarray(moments / length**degree)


def _sums(values: Array, subdomain: Array, num: int, comm: MPI.Intracomm) -> Array:
    """Sums over the cells of each subdomain. Collective."""
    total = np.zeros((num, values.shape[1]))
    np.add.at(total, subdomain, values)
    return summed(comm, total)


def deal(weights: Array, centres: Array, num_ranks: int) -> Array:
    """Rank of each subdomain: neighbouring subdomains in chunks of about equal weight.

    Args:
        weights: Cells of each subdomain, shape ``(N,)``.
        centres: Centres of the subdomains, shape ``(N, gdim)``.
        num_ranks: Number of ranks.

    Returns:
        Ranks, shape ``(N,)``; each rank has a subdomain if there are enough of them.
    """
    n = len(weights)
    order = np.argsort(bisect_points(centres, n, MPI.COMM_SELF), kind="stable")
    sorted_weights = weights[order]
    middle = np.cumsum(sorted_weights) - 0.5 * sorted_weights
    position = np.arange(n)
    rank = np.floor(middle / sorted_weights.sum() * num_ranks).astype(np.int64)
    rank = np.clip(rank, num_ranks - n + position, position)
    rank = np.minimum.accumulate(rank - position) + position
    ranks = np.empty(n, dtype=np.int32)
    ranks[order] = np.clip(rank, 0, num_ranks - 1)
    return ranks
