"""Random nonlinear scenes: each accepted step is checked by laws on the untorn mesh.

    ./run python3 -m benchmarks.stress.nonlinear --scenes 300 --seed 0

A scene is a block on a fixed obstacle, a block under a rigid tool that moves by a law or under a
force, or a block on another one; of neo-Hooke, St. Venant and Kirchhoff, J2 plasticity, or a law of
total deformations; with friction or without; pressed, drawn along, let go, in 2D and 3D. A step
that does not converge is halved. What is accepted is looked at by code that shares nothing with the
package: the residual of the displacement, assembled by DOLFINx on the mesh as it was given,
balances by itself but for supports and contact, and its part at contacts keeps the laws of contact
and Coulomb at each node. Classes in capitals must not occur; ends with 1 if one did. Serial.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.stress import meshes
from benchmarks.stress.laws import SimplePlasticity, deformation, neo_hooke, st_venant
from benchmarks.stress.scene import GDIM, Body, side_name
from benchmarks.stress.scene import Scene as Boxes
from benchmarks.tools import limited, over_seeds, wrong

RTOL = 1e-7  # of the package
RESIDUAL, GAP, SLIP = 1e-5, 1e-5, 1e-4  # of stiffness times displacement, and of displacement
SECONDS, HALVINGS = 300, 5
CELLS = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
# how far a block is pressed at most, by law
DEEPEST = {"neo-Hooke": 0.5, "St. Venant": 0.15, "J2": 0.08, "deformation": 0.15}
HELD = {"press": ("top",), "tool": ("bottom",), "force": ("bottom",), "pair": ("bottom", "top")}
MEETS = {
    "press": ("bottom",),
    "tool": ("top",),
    "force": ("top",),
    "pair": ("inner low", "inner high"),
}


@dataclass
class Scene:
    """A scene drawn from a seed."""

    kind: str  # "press", "tool", "force" or "pair"
    law: str  # "neo-Hooke", "St. Venant", "J2" or "deformation"
    cell: str  # name of the cell type
    cells: list[tuple[int, ...]]  # cells along the axes of each block
    nu: float  # Poisson's ratio
    friction: float  # μ
    radius: float  # that of a ball, or infinite of a plane
    # displacements of what moves, or in the last component its force, shape ``(s, gdim)``
    path: np.ndarray
    subdomains: int  # how many

    @property
    def gdim(self) -> int:
        """Dimension."""
        return len(self.cells[0])

    @property
    def finite(self) -> bool:
        """True if strains are finite."""
        return self.law in ("neo-Hooke", "St. Venant")


def random_scene(seed: int) -> Scene:
    """Draw a scene."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(list(HELD)))
    law = str(rng.choice(list(DEEPEST), p=[0.4, 0.1, 0.3, 0.2]))
    cell = str(rng.choice(CELLS, p=[0.35, 0.35, 0.15, 0.15]))
    gdim = GDIM[cell]
    most = 7 if gdim == 2 else 4
    count = 2 if kind == "pair" else 1
    cells = [tuple(int(n) for n in rng.integers(2, most, gdim)) for _ in range(count)]
    deepest = DEEPEST[law] * float(rng.uniform(0.1, 1.0)) * (2.0 if kind == "pair" else 1.0)
    steps = int(rng.integers(3, 7))
    path = np.zeros((steps, gdim))
    share = np.linspace(1.0 / steps, 1.0, steps)
    if rng.uniform() < 0.5:  # to and fro
        share = rng.uniform(-0.1, 1.0, steps)
    path[:, -1] = -deepest * share
    if rng.uniform() < 0.7:
        path[:, 0] = deepest * np.cumsum(rng.uniform(-0.5, 0.7, steps))
    if kind == "force":
        path[:, -1] = -0.5 * deepest * np.clip(share, 0.05, 1.0)
    return Scene(
        kind=kind,
        law=law,
        cell=cell,
        cells=cells,
        nu=float(rng.uniform(0.0, 0.4)),
        friction=float(rng.uniform(0.0, 1.0)) if rng.uniform() < 0.6 else 0.0,
        radius=float(rng.uniform(0.6, 3.0)) if rng.uniform() < 0.6 else np.inf,
        path=path,
        subdomains=int(rng.integers(1, 6)),
    )


