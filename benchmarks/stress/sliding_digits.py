"""Coulomb's friction where double precision has too few digits: by decimal ones, dense.

Lemke's method with friction in polygons and weak springs says what touches and slips, Newton's
method with the discs ends there. KR = 0 is made to hold.
"""

from __future__ import annotations

from decimal import Decimal

import numpy as np

from benchmarks.stress.digits import (
    ONE,
    ZERO,
    Cholesky,
    SingularError,
    eliminated,
    exact,
    largest,
    lemke,
    orthonormal,
    zeros,
)
from benchmarks.stress.qp import UnsettledError
from benchmarks.stress.sliding import Law

SPRING = Decimal("1e-50")  # of the largest entry of K
APART = Decimal("1e-25")  # of the largest load: what keeps bounds from being equal
SETTLED = Decimal("1e-25")
SIDES = 6  # of the polygon around a disc
BORNE = Decimal("1e-15")  # of the largest load: what springs may bear
PIVOTS, STEPS = 5000, 60


def without_motions(
    K: np.ndarray, x: np.ndarray, bodies: list[np.ndarray], gdim: int
) -> np.ndarray:
    """(I − QQᵀ)K(I − QQᵀ) in digits, Q a basis of the rigid motions of each body.

    Args:
        K: Stiffness in double precision, dense, shape ``(n, n)``.
        x: Nodes.
        bodies: Nodes of each body, which share none.
        gdim: 2 or 3.
    """
    found = exact(K)
    turns = [(0, 1)] if gdim == 2 else [(0, 1), (1, 2), (2, 0)]
    for nodes in bodies:
        arm = exact(x[nodes, :gdim])
        arm = arm - arm.mean(axis=0)
        arm = arm / largest(arm)
        R = zeros(len(nodes), gdim, gdim + len(turns))
        R[:, range(gdim), range(gdim)] = ONE
        for k, (i, j) in enumerate(turns):
            R[:, i, gdim + k], R[:, j, gdim + k] = -arm[:, j], arm[:, i]
        Q = orthonormal(R.reshape(len(nodes) * gdim, -1))
        dofs = (nodes[:, None] * gdim + np.arange(gdim)).ravel()
        A = found[np.ix_(dofs, dofs)]
        A = A - Q.dot(Q.T.dot(A))
        A = A - A.dot(Q).dot(Q.T)
        found[np.ix_(dofs, dofs)] = (A + A.T) / 2
    return found


