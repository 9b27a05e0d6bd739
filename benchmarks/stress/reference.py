"""The independent answer: untorn bodies on one rank, an LP's verdict, a dense dual problem.

Elasticity is assembled by DOLFINx on the untorn mesh. The conditions are nodal at obstacles and
those of ``mortar`` between sides. Whether there is a solution is an LP on the rigid motions that
Dirichlet conditions leave (Farkas). The solution comes from the compliance of the contact rows.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse import csr_array, diags_array

from benchmarks.stress import meshes
from benchmarks.stress.conditions import Conditions, conditions
from benchmarks.stress.scene import Scene, Side, side_name
from benchmarks.stress.sliding import solve_sliding
from benchmarks.stress.solve import DEPENDENT, EPSILON, UnsettledError, null_space, solve, verdict

SMALLEST = 2.5e-9  # of the largest displacement: a body has no less, 2.5e-13 of all being rounding
NO_WORK = 1e-13  # of all loads: rounding
ALONG = 1e-12  # of a motion: rounding, which must not hold anything
LITTLE = 0.25  # of a slip: what prescribed components leave
CARRIES = 1e-7  # of the largest force


@dataclass
class Answer:
    """What is right."""

    # solvable, no_solution, contradiction (of prescribed values and contacts), or borderline
    verdict: str
    x: np.ndarray  # nodes, shape ``(n, 3)``
    body: np.ndarray  # body of each node
    rows: csr_array  # conditions N u ≤ gap
    gap: np.ndarray  # their right sides
    load: float  # sum of the absolute values of the load
    u: np.ndarray | None = None  # displacement, shape ``(n, gdim)``
    forces: np.ndarray | None = None  # contact forces on the nodes, shape ``(n, gdim)``
    # rigid motions that the solution is unique up to, shape ``(n * gdim, k)``
    free: np.ndarray | None = None
    # relative change of u, per body, when K and the gaps change by rounding
    noise: np.ndarray | None = None
    force_noise: float = 0.0  # change of the resultants of forces by that, or what balance lacks

    @property
    def point_noise(self) -> np.ndarray:
        """Lengths that rounding of the points of each body makes: less than that is no motion."""
        bodies = range(self.body.max() + 1)
        extents = [np.ptp(self.x[self.body == b], axis=0).max() for b in bodies]
        return EPSILON * np.array(extents)


class Untorn:
    """The scene on one rank.

    Args:
        scene: The scene.
        g: Its grid.
        mu: Lamé's μ of the grid's cells.
        lmbda: Lamé's λ of the grid's cells.
    """

    def __init__(self, scene: Scene, g: meshes.Grid, mu: np.ndarray, lmbda: np.ndarray) -> None:
        self.scene, self.gdim = scene, scene.gdim
        mesh, tags, cell = meshes.make_mesh(scene, g, MPI.COMM_SELF)
        of_cells = (values[cell] for values in (mu, lmbda, meshes.loads_of(scene, g)))
        V, a, L = meshes.elasticity(scene, mesh, tags, *of_cells)
        K = fem.assemble_matrix(fem.form(a), block_mode=None).to_scipy()
        self.K, self.f = csr_array(K), fem.assemble_vector(fem.form(L)).array.copy()
        self.x = V.tabulate_dof_coordinates()
        self.body = np.zeros(len(self.x), dtype=int)
        cells = V.dofmap.list
        self.body[cells] = g.body[cell][:, None]
        self._mesh, self._tags, self._V = mesh, tags, V
        self._nodes_of = [np.unique(cells[g.body[cell] == b]) for b in range(len(scene.bodies))]
        self.fixed, self.values = np.zeros(len(self.f), dtype=bool), np.zeros(len(self.f))
        for bc in meshes.prescribed(scene, V, self._facets):
            dofs, own = bc.dof_indices()
            self.fixed[dofs[:own]] = True
            bc.set(self.values)
        self.conditions = conditions(scene, self.x, self._facet_nodes, self.fixed)
        self.rows, self.gap = self.conditions.N, self.conditions.gap
        boxes = [np.subtract(b.high, b.low) for b in scene.bodies]
        self.length = float(min(box.max() for box in boxes))

    def _facets(self, side: Side) -> np.ndarray:
        return self._tags.find(self.scene.surfaces[side_name(side)])

    def _facet_nodes(self, side: Side) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and all nodes of the facets of a side."""
        topology, fdim, nodes = self._mesh.topology, self.gdim - 1, []
        topology.create_connectivity(fdim + 1, fdim)
        cell_of = topology.connectivity(fdim, fdim + 1)
        facets_of = topology.connectivity(fdim + 1, fdim)
        for facet in self._facets(side):
            cell = cell_of.links(facet)[0]
            local = int(np.flatnonzero(facets_of.links(cell) == facet)[0])
            on_facet = self._V.dofmap.dof_layout.entity_closure_dofs(fdim, local)
            nodes.append(self._V.dofmap.list[cell][on_facet])  # vertices first
        corners = fdim + 1 if self.scene.cell in meshes.SPLIT else 2**fdim
        return np.array(nodes)[:, :corners], np.array(nodes)

    def rigid_motions(self) -> np.ndarray:
        """Motions of bodies that prescribed values and hinges leave, largest about 1."""
        n, gdim, out, held = len(self.f), self.gdim, [], []
        for nodes in self._nodes_of:
            x = self.x[nodes] - self.x[nodes].mean(axis=0)
            x /= np.abs(x).max()
            turns = [(0, 1)] if gdim == 2 else [(0, 1), (1, 2), (2, 0)]
            R = np.zeros((len(nodes), gdim, gdim + len(turns)))
            R[:, range(gdim), range(gdim)] = 1.0
            for k, (i, j) in enumerate(turns):
                R[:, i, gdim + k], R[:, j, gdim + k] = -x[:, j], x[:, i]
            R = R.reshape(-1, R.shape[2])
            dofs = (nodes[:, None] * gdim + np.arange(gdim)).ravel()
            kept = null_space(R[self.fixed[dofs]])
            motions = np.zeros((n, kept.shape[1]))
            moved = R @ kept
            motions[dofs] = np.where(np.abs(moved) > ALONG * np.abs(moved).max(axis=0), moved, 0.0)
            out.append(motions)
            held.append(np.repeat(np.isin(np.arange(len(self.x)), nodes), gdim))
        return _hinged(out, held)

    def _slid(self, known: Answer, K: csr_array, f: np.ndarray, gap: np.ndarray) -> None:
        """The answer where there is friction: K, loads and gaps of the free unknowns are given."""
        c, free = self.conditions, ~self.fixed
        size = (np.asarray(abs(A).sum(axis=1)) for A in (c.T[:, free], c.T))
        # on a plane of symmetry nothing slips across, whatever other nodes leave of a row
        slips = np.divide(*size) > LITTLE
        slip = csr_array(diags_array(slips.astype(float)) @ c.T)
        T = slip[:, free]
        # Tresca's law acts where the normal displacement is prescribed, too
        size = np.asarray(abs(T).sum(axis=1)).reshape(c.N.shape[0], -1).sum(axis=1)
        moves = np.asarray(abs(c.N[:, free]).sum(axis=1)).ravel() > DEPENDENT
        moves |= (c.given > 0.0) & (size > DEPENDENT)
        along = np.repeat(moves, T.shape[0] // len(moves))
        N, gap, slipped = c.N[moves][:, free], gap[moves], slip[along] @ self.values
        law = Conditions(N, T[along], gap, c.given[moves], c.coefficient[moves], slipped)
        u, lam, tau = solve_sliding(K, f, law)
        known.free = np.zeros((len(self.f), 0))
        known.u = self._smallest(u, known.free)
        force = c.N[moves].T @ lam + slip[along].T @ tau.ravel()
        known.forces = -force.reshape(-1, self.gdim)
        known.noise = np.zeros(len(self.scene.bodies))
        K, gap = self._shaken(known, K, c.N[moves], gap)
        with contextlib.suppress(UnsettledError):
            u, *_ = solve_sliding(K, f, replace(law, gap=gap))
            known.noise = body_errors(known, self._smallest(u, known.free))

    def _shaken(
        self, known: Answer, K: csr_array, rows: csr_array, gap: np.ndarray
    ) -> tuple[csr_array, np.ndarray]:
        """K and the gaps of rows, changed by rounding."""
        rng = np.random.default_rng(0)
        shaken = K.copy()
        shaken.data = K.data * (1 + EPSILON * rng.uniform(-1, 1, len(K.data)))
        # points are rounded, as far as the largest of their coordinates, and so is N u where bodies
        # move far
        size = np.abs(known.u) + np.abs(self.x).max(axis=1, keepdims=True)
        gap = gap + EPSILON * (abs(rows) @ size.ravel()) * rng.uniform(-1, 1, len(gap))
        return 0.5 * (shaken + shaken.T), gap

    def answer(self) -> Answer:
        """Verdict and solution."""
        known = Answer("", self.x, self.body, self.rows, self.gap, np.abs(self.f).sum())
        free = ~self.fixed
        K, f = self.K[free][:, free], (self.f - self.K @ self.values)[free]
        N, gap = self.rows[:, free], self.gap - self.rows @ self.values
        R = self.rigid_motions()[free]
        weight = np.sqrt(N.multiply(N).sum(axis=1)) if N.shape[0] else np.zeros(0)
        known.verdict = verdict(N, gap, R, self.f[free], weight, self.length)
        if self.conditions.has_friction:
            known.verdict = "solvable"
            self._slid(known, K, f, gap)
        if known.verdict != "solvable" or known.u is not None:
            return known
        used = (weight > DEPENDENT) & _first(self.rows, self.gap)
        N, gap = N[used], gap[used]
        e = R.T @ self.f[free]
        e[np.abs(e) <= NO_WORK * known.load] = 0.0
        lam, u, rigid = solve(K, f, N, gap, R, e)
        carrying = lam > CARRIES * lam.max(initial=0.0)
        kept = R @ null_space(N[carrying] @ R)
        known.free = np.zeros((len(self.f), kept.shape[1]))
        known.free[free] = kept
        known.u = self._smallest(u, known.free)
        known.forces = self._forces(used, lam)
        K, gap = self._shaken(known, K, self.rows[used], gap)
        pressed, other, _ = solve(K, f, N, gap, R, e, (lam > 0.0, rigid))
        second = self._smallest(other, known.free)
        known.noise = body_errors(known, second)
        change = resultants(known, self._forces(used, pressed)) - resultants(known, known.forces)
        left = R.T @ (f - N.T @ lam)  # bodies that fall far are not held to the last digits
        known.force_noise = float(max(np.abs(change).max(), np.abs(left).max(initial=0.0)))
        return known

    def _forces(self, used: np.ndarray, lam: np.ndarray) -> np.ndarray:
        return -(self.rows[used].T @ lam).reshape(-1, self.gdim)

    def _smallest(self, u: np.ndarray, motions: np.ndarray) -> np.ndarray:
        """All displacements, from the free ones, less what is free."""
        full = self.values.copy()
        full[~self.fixed] = u
        if motions.shape[1]:
            full -= motions @ np.linalg.lstsq(motions, full)[0]
        return full.reshape(-1, self.gdim)


def _first(N: csr_array, gap: np.ndarray) -> np.ndarray:
    """Of conditions that are the same the first."""
    both = np.concatenate((N.toarray(), gap[:, None]), axis=1)
    first = np.zeros(len(gap), dtype=bool)
    first[np.unique(both, axis=0, return_index=True)[1]] = True
    return first


def _hinged(motions: list[np.ndarray], of_body: list[np.ndarray]) -> np.ndarray:
    """Of motions of bodies those that agree where bodies share nodes."""
    whole = np.concatenate(motions, axis=1) / np.sum(of_body, axis=0)[:, None]
    differ = [np.zeros((0, whole.shape[1]))]
    for j, i in combinations(range(len(motions)), 2):
        rows = of_body[i] & of_body[j]
        parts = [np.zeros((rows.sum(), m.shape[1])) for m in motions]
        parts[i], parts[j] = motions[i][rows], -motions[j][rows]
        differ.append(np.concatenate(parts, axis=1))
    return whole @ null_space(np.concatenate(differ))


def resultants(answer: Answer, forces: np.ndarray) -> np.ndarray:
    """Sums of nodal forces over each body, shape ``(bodies, gdim)``."""
    bodies = range(answer.body.max() + 1)
    return np.array([forces[answer.body == b].sum(axis=0) for b in bodies])


def body_sizes(answer: Answer, u: np.ndarray) -> np.ndarray:
    """Displacement of each body: where it moves freely, what it was taken to be counts too."""
    both = np.maximum(np.abs(answer.u), np.abs(u)).max(axis=1)
    size = np.array([both[answer.body == b].max() for b in range(answer.body.max() + 1)])
    size = np.maximum(size, SMALLEST * size.max())
    size[size == 0.0] = 1.0
    return size


def body_errors(answer: Answer, u: np.ndarray) -> np.ndarray:
    """max |u − answer.u| over the displacement of each body, modulo its free motions."""
    bodies = range(answer.body.max() + 1)
    difference, size = u - answer.u, body_sizes(answer, u)
    weight = np.repeat(1.0 / size[answer.body], u.shape[1])
    if answer.free.shape[1]:
        z = np.linalg.lstsq(answer.free * weight[:, None], difference.ravel() * weight)[0]
        difference = difference - (answer.free @ z).reshape(u.shape)
    return np.array([np.abs(difference[answer.body == b]).max() for b in bodies]) / size