# --- Meshes -----------------------------------------------------------------------------------


def blocks(scene: Scene) -> tuple[dmesh.Mesh, Any, dict[str, int]]:
    """Unit blocks, one on the other, that share no node; tags of their sides, and names of some."""
    up = (0.0,) * (scene.gdim - 1)
    bodies = [
        Body((*up, float(k)), (*(1.0 for _ in up), k + 1.0), n) for k, n in enumerate(scene.cells)
    ]
    boxes = Boxes(scene.cell, tuple(bodies))
    mesh, tags, _ = meshes.make_mesh(boxes, meshes.grid(boxes), MPI.COMM_SELF)
    last, axis = len(bodies) - 1, len(up)
    names = {"bottom": (0, axis, 0), "top": (last, axis, 1)}
    if last:
        names |= {"inner low": (0, axis, 1), "inner high": (1, axis, 0)}
    return mesh, tags, {name: boxes.surfaces[side_name(side)] for name, side in names.items()}


YIELD, HARDENING = 0.01, 0.1
ENERGIES = {"neo-Hooke": neo_hooke, "St. Venant": st_venant, "deformation": deformation}


def elastic_residual(scene: Scene, u: fem.Function) -> Any:
    """Both sides of the comparison get the same law from the user's hands."""
    V = u.function_space
    energy = ENERGIES[scene.law](u, 1.0, fem.Constant(V.mesh, scene.nu))
    dx = ufl.dx(metadata={"quadrature_degree": 4})
    return ufl.derivative(energy * dx, u, ufl.TestFunction(V))


# --- The package's problem ----------------------------------------------------------------------


