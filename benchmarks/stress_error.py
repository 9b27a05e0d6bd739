"""The error in energy of a solution against a finer one of the same scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem, geometry
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.profiles import Array

NU = 0.3  # of all scenes


def densities(sigma: Array) -> Array:
    """Eσ : C⁻¹σ of stresses, shape ``(n, 3, 3)``."""
    squares = (1 + NU) * np.einsum("nij,nij->n", sigma, sigma)
    return squares - NU * np.einsum("nii->n", sigma) ** 2


def stresses(solution: tfeti.Solution, points: Array, cells: Array) -> Array:
    """Stress at points of some cells of this rank."""
    return solution.stress.eval(points, cells).reshape(-1, 3, 3)


def write_stresses(file: Path, solution: tfeti.Solution, young: Callable[[Array], Array]) -> None:
    """Write the stress at the midpoints of all cells, with what each counts. Collective."""
    mesh, comm = solution.decomposition.mesh, solution.decomposition.comm
    cells = np.arange(len(solution.decomposition.cell_subdomain), dtype=np.int32)
    W = fem.functionspace(mesh, ("DG", 0))
    points = dmesh.compute_midpoints(mesh, mesh.topology.dim, cells)
    volumes = fem.assemble_vector(fem.form(ufl.TestFunction(W) * ufl.dx)).array
    weights = volumes[np.asarray(W.dofmap.list)[cells, 0]]
    found = comm.gather((points, weights, stresses(solution, points, cells)))
    if found is not None:
        x, w, sigma = (np.concatenate(part) for part in zip(*found, strict=True))
        np.savez(file, points=x, weights=w / young(x), sigma=sigma)


def energy_error(file: Path, solution: tfeti.Solution) -> float:
    """‖σ_h − σ‖ in energy over ‖σ‖, where the two meshes both are. Collective."""
    mesh, comm = solution.decomposition.mesh, solution.decomposition.comm
    with np.load(file) as fine:
        points, weights, sigma = (fine[name] for name in ("points", "weights", "sigma"))
    cells = np.arange(len(solution.decomposition.cell_subdomain), dtype=np.int32)
    tree = geometry.bb_tree(mesh, mesh.topology.dim, entities=cells)
    near = geometry.compute_collisions_points(tree, points)
    hit = geometry.compute_colliding_cells(mesh, near, points)
    inside = np.diff(hit.offsets) > 0
    # a point between subdomains is in several ranks' cells: the first one counts it
    first = np.where(inside, comm.rank, comm.size)
    comm.Allreduce(MPI.IN_PLACE, first, op=MPI.MIN)
    own = np.flatnonzero(inside & (first == comm.rank))
    found = stresses(solution, points[own], hit.array[hit.offsets[own]])
    error = weights[own] @ densities(found - sigma[own])
    size = weights @ densities(sigma)
    return float(np.sqrt(comm.allreduce(error) / size))
