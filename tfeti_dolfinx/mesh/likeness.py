"""Which subdomains look equal but for a translation, before there is any stiffness."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.mesh.entities import NO_TAG, facet_keys
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import Exchange, summed

# Of the size of a subdomain, in what is measured of its shape: less is rounding of coordinates,
# more another shape. The root keeps regular grids, which are rational, off the middle between
# two roundings.
SHAPE = 1e-6 * np.sqrt(2.0)


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


def alike(*columns: Array) -> Array:
    """A number for each subdomain, the same for those that agree up to ``SHAPE``.

    Args:
        columns: What must agree, shapes ``(N,)`` or ``(N, q)``.
    """
    keys = np.rint(np.column_stack(columns) / SHAPE).astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].ravel()


def bare_sides(
    mesh: UntornMesh, subdomain: Array, cells: Array, centres: Array, comm: MPI.Intracomm
) -> Array:
    """Where the sides of each subdomain lie that no row will touch. Collective.

    They are facets of one cell only, without a tag: there is nothing to glue, to prescribe or to
    meet. Equal subdomains with the same ones are likely to share S, too.

    Args:
        mesh: This rank's share of the untorn mesh.
        subdomain: Subdomain of each local cell.
        cells: Cells of each subdomain, shape ``(N,)``.
        centres: Their centres, shape ``(N, gdim)``.
        comm: Communicator.

    Returns:
        Moments of the cells with such facets, shape ``(N, q)``.
    """
    sides = np.sum(_is_outer(mesh, comm) & (mesh.facet_tags == NO_TAG), axis=1)
    some = np.flatnonzero(sides)
    of_cells = _moments(mesh.midpoints()[some] - centres[subdomain[some]], np.ones(len(some)))
    moments = _sums(sides[some, None] * of_cells, subdomain[some], len(centres), comm)
    return _scaled(moments / cells[:, None], centres.shape[1])


def _is_outer(mesh: UntornMesh, comm: MPI.Intracomm) -> Array:
    """Whether facets of cells are facets of no other cell, shape ``(n, num_facets)``."""
    keys = facet_keys(mesh.cells, mesh.cell_type)
    outer = _occur_once(keys.ravel())
    own = keys.ravel()[outer]
    exchange = Exchange(comm, (own % np.uint64(comm.size)).astype(np.int64))
    outer[outer] = exchange.answer(_occur_once(exchange.send(own)))
    return outer.reshape(keys.shape)


def _occur_once(keys: Array) -> Array:
    """Flags of those that no other one is equal to."""
    order = np.argsort(keys)  # not stable: that takes four times as long
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    once = np.ones(len(keys), dtype=bool)
    once[order[same]] = once[order[same + 1]] = False
    return once


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
