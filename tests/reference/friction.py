"""Friction on an untorn mesh, condensed on the contact nodes.

Tresca's by an interior point method, Coulomb's by iterating its own natural map.

Nothing of the package is used but the meshes of the scenes.
"""

import numpy as np
import ufl
from bodies import boxes
from dolfinx import fem
from mpi4py import MPI
from scenes import box, clamp, hooke, strain
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from reference.conic import constrained_qp


class Untorn:
    """Elastic boxes on one rank, some sides clamped; conditions between nodes and what they meet.

    Args:
        mesh, tags, names: The boxes.
        traction: On each of these sides, by name.
        clamped: Clamped sides.
        load: A force per volume.
    """

    def __init__(self, mesh, tags, names, traction, clamped, load=None):
        gdim = self.gdim = mesh.geometry.dim
        V = self.V = fem.functionspace(mesh, ("Lagrange", 1, (gdim,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2})
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags, metadata={"quadrature_degree": 2})
        a = ufl.inner(hooke()(u), strain(v)) * dx
        L = ufl.dot(fem.Constant(mesh, np.array(load or np.zeros(gdim))), v) * dx
        for name, q in traction.items():
            L += ufl.dot(fem.Constant(mesh, np.array(q, dtype=float)), v) * ds(names[name])
        self.K = fem.assemble_matrix(fem.form(a), block_mode=None).to_scipy().tocsc()
        self.f = fem.assemble_vector(fem.form(L)).array.copy()
        held = [clamp(V, tags.find(names[name])).dof_indices()[0] for name in clamped]
        self.free = np.setdiff1d(np.arange(len(self.f)), np.concatenate(held))
        self.x = V.tabulate_dof_coordinates()
        self.order = np.lexsort(np.rint(self.x.T * 1e7))
        self.tags, self.names, self.ds = tags, names, ds

    def side(self, name):
        """Nodes of a side in the order of their points, and the integrals of their hats."""
        W = fem.functionspace(self.V.mesh, ("Lagrange", 1))
        hats = fem.assemble_vector(fem.form(ufl.TestFunction(W) * self.ds(self.names[name]))).array
        at = W.tabulate_dof_coordinates()
        fdim = self.gdim - 1
        nodes = fem.locate_dofs_topological(self.V, fdim, self.tags.find(self.names[name]))
        nodes = nodes[np.lexsort(np.rint(self.x[nodes].T * 1e7))]
        area = [hats[np.argmin(np.linalg.norm(at - self.x[n], axis=1))] for n in nodes]
        return nodes, np.array(area)

    def solve(self, entries, gap, semi_axes, frame, coulomb=False):
        """Displacement, sorted by point, and forces of the conditions along their frame.

        Args:
            entries: For each condition its nodes with their weights.
            gap: Of each condition.
            semi_axes: Largest tangential forces of each, shape (n, gdim - 1); under Coulomb's law
                coefficients of friction.
            frame: Axes, normal first, of all conditions, shape (gdim, gdim).
            coulomb: Whether that is the law.
        """
        n, gdim = len(entries), self.gdim
        B = np.zeros((n * gdim, len(self.f)))
        for i, nodes in enumerate(entries):
            for node, weight in nodes.items():
                for k in range(gdim):
                    B[n * k + i, node * gdim : (node + 1) * gdim] = weight * frame[k]
        B, f = B[:, self.free], self.f[self.free]
        used = np.linalg.norm(B, axis=1) > 0.0
        solve = splu(csc_matrix(self.K[self.free][:, self.free])).solve
        KB = solve(B.T.copy())
        c = np.concatenate((gap, np.zeros(n * (gdim - 1))))
        kept = np.flatnonzero(used[:n])
        pairs = np.stack([kept + n * k for k in range(1, gdim)], axis=1)
        rows = np.concatenate((kept, pairs.T.ravel()))
        m = len(kept)
        F, d = B[rows] @ KB[:, rows], (B @ solve(f) - c)[rows]
        places = np.arange(m, m * gdim).reshape(gdim - 1, m).T
        if coulomb:
            lam = natural_map(F, d, places, semi_axes[kept])
        else:
            none = np.zeros((0, len(d))), np.zeros(0)
            lam = constrained_qp(F, d, *none, np.arange(m), places, semi_axes[kept])
        u, force = np.zeros(len(self.f)), np.zeros((n, gdim))
        u[self.free] = solve(f - B[rows].T @ lam)
        force[kept] = lam.reshape(gdim, m).T
        return u.reshape(-1, gdim)[self.order], force