def placed(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """A point of the obstacle and its normal there: below what is pressed on it, or a tool above.

    The bottom of the ball or the plane of a tool is at the top of the block.
    """
    foot, normal = np.full(scene.gdim, 0.45), np.zeros(scene.gdim)
    foot[-1], normal[-1] = (0.0, 1.0) if scene.kind == "press" else (1.0, -1.0)
    return foot, normal


def shape_of(scene: Scene) -> Any:
    """The obstacle in the package's words."""
    foot, normal = placed(scene)
    if np.isinf(scene.radius):
        return tfeti.Plane(foot, normal)
    return tfeti.Sphere(foot - scene.radius * normal, scene.radius)


def posed(
    scene: Scene, mesh: dmesh.Mesh, tags: Any, surfaces: dict[str, int]
) -> tuple[Any, Callable[[np.ndarray], None]]:
    """Give a scene to the package; the problem, and how the scene moves."""
    gdim = scene.gdim
    count = min(scene.subdomains, mesh.topology.index_map(mesh.topology.dim).size_global)
    decomposition = tfeti.decompose(mesh, count, facet_tags=tags, surfaces=surfaces)
    V = fem.functionspace(decomposition.mesh, ("Lagrange", 1, (gdim,)))
    u = fem.Function(V, name="u")
    given: dict[str, Any] = {"petsc_options": {"rtol": RTOL}, "finite": scene.finite}
    if scene.law == "J2":
        model = "plane_strain" if gdim == 2 else "3d"
        elastic = tfeti.Elasticity(decomposition, E=1.0, nu=scene.nu, model=model)
        law = tfeti.J2Plasticity(elastic, u, yield_stress=YIELD, hardening=HARDENING)
        residual = law.residual(ufl.TestFunction(V))
    else:
        residual = elastic_residual(scene, u)
    way, force = (fem.Constant(decomposition.mesh, np.zeros(gdim)) for _ in range(2))
    bcs = []
    for name, value in (("bottom", np.zeros(gdim)), ("top", way)):
        if name in HELD[scene.kind]:
            dofs = fem.locate_dofs_topological(V, gdim - 1, decomposition.facets(name))
            bcs.append(fem.dirichletbc(value, dofs, V))

    def move(to: np.ndarray) -> None:
        way.value[:] = to
        if scene.kind == "force":
            way.value[-1], force.value[-1] = 0.0, to[-1]

    contacts = [contact_of(scene, way, force)]
    problem = tfeti.NonlinearContactProblem(residual, u, bcs, contacts, decomposition, **given)
    return problem, move


def contact_of(scene: Scene, way: fem.Constant, force: fem.Constant) -> Any:
    """Return the contact of a scene; a tool goes a way, or is under a force."""
    friction = tfeti.Coulomb(scene.friction) if scene.friction else None
    if scene.kind == "pair":
        return tfeti.Contact("inner low", "inner high", friction=friction)
    if scene.kind == "press":
        return tfeti.Obstacle("bottom", shape_of(scene), friction=friction)
    given: dict[str, Any] = {"displacement": way}
    if scene.kind == "force":
        given |= {"force": force, "free": ("xyz"[scene.gdim - 1],)}
    tool = tfeti.RigidBody(shape_of(scene), name="tool", **given)
    return tfeti.Obstacle("top", tool, friction=friction)


# --- Checks on the mesh as it was given -----------------------------------------------------------


class Check:
    """Checks of accepted steps.

    Args:
        scene: The scene.
        mesh: The mesh given to ``decompose``.
        tags: Tags of its sides.
        surfaces: Their names.
    """

    def __init__(self, scene: Scene, mesh: dmesh.Mesh, tags: Any, surfaces: dict[str, int]) -> None:
        self.scene, gdim = scene, scene.gdim
        V = fem.functionspace(mesh, ("Lagrange", 1, (gdim,)))
        self.u, self.x = fem.Function(V), V.tabulate_dof_coordinates()[:, :gdim]
        self.plastic = None
        if scene.law == "J2":
            nu = fem.Constant(mesh, scene.nu)
            self.plastic = SimplePlasticity(self.u, 1.0, nu, YIELD, HARDENING, 2)
            self._form = fem.form(self.plastic.residual(ufl.TestFunction(V)))
        else:
            self._form = fem.form(elastic_residual(scene, self.u))
        nodes = {
            name: fem.locate_dofs_topological(V, gdim - 1, tags.find(tag))
            for name, tag in surfaces.items()
        }
        self.held = np.unique(np.concatenate([nodes[name] for name in HELD[scene.kind]]))
        self.meets = [nodes[name] for name in MEETS[scene.kind]]
        self.before, self.tool = np.zeros_like(self.x), np.zeros(gdim)
        self._gdim, self._h = gdim, 1.0 / max(max(n) for n in scene.cells)

    def step(self, u: fem.Function, tool: np.ndarray, force: float | None) -> list[str]:
        """Return what is wrong with a step: its displacement, the tool's, the force on it."""
        self.u.x.array[:] = u.x.array
        r = np.array(fem.assemble_vector(self._form).array).reshape(-1, self._gdim)
        moved = self.u.x.array.reshape(-1, self._gdim)
        size = max(float(np.abs(moved).max()), float(np.abs(tool).max()), 1e-12)
        unit = size * self._h ** (self._gdim - 2)  # E = 1
        free = np.ones(len(self.x), dtype=bool)
        free[self.held] = False
        for nodes in self.meets:
            free[nodes] = False
        found = {"residual": float(np.abs(r[free]).max(initial=0.0)) / unit / RESIDUAL}
        if self.scene.kind == "pair":
            found |= self._pair(r, unit)
        else:
            found |= self._obstacle(r, moved, tool, unit, size)
            if force is not None:
                pushed = r[self.meets[0], -1].sum()
                found["tool"] = abs(pushed - force) / unit / RESIDUAL
        if self.plastic is not None:
            self.plastic.commit()
        self.before, self.tool = moved.copy(), tool.copy()
        return [f"{name} {value:.1e}" for name, value in found.items() if not value <= 1.0]

    def _pair(self, r: np.ndarray, unit: float) -> dict[str, float]:
        """Action and reaction, and the upper block is pushed upwards, within Coulomb's cone."""
        low, high = (r[nodes].sum(axis=0) for nodes in self.meets)
        limit = RESIDUAL * unit
        found = {"reaction": np.abs(low + high).max() / limit, "pull": -high[-1] / limit}
        if not self.scene.finite:
            drag = np.linalg.norm(high[:-1]) - self.scene.friction * high[-1]
            found["cone"] = drag / limit
        return found

    def _obstacle(
        self, r: np.ndarray, moved: np.ndarray, tool: np.ndarray, unit: float, size: float
    ) -> dict[str, float]:
        """Signorini's and Coulomb's laws at each node."""
        scene, nodes = self.scene, np.setdiff1d(self.meets[0], self.held)
        X, u, f = self.x[nodes], moved[nodes], r[nodes]
        if scene.finite:
            gap, normal = self._distance(X + u - tool)
        else:
            gap, normal = self._distance(X)
            gap = gap + np.sum(normal * (u - tool), axis=1)
        p = np.sum(f * normal, axis=1)
        t = f - p[:, None] * normal
        slip = (u - self.before[nodes]) - (tool - self.tool)
        slip -= np.sum(slip * normal, axis=1)[:, None] * normal
        drag, way = np.linalg.norm(t, axis=1), np.linalg.norm(slip, axis=1)
        bound = scene.friction * np.maximum(p, 0.0)
        limit = RESIDUAL * unit
        sticks = drag < bound - 10 * limit
        slips = way > SLIP * size
        against = np.sum(t * slip, axis=1) / np.maximum(way, 1e-300) + np.minimum(drag, bound)
        return {
            "pull": float(np.max(-p, initial=0.0)) / limit,
            "overlap": float(np.max(-gap, initial=0.0)) / (GAP * size),
            "apart": float(np.max(gap[p > 10 * limit], initial=0.0)) / (GAP * size),
            "cone": float(np.max(drag - bound, initial=0.0)) / limit,
            "stick": float(np.max(way[sticks], initial=0.0)) / (SLIP * size),
            "direction": float(np.max(against[slips], initial=0.0)) / (100 * limit),
        }

    def _distance(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance from the obstacle where its motion is 0, and its normal."""
        foot, normal = placed(self.scene)
        if np.isinf(self.scene.radius):
            return (x - foot) @ normal, np.tile(normal, (len(x), 1))
        way = x - (foot - self.scene.radius * normal)
        r = np.linalg.norm(way, axis=1)
        return r - self.scene.radius, way / r[:, None]


# --- One scene, and all -----------------------------------------------------------------------


def run_scene(scene: Scene) -> dict[str, Any]:
    """Solve and check a scene; its class and figures."""
    row: dict[str, Any] = {"kind": scene.kind, "law": scene.law, "cell": scene.cell, "halved": 0}
    begin = time.perf_counter()
    try:
        row["class"] = limited(SECONDS, lambda: _solved(scene, row))
    except TimeoutError:
        row["class"] = "SLOW"
    except Exception as error:
        kind = "not solved" if isinstance(error, tfeti.TfetiError) else "CRASH"
        row |= {"class": kind, "error": f"{type(error).__name__}: {error}"}
    return {**row, "seconds": time.perf_counter() - begin}


def _solved(scene: Scene, row: dict[str, Any]) -> str:
    made, missed = blocks(scene), list[str]()
    (problem, move), check = posed(scene, *made), Check(scene, *made)
    row["F"] = row["newton"] = 0

    def advance(start: np.ndarray, end: np.ndarray, halvings: int) -> None:
        move(end)
        try:
            problem.solve()
        except tfeti.ConvergenceError:
            if halvings == HALVINGS:
                raise
            problem.go_back()
            row["halved"] += 1
            middle = 0.5 * (start + end)
            advance(start, middle, halvings + 1)
            advance(middle, end, halvings + 1)
            return
        problem.accept()
        row["F"] += problem.report.F_multiplications
        row["newton"] += problem.report.newton_steps
        tool, force = np.zeros(scene.gdim), None
        if scene.kind in ("tool", "force"):
            tool = np.array(problem.solution.tool("tool").displacement)
            force = float(end[-1]) if scene.kind == "force" else None
        u = problem.decomposition.to_original(problem.u)
        missed.extend(check.step(u, tool, force))

    start = np.zeros(scene.gdim)
    if scene.kind == "force":
        start[-1] = 0.1 * scene.path[0, -1]
    for end in scene.path:
        advance(start, end, 0)
        start = end
    problem.destroy()
    if missed:
        row["error"] = "; ".join(missed[:4])
    return "WRONG" if missed else "right"


def main(argv: list[str]) -> list[dict[str, Any]]:
    """Run scenes; returns their rows."""
    return over_seeds(__doc__, argv, 300, "nonlinear", lambda seed: run_scene(random_scene(seed)))


if __name__ == "__main__":
    sys.exit(wrong(main(sys.argv[1:])))
