"""Which rank a subdomain belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.bisection import bisect_points
from tfeti_dolfinx.mesh.likeness import alike, bare_sides, measured
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import agreed

# Of the time and memory of a subdomain that has factors of its own: what one more costs that
# shares them. 0.32 was measured for plane squares of 10 000 nodes, 0.26 for cubes of 2197.
SHARED = 0.3
# Beside what K⁺ and S of a subdomain with factors of its own cost each: what is done for each,
# equal or not, as assembly, gluing and vectors are; roughly, of the same squares and cubes.
ALIKE = 0.12
# sides of a box that are so many times shorter than the longest may be cut across as early as it,
# where ranks cost less by that part
LONG, GAIN = 4.0, 0.02
# of costs beside their mean: those that differ by less are the same but for rounding
DIGITS = 9


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
    if comm.size == 1:
        return np.zeros(num, dtype=np.int32)
    cells, centres, shapes = measured(mesh.midpoints(), mesh.cell_tags, subdomain, num, comm)
    kinds = agreed(comm, alike(cells, shapes))
    if len(np.unique(kinds)) == num:
        return agreed(comm, deal(cells, centres, comm.size))
    seen = alike(kinds, bare_sides(mesh, subdomain, cells, centres, comm))
    return deal_shared(cells, centres, (kinds, seen), comm.size, comm)


def deal_shared(
    cells: Array, centres: Array, shared: Sequence[Array], num_ranks: int, comm: MPI.Intracomm
) -> Array:
    """Rank of each subdomain, in that of a few orders in which ranks share most. Collective.

    Args:
        cells: Cells of each subdomain, shape ``(N,)``.
        centres: Their centres, shape ``(N, gdim)``.
        shared: As for ``dearest``; by the first of them ranks get chunks of equal cost.
        num_ranks: Number of ranks.
        comm: Communicator of those that try; each tries its part of the orders.

    Returns:
        Ranks, shape ``(N,)``, the same on all ranks.
    """
    orders, weights = _orders(centres), costs(cells, shared[0])
    own = range(comm.rank, len(orders), comm.size)
    found = {i: deal(weights, orders[i][0], num_ranks) for i in own}
    tried = [
        (dearest(ranks, cells, shared, num_ranks) * orders[i][1], i) for i, ranks in found.items()
    ]
    _, best = comm.allreduce(min(tried, default=(np.inf, -1)), op=MPI.MIN)
    return np.asarray(comm.bcast(found.get(best), root=best % comm.size))


def _orders(centres: Array) -> list[tuple[Array, float]]:
    """Coordinates to bisect by, and how much worse each is for the sake of short interfaces.

    Which of several sides that are as long as each other is cut across first is for the order of
    axes to say; sides that are a little shorter are made as long, too.
    """
    sides = np.ptp(centres, axis=0)
    longest = sides.max() or 1.0
    even = centres / np.where(LONG * sides >= longest, sides, longest)
    axes = [list(order) for order in permutations(range(centres.shape[1]))]
    return [
        (x[:, order], worse) for x, worse in ((centres, 1.0), (even, 1.0 + GAIN)) for order in axes
    ]


def costs(cells: Array, kinds: Array) -> Array:
    """What subdomains cost, in cells: one of several that are equal pays its part of the factor.

    Args:
        cells: Cells of each subdomain, shape ``(N,)``.
        kinds: A number for each, the same for equal ones, shape ``(N,)``.
    """
    equal = np.bincount(kinds)[kinds]
    return np.asarray(cells * (SHARED + (1.0 - SHARED) / equal))


def dearest(ranks: Array, cells: Array, shared: Sequence[Array], num_ranks: int) -> float:
    """What ranks cost that wait for each other, beside their mean if nothing were shared.

    They wait after each thing, say K⁺ of all subdomains, of which a rank makes what equal ones
    share once.

    Args:
        ranks: Rank of each subdomain, shape ``(N,)``.
        cells: Cells of each, shape ``(N,)``.
        shared: For each thing, a number for each subdomain, the same for those that share it.
        num_ranks: Number of ranks.
    """
    each = np.bincount(ranks, cells, minlength=num_ranks)
    waited = ALIKE * each.max()
    for numbers in shared:
        _, first = np.unique(np.stack((ranks, numbers)), axis=1, return_index=True)
        made = np.bincount(ranks[first], cells[first], minlength=num_ranks)
        waited += np.max(SHARED * each + (1.0 - SHARED) * made)
    return round(float(waited * num_ranks / cells.sum()), DIGITS)


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
