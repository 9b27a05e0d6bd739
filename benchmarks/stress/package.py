"""A scene given to tfeti_dolfinx, and what comes back."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

import tfeti_dolfinx as tfeti
from benchmarks.stress import meshes
from benchmarks.stress.scene import Scene, side_name, wall_distance


@dataclass
class Outcome:
    """What the package did with a scene, on rank 0; what is not known is None."""

    error: str = ""  # type and message of what was raised, the same on all ranks
    disagree: str = ""  # what ranks raised where they differ
    mu: np.ndarray | None = None  # Lamé's constants of the grid's cells, if the mesh was torn
    lmbda: np.ndarray | None = None
    x: np.ndarray | None = None  # nodes of all torn copies, their bodies and displacements
    body: np.ndarray | None = None
    u: np.ndarray | None = None
    forces: np.ndarray | None = None  # resultants of the contact forces on the bodies
    report: dict[str, Any] = field(default_factory=dict)  # some of it
    seconds: float = 0.0


def contacts_of(scene: Scene) -> list[Any]:
    """Obstacles and pairs in the package's words."""
    laws = {"tresca": tfeti.Tresca, "coulomb": tfeti.Coulomb}

    def law(friction: tuple[str, float] | None) -> Any:
        return friction and laws[friction[0]](friction[1])

    walls: list[Any] = []
    for w in scene.walls:
        distances = (lambda x, w=w, k=k: wall_distance(w, x)[k] for k in (0, 1))
        shape = tfeti.SignedDistance(*distances)
        walls.append(tfeti.Obstacle(side_name(w.side), shape, friction=law(w.friction)))
    for p in scene.pairs:
        own, other = side_name(p.secondary), side_name(p.primary)
        walls.append(tfeti.Contact(own, other, secondary=own, friction=law(p.friction)))
    return walls


def partition(scene: Scene) -> Any:
    """What ``decompose`` is given: a number, or subdomains of points.

    Random ones are by nearest points of each body. Those that hang together in corners alone are
    two in each body, its quarters or eighths in turn.
    """
    if not scene.hanging and scene.scattered is None:
        return scene.subdomains
    low = np.array([b.low for b in scene.bodies])
    high = np.array([b.high for b in scene.bodies])
    share = 2 if scene.hanging else -(-scene.subdomains // len(scene.bodies))
    rng = np.random.default_rng(scene.scattered or 0)
    seeds = rng.uniform(size=(len(scene.bodies), share, scene.gdim))

    def subdomain(x: np.ndarray) -> np.ndarray:
        t = (x[: scene.gdim].T[:, None] - low) / (high - low)
        body = np.abs(t - 0.5).max(axis=2).argmin(axis=1)
        own = t[np.arange(len(t)), body]
        if scene.hanging:
            return share * body + (own > 0.5).sum(axis=1) % 2
        nearest = np.linalg.norm(own[:, None] - seeds[body], axis=2)
        return share * body + nearest.argmin(axis=1)

    return subdomain


def solve_scene(scene: Scene, g: meshes.Grid, comm: MPI.Intracomm) -> Outcome:
    """Solve by the package. Collective; the outcome is complete on rank 0."""
    outcome, start, error, problem = Outcome(), time.perf_counter(), "", None
    try:
        problem = _problem(scene, g, comm, outcome)
        problem.solve()
        _collect(scene, g, problem, outcome)
    except Exception as caught:
        error = f"{type(caught).__name__}: {caught}"
    if problem is not None:
        report = problem.report
        outcome.report = {
            "reason": report.converged_reason,
            "warnings": report.warnings + report.notes,
            "F": report.F_multiplications,
            "S": report.preconditioner_multiplications,
            "estimate": report.residuals.get("displacement_error", 0.0),
        }
        problem.destroy()
    outcome.seconds = time.perf_counter() - start
    errors = comm.allgather(error)
    outcome.error = next((e for e in errors if e), "")
    if len(set(errors)) > 1:
        outcome.disagree = " | ".join(errors)
    return outcome


def _problem(
    scene: Scene, g: meshes.Grid, comm: MPI.Intracomm, outcome: Outcome
) -> tfeti.ContactProblem:
    mesh, tags, _ = meshes.make_mesh(scene, g, comm)
    d = tfeti.decompose(mesh, partition(scene), facet_tags=tags, surfaces=scene.surfaces)
    subdomain = np.zeros(len(g.cells), dtype=np.int64)
    subdomain[d.original_cells] = d.cell_subdomain
    subdomain = comm.allreduce(subdomain)
    outcome.mu, outcome.lmbda = mu, lmbda = meshes.materials(scene, g, subdomain)
    of_cells = (values[d.original_cells] for values in (mu, lmbda, meshes.loads_of(scene, g)))
    V, a, L = meshes.elasticity(scene, d.mesh, d.facet_tags, *of_cells)
    bcs = meshes.prescribed(scene, V, lambda side: d.facets(side_name(side)))
    options = dict(scene.options)
    return tfeti.ContactProblem(a, L, bcs, contacts_of(scene), d, petsc_options=options)


def _collect(scene: Scene, g: meshes.Grid, problem: tfeti.ContactProblem, outcome: Outcome) -> None:
    d, V, gdim = problem.decomposition, problem.u.function_space, scene.gdim
    comm = d.comm
    x = V.tabulate_dof_coordinates()
    body = np.zeros(len(x), dtype=int)
    body[V.dofmap.list[: len(d.original_cells)]] = g.body[d.original_cells][:, None]
    forces = np.zeros((len(scene.bodies), gdim))
    partners = [(w.side[0], None) for w in scene.walls]
    partners += [(p.secondary[0], p.primary[0]) for p in scene.pairs]
    gluing, force = problem.solution.gluing, problem.solution.force.copy()
    force[gluing.closed()] = 0.0  # held nodes are given what nothing says (docs/howto/reactions.md)
    for k, (own, other) in enumerate(partners):
        data, of = problem.solution.contact(k), gluing.records.contact == k
        total = force[of] @ gluing.records.normal[of]
        total -= data.area @ data.tangential_traction.reshape(len(data.force), gdim)
        forces[own] -= total
        if other is not None:
            forces[other] += total
    outcome.forces = comm.allreduce(forces)
    gathered = [comm.gather(part) for part in (x, body, problem.u.x.array.reshape(-1, gdim))]
    if comm.rank == 0:
        outcome.x, outcome.body, outcome.u = (np.concatenate(part) for part in gathered)
