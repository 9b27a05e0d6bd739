"""Coulomb's cones, by gaps that grow with slips."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.parallel import bcast_from_root, norm_over, summed
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.qp.homogenised import homogenise, operator_product
from tfeti_dolfinx.qp.newton import newton
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, ResidualRule, Start
from tfeti_dolfinx.qp.sets import Bounds, Ellipses, Face, Product, Status, reduced_by

# --- Anderson acceleration --------------------------------------------------------------------

# Steps that are remembered: one, which makes it the crossed secant method. More of them mix
# values of Φ on several faces, each inexact, and took up to twice as many steps.
DEPTH = 1
# ‖Φ(x) − x‖ that has grown by more than this since its least: what is remembered misleads
GROWTH = 2.0
# of the largest singular value: directions of the memory that inexact values of Φ decide
DEPENDENT = 1e-6
# of a plain step where the iteration has gone astray
CAUTION = 0.5


class Anderson:
    """Proposes the next x from the last values of Φ.

    x⁺ = Φ_k − Σ_j γ_j (Φ_{j+1} − Φ_j), γ such that Σ_j γ_j (f_{j+1} − f_j) is nearest to f_k, with
    f = Φ(x) − x (Anderson, J. ACM 12, 1965); with one step remembered it is the crossed secant
    method. Negative entries become 0.

    Args:
        products: AᵀB of columns on this rank, added up over ranks and the same on all.
        depth: Steps that are remembered.
        growth: What ‖f‖ may grow by before all is forgotten.
    """

    def __init__(
        self,
        products: Callable[[Array, Array], Array],
        depth: int = DEPTH,
        growth: float = GROWTH,
    ) -> None:
        self._products, self._depth, self._growth = products, depth, growth
        self._known: list[tuple[Array, Array]] = []
        self._least = np.inf

    def next(self, x: Array, image: Array) -> Array:
        """Return the next x, given the last one and Φ(x). Collective."""
        f = image - x
        size = float(np.sqrt(self._products(f[:, None], f[:, None])[0, 0]))
        astray = size > self._growth * self._least
        self._least = size if astray else min(size, self._least)
        if astray:
            self._known.clear()
        self._known = [*self._known[-self._depth :], (f, image)]
        if astray:
            return np.asarray(x + CAUTION * f)
        return np.maximum(image - self._correction(f), 0.0)

    def _correction(self, f: Array) -> Array:
        """Σ_j γ_j (Φ_{j+1} − Φ_j)."""
        if len(self._known) == 1:
            return np.zeros_like(f)
        residuals, images = (np.stack(known, axis=1) for known in zip(*self._known, strict=True))
        df, dimage = np.diff(residuals, axis=1), np.diff(images, axis=1)
        gram = self._products(df, np.column_stack((df, f)))
        # the root of DEPENDENT's square is what a Gram matrix shows of singular values
        gamma = np.linalg.lstsq(gram[:, :-1], gram[:, -1], rcond=DEPENDENT**2)[0]
        return np.asarray(dimage @ gamma)


# --- Coulomb's cone ---------------------------------------------------------------------------

# halvings of an interval of length 1: down to rounding
HALVINGS = 60
# of the distance from the axis: what is so near to the boundary is on it
ON = 1e-12


class Cones:
    """‖τ/μ‖ ≤ n for points (n, τ) − apex of one normal and one or two tangential entries each.

    >>> cone = Cones(np.array([[1.0]]))
    >>> cone.project(np.array([0.0, 2.0])).round(12).tolist()
    [1.0, 1.0]
    >>> cone.project(np.array([-2.0, 1.0])).tolist()
    [0.0, 0.0]

    Args:
        mu: Coefficients of friction, not all 0 at a point, shape ``(n, k)``, k = 1 or 2; along an
            axis with 0 the point has no entry but the apex's.
        apex: The apices, shape ``(n, k + 1)``, or 0.
    """

    def __init__(self, mu: Array, apex: Array | float = 0.0) -> None:
        self.mu = np.asarray(mu, dtype=float)
        self.apex = np.broadcast_to(apex, (len(self.mu), self.mu.shape[1] + 1))
        self._moves = self.mu > 0.0
        self._own = np.column_stack((np.ones(len(self.mu), dtype=bool), self._moves))
        self._inverse = np.divide(1.0, self.mu, out=np.zeros_like(self.mu), where=self._moves)

    def project(self, x: Array) -> Array:
        """Return the nearest points of the cones."""
        values, nearest = self._points(x), self._nearest(self._from_apex(x))
        stays = values - self.apex == nearest  # what stays where it was is not rounded
        return np.where(stays, values, self.apex + nearest).ravel()

    def split(self, x: Array, g: Array) -> tuple[Array, Array]:
        """φ = g inside; on the boundary and at the apex β, what of g a way in the cone goes down.

        On the boundary it is g − min(νᵀg, 0)ν, ν the outward normal; at the apex −P(−g).
        """
        point, g = self._from_apex(x), np.where(self._own, self._points(g), 0.0)
        closed, inside = self._places(point)
        normal = self._normals(point)
        pushing = np.minimum(np.sum(normal * g, axis=1, keepdims=True), 0.0)
        beta = np.where(closed[:, None], g - pushing * normal, -self._nearest(-g))
        within = inside[:, None]
        return np.where(within, g, 0.0).ravel(), np.where(within, 0.0, beta).ravel()

    def reduced(self, x: Array, phi: Array, alpha: float) -> Array:
        """φ̃ = (x − P(x − αφ))/α, φ itself where the step stays inside."""
        return reduced_by(self.project, x, phi, alpha)

    def max_step(self, x: Array, p: Array) -> float:
        """Largest α with x − αp inside: the smallest root of a quadratic equation for each."""
        p = self._points(p)
        if np.any(p[~self._own]):
            return 0.0
        moves = np.any(p != 0.0, axis=1)
        point, p = self._from_apex(x)[moves], p[moves]
        inverse = self._inverse[moves]
        n, t, down, along = point[:, 0], point[:, 1:] * inverse, p[:, 0], p[:, 1:] * inverse
        a = np.sum(along**2, axis=1) - down**2  # aα² − 2bα = room
        b = np.sum(along * t, axis=1) - down * n
        room = np.maximum(n**2 - np.sum(t**2, axis=1), 0.0)
        root = np.sqrt(np.maximum(b * b + a * room, 0.0))
        rises, endless = (a > 0.0) & (b > 0.0), (a <= 0.0) & ((b >= 0.0) | (b * b + a * room < 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            # of the two forms of the root the one that cancels nothing
            steps = np.where(rises, (b + root) / a, room / np.maximum(root - b, TINY))
            to_apex = np.where(down > 0.0, n / down, np.inf)
        return float(np.min(np.minimum(np.where(endless, np.inf, steps), to_apex), initial=np.inf))

    def shifted(self, shift: Array) -> Cones:
        """Cones with the apices moved by −shift."""
        return Cones(self.mu, self.apex - self._points(shift))

    def face(self, x: Array, g: Array) -> Face:
        """Inside all directions; on the boundary the ray, and the tangent of the ellipse."""
        point = self._from_apex(x)
        closed, inside = self._places(point)
        on = np.flatnonzero(closed & ~inside)
        free = np.flatnonzero((self._own & inside[:, None]).ravel())
        rows = self._own.shape[1] * on[:, None] + np.arange(self._own.shape[1])
        ray = _unit(point[on])
        columns, kappa = [(free[:, None], np.ones((len(free), 1))), (rows, ray)], []
        if self.mu.shape[1] == 2:
            kept = self._moves[on].all(axis=1)
            curved = on[kept]
            around, bent = _tangents(point[curved], self.mu[curved], ray[kept])
            pushing = -np.sum(self._points(g)[curved] * self._normals(point)[curved], axis=1)
            columns.append((rows[kept], around))
            kappa.append(np.maximum(pushing, 0.0) * bent)
        status = np.where(inside[:, None], Status.STICK, Status.SLIP)
        status = np.where(self._own & closed[:, None], status, Status.OPEN).ravel()
        Z = _columns(columns, status.size)
        flat = np.zeros(len(free) + len(on))
        return Face(Z, np.concatenate([flat, *kappa]), status)

    def onto(self, x: Array, status: Array) -> Array:
        """Return the nearest points of the cones; of their boundary, from inside too, for slip."""
        values, status = self._points(self.project(x)).copy(), self._points(status)[:, 0]
        point = self._from_apex(x)
        within = self._places(point)[1] & np.any(point[:, 1:] != 0.0, axis=1)
        inward = within & (status == Status.SLIP)
        values[inward] = self.apex[inward] + self._outwards(point[inward], inward)
        is_open = status == Status.OPEN
        values[is_open] = self.apex[is_open]
        return np.asarray(values.ravel())

    def _points(self, x: Array) -> Array:
        return np.asarray(x).reshape(self.apex.shape)

    def _from_apex(self, x: Array) -> Array:
        return np.where(self._own, self._points(x) - self.apex, 0.0)

    def _places(self, point: Array) -> tuple[Array, Array]:
        """Return flags of points off the apex, and of those inside."""
        level = np.linalg.norm(point[:, 1:] * self._inverse, axis=1)
        closed = point[:, 0] > 0.0
        return closed, closed & (level < (1.0 - ON) * point[:, 0])

    def _normals(self, point: Array) -> Array:
        """Outward normals (−1, t/μ²‖t/μ‖) of the boundary, of unit length."""
        level = np.linalg.norm(point[:, 1:] * self._inverse, axis=1, keepdims=True)
        steep = point[:, 1:] * self._inverse**2 / np.maximum(level, TINY)
        return _unit(np.column_stack((-np.ones(len(point)), steep)))

    def _nearest(self, point: Array) -> Array:
        """Return the nearest points, from the apex.

        With m the multiplier of the constraint, τ = μ²t/(μ² + m) and n = n₀/(1 − m): m is below 1
        where n₀ > 0, above it where n₀ < 0. Where nothing but 0 is near, ‖μt‖ ≤ −n₀.
        """
        n, t = point[:, 0], point[:, 1:]
        inside = np.linalg.norm(t * self._inverse, axis=1) <= n
        nothing = np.linalg.norm(t * self.mu, axis=1) <= -n
        tau = self.mu**2 * t / (self.mu**2 + self._multiplier(n, t)[:, None] + TINY)
        normal = np.linalg.norm(tau * self._inverse, axis=1)
        normal = np.where(inside, n, np.where(nothing, 0.0, normal))
        tau = np.where(inside[:, None], t, np.where(nothing[:, None], 0.0, tau))
        return np.column_stack((normal, tau))

    def _outwards(self, point: Array, which: Array) -> Array:
        """Return the nearest points of the boundary to points inside: the same with m below 0."""
        mu, (n, t) = self.mu[which], (point[:, 0], point[:, 1:])
        low = -(np.min(np.where(mu > 0.0, mu, np.inf), axis=1) ** 2)
        high: Array = np.zeros(len(n))
        for _ in range(HALVINGS):
            m = 0.5 * (low + high)
            level = np.linalg.norm(mu * t / (mu**2 + m[:, None] + TINY), axis=1)
            far = level * (1.0 - m) > n  # falls in m
            low, high = np.where(far, m, low), np.where(far, high, m)
        m = 0.5 * (low + high)
        tau, normal = mu**2 * t / (mu**2 + m[:, None] + TINY), n / (1.0 - m)
        level = np.linalg.norm(tau * self._inverse[which], axis=1)
        return np.column_stack((normal, tau * (normal / np.maximum(level, TINY))[:, None]))

    def _multiplier(self, n: Array, t: Array) -> Array:
        """m of ‖μt/(μ² + m)‖ = n/(1 − m) by halving, of r = 1/m where n < 0."""
        low: Array = np.zeros(len(n))
        high: Array = np.ones(len(n))
        below = n < 0.0
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            m = np.where(below, 1.0 / np.maximum(middle, TINY), middle)
            level = np.linalg.norm(self.mu * t / (self.mu**2 + m[:, None] + TINY), axis=1)
            far = level * np.abs(1.0 - m) > np.abs(n)  # falls in m below 1, in r where m is above
            low, high = np.where(far, middle, low), np.where(far, high, middle)
        middle = 0.5 * (low + high)
        return np.where(below, 1.0 / np.maximum(middle, TINY), middle)


def _tangents(point: Array, mu: Array, ray: Array) -> tuple[Array, Array]:
    """Tangents of the boundary orthogonal to rays, of unit length; how a unit push bends them."""
    inverse = mu**-2.0
    steep = point[:, 1:] * inverse
    slope = np.linalg.norm(steep, axis=1, keepdims=True)
    radial = steep / np.maximum(slope, TINY)
    around = np.column_stack((np.zeros(len(point)), -radial[:, 1], radial[:, 0]))
    along = np.sum(around * ray, axis=1, keepdims=True)  # 0 on a circle
    level = np.linalg.norm(point[:, 1:] / mu, axis=1)
    tilted = slope[:, 0] / np.maximum(np.hypot(slope[:, 0], level), TINY)  # of ν, in its plane
    bent = tilted * np.sum(inverse * radial[:, ::-1] ** 2, axis=1) / np.maximum(slope[:, 0], TINY)
    return _unit(around - along * ray), bent / np.maximum(1.0 - along[:, 0] ** 2, TINY)


def _unit(x: Array) -> Array:
    """Vectors of length 1; 0 stays."""
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), TINY))


def _columns(parts: list[tuple[Array, Array]], size: int) -> csr_array:
    """Columns from their rows and entries."""
    row, column, value, start = [], [], [], 0
    for rows, entries in parts:
        row.append(rows.ravel())
        column.append(start + np.repeat(np.arange(len(rows)), rows.shape[1]))
        value.append(entries.ravel())
        start += len(rows)
    places = (np.concatenate(row), np.concatenate(column))
    return csr_array((np.concatenate(value), places), shape=(size, start))


# --- De Saxcé's fixed point -------------------------------------------------------------------

# Of the first residual, and of the last change of the slips: what a problem is solved to
FIRST, SHARE = 1e-4, 1e-3
# changes of slips that are remembered: the map is piecewise nearly linear
DEPTH_OF_GAPS = 3
# times the last change: the longest step; of the slips: the farthest way back
LEAP, BACK = 30.0, 0.1
# problems in a row whose change is not half of the least before; then bodies slide on without end
PATIENCE = 12
# problems in a row that are not solved: the second one goes on where the first has ended
UNSOLVED = 2
# steps of one problem: beyond that it is not solved
MOST_STEPS = 500
# times the first slips: more of them are no measure of changes, since they may grow without end
FARTHER = 100.0
# times the first slips: so many of them, and still no rest, are bodies that slide
GROWN = 10.0


class DeSaxceIteration:
    """Forces within Coulomb's cones, from problems in which each gap grows by the slip there.

    With q_i the slip, a gap of g_i + w_i, w_i = ‖μ_i q_i‖, makes Coulomb's law the optimality of
    min ½λᵀFλ − λᵀd over all cones ‖τ_i/μ_i‖ ≤ λ_N,i at once (De Saxcé). Each of these problems is
    convex, and has a solution wherever forces within the law can balance the load, if gaps do not
    exclude each other; with bounds in the place of cones that is so for some bounds only. w is
    iterated to its fixed point (Acary, Cadoux, Lemaréchal, Malick, Z. Angew. Math. Mech. 91, 2011).

    Args:
        dual: The dual problem.
        lam: Forces within the law that balance the load, on this rank's rows.
        options: Parameters of block Newton. Creation and all methods are collective.

    Attributes:
        lam: The last forces, on this rank's rows.
        mu: Multipliers of Gλ = e there.
        astray: Whether slips grow without end, or do not come to rest, or problems are not solved.
        slides: Whether they have grown.
    """

    def __init__(self, dual: Dual, lam: Array, options: Options) -> None:
        self._dual, self._options, self._comm = dual, options, dual.coarse.comm
        constraints, at = dual.constraints, dual.constraints.pressed
        self._tangents, self._mu = constraints.sets.tangents[at], constraints.coefficients[at]
        self._rows = constraints.pressed_by[at]
        self.lam = lam
        self.mu: Array = np.zeros(dual.coarse.dimension)
        self._w: Array = np.zeros(len(at))
        self._anderson = Anderson(self._products, DEPTH_OF_GAPS)
        self._change, self._first = np.inf, 0.0
        self.astray, self.slides, self._unsolved = False, False, 0

    def settle(self, share: float) -> Array:
        """Iterate until slips change by less than a share; returns the λ_N under the law."""
        best, idle = np.inf, 0
        while idle < PATIENCE and self._unsolved < UNSOLVED:
            slips = self._slips()
            size, self._change = self._size(slips), self._size(slips - self._w)
            self._first = self._first or size
            if self._change <= share * min(size, FARTHER * self._first):
                return np.array(self.lam[self._rows])
            idle += 1
            if self._change <= 0.5 * best:
                best, idle = self._change, 0
            self._advance(slips)
        self.astray, self.slides = True, self._size(self._w) > GROWN * self._first
        return np.array(self.lam[self._rows])

    def _advance(self, slips: Array) -> None:
        """Return the accelerated step, limited in length, or a plain one if that goes far back."""
        plain = slips - self._w
        step = self._anderson.next(self._w, slips) - self._w
        along = self._products(step[:, None], plain[:, None])[0, 0]
        if along <= 0.0 and self._size(step) > BACK * self._size(self._w):
            step = plain
        longest = LEAP * self._change
        self._w = np.maximum(self._w + min(1.0, longest / max(self._size(step), TINY)) * step, 0.0)

    def _slips(self) -> Array:
        """‖μ_i q_i‖ at the solution with the present gaps; keeps its forces."""
        given = self._dual.qp()
        d, lam = given.d.duplicate(), given.d.duplicate()
        given.coarse.combine(self.mu, d)  # with the last Gᵀμ in d only what changes is left to find
        d.axpy(1.0, given.d)
        d.array[self._rows] -= self._w
        lam.array[:] = self.lam
        qp: QP = replace(given, d=d, feasible=cone_set(self._dual.constraints))
        at = operator_product(qp.F, lam)
        homogenised, start = homogenise(qp, at), Start(lam, np.zeros_like(self.mu))
        tolerance = FIRST * homogenised.scale.reference
        if np.isfinite(self._change):
            tolerance = min(tolerance, SHARE * self._change)
        rule = ResidualRule(max(tolerance, homogenised.scale.rounding))
        most = min(self._options.max_it, MOST_STEPS)
        result = newton(qp, homogenised, rule, self._options.newton, max_it=most, start=start)
        self._dual.saw(result.norm)
        late = result.reason == ConvergedReason.DIVERGED_ITS
        self._unsolved = self._unsolved + 1 if late else 0
        self.lam, self.mu = np.array(result.lam.array_r), self.mu + result.mu
        slips = np.linalg.norm(self._mu * result.gradient.array_r[self._tangents], axis=1)
        homogenised.destroy()
        at.destroy()
        result.destroy()
        d.destroy()
        return np.asarray(slips)

    def _size(self, x: Array) -> float:
        return norm_over(self._comm, x)

    def _products(self, A: Array, B: Array) -> Array:
        return bcast_from_root(self._comm, summed(self._comm, A.T @ B))


def cone_set(constraints: Constraints) -> Product:
    """λ_N ≥ 0, given bounds, and Coulomb's law for normal and tangents together."""
    sets, pressed = constraints.sets, constraints.pressed
    above = constraints.pressed_by[pressed]
    given = np.setdiff1d(np.arange(len(sets.tangents)), pressed)
    rows = np.column_stack((above, sets.tangents[pressed]))
    return Product(
        [
            (np.setdiff1d(sets.normals, above), Bounds()),
            (sets.tangents[given].ravel(), Ellipses(constraints.limits[given])),
            (rows.ravel(), Cones(constraints.coefficients[pressed])),
        ]
    )
