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
from scipy.linalg import qr
from scipy.optimize import linprog
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from benchmarks.stress import meshes
from benchmarks.stress.mortar import Facet, mortar
from benchmarks.stress.qp import UnsettledError, solve_qp
from benchmarks.stress.scene import Pair, Scene, Side, wall_distance

DEPENDENT = 1e-10
ESCAPES, SURELY_HELD = 1e-6, 1e-9  # work of a motion, of that of all loads
FARTHER = 10.0
WRONG = 1e-7  # relative residual of the reference
CARRIES = 1e-7  # of the largest force
EPSILON = 2.2e-16


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
        self._dof[mesh.geometry.dofmap] = cells
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
            motions[dofs] = R @ kept
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
        lam, u = solve(K, f, N, gap, R, e)
        carrying = lam > CARRIES * lam.max(initial=0.0)
        kept = R @ null_space(N[carrying] @ R)
        known.free = np.zeros((len(self.f), kept.shape[1]))
        known.free[free] = kept
        known.u = self._smallest(u, known.free)
        known.forces = -(self.rows[used].T @ lam).reshape(-1, self.gdim)
        rng = np.random.default_rng(0)
        shaken = K.copy()
        shaken.data = K.data * (1 + EPSILON * rng.uniform(-1, 1, len(K.data)))
        # points are rounded, and so is N u where bodies move far
        size = np.abs(known.u.ravel()) + np.abs(self.x[:, : self.gdim].ravel())
        gap = gap + EPSILON * (abs(self.rows[used]) @ size) * rng.uniform(-1, 1, len(gap))
        _, other = solve(0.5 * (shaken + shaken.T), f, N, gap, R, e, lam > 0.0)
        second = self._smallest(other, known.free)
        known.noise = body_errors(known, second)
        return known

    def _smallest(self, u: np.ndarray, motions: np.ndarray) -> np.ndarray:
        """All displacements, from the free ones, less what is free."""
        full = self.values.copy()
        full[~self.fixed] = u
        if motions.shape[1]:
            full -= motions @ np.linalg.lstsq(motions, full)[0]
        return full.reshape(-1, self.gdim)


