"""Elastic boxes on an untorn mesh, and contact with friction by the natural map of its law.

Conditions are condensed on dense matrices. Nothing of the package is used but the meshes of scenes.
"""

import numpy as np
import ufl
from bodies import boxes
from dolfinx import fem
from mpi4py import MPI
from scenes import box, hooke, strain
from scipy.sparse.linalg import splu


class Untorn:
    """Elastic boxes on one rank, their nodes sorted by point.

    Args:
        mesh, tags, names: The boxes.
        traction: On sides, by name: a vector, or a function from UFL's coordinates to one.
        clamped: Clamped sides.
        degree: Of the displacement.
    """

    def __init__(self, mesh, tags, names, traction, clamped=("left",), degree=1):
        gdim = self.gdim = mesh.geometry.dim
        V = self.V = fem.functionspace(mesh, ("Lagrange", degree, (gdim,)))
        u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        exact = {"quadrature_degree": 2 * degree}
        dx = ufl.Measure("dx", domain=mesh, metadata=exact)
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=tags, metadata=exact)
        L = ufl.dot(fem.Constant(mesh, np.zeros(gdim)), v) * dx
        for name, q in traction.items():
            given = callable(q) and ufl.as_vector(q(ufl.SpatialCoordinate(mesh)))
            q = given or fem.Constant(mesh, np.array(q, dtype=float))
            L += ufl.dot(q, v) * ds(names[name])
        a = fem.form(ufl.inner(hooke()(u), strain(v)) * dx)
        self.K = fem.assemble_matrix(a, block_mode=None).to_scipy().tocsc()
        self.f = fem.assemble_vector(fem.form(L)).array.copy()
        self.tags, self.names, self.ds = tags, names, ds
        held = [self.nodes(name)[:, None] * gdim + np.arange(gdim) for name in clamped]
        self.fixed = np.unique(np.concatenate([np.ravel(dofs) for dofs in [*held, []]])).astype(int)
        self.free = np.setdiff1d(np.arange(len(self.f)), self.fixed)
        self.inverse = splu(self.K[self.free][:, self.free]).solve
        self.x = V.tabulate_dof_coordinates()
        self.order = np.lexsort(np.rint(self.x.T * 1e7))

    def nodes(self, name):
        facets = self.tags.find(self.names[name])
        return fem.locate_dofs_topological(self.V, self.gdim - 1, facets)

    def side(self, name):
        """Nodes of a side in the order of their points, and the integrals of their hats."""
        W = fem.functionspace(self.V.mesh, ("Lagrange", 1))
        hats = fem.assemble_vector(fem.form(ufl.TestFunction(W) * self.ds(self.names[name]))).array
        at, nodes = W.tabulate_dof_coordinates(), self.nodes(name)
        nodes = nodes[np.lexsort(np.rint(self.x[nodes].T * 1e7))]
        area = [hats[np.argmin(np.linalg.norm(at - self.x[n], axis=1))] for n in nodes]
        return nodes, np.array(area)

    def loads(self, name):
        """Right sides of unit tractions on a side along all axes, one a column."""
        nodes, area = self.side(name)
        found = np.zeros((len(self.f), self.gdim))
        for k in range(self.gdim):
            found[nodes * self.gdim + k, k] = area
        return found

    def linear(self, f=None, values=0.0):
        """All unknowns without contact, with values of what is clamped."""
        u = np.zeros(len(self.f))
        u[self.fixed] = np.resize(values, len(self.fixed))
        f = (self.f if f is None else f) - self.K @ u
        u[self.free] = self.inverse(f[self.free])
        return u

    def by_point(self, u):
        return u.reshape(-1, self.gdim)[self.order]


def untorn_box(cell, n, traction, clamped=("left",), degree=1, loaded="top", grading=1.0):
    """The box of ``scenes``."""
    alone = box(cell, n, MPI.COMM_SELF, grading)
    return Untorn(*alone, {loaded: traction}, clamped, degree)