def natural_map(F, d, places, mu):
    """λ_N = max(λ_N − r(Fλ − d)_N, 0), τ = P(τ − r(Fλ − d)_T) on the ellipse of μλ_N.

    Args:
        F, d: The condensed program, normals first.
        places: Rows of each condition's tangents, shape (n, gdim - 1).
        mu: Coefficients, of the same shape.
    """
    lam, r, n = np.zeros(len(d)), 1.0 / np.linalg.norm(F, 2), len(places)
    for _ in range(400_000):
        step = lam - r * (F @ lam - d)
        new = np.concatenate((np.maximum(step[:n], 0.0), np.zeros(len(d) - n)))
        new[places] = in_ellipses(step[places], mu * new[:n, None])
        change, lam = np.linalg.norm(new - lam), new
        if change <= 1e-13 * np.linalg.norm(lam):
            return lam
    raise AssertionError("the reference did not settle")


def in_ellipses(z, a):
    """The nearest points of ellipses: multipliers t ≥ 0 by Newton's method on 1/‖az/(a² + t)‖ = 1.

    It is concave in t, so that t grows to the solution, and is 0 within the ellipse.
    """
    squares, t = np.where(a > 0.0, a**2, 1.0), np.zeros((len(z), 1))
    for _ in range(60):
        y = a * z / (squares + t)
        size = np.sum(y**2, axis=1, keepdims=True)
        slope = np.where(size > 1.0, np.sum(y**2 / (squares + t), axis=1, keepdims=True), 1.0)
        step = np.maximum(np.sqrt(size) - 1.0, 0.0) * size / slope
        t = t + step
        if np.all(step <= 1e-15 * t):
            break
    return np.where(a > 0.0, a**2 * z / (squares + t), 0.0)


def on_plane(cell, n, traction, bounds, frame, gap=0.0, clamped=("left",), coulomb=False):
    """The box of ``scenes`` over a plane: u, contact points, forces."""
    scene = Untorn(*box(cell, n, MPI.COMM_SELF), {"top": traction}, clamped)
    nodes, area = scene.side("bottom")
    entries = [{int(node): 1.0} for node in nodes]
    axes = (np.ones_like(area) if coulomb else area)[:, None] * np.asarray(bounds)
    u, force = scene.solve(entries, np.full(len(nodes), gap), axes, frame, coulomb)
    return u, scene.x[nodes], force


def parts(gdim, n, gap):
    """Two boxes whose nodes face each other across a gap."""
    cross = (0.0,) * (gdim - 1)
    return [
        ("lower", (*cross, -1.0), (1.0,) * (gdim - 1) + (0.0,), (n,) * gdim),
        ("upper", (*cross, gap), (1.0,) * (gdim - 1) + (1.0 + gap,), (n,) * gdim),
    ]


def on_each_other(cell, n, traction, bounds, frame, apart, clamped, coulomb=False):
    """Two boxes, gaps taken as 0: u, contact points of the lower box, forces on it."""
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    mesh, tags, names = boxes(cell, parts(gdim, n, apart), MPI.COMM_SELF)
    scene = Untorn(mesh, tags, names, {"upper top": traction}, clamped)
    (below, area), (above, _) = scene.side("lower top"), scene.side("upper bottom")
    entries = [{int(a): 1.0, int(b): -1.0} for a, b in zip(below, above, strict=True)]
    axes = (np.ones_like(area) if coulomb else area)[:, None] * np.asarray(bounds)
    u, force = scene.solve(entries, np.zeros(len(below)), axes, frame, coulomb)
    return u, scene.x[below], force


