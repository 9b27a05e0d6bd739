"""Displacement and stress at points of the user's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from dolfinx import fem, geometry
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.solved import BoundarySolution
from tfeti_dolfinx.compat import geometry_dofmap
from tfeti_dolfinx.errors import InputError

# Of the size of the mesh: how far from a cell of finite elements a point may be
PADDING = 1e-10
# Share of directions hidden by a body that is neither 0 nor 1: points on its surface
SURE = 1e-3
# Their stress is taken so far on the way to the middle of their cell
BESIDE = 0.1


@dataclass(frozen=True)
class PointValues:
    """Values at points; not a number where a point is in no body.

    Attributes:
        displacement: Shape ``(k, gdim)``.
        stress: Shape ``(k, gdim, gdim)``, in 2D without σ_zz.
    """

    displacement: Array
    stress: Array


def checked_points(points: Any, gdim: int) -> Array:
    """Points as an array of shape ``(k, gdim)``.

    Raises:
        InputError: They are of another shape, or not finite numbers.
    """
    try:
        found = np.array(points, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"points: {error}; expected numbers of shape (k, {gdim})") from error
    if found.ndim != 2 or found.shape[1] != gdim or not np.all(np.isfinite(found)):
        raise InputError(
            f"points of shape {found.shape}; expected finite numbers of shape (k, {gdim})"
        )
    return found


def values_at(
    points: Array,
    boundary: BoundarySolution | None,
    thickness: Any,
    u: fem.Function,
    stress: fem.Function | None,
) -> PointValues:
    """Values at points, means of the subdomains that share a point. Collective.

    Args:
        points: The same on all ranks, shape ``(k, gdim)``.
        boundary: What boundary elements know.
        thickness: What stresses of boundary elements have to be divided by.
        u: Displacement on the torn mesh.
        stress: Stress in the cells, 3×3, or None.
    """
    k, d = points.shape
    total = np.zeros((k, 1 + d + d * d))
    place, cells = _cells(u.function_space.mesh, points)
    if boundary is not None:
        total += _of_boundary_elements(points, (place, cells), boundary, _number(thickness), u)
        kept = np.isin(cells, boundary.finite)
        place, cells = place[kept], cells[kept]
    if len(place):
        x = _in_space(points[place])
        sigma = np.full((len(place), d, d), np.nan)
        if stress is not None:
            sigma = stress.eval(x, cells).reshape(-1, 3, 3)[:, :d, :d]
        np.add.at(total, place, _row(u.eval(x, cells).reshape(-1, d), sigma))
    u.function_space.mesh.comm.Allreduce(MPI.IN_PLACE, total, op=MPI.SUM)
    with np.errstate(invalid="ignore"):
        mean = np.where(total[:, :1] > 0.0, total[:, 1:] / total[:, :1], np.nan)
    return PointValues(mean[:, :d], mean[:, d:].reshape(k, d, d))


def _of_boundary_elements(
    points: Array,
    found: tuple[Array, Array],
    boundary: BoundarySolution,
    thickness: float,
    u: fem.Function,
) -> Array:
    """Rows of the bodies of this rank, added for each point."""
    (k, d), mesh = points.shape, u.function_space.mesh
    total = np.zeros((k, 1 + d + d * d))
    (place, cells), owner = found, boundary.cell_subdomain
    for body in boundary.bodies():
        share = body.inside.share(points)
        own = np.flatnonzero(share > 1.0 - SURE)
        sigma = body.inside.stress(points[own]) / thickness
        total[own] += _row(body.inside.displacement(points[own]), sigma)
        on = (share > SURE) & (share <= 1.0 - SURE)
        there = np.flatnonzero(on[place] & (owner[cells] == body.subdomain))
        if len(there):
            own, first = np.unique(place[there], return_index=True)
            cell, at = cells[there[first]], points[own]
            middle = mesh.geometry.x[geometry_dofmap(mesh)[cell]].mean(axis=1)[:, :d]
            sigma = body.inside.stress(at + BESIDE * (middle - at)) / thickness
            total[own] += _row(u.eval(_in_space(at), cell).reshape(-1, d), sigma)
    return total


def _in_space(points: Array) -> Array:
    """Points with three coordinates."""
    x = np.zeros((len(points), 3))
    x[:, : points.shape[1]] = points
    return x


def _row(u: Array, stress: Array) -> Array:
    return np.column_stack((np.ones(len(u)), u, stress.reshape(len(u), u.shape[1] ** 2)))


def _number(thickness: Any) -> float:
    """A thickness as a number; where it varies there are no boundary elements."""
    if isinstance(thickness, fem.Constant):
        return float(thickness.value)
    return float(thickness) if isinstance(thickness, float) else 1.0


def _cells(mesh: Any, points: Array) -> tuple[Array, Array]:
    """Points by position, and the cells of this rank that each of them is in."""
    x = _in_space(points)
    size = float(np.ptp(mesh.geometry.x, axis=0).max(initial=0.0)) if len(mesh.geometry.x) else 0.0
    tree = geometry.bb_tree(mesh, mesh.topology.dim, padding=PADDING * size)
    near = geometry.compute_collisions_points(tree, x)
    found = geometry.compute_colliding_cells(mesh, near, x)
    place = np.repeat(np.arange(len(points)), np.diff(found.offsets))
    return place, np.asarray(found.array)