class Conditions:
    """Contact of an untorn scene, condensed on its conditions; slips count from ``accept`` on.

    Args:
        scene: The boxes.
        entries: For each condition its nodes with their weights.
        gap: Of each condition, or of all.
        axes: Largest tangential forces, shape (n, gdim - 1); under Coulomb's law coefficients.
        frame: Axes, normal first, of all conditions, shape (gdim, gdim).
        coulomb: Whether that is the law.
    """

    def __init__(self, scene, entries, gap, axes, frame, coulomb=False):
        gdim, self.scene, self.coulomb = scene.gdim, scene, coulomb
        B = np.zeros((gdim, len(entries), len(scene.f)))
        for i, nodes in enumerate(entries):
            for node, weight in nodes.items():
                B[:, i, node * gdim : (node + 1) * gdim] = weight * np.asarray(frame)
        self.kept = np.flatnonzero(np.abs(B[:, :, scene.free]).sum(axis=(0, 2)) > 0.0)
        m = self.m = len(self.kept)
        self.B, self.n = B[:, self.kept].reshape(gdim * m, -1), len(entries)
        self.KB = scene.inverse(self.B[:, scene.free].T.copy())
        self.F = self.B[:, scene.free] @ self.KB
        self.places = np.arange(m, m * gdim).reshape(gdim - 1, m).T
        self.axes = np.broadcast_to(axes, (self.n, gdim - 1))[self.kept]
        self.c, self.lam = np.zeros(m * gdim), np.zeros(m * gdim)
        self.c[:m] = np.broadcast_to(gap, self.n)[self.kept]
        self.r = 1.0 / np.linalg.norm(self.F, 2)

    def solve(self, f=None, values=0.0):
        """The displacement, sorted by point."""
        u = self.scene.linear(f, values)
        self.d = self.B @ u - self.c
        lam = np.zeros(len(self.d))
        for _ in range(1000):
            for _ in range(50):
                lam = self.projected(lam)
            lam, left = self.newton(lam)
            if left <= 1e-14 * np.linalg.norm(lam):
                break
        else:
            raise AssertionError("the reference did not settle")
        self.lam = self.projected(lam)
        u[self.scene.free] -= self.KB @ self.lam
        return self.scene.by_point(u)

    @property
    def force(self):
        """Forces of all conditions along their frame."""
        force = np.zeros((self.n, self.scene.gdim))
        force[self.kept] = self.lam.reshape(-1, self.m).T
        return force

    def unknowns(self, u):
        """A displacement that is sorted by point, as all unknowns."""
        full = np.zeros_like(u)
        full[self.scene.order] = u
        return full.ravel()

    def accept(self, u):
        """Let slips count from a displacement, sorted by point; what sticks stays."""
        limits = self.axes * (self.lam[: self.m, None] if self.coulomb else 1.0)
        share = np.sum((self.lam[self.places] / np.maximum(limits, 1e-300)) ** 2, axis=1)
        moved = (share >= 1.0 - 1e-6) | np.all(self.lam[self.places] == 0.0, axis=1)
        moved = self.places[moved].ravel()
        self.c[moved] = (self.B @ self.unknowns(u))[moved]

    def distance(self, u, f):
        """‖u − v‖ / ‖u‖, largest entries, v what Newton's method finds for the law from u on.

        A law with a large coefficient may have several solutions: v is the one that belongs to u.
        """
        u, linear = self.unknowns(u), self.scene.linear(f)
        self.d = self.B @ linear - self.c
        lam, left = self.newton(self.B @ (f - self.scene.K @ u))
        self.lam = self.projected(lam)
        assert left <= 1e-10 * self.r * np.linalg.norm(self.d), "the reference did not converge"
        free = self.scene.free
        return np.abs((linear - u)[free] - self.KB @ self.lam).max() / np.abs(u).max()

    def projected(self, lam):
        """P(λ − r(Fλ − d)) of one λ, or of rows of them."""
        step = lam - self.r * (lam @ self.F - self.d)
        new = np.zeros_like(step)
        new[..., : self.m] = np.maximum(step[..., : self.m], 0.0)
        axes = self.axes * (new[..., : self.m, None] if self.coulomb else 1.0)
        new[..., self.places] = in_ellipses(step[..., self.places], axes)
        return new

    def newton(self, lam):
        """Newton's method on the natural map with a line search; λ, and what is left."""
        past, left = [], lam - self.projected(lam)
        for _ in range(100):
            past = [*past[-4:], np.linalg.norm(left)]
            h = 1e-7 * np.linalg.norm(lam)
            if past[-1] <= 1e-15 * np.linalg.norm(lam) or h == 0.0:
                break
            ways = lam + h * np.eye(len(lam))
            slopes = (ways - self.projected(ways) - left) / h
            step, length = np.linalg.lstsq(slopes.T, -left, rcond=None)[0], 1.0
            while True:
                new = lam + length * step
                after = new - self.projected(new)
                if np.linalg.norm(after) <= (1.0 - 1e-4 * length) * max(past) or length < 1e-4:
                    break
                length *= 0.5
            if np.linalg.norm(after) >= max(past):
                break
            lam, left = new, after
        return lam, past[-1]