def null_space(A: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the null space, columns of A being of one size."""
    if A.shape[0] == 0 or A.shape[1] == 0:
        return np.eye(A.shape[1])
    _, sigma, Vt = np.linalg.svd(A, full_matrices=True)
    return Vt[int(np.sum(sigma > DEPENDENT * max(sigma.max(initial=0.0), 1e-300))) :].T


def verdict(
    N: csr_array,
    gap: np.ndarray,
    R: np.ndarray,
    f: np.ndarray,
    weight: np.ndarray,
    length: float,
) -> str:
    """Whether a displacement keeps all conditions, and no motion escapes to infinity."""
    size = max(np.abs(gap).max(initial=0.0), length)
    if np.any(gap[weight <= DEPENDENT] < -1e-9 * size):
        return "contradiction"
    if np.any(gap < -1e-12 * size):  # else u = 0 does
        m = len(gap)
        A = np.hstack((N.toarray(), -np.ones((m, 1))))
        cost = np.r_[np.zeros(A.shape[1] - 1), 1.0]
        bounds = [(None, None)] * (A.shape[1] - 1) + [(0, None)]
        best = linprog(cost, A, gap / size, bounds=bounds, method="highs")
        if best.fun > 1e-7:
            return "contradiction"
    load = R.T @ f  # prescribed values do no work on what they leave
    total = np.abs(f).sum()
    if R.shape[1] == 0 or np.abs(load).max() <= 1e-12 * total:
        return "solvable"
    A = N @ R
    options = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    best = linprog(
        -load / total, A, np.zeros(len(gap)), bounds=(-1, 1), method="highs", options=options
    )
    if -best.fun > ESCAPES:
        return "no_solution"
    return "solvable" if -best.fun < SURELY_HELD else "borderline"


def solve(
    K: csr_array,
    f: np.ndarray,
    N: csr_array,
    gap: np.ndarray,
    R: np.ndarray,
    e: np.ndarray,
    active: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """λ and u of min ½uᵀKu − fᵀu, N u ≤ gap; R spans the kernel of K, e = Rᵀf."""
    Q = np.linalg.qr(R)[0] if R.shape[1] else R
    pinned = qr(R.T, pivoting=True, mode="r")[1][: R.shape[1]]
    rest = np.setdiff1d(np.arange(len(f)), pinned)
    scale = 1.0 / np.sqrt(K.diagonal()[rest])
    scaled = csr_array(K[rest][:, rest].multiply(scale[:, None]).multiply(scale))
    factor = splu(scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def compliance(b: np.ndarray) -> np.ndarray:
        b = b - Q @ (Q.T @ b)
        right = b[rest] * scale[(...,) + (None,) * (b.ndim - 1)]
        x = factor.solve(right)
        x += factor.solve(right - scaled @ x)
        out = np.zeros_like(b)
        out[rest] = x * scale[(...,) + (None,) * (b.ndim - 1)]
        return out - Q @ (Q.T @ out)

    free = compliance(f)
    if N.shape[0] == 0:
        return np.zeros(0), free
    W = compliance(np.asarray(N.T.todense()))
    F, G = N @ W, np.asarray((N @ R).T)
    F = 0.5 * (F + F.T)
    lam, alpha = solve_near(F, N @ free - gap, G, e, gap, active)
    push = f - N.T @ lam
    bent = compliance(push)
    u = bent + R @ alpha
    size = np.abs(f).max() + np.abs(N.T @ lam).max()
    rounding = 1e3 * EPSILON * (abs(K) @ np.abs(bent)).max()
    off = max(np.abs(K @ bent - push).max() - rounding, 0.0) / size
    overlap = (N @ u - gap).max() / max(np.abs(u).max(), np.abs(gap).max())
    if off > WRONG or overlap > WRONG:
        raise UnsettledError(f"residual {off:.1e}, overlap {overlap:.1e}")
    return lam, u


def solve_near(
    F: np.ndarray,
    d: np.ndarray,
    G: np.ndarray,
    e: np.ndarray,
    gap: np.ndarray,
    active: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """``solve_qp``, without gaps that are far at first: they would spoil its scale."""
    reach = np.quantile(np.abs(gap), [0.25, 0.5, 0.75])
    for near in (*(gap <= FARTHER * r for r in reach), np.ones(len(gap), dtype=bool)):
        for _ in range(20):
            lam = np.zeros(len(gap))
            guess = None if active is None else active[near]
            try:
                lam[near], alpha = solve_qp(F[np.ix_(near, near)], d[near], G[:, near], e, guess)
            except UnsettledError:
                if near.all():
                    raise
                break
            s = F @ lam - d - G.T @ alpha
            entered = ~near & (s < 0.0)
            if not entered.any():
                return lam, alpha
            near = near | entered
    raise UnsettledError("rows that were far came in again and again")


def body_errors(answer: Answer, u: np.ndarray) -> np.ndarray:
    """max |u − answer.u| over max |answer.u| of each body, modulo its free motions."""
    bodies = range(answer.body.max() + 1)
    difference = u - answer.u
    size = np.array([np.abs(answer.u[answer.body == b]).max() for b in bodies])
    size = np.maximum(size, 1e-10 * size.max())
    size[size == 0.0] = 1.0
    weight = np.repeat(1.0 / size[answer.body], u.shape[1])
    if answer.free.shape[1]:
        z = np.linalg.lstsq(answer.free * weight[:, None], difference.ravel() * weight)[0]
        difference = difference - (answer.free @ z).reshape(u.shape)
    return np.array([np.abs(difference[answer.body == b]).max() for b in bodies]) / size
