"""Paths of loads that come back to zero, or to next to nothing: right at every step."""

import numpy as np
import ufl
from dolfinx import fem
from friction_reference import Untorn, in_ellipses
from mpi4py import MPI
from scenes import box, decomposed, displacement, forms, hooke

import tfeti_dolfinx as tfeti

SIZES = {"triangle": (6, 3), "quadrilateral": (8, 4), "hexahedron": (3, 4), "tetrahedron": (2, 3)}
# clamped and loaded sides; what is clamped on top is moved
KINDS = {"loaded": ("left", "top"), "driven": ("top", "right")}
LAWS = ("none", "tresca", "coulomb", "orthotropic")
DIRECTION = 0.4  # of the first axis of orthotropic friction, from x
STEPS = ("new", "zero", "same", "turned", "tiny", "less", "other tiny")


def law(name, gdim):
    """The law, its semi-axes or coefficients, and the frame that they hold in."""
    normal = -np.eye(gdim)[-1]
    if gdim == 2 or name != "orthotropic":
        frame = np.stack((normal, *np.eye(gdim)[:-1]))
        if name == "none":
            return None, (0.0,) * (gdim - 1), frame
        value = 0.003 if name == "tresca" else 0.3
        given = tfeti.Tresca(value) if name == "tresca" else tfeti.Coulomb(value)
        return given, (value,) * (gdim - 1), frame
    along = np.array([np.cos(DIRECTION), np.sin(DIRECTION), 0.0])
    given = tfeti.Coulomb((0.4, 0.15), direction=along)
    return given, (0.4, 0.15), np.stack((normal, along, np.cross(normal, along)))


class Scene:
    """A box above a plane, a side clamped or moved, another one loaded."""

    def __init__(self, cell, kind="loaded", friction="none", gap=0.0, **options):
        held, loaded = KINDS[kind]
        d = decomposed(cell, *SIZES[cell])
        gdim = self.gdim = d.mesh.geometry.dim
        V, a, _ = forms(d.mesh, d.facet_tags, (0.0,) * gdim, d.surface(loaded))
        self.traction, self.value = (fem.Constant(d.mesh, np.zeros(gdim)) for _ in range(2))
        ds = ufl.Measure("ds", domain=d.mesh, subdomain_data=d.facet_tags)
        L = ufl.dot(self.traction, ufl.TestFunction(V)) * ds(d.surface(loaded))
        bc = fem.dirichletbc(
            self.value, fem.locate_dofs_topological(V, gdim - 1, d.facets(held)), V
        )
        given, _, _ = law(friction, gdim)
        plane = tfeti.Plane((0,) * gdim, (0,) * (gdim - 1) + (1,))
        obstacle = tfeti.Obstacle("bottom", plane, gap=gap, friction=given, reach=0.5)
        self.problem = tfeti.ContactProblem(
            a, L, [bc], [obstacle], d, stress=hooke(), petsc_options=options
        )

    def solve(self, traction, value=None):
        """Displacements of the nodes, sorted by point."""
        self.traction.value[:] = traction
        self.value.value[:] = 0.0 if value is None else value
        self.problem.solve()
        return displacement(self.problem)[1]