class SlidingInDigits:
    """K u + Nᵀλ + Tᵀτ = f with contact and friction, by the compliance of their rows.

    Args:
        K: Stiffness, symmetric and semidefinite, shape ``(n, n)``.
        f: Load.
        law: The conditions, in decimal digits.
    """

    def __init__(self, K: np.ndarray, f: np.ndarray, law: Law) -> None:
        self._law, self._f, self._load = law, f, largest(f)
        self.count, self.axes = len(law.gap), len(law.T) // len(law.gap)
        self._H = np.concatenate((law.N, law.T))
        self._still = np.array([not row.any() for row in self._H])
        self._spring = SPRING * largest(np.diag(K))
        self._factor = Cholesky(K + self._spring * np.diag([ONE] * len(K)))
        self._bent = self._factor.solve(self._H.T)
        self._C = self._H.dot(self._bent)
        self._given = np.concatenate((zeros(self.count), law.slip))
        sizes = (self._H * self._H / np.diag(K)).sum(axis=1)
        turned = sizes[self.count :].reshape(self.count, self.axes).sum(axis=1)
        self._r = np.array([ONE / (a or b) for a, b in zip(sizes, turned, strict=False)])
        self._state: tuple[np.ndarray, np.ndarray] | None = None

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """u, and λ and τ.

        Raises:
            UnsettledError: No state was found, or springs are what bears the load.
        """
        try:
            free = self._factor.solve(self._f[:, None])[:, 0]
            moved = self._H.dot(free) + self._given
            force = self._newton(self._sticking_or_slipping(moved), moved)
        except SingularError as error:
            raise UnsettledError(f"friction did not settle in digits: {error}") from error
        u = free - self._bent.dot(force)
        if self._spring * largest(u) > BORNE * self._load:
            raise UnsettledError("friction did not settle in digits: springs bear the load")
        return u, force

    def changed(self, pull: np.ndarray, gap: np.ndarray) -> np.ndarray:
        """Change of u by that of the load and the gaps, to first order. After ``solve``."""
        assert self._state is not None
        moved = self._state[1]
        free = self._factor.solve(pull[:, None])[:, 0]
        J, before = self._linearised(moved, self._law.gap)
        _, after = self._linearised(moved + self._H.dot(free), self._law.gap + gap)
        change: np.ndarray = free - self._bent.dot(eliminated(J, after - before))
        return change

    def _sticking_or_slipping(self, moved: np.ndarray) -> np.ndarray:
        """Forces with friction in polygons."""
        c, t, law = self.count, self.axes, self._law
        angles = np.arange(SIDES) * 2.0 * np.pi / SIDES
        ways = np.column_stack((np.cos(angles), np.sin(angles)))
        E = exact(np.array([[1.0], [-1.0]]) if t == 1 else ways)
        sides = len(E)
        B = zeros(c * (1 + t), c * (1 + sides))
        M, q = zeros(c * (2 + sides), c * (2 + sides)), zeros(c * (2 + sides))
        for i in range(c):
            own = slice(c + i * sides, c + (i + 1) * sides)
            last = c * (1 + sides) + i
            B[i, i], B[c + i * t : c + (i + 1) * t, own] = ONE, E.T
            M[own, last], M[last, own], M[last, i] = ONE, -ONE, law.coefficient[i]
        M[: B.shape[1], : B.shape[1]] = B.T.dot(self._C.dot(B))
        q[: B.shape[1]] = -B.T.dot(moved)
        q[:c] += law.gap
        some = exact(1.0 + np.random.default_rng(0).random(c))
        q[B.shape[1] :] = law.given + some * self._load * APART
        found: np.ndarray = B.dot(lemke(M, q, PIVOTS)[: B.shape[1]])
        return found

    def _newton(self, force: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Alart's and Curnier's method for the forces, H u = moved − C force."""
        for _ in range(STEPS):
            self._state = (force, moved)
            new = eliminated(*self._linearised(moved, self._law.gap))
            if largest(new - force) <= SETTLED * max(largest(new), self._load):
                return new
            force = new
        raise SingularError("Newton's method did not end")

    def _linearised(self, b: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The linear system of the last state, for displacements of rows and gaps."""
        assert self._state is not None
        (force, moved), c, t, C = self._state, self.count, self.axes, self._C
        slip, J, right = moved - C.dot(force), zeros(len(C), len(C)), zeros(len(C))
        for i in range(c):
            rows, r = np.arange(c + i * t, c + (i + 1) * t), self._r[i]
            z, y = force[i] + r * (slip[i] - self._law.gap[i]), force[rows] + r * slip[rows]
            J[i, i], closed = ONE, z > 0
            if closed:
                J[i], right[i] = C[i], b[i] - gap[i]
            bound = self._law.given[i] + self._law.coefficient[i] * max(z, ZERO)
            length = y.dot(y).sqrt()
            J[rows, rows] = ONE
            if self._still[rows].all():
                continue
            if length < bound:
                sticks = rows[~self._still[rows]]
                J[sticks], right[sticks] = C[sticks], b[sticks]
                continue
            if length == 0:
                continue
            e = y / length
            turn = bound / length * (np.diag([ONE] * t) - np.outer(e, e))
            J[np.ix_(rows, rows)] -= turn
            J[rows] += r * turn.dot(C[rows])
            right[rows] = r * turn.dot(b[rows]) + bound * e
            if closed:
                draw = self._law.coefficient[i] * e
                J[rows, i] -= draw
                J[rows] += r * np.outer(draw, C[i])
                right[rows] += draw * (r * (b[i] - gap[i]) - z)
        return J, right
