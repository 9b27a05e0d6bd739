"""Meshes of a scene, their sides, and elasticity on them with coefficients in the cells."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

from benchmarks.stress.scene import Scene

# simplices around the diagonal of a box whose corners are numbered x + 2y + 4z
SPLIT = {
    "triangle": [[0, 1, 3], [0, 2, 3]],
    "tetrahedron": [[0, a, b, 7] for a, b in ((1, 3), (1, 5), (2, 3), (2, 6), (4, 5), (4, 6))],
}


@dataclass(frozen=True)
class Grid:
    """Cells and points of all bodies."""

    points: np.ndarray  # (n, gdim)
    cells: np.ndarray  # points of each cell
    body: np.ndarray  # of each cell
    colour: np.ndarray  # of each cell on a checkerboard, 0 or 1


def grid(scene: Scene) -> Grid:
    points, cells, body, colour, start = [], [], [], [], 0
    for b, box in enumerate(scene.bodies):
        n = np.array(box.cells)
        axes = [np.linspace(lo, hi, k + 1) for lo, hi, k in zip(box.low, box.high, n, strict=True)]
        x = np.stack([c.ravel(order="F") for c in np.meshgrid(*axes, indexing="ij")], axis=1)
        index = np.stack(np.unravel_index(np.arange(n.prod()), n, order="F"))
        stride = np.cumprod(np.r_[1, n[:-1] + 1])
        corner = np.stack(np.unravel_index(np.arange(2 ** len(n)), (2,) * len(n), order="F"))
        boxes = start + (stride @ index)[:, None] + stride @ corner
        split = SPLIT.get(scene.cell)
        parts = 1 if split is None else len(split)
        cells.append(boxes if split is None else boxes[:, split].reshape(-1, len(split[0])))
        colour.append(np.repeat(index.sum(axis=0) % 2, parts))
        body.append(np.full(len(cells[-1]), b))
        points.append(x)
        start += len(x)
    g = Grid(*(np.concatenate(part) for part in (points, cells, body, colour)))
    if scene.joined:  # one point where bodies have one in common
        once, new = np.unique(g.points.round(12), axis=0, return_inverse=True)
        g = replace(g, points=once, cells=new.ravel()[g.cells])
    return g


def make_mesh(
    scene: Scene, g: Grid, comm: MPI.Intracomm
) -> tuple[dmesh.Mesh, dmesh.MeshTags, np.ndarray]:
    """The mesh, from the cells that rank 0 has, tags of all sides, cells of the grid here."""
    own = slice(None) if comm.rank == 0 else slice(0, 0)
    element = basix.ufl.element("Lagrange", scene.cell, 1, shape=(scene.gdim,))
    mesh = dmesh.create_mesh(comm, cells=g.cells[own], x=g.points[own], e=element)
    cell, tdim = np.asarray(mesh.topology.original_cell_index), scene.gdim
    mesh.topology.create_connectivity(tdim - 1, tdim)
    facets = dmesh.exterior_facet_indices(mesh.topology)
    links = mesh.topology.connectivity(tdim - 1, tdim)
    body = g.body[cell[np.array([links.links(f)[0] for f in facets], dtype=int)]]
    middle = dmesh.compute_midpoints(mesh, tdim - 1, facets)[:, :tdim]
    low, high = np.array([(b.low, b.high) for b in scene.bodies])[body].swapaxes(0, 1)
    # a facet's midpoint is on its own side, and half a cell away from all others
    away = np.stack((middle - low, high - middle), axis=2) / (high - low)[:, :, None]
    side = np.abs(away).reshape(-1, 2 * tdim).argmin(axis=1)
    tags = (body * 2 * tdim + side + 1).astype(np.int32)
    if scene.bent is not None:
        kind, strength = scene.bent
        {"layers": _layers, "slivers": _slivers, "arch": _arch}[kind](scene, mesh, strength)
    return mesh, dmesh.meshtags(mesh, tdim - 1, facets, tags), cell


def loads_of(scene: Scene, g: Grid) -> np.ndarray:
    """Tractions on the sides of each cell's body and its force per volume, one after the other."""
    values = np.zeros((len(scene.bodies), 2 * scene.gdim + 1, scene.gdim))
    for load in scene.loads:
        body, axis, end = load.side
        values[body, 2 * axis + end if axis >= 0 else -1] += load.value
    return values[g.body]


def materials(scene: Scene, g: Grid, subdomain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lamé's μ and λ of each cell, given the subdomain of each cell."""
    E, nu, jump = np.array([(b.E, b.nu, b.jump) for b in scene.bodies])[g.body].T
    E = E * np.where(g.colour == 1, jump, 1.0)
    E = E * np.where(subdomain % 2 == 1, scene.subdomain_jump, 1.0)
    return E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)