class Reference:
    """The same box in one piece; the law by Newton's method on its dense natural map."""

    def __init__(self, cell, kind, friction, gap):
        held, loaded = KINDS[kind]
        mesh, tags, names = box(cell, SIZES[cell][0], MPI.COMM_SELF)
        gdim = mesh.geometry.dim
        scenes = [Untorn(mesh, tags, names, {loaded: axis}, (held,)) for axis in np.eye(gdim)]
        scene, self.gdim = scenes[0], gdim
        self.loads = np.stack([scene.f for scene in scenes], axis=1)
        self.order, self.free = scene.order, scene.free
        self.fixed = np.setdiff1d(np.arange(len(scene.f)), self.free)
        K = scene.K.toarray()
        self.inverse = np.linalg.inv(K[np.ix_(self.free, self.free)])
        self.held = K[np.ix_(self.free, self.fixed)]
        self.coulomb = friction in ("coulomb", "orthotropic")
        nodes, area = scene.side("bottom")
        kept = ~np.isin(nodes * gdim, self.fixed)
        nodes, area = nodes[kept], area[kept]
        _, axes, frame = law(friction, gdim)
        n = len(nodes)
        self.B = np.zeros((n * gdim, len(scene.f)))
        for k in range(gdim):
            for j in range(gdim):
                self.B[np.arange(n) + n * k, nodes * gdim + j] = frame[k, j]
        self.F = self.B[:, self.free] @ self.inverse @ self.B[:, self.free].T
        self.places = np.arange(n, n * gdim).reshape(gdim - 1, n).T
        self.axes = np.outer(np.ones(n) if self.coulomb else area, axes)
        self.gap, self.n = np.full(n, gap), n
        self.begin = np.zeros(n * gdim)  # what slips count from
        self._by_node = (self.order[:, None] * gdim + np.arange(gdim)).ravel()

    def accept(self, u):
        """Let slips count from displacements of the nodes, sorted by point."""
        self.begin = self.B[:, self._by_node] @ u.ravel()
        self.begin[: self.n] = 0.0

    def solve(self, traction, value=None):
        u = np.zeros(len(self.order) * self.gdim)
        u[self.fixed] = np.tile(np.zeros(self.gdim) if value is None else value, len(self.fixed))[
            : len(self.fixed)
        ]
        f = (self.loads @ traction)[self.free] - self.held @ u[self.fixed]
        c = self.begin.copy()
        c[: self.n] += self.gap
        d = self.B[:, self.free] @ (self.inverse @ f) - c
        lam = self._forces(d)
        u[self.free] = self.inverse @ (f - self.B[:, self.free].T @ lam)
        return u.reshape(-1, self.gdim)[self.order]

    def _brought(self, lam, d, r):
        step = lam - r * (self.F @ lam - d)
        new = np.concatenate((np.maximum(step[: self.n], 0.0), np.zeros(len(d) - self.n)))
        axes = self.axes * (new[: self.n, None] if self.coulomb else 1.0)
        new[self.places] = in_ellipses(step[self.places], axes)
        return new

    def _forces(self, d):
        """λ = P(λ − r(Fλ − d)): Newton's method, and steps of the map where that does not help."""
        lam, r = np.zeros(len(d)), 1.0 / np.linalg.norm(self.F, 2)
        for _ in range(2000):
            for _ in range(50):
                lam = self._brought(lam, d, r)
            miss = self._brought(lam, d, r) - lam
            left = np.linalg.norm(miss)
            if left <= 1e-14 * np.linalg.norm(lam):
                return lam
            h = 1e-7 * np.linalg.norm(lam)
            ways = h * np.eye(len(d))
            slopes = [(self._brought(lam + x, d, r) - lam - x - miss) / h for x in ways]
            step = np.linalg.lstsq(np.stack(slopes, axis=1), -miss, rcond=None)[0]
            if np.linalg.norm(self._brought(lam + step, d, r) - lam - step) < 0.5 * left:
                lam = lam + step
        raise AssertionError("the reference did not settle")


def path(rng, gdim, kind):
    """Tractions and values of ten steps: zero twice at least, and an ordinary load after it."""
    size = np.array([0.03] * (gdim - 1) + [0.06])

    def ordinary():
        traction, value = size * rng.uniform(-1, 1, gdim), 0.3 * size * rng.uniform(-1, 1, gdim)
        traction[-1], value[-1] = -abs(traction[-1]), -abs(value[-1])
        turned = rng.uniform() < 0.2
        lifted = np.where(np.arange(gdim) == gdim - 1, -1.0 if turned else 1.0, 1.0)
        if kind == "loaded":
            return traction * lifted, np.zeros(gdim)
        return rng.choice([0.0, 0.2]) * traction, value * lifted

    last = ordinary()
    steps = [last, (np.zeros(gdim), np.zeros(gdim)), ordinary()]
    for what in rng.choice(STEPS, 5):
        exponent = {"less": (-9, -1)}.get(what, (-14, -10) if "tiny" in what else (0, 0))
        factor = {"zero": 0.0, "turned": -1.0}.get(what, 10.0 ** rng.uniform(*exponent))
        given = ordinary() if what in ("new", "other tiny") else last
        steps.append((factor * given[0], factor * given[1]))
        if what in ("new", "turned"):
            last = steps[-1]
    return [*steps, (np.zeros(gdim), np.zeros(gdim)), ordinary()]


def follow(seed, qp_type="newton", cells=tuple(SIZES), laws=LAWS):
    """A random path beside the reference; what went wrong."""
    rng = np.random.default_rng(seed)
    cell, friction, kind = rng.choice(cells), rng.choice(laws), rng.choice(list(KINDS))
    gap = rng.choice([0.0, 0.0, 0.01, -0.002 if kind == "driven" else 0.0])
    accepts = bool(rng.uniform() < 0.4)
    rtol = 1e-8 if qp_type == "newton" else 1e-6
    scene = Scene(cell, kind, friction, gap, qp_type=qp_type, rtol=rtol)
    other = Reference(cell, kind, friction, gap)
    about = f"seed {seed}: {cell} {kind} {friction} gap {gap} {qp_type} accepts {accepts}"
    slips = friction != "none" and accepts
    share = (100.0 if friction in ("coulomb", "orthotropic") else 1.0) * 10.0 * rtol
    wrong, most = [], 0.0
    for i, (traction, value) in enumerate(path(rng, scene.gdim, kind)):
        expected = other.solve(traction, value)
        size = np.abs(expected).max()
        try:
            u = scene.solve(traction, value)
        except tfeti.TfetiError as error:
            wrong.append(f"{about}, step {i} {traction} {value}: {error}")
            continue
        apart = np.abs(u - expected).max()
        if not apart <= share * size + (1e-13 * most if slips else 0.0):
            wrong.append(f"{about}, step {i} {traction} {value}: {apart:.2e} of {size:.2e}")
        most = max(most, size)
        if accepts:
            scene.problem.accept()
            other.accept(u)
    scene.problem.destroy()
    return wrong