def in_ellipses(z, a):
    """The nearest points of ellipses: multipliers t ≥ 0 by Newton's method on 1/‖az/(a² + t)‖ = 1.

    It is concave in t, so that t grows to the solution, and is 0 within the ellipse.
    """
    a = np.where(a > 1e-50 * np.abs(z), a, 0.0)
    squares, t = np.where(a > 0.0, a**2, 1.0), np.zeros((*z.shape[:-1], 1))
    for _ in range(60):
        y = a * z / (squares + t)
        size = np.sum(y**2, axis=-1, keepdims=True)
        slope = np.where(size > 1.0, np.sum(y**2 / (squares + t), axis=-1, keepdims=True), 1.0)
        step = np.maximum(np.sqrt(size) - 1.0, 0.0) * size / slope
        t = t + step
        if np.all(step <= 1e-15 * t):
            break
    return np.where(a > 0.0, a**2 * z / (squares + t), 0.0)


def on_plane(scene, axes, frame, gap=0.0, coulomb=False):
    """The bottom of a box over a plane; axes per area, or coefficients."""
    nodes, area = scene.side("bottom")
    axes = (np.ones_like(area) if coulomb else area)[:, None] * np.asarray(axes)
    gap = gap(scene.x[nodes].T) if callable(gap) else gap
    return Conditions(scene, [{int(node): 1.0} for node in nodes], gap, axes, frame, coulomb)


def parts(gdim, n_lower, n_upper, gap=0.0):
    """A box over another one."""
    cross = (0.0,) * (gdim - 1)
    return [
        ("lower", (*cross, -1.0), (1.0,) * (gdim - 1) + (0.0,), (n_lower,) * gdim),
        ("upper", (*cross, gap), (1.0,) * (gdim - 1) + (1.0 + gap,), (n_upper,) * gdim),
    ]


def two_boxes(cell, traction, clamped, n_lower, n_upper, gap=0.0):
    gdim = 2 if cell in ("triangle", "quadrilateral") else 3
    made = boxes(cell, parts(gdim, n_lower, n_upper, gap), MPI.COMM_SELF)
    return Untorn(*made, {"upper top": traction}, clamped)


def check_optimal(F, d, G, e, bounded, lam, share=1e-9, mu=None, pairs=(), axes=()):
    """Gλ = e and λ = P(λ − r(Fλ − d − Gᵀμ)): of min ½λᵀFλ − λᵀd only the minimiser fulfils it.

    λ ≥ 0 on rows ``bounded``, ``pairs`` of rows are in ellipses of semi-axes ``axes``, both of
    shape (n, k), where 0 fixes a row; rows of no set say what μ is unless it is given.
    """
    s, pairs = F @ lam - d, np.asarray(pairs, dtype=int)
    if mu is None and len(e):
        others = np.setdiff1d(np.arange(len(lam)), [*bounded, *pairs.ravel()])
        mu = np.linalg.lstsq(G[:, others].T, s[others], rcond=None)[0]
    near = lam - (s if mu is None else s - G.T @ mu) / np.linalg.norm(F, 2)
    near[bounded] = np.maximum(near[bounded], 0.0)
    if len(pairs):
        near[pairs] = in_ellipses(near[pairs], np.asarray(axes))
    assert np.linalg.norm(G @ lam - e) <= share * (1.0 + np.linalg.norm(e))
    assert np.linalg.norm(near - lam) <= share * np.linalg.norm(lam)