def cellwise(mesh: dmesh.Mesh, values: np.ndarray) -> fem.Function:
    """Values of the cells as a function."""
    function = fem.Function(fem.functionspace(mesh, ("DG", 0, values.shape[1:])))
    cell_dof = function.function_space.dofmap.list[: len(values), 0]
    width = int(np.prod(values.shape[1:]))
    function.x.array.reshape(-1, width)[cell_dof] = values.reshape(len(values), width)
    return function


def elasticity(
    scene: Scene, mesh: dmesh.Mesh, facet_tags: dmesh.MeshTags, *of_cells: np.ndarray
) -> tuple[Any, Any, Any]:
    """V, a, L; Lamé's μ and λ and ``loads_of`` are those of this rank's cells.

    One compiled form serves all scenes of a cell type: tractions depend on the facet's normal.
    """
    gdim = scene.gdim
    V = fem.functionspace(mesh, ("Lagrange", scene.order, (gdim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    mu, lmbda, t = (cellwise(mesh, values) for values in of_cells)
    linear = 1 if scene.cell in SPLIT else 2
    quadrature = {"quadrature_degree": linear if scene.order == 1 else 4}
    dx = ufl.Measure("dx", domain=mesh, metadata=quadrature)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags, metadata=quadrature)
    e, n = ufl.sym(ufl.grad(u)), ufl.FacetNormal(mesh)
    stress = 2 * mu * e + lmbda * ufl.tr(e) * ufl.Identity(gdim)
    traction = sum(
        ufl.max_value(sign * n[k], 0.0) * t[2 * k + end, :]
        for k in range(gdim)
        for end, sign in ((0, -1.0), (1, 1.0))
    )
    tags = tuple(scene.surfaces.values())
    L = ufl.dot(t[2 * gdim, :], v) * dx + ufl.dot(traction, v) * ds(tags)
    return V, ufl.inner(stress, ufl.sym(ufl.grad(v))) * dx, L


def prescribed(scene: Scene, V: Any, facets_of: Any) -> list[fem.DirichletBC]:
    """Dirichlet conditions; ``facets_of`` gives the local facets of a side."""
    made = []
    for held in scene.held:
        for c in held.components:
            dofs = fem.locate_dofs_topological(V.sub(c), scene.gdim - 1, facets_of(held.side))
            made.append(fem.dirichletbc(held.value, dofs, V.sub(c)))
    return made


def _layers(scene: Scene, mesh: dmesh.Mesh, strength: float) -> None:
    """Layers of cells that are as much flatter at the lowest side as ``strength`` says."""
    box, up = scene.bodies[0], scene.gdim - 1
    low, high, n = box.low[up], box.high[up], box.cells[up]
    t = n * (mesh.geometry.x[:, up] - low) / (high - low)
    steps = strength ** (np.arange(n) / max(n - 1, 1))
    heights = np.concatenate(([0.0], np.cumsum(steps))) / steps.sum()
    mesh.geometry.x[:, up] = low + (high - low) * np.interp(t, np.arange(n + 1), heights)


def _slivers(scene: Scene, mesh: dmesh.Mesh, strength: float) -> None:
    """Every other inner point goes to the opposite facet of a cell of its, all but 1/strength."""
    box, x, gdim = scene.bodies[0], mesh.geometry.x, scene.gdim
    low, high, n = (np.array(v, dtype=float) for v in (box.low, box.high, box.cells))
    at = np.rint(n * (x[:, :gdim] - low) / (high - low))
    moved = np.all((at > 0) & (at < n), axis=1) & (at.sum(axis=1) % 2 == 0)
    # the middle of the other corners of the first cell of ``SPLIT``
    away = np.array([1.0, 0.5] if gdim == 2 else [1.0, 2 / 3, 1 / 3]) * (high - low) / n
    x[moved, :gdim] += (1.0 - 1.0 / strength) * away


def _arch(scene: Scene, mesh: dmesh.Mesh, strength: float) -> None:
    """The first axis becomes an arc of a circle of this radius, its middle at the bottom."""
    box, x, up = scene.bodies[0], mesh.geometry.x, scene.gdim - 1
    middle = 0.5 * (box.low[0] + box.high[0])
    angle = (x[:, 0] - middle) / strength
    height = x[:, up].copy()
    x[:, 0] = middle + (strength - height) * np.sin(angle)
    x[:, up] = strength - (strength - height) * np.cos(angle)
