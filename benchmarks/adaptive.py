"""Solves on meshes that follow the estimated error."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

import tfeti_dolfinx as tfeti
from meshes.tools import sizes_from_simplices
from tfeti_dolfinx.common.compat import geometry_dofmap

# An element becomes at most so many times smaller or larger at once, and the error of all halved:
# a coarse mesh says little of where a fine one should be.
SMALLER, LARGER, STEP = 4.0, 2.0, 0.5
MISSED = 1.25  # at most: what a coarse mesh says is far off


def new_sizes(solution: tfeti.Solution, wanted: float) -> list[Any] | None:
    """Corners of all simplices with their sizes in the next mesh, on rank 0. Collective.

    In d dimensions the square of the error of an element of size h is about C h^(d+2) (degree 1),
    and the fewest elements have equal errors √c: h' = h (c/η²)^(1/(d+2)), and all of them add up to
    ``wanted``² for c^(2/(d+2)) = wanted²/Σ(η²)^(d/(d+2)).
    """
    mesh, comm = solution.decomposition.mesh, solution.decomposition.comm
    field, d = solution.discretisation_error, mesh.topology.dim
    cells = len(solution.decomposition.cell_subdomain)
    square = field.x.array[np.asarray(field.function_space.dofmap.list)[:cells, 0]] ** 2
    corners = mesh.geometry.x[geometry_dofmap(mesh)[:cells]]
    h = np.abs(np.linalg.det(corners[:, 1:, :d] - corners[:, :1, :d])) ** (1 / d)
    root = wanted**2 / comm.allreduce(float(np.sum(square ** (d / (d + 2)))))
    factor = np.sqrt(root) / np.maximum(square, 1e-300) ** (1 / (d + 2))
    size = h * np.clip(factor, 1 / SMALLER, LARGER)
    found = corners, np.repeat(size[:, None], d + 1, axis=1)
    parts = comm.gather(found, root=0)
    return None if parts is None else [np.concatenate(part) for part in zip(*parts, strict=True)]


def solves(
    build: Callable[[Callable[[], int] | None], Any],
    scene: Callable[[tfeti.Decomposition], dict[str, Any]],
    goal: float,
    subdomains: Callable[[int], int],
    options: dict[str, Any],
    comm: Any,
) -> Iterator[tuple[tfeti.ContactProblem, Any, float]]:
    """Problems that are solved, each on a better mesh, until the error is small enough. Collective.

    Args:
        build: gmsh's model, from what makes a field of sizes; None for the first, coarse mesh.
        scene: What ``ContactProblem`` is made of.
        goal: Estimated discretisation error over the energy norm.
        subdomains: Their number, from that of the mesh's nodes.
        options: PETSc options.
        comm: Communicator.

    Yields:
        The problem, its estimate, and the seconds that gmsh has taken for the mesh. Destroying
        the problem is up to the caller.
    """
    sizes, asked = None, np.inf
    while True:
        start, model, nodes = time.perf_counter(), None, 0
        if comm.rank == 0:
            model = build(None if sizes is None else partial(sizes_from_simplices, *sizes))
            nodes = len(model.mesh.getNodes()[0])
        parts = subdomains(comm.bcast(nodes))
        meshing = time.perf_counter() - start
        decomposition = tfeti.read_gmsh(model, comm, parts)
        problem = tfeti.ContactProblem(**scene(decomposition), petsc_options=options)
        problem.solve()
        found = problem.estimate()
        # a mesh is coarser than what gmsh was asked for: so much more is asked for the last one
        missed = min(max(1.0, found.discretisation / asked), MISSED)
        asked = max(STEP * found.discretisation, 0.95 * goal * found.energy / missed)
        done = found.relative_discretisation <= goal
        if not done:
            sizes = new_sizes(problem.solution, asked)
        yield problem, found, meshing
        if done:
            return