class ClampedLaw:
    """Coulomb's law of a clamped box of ``scenes`` above a rough plane, condensed on its nodes.

    Args:
        cell, n: The box.
        mu: Coefficient.
        clamped, loaded: Sides.
        gap: Of the plane.
    """

    def __init__(self, cell, n, mu, clamped, loaded, gap):
        gdim = 2 if cell in ("triangle", "quadrilateral") else 3
        units = np.eye(gdim)
        scenes = [
            Untorn(*box(cell, n, MPI.COMM_SELF), {loaded: tuple(unit)}, (clamped,))
            for unit in units
        ]
        self.mu, self.gdim, self.scene = mu, gdim, scenes[0]
        free = self.free = self.scene.free
        nodes = self.scene.side("bottom")[0]
        nodes = nodes[np.isin(nodes * gdim, free)]
        self.m, frame = len(nodes), np.vstack([-units[-1], units[:-1]])
        B = np.zeros((gdim, self.m, len(self.scene.f)))
        for k in range(gdim):
            for axis in range(gdim):
                B[k, np.arange(self.m), nodes * gdim + axis] = frame[k, axis]
        self.B = B.reshape(-1, B.shape[-1])[:, free]
        self.K = csc_matrix(self.scene.K[free][:, free])
        solve = splu(self.K).solve
        self.KB = solve(self.B.T.copy())
        self.F, self.loads = self.B @ self.KB, np.array([one.f[free] for one in scenes]).T
        self.bent = solve(self.loads)
        self.c = np.zeros(len(self.B))
        self.c[: self.m] = gap
        self.r = 3.0 / np.linalg.norm(self.F, 2)

    def rest(self, u):
        """Count slips from a displacement, sorted by point, that ``distance`` was asked of."""
        p, T = self.lam[: self.m], self.lam[self.m :].reshape(self.gdim - 1, self.m)
        slips = np.linalg.norm(T, axis=0) >= (1.0 - 1e-12) * self.mu * p  # what sticks stays
        end = (self.B @ self.own(u))[self.m :].reshape(T.shape)
        self.c[self.m :] = np.where(slips, end, self.c[self.m :].reshape(T.shape)).ravel()

    def own(self, u):
        """A displacement that is sorted by point, on free unknowns."""
        full = np.zeros_like(u)
        full[self.scene.order] = u
        return full.ravel()[self.free]

    def distance(self, u, load):
        """‖u − v‖ / ‖u‖, largest entries, v what Newton's method finds for the law from u on.

        A law with a large coefficient may have several solutions: v is the one that belongs to u.
        """
        u, self.d = self.own(u), self.B @ (self.bent @ load) - self.c
        lam = self.lam = self.newton(self.B @ (self.loads @ load - self.K @ u))
        return np.abs(self.bent @ load - self.KB @ lam - u).max() / np.abs(u).max()

    def natural(self, lam):
        """The natural map λ − P(λ − r(Fλ − d)), and its generalised derivative."""
        m, mu, one = self.m, self.mu, np.eye(len(lam))
        y = lam - self.r * (self.F @ lam - self.d)
        p, T = np.maximum(y[:m], 0.0), y[m:].reshape(self.gdim - 1, m)
        size, P, i = np.linalg.norm(T, axis=0), np.zeros_like(one), np.arange(m)
        slips, e = size > mu * p, T / np.maximum(size, 1e-300)
        P[i, i] = y[:m] > 0.0
        for a in range(self.gdim - 1):
            P[m * (a + 1) + i, i] = np.where(slips & (p > 0.0), mu * e[a], 0.0)
            for b in range(self.gdim - 1):
                bent = mu * p / np.maximum(size, 1e-300) * ((a == b) - e[a] * e[b])
                P[m * (a + 1) + i, m * (b + 1) + i] = np.where(slips, bent, float(a == b))
        tau = np.where(slips, mu * p * e, T)
        R = lam - np.concatenate((p, tau.ravel()))
        return R, one - P @ (one - self.r * self.F)

    def newton(self, lam):
        """A semismooth Newton method with a line search; its residual comes down to rounding."""
        scale, past = self.r * np.linalg.norm(self.d), []
        for _ in range(200):
            R, J = self.natural(lam)
            past = [*past[-4:], np.linalg.norm(R)]
            if past[-1] <= 1e-13 * scale:
                return lam
            step, length = np.linalg.solve(J, -R), 1.0
            while length > 1e-4 and np.linalg.norm(self.natural(lam + length * step)[0]) > (
                1.0 - 1e-4 * length
            ) * max(past):
                length *= 0.5
            lam = lam + length * step
        assert past[-1] <= 1e-10 * scale, "the reference did not converge"
        return lam
