"""The independent answer: untorn bodies on one rank, an LP's verdict, a dense dual problem.

Elasticity is assembled by DOLFINx on the untorn mesh. The conditions are nodal at obstacles and
those of ``mortar`` between sides. Whether there is a solution is an LP on the rigid motions that
Dirichlet conditions leave (Farkas). The solution comes from the compliance of the contact rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from scipy.sparse import csr_array

from benchmarks.stress import meshes
from benchmarks.stress.mortar import Facet, mortar
from benchmarks.stress.scene import Pair, Scene, Side, wall_distance
from benchmarks.stress.solve import DEPENDENT, EPSILON, null_space, solve, verdict
from tfeti_dolfinx.compat import geometry_dofmap

SMALLEST = 1e-9  # of the largest displacement of all bodies: what a body has at least
NO_WORK = 1e-13  # of all loads: rounding
ALONG = 1e-12  # of a motion: rounding, which must not hold anything
CARRIES = 1e-7  # of the largest force


@dataclass
class Answer:
    """What is right.

    Attributes:
        verdict: solvable, no_solution, contradiction (of prescribed values and contacts), or
            borderline.
        x: Nodes, shape ``(n, 3)``.
        body: Body of each node.
        u: Displacement, shape ``(n, gdim)``.
        forces: Contact forces on the nodes, shape ``(n, gdim)``.
        free: Rigid motions that the solution is unique up to, shape ``(n * gdim, k)``.
        load: Sum of the absolute values of the load.
        noise: Relative change of u, per body, when K and the gaps change by rounding.
        force_noise: Change of the resultants of the contact forces on the bodies by that.
        rows: Conditions N u ≤ gap.
        gap: Their right sides.
    """

    verdict: str
    x: np.ndarray
    body: np.ndarray
    rows: csr_array
    gap: np.ndarray
    load: float
    u: np.ndarray | None = None
    forces: np.ndarray | None = None
    free: np.ndarray | None = None
    noise: np.ndarray | None = None
    force_noise: float = 0.0

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
        mesh = meshes.make_mesh(scene, g, MPI.COMM_SELF)
        cell = np.asarray(mesh.topology.original_cell_index)
        tags = meshes.tag_sides(scene, mesh, g.body[cell])
        loads = meshes.loads_of(scene)[g.body[cell]]
        V, a, L = meshes.elasticity(scene, mesh, tags, mu[cell], lmbda[cell], loads)
        K = fem.assemble_matrix(fem.form(a), block_mode=None).to_scipy()
        self.K, self.f = csr_array(K), fem.assemble_vector(fem.form(L)).array.copy()
        self.x = V.tabulate_dof_coordinates()
        self.body = np.zeros(len(self.x), dtype=int)
        cells = V.dofmap.list
        self.body[cells] = g.body[cell][:, None]
        self._mesh, self._tags, self._V = mesh, tags, V
        self._dof = np.zeros(len(mesh.geometry.x), dtype=int)
        self._dof[geometry_dofmap(mesh)] = cells
        self.fixed, self.values = np.zeros(len(self.f), dtype=bool), np.zeros(len(self.f))
        for bc in meshes.prescribed(scene, V, self._facets):
            dofs, own = bc.dof_indices()
            self.fixed[dofs[:own]] = True
            bc.set(self.values)
        self.rows, self.gap = self._conditions()
        boxes = [np.subtract(b.high, b.low) for b in scene.bodies]
        self.length = float(min(box.max() for box in boxes))

    def _facets(self, side: Side) -> np.ndarray:
        body, axis, end = side
        return self._tags.find(body * 2 * self.gdim + 2 * axis + end + 1)

    def _conditions(self) -> tuple[csr_array, np.ndarray]:
        rows, columns, values, gaps = [], [], [], []
        for wall in self.scene.walls:
            nodes = np.unique(self._dof[self._vertices(wall.side)])
            distance, gradient = wall_distance(wall, self.x[nodes].T)
            length = np.linalg.norm(gradient, axis=0)
            for k, node in enumerate(nodes):
                for c in range(self.gdim):
                    rows.append(len(gaps))
                    columns.append(node * self.gdim + c)
                    values.append(-gradient[c, k] / length[k])
                gaps.append(distance[k] / length[k])
        for pair in self.scene.pairs:
            D, M, sign, gap = self._mortar(pair)
            number = {i: len(gaps) + k for k, i in enumerate(D)}
            axis = pair.secondary[1]
            for i in D:
                rows.append(number[i])
                columns.append(i * self.gdim + axis)
                values.append(sign)
                gaps.append(gap)
            for (i, j), m in M.items():
                if i in D:
                    rows.append(number[i])
                    columns.append(j * self.gdim + axis)
                    values.append(-sign * m / D[i])
        shape = (len(gaps), len(self.f))
        return csr_array((values, (rows, columns)), shape=shape), np.array(gaps)

    def _vertices(self, side: Side) -> np.ndarray:
        return dmesh.entities_to_geometry(self._mesh, self.gdim - 1, self._facets(side))

    def _mortar(
        self, pair: Pair
    ) -> tuple[dict[int, float], dict[tuple[int, int], float], float, float]:
        axis, end = pair.secondary[1:]
        across = [c for c in range(self.gdim) if c != axis]
        sides = []
        for side in (pair.secondary, pair.primary):
            nodes = self._dof[self._vertices(side)]
            sides.append([Facet(n, self.x[n][:, across]) for n in nodes])
        sign = 1.0 if end else -1.0
        at = [
            (b.low, b.high)[side[2]][axis]
            for side in (pair.secondary, pair.primary)
            for b in [self.scene.bodies[side[0]]]
        ]
        return *mortar(*sides), sign, sign * (at[1] - at[0])

    def rigid_motions(self) -> np.ndarray:
        """Motions of whole bodies that prescribed values leave, largest displacement about 1."""
        n, gdim, out = len(self.f), self.gdim, []
        for b in range(len(self.scene.bodies)):
            nodes = np.flatnonzero(self.body == b)
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
        return np.concatenate(out, axis=1)

    def answer(self) -> Answer:
        """Verdict and solution."""
        known = Answer("", self.x, self.body, self.rows, self.gap, np.abs(self.f).sum())
        free = ~self.fixed
        f = self.f[free] - self.K[free][:, self.fixed] @ self.values[self.fixed]
        N = self.rows[:, free]
        gap = self.gap - self.rows[:, self.fixed] @ self.values[self.fixed]
        R = self.rigid_motions()[free]
        weight = np.sqrt(N.multiply(N).sum(axis=1)) if N.shape[0] else np.zeros(0)
        known.verdict = verdict(N, gap, R, self.f[free], weight, self.length)
        if known.verdict != "solvable":
            return known
        used = weight > DEPENDENT
        N, gap = N[used], gap[used]
        K = self.K[free][:, free]
        e = R.T @ self.f[free]
        e[np.abs(e) <= NO_WORK * known.load] = 0.0
        lam, u = solve(K, f, N, gap, R, e)
        carrying = lam > CARRIES * lam.max(initial=0.0)
        kept = R @ null_space(N[carrying] @ R)
        known.free = np.zeros((len(self.f), kept.shape[1]))
        known.free[free] = kept
        known.u = self._smallest(u, known.free)
        known.forces = self._forces(used, lam)
        rng = np.random.default_rng(0)
        shaken = K.copy()
        shaken.data = K.data * (1 + EPSILON * rng.uniform(-1, 1, len(K.data)))
        # points are rounded, as far as the largest of their coordinates, and so is N u where bodies
        # move far
        size = np.abs(known.u) + np.abs(self.x).max(axis=1, keepdims=True)
        gap = gap + EPSILON * (abs(self.rows[used]) @ size.ravel()) * rng.uniform(-1, 1, len(gap))
        pressed, other = solve(0.5 * (shaken + shaken.T), f, N, gap, R, e, lam > 0.0)
        second = self._smallest(other, known.free)
        known.noise = body_errors(known, second)
        change = resultants(known, self._forces(used, pressed)) - resultants(known, known.forces)
        known.force_noise = float(np.abs(change).max())
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
