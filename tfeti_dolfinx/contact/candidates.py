"""Which facets of two surfaces may meet: rendezvous of ranks, then a tree on each."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.facets import Facets
from tfeti_dolfinx.mesh.partition import bisect_points
from tfeti_dolfinx.parallel import Exchange


def rendezvous(
    secondary: Facets, primary: Facets, num_vertices: int, radius: float, comm: MPI.Intracomm
) -> tuple[Facets, Facets]:
    """Bring facets that may meet to the same rank. Collective.

    Each secondary facet goes to one rank, in chunks of equal number that are compact in space;
    a primary facet goes to every rank whose box it comes near.

    Args:
        secondary: Secondary facets of this rank.
        primary: Primary facets of this rank.
        num_vertices: Vertices of a facet.
        radius: How far apart facets may be.
        comm: Communicator.

    Returns:
        The secondary and the primary facets that have come to this rank.
    """
    centres = secondary.corners(num_vertices).mean(axis=1)
    here = secondary.sent(Exchange(comm, bisect_points(centres, comm.size, comm)))
    low, high = here.box(num_vertices)
    gdim = low.shape[1]
    box = np.stack((low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)))
    boxes = np.empty((comm.size, 2, gdim))
    comm.Allgather(box, boxes)
    low, high = primary.box(num_vertices)
    near = np.ones((len(primary), comm.size), dtype=bool)
    for axis in range(gdim):
        near &= low[:, axis, None] - radius <= boxes[None, :, 1, axis]
        near &= high[:, axis, None] + radius >= boxes[None, :, 0, axis]
    facet, rank = np.nonzero(near)
    return here, primary.sent(Exchange(comm, rank), facet)


def candidate_pairs(
    secondary: Facets, primary: Facets, num_vertices: int, radius: float
) -> tuple[Array, Array]:
    """Pairs of facets whose enclosing balls are no farther apart than a radius.

    Primary facets are sorted into classes of equal size up to a factor of 2, each with a tree of
    its own, so that a graded mesh does not make large balls meet small ones in vain.

    Args:
        secondary: Secondary facets.
        primary: Primary facets.
        num_vertices: Vertices of a facet.
        radius: Largest distance of the balls.

    Returns:
        Secondary and primary facet of each pair.
    """
    s_centre, s_size = _balls(secondary, num_vertices)
    p_centre, p_size = _balls(primary, num_vertices)
    found_s: list[Array] = [np.empty(0, dtype=np.int64)]
    found_p: list[Array] = [np.empty(0, dtype=np.int64)]
    classes = np.floor(np.log2(np.maximum(p_size, 1e-300))).astype(np.int64)
    for size_class in np.unique(classes) if len(secondary) else ():
        members = np.flatnonzero(classes == size_class)
        reach = s_size + p_size[members].max() + radius
        lists = cKDTree(p_centre[members]).query_ball_point(s_centre, reach, return_sorted=False)
        count = np.fromiter((len(hits) for hits in lists), dtype=np.int64, count=len(lists))
        found_s.append(np.repeat(np.arange(len(s_centre)), count))
        hits = np.concatenate([np.asarray(h, dtype=np.int64) for h in lists if h] or [members[:0]])
        found_p.append(members[hits])
    s, p = np.concatenate(found_s), np.concatenate(found_p)
    near = np.linalg.norm(s_centre[s] - p_centre[p], axis=1) <= s_size[s] + p_size[p] + radius
    return s[near], p[near]


def _balls(facets: Facets, num_vertices: int) -> tuple[Array, Array]:
    """Centre and radius of a ball around each facet."""
    corners = facets.corners(num_vertices)
    centre = corners.mean(axis=1)
    return centre, np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1, initial=0.0)
