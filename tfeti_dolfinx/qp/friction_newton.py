"""Newton's method on Coulomb's law itself, by GCR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, norm_over, summed
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.qp.coarse import Oblique
from tfeti_dolfinx.qp.problem import QP, FaceOperator, Operator
from tfeti_dolfinx.qp.recycling import RecycledOnFace, triangle
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status

# --- Generalised conjugate residuals ----------------------------------------------------------

# of Az: what earlier directions leave of it, less is rounding; and of the residual: what a
# direction takes from it, or there is nothing to gain
NEW, GAIN = 1e-7, 1e-8


@dataclass(frozen=True)
class KrylovBasis:
    """Directions of which A is known, as rows.

    Attributes:
        Q: Az of each, orthonormal over all ranks, this rank's part, shape ``(k, n)``.
        Z: The directions z.
        images: What is given with each Az.
    """

    Q: Array
    Z: Array
    images: Array

    @staticmethod
    def nothing(like: Array) -> KrylovBasis:
        """Return an empty basis of vectors like one."""
        return KrylovBasis(*(np.zeros((0, len(like))) for _ in range(3)))

    def without(self, c: Array, q: Array, z: Array, w: Array) -> tuple[Array, Array, Array]:
        """Orthogonalise a direction with its Az and image against the basis."""
        return q - c @ self.Q, z - c @ self.Z, w - c @ self.images


@dataclass(frozen=True)
class GCRResult:
    """Result of generalised conjugate residuals, started from 0.

    Attributes:
        u: The solution.
        image: What was given with each Az, combined as u is.
        new: The directions gone, each for one multiplication.
        length: The least step along one of them, over Mr less earlier directions; 0 without any.
    """

    u: Array
    image: Array
    new: KrylovBasis
    length: float


def gcr(
    apply: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    b: Array,
    target: float,
    most: int,
    comm: MPI.Intracomm,
    known: KrylovBasis | None = None,
) -> GCRResult:
    """Make ‖b − Au‖ least over more and more directions. Collective; one sum over ranks a step.

    Eisenstat, Elman, Schultz, SIAM J. Numer. Anal. 20 (1983) 345–357: each direction z = Mr with
    Az orthogonal to those before. All are kept.

    Args:
        apply: Gives Az, and what else is linear in z and wanted of u.
        precondition: M.
        b: Right side, this rank's part.
        target: Ends at ‖b − Au‖ ≤ target.
        most: Most directions.
        comm: Communicator.
        known: Directions to begin with.
    """
    old, new = known or KrylovBasis.nothing(b), _GrowingBasis(len(b))
    c = summed(comm, old.Q @ b)
    u, image, r = c @ old.Z, c @ old.images, b - c @ old.Q
    size, lengths = norm_over(comm, r), list[float]()
    while size > target and new.count < most:
        z = precondition(r)
        q, w = apply(z)
        sums = summed(comm, np.concatenate((old.Q @ q, new.rows.Q @ q, (q @ q, q @ r, r @ r))))
        c, (square, along, left) = sums[:-3], sums[-3:]
        length = float(np.sqrt(max(square - c @ c, 0.0)))
        if bcast_from_root(
            comm, length <= NEW * np.sqrt(square) or abs(along) <= GAIN * length * size
        ):
            break
        q, z, w = new.rows.without(c[len(old.Q) :], *old.without(c[: len(old.Q)], q, z, w))
        q, z, w, step = q / length, z / length, w / length, along / length
        u, image, r = u + step * z, image + step * w, r - step * q
        new.add(q, z, w)
        lengths.append(step / length)
        size = bcast_from_root(comm, float(np.sqrt(max(left - step**2, 0.0))))
    return GCRResult(u, image, new.rows, bcast_from_root(comm, max(min(lengths, default=0.0), 0.0)))


class _GrowingBasis:
    """Directions, with room for more.

    Args:
        size: Of this rank's part.
    """

    def __init__(self, size: int) -> None:
        self.count = 0
        self._room: Array = np.zeros((3, 8, size))

    @property
    def rows(self) -> KrylovBasis:
        """The directions stored so far."""
        return KrylovBasis(*self._room[:, : self.count])

    def add(self, q: Array, z: Array, w: Array) -> None:
        """Store another direction."""
        if self.count == self._room.shape[1]:
            self._room = np.concatenate((self._room, np.zeros_like(self._room)), axis=1)
        self._room[:, self.count] = q, z, w
        self.count += 1


# --- Laws of friction -------------------------------------------------------------------------

# what sticks for once is moved so far to the centre of its disc
INSIDE = 0.5


@dataclass(frozen=True)
class Law:
    """λ ∈ Ω(λ_N), on this rank's rows: the set of a point's λ_T is λ_N times one of its own.

    Attributes:
        at: Makes Ω of the λ_N of all points, shape ``(p,)``.
        normals: Row of λ_N of each point, shape ``(p,)``.
        tangents: Rows of its λ_T, shape ``(p, k)``.
        share: Of all coefficients of friction: Ω(share λ_N) is the set.
    """

    at: Callable[[Array], FeasibleSet]
    normals: Array
    tangents: Array
    share: float = 1.0

    def with_share(self, share: float) -> Law:
        """Return the law with this share of all coefficients; 0 is contact without friction."""
        return replace(self, share=share)

    def nearest(self, y: Array) -> tuple[FeasibleSet, Array]:
        """Ω(y_N⁺), and the nearest point to y in it."""
        feasible = self.at(self.share * np.maximum(y[self.normals], 0.0))
        return feasible, feasible.project(y)

    def slips(self, face: Face) -> Array:
        """Return the slipping points, flags of shape ``(p,)``."""
        return np.asarray(np.any(face.status[self.tangents] == Status.SLIP, axis=1))

    def following(self, p: Array, face: Face) -> csr_array:
        """C: where points slip λ_T follows λ_N, λ_T = Cλ with the direction of p. Shape ``(m, m)``.

        Args:
            p: A point of Ω(p_N).
            face: Its face.
        """
        at = np.flatnonzero(self.slips(face))
        rows, columns = self.tangents[at], self.normals[at]
        values = p[rows] / p[columns][:, None]
        index = rows.ravel(), np.repeat(columns, rows.shape[1])
        return csr_array((values.ravel(), index), shape=(len(p), len(p)))

    def stuck(self, p: Array, at: Array) -> Array:
        """p with the λ_T of points flagged inside of their sets."""
        inside = np.array(p)
        inside[self.tangents[at]] *= INSIDE
        return inside


@dataclass(frozen=True)
class OnFace:
    """Face of a Newton step: its directions, the coupling C of slips, a point to enter it at.

    Attributes:
        face: The face, hard directions held.
        C: What λ_T follows.
        p: A point of the face.
    """

    face: Face
    C: csr_array
    p: Array

    def followed(self, u: Array) -> Array:
        """Return (I + C)u, shapes ``(m,)`` or ``(m, q)``."""
        return np.asarray(u + self.C @ u)

    def entered(self, lam: Array) -> Array:
        """Return λ with open and slipping entries set to those of p, coupled ones following."""
        held = np.isin(self.face.status, (Status.OPEN, Status.SLIP))
        follows = np.diff(self.C.indptr) > 0
        return np.where(follows, self.C @ lam, np.where(held, self.p, lam))

    def bend(self, u: Array) -> Array:
        """Return Z diag(κ) Zᵀu, shapes ``(m,)`` or ``(m, q)``."""
        Z = self.face.Z
        return np.asarray(Z @ (self.face.curvature * (Z.T @ u).T).T)


# --- Recycled directions of earlier solves ----------------------------------------------------

# of the largest image of a direction: what others leave of one, less would be rounding
NEW_DIRECTION = 1e-7


def known_on(
    past: RecycledOnFace | None, on: OnFace, project: Callable[[Array], Array]
) -> KrylovBasis | None:
    """Return known products Au = P(F(I + C)u + κu) from directions WN = (I + C)U of past solves.

    Farhat, Crivelli, Roux (``Recycled``); as Carvalho, Gratton, Lago, Vasseur, SIAM J. Sci.
    Comput. 33 (2011) 2463–2490 begin residuals. Multiplies by nothing. Collective.

    Args:
        past: Directions W; None: there are none.
        on: The face.
        project: P, of shapes ``(m, q)``.

    Returns:
        U with AU orthonormal, and FWN combined likewise; None where there is nothing.
    """
    if past is None or past.known.count == 0:
        return None
    comm, (W, FW) = past.known.comm, past.known.columns
    U = on.face.restricted(W - on.C @ W)
    N = past.known.without(W - on.followed(U))
    if N.shape[1] == 0:
        return None
    U, FU = U @ N, FW @ N
    AU = project(FU + on.bend(U))
    _, sizes, Vt = np.linalg.svd(triangle(comm, AU))
    kept = sizes > NEW_DIRECTION * sizes[0]
    T = Vt[kept].T / sizes[kept]
    return KrylovBasis((AU @ T).T, (U @ T).T, (FU @ T).T)


def keep(past: RecycledOnFace | None, x: Array, Fx: Array) -> None:
    """Store a search direction x, Gx = 0, with Fx. Collective."""
    if past is None:
        return
    energy = bcast_from_root(past.known.comm, float(summed(past.known.comm, np.array([x @ Fx]))[0]))
    if energy > 0.0:
        past.known.add(x, Fx, energy)


# --- Newton's method on a law of friction -----------------------------------------------------

# steps; and steps in a row without a residual below so much of the least one, before one gives up
MOST_STEPS, PATIENCE, LESS = 80, 10, 0.98
# steps for one share of the coefficients, and on the whole path; and its shortest step
MOST_A_SHARE, MOST_ON_PATH, SHORTEST = 25, 200, 1e-4
# residuals of so many steps before bound the next one; the shortest part of a step that is tried
MEMORY, LEAST = 5, 0.01
# of its residual: what a solve leaves on the path; beside a soft motion SHARE leaves all the others
EXACT = 1e-3
# of a residual: rounding of the λ that has it; from there nothing comes lower
ROUNDING = 1e-16
# directions of one solve
MOST_DIRECTIONS = 80
# what a solve leaves of its residual: less where the last step has brought that far down; of the
# target: no solve leaves less
SHARE, FOLLOWED, FINAL = 0.3, 0.3, 0.3
# relative to the target: ‖F‖‖p‖ of a correction p onto a face below which Fp is not computed
UNSEEN = 0.1
# relative to the residual: ‖F‖‖p‖ of that correction up to which a search direction is added to it
# for the same multiplication; the direction is chosen before Fp is known
BESIDE = 2.0
# times ‖F‖: directions that bend more are turned by the projection alone
HARD = 10.0


@dataclass(frozen=True)
class LawPoint:
    """Multipliers, this rank's part.

    Attributes:
        lam: λ.
        s: Fλ − d − Gᵀμ.
        mu: μ, replicated.
    """

    lam: Array
    s: Array
    mu: Array

    def towards(self, other: LawPoint, length: float) -> LawPoint:
        """Return the point at this share of the way to another one."""
        if length == 1.0:
            return other
        ends = (self.lam, other.lam), (self.s, other.s), (self.mu, other.mu)
        return LawPoint(*((1.0 - length) * a + length * b for a, b in ends))


class SlipReversal:
    """Directions of slip of the last step, to detect points whose slip reverses.

    Args:
        law: The sets.
    """

    def __init__(self, law: Law) -> None:
        self._law = law
        self._slips = np.zeros(len(law.normals), dtype=bool)
        self._to: Array = np.zeros(law.tangents.shape)

    def face(self, feasible: FeasibleSet, p: Array, s: Array) -> tuple[Array, Face]:
        """Return p and its face under s; points whose slip has just reversed stick."""
        law, face, to = self._law, feasible.face(p, s), p[self._law.tangents]
        turned = law.slips(face) & self._slips & (np.sum(to * self._to, axis=1) < 0.0)
        if np.any(turned):
            p = law.stuck(p, turned)
            face = feasible.face(p, s)
        self._slips, self._to = law.slips(face), to
        return p, face


def newton_on_law(
    qp: QP,
    law: Law,
    oblique: Callable[[Face, csr_array], Oblique],
    at: LawPoint,
    target: float,
    norm: float,
    most_steps: int = MOST_STEPS,
    most: float = SHARE,
) -> tuple[LawPoint | None, int]:
    """Solve λ = P(λ − s/‖F‖), P the projection onto Ω(λ_N − s_N/‖F‖), and Gλ = e. Collective.

    The natural map of Coulomb's law, by a semismooth Newton method (Alart, Curnier, Comput.
    Methods Appl. Mech. Engrg. 92, 1991; Hüeber, Stadler, Wohlmuth, SIAM J. Sci. Comput. 30, 2008).
    The residual may rise above those of a few steps before only where no part of a step of 1/64 or
    more keeps it below. It may fail: whoever calls it has something else to try.

    Args:
        qp: The program; its set is not looked at.
        law: The sets.
        oblique: Makes the projectors of a face and of what follows it.
        at: Where to start.
        target: Ends where ‖F‖‖λ − P(λ − s/‖F‖)‖, and ‖F‖ times the distance to Gλ = e, are that.
        norm: ‖F‖, or an estimate.
        most_steps: Steps at most.
        most: What a solve leaves of its residual at most.

    Returns:
        Where it has ended, None if it gave up; and the steps taken.
    """
    last, best, idle, length = 0.0, np.inf, 0, 0.0
    past: list[float] = []
    turning = SlipReversal(law)
    for step in range(most_steps):
        # Step 1: what a gradient step, brought back, moves, and what Gλ lacks
        feasible, p = law.nearest(at.lam - at.s / norm)
        residual = norm * _missed(qp, p, at.lam)
        if residual <= target:
            return at, step
        idle = 0 if residual < LESS * best else idle + 1
        best = min(best, residual)
        if idle > PATIENCE or not ROUNDING * residual <= target:
            break
        # Step 2: the face there
        p, face = turning.face(feasible, p, at.s)
        # Steps 3 and 4: onto the face, and a solve there
        eased = face.with_directions(np.flatnonzero(face.curvature <= HARD * norm))
        share = min(most, FOLLOWED * residual / last) if step else most
        on = OnFace(eased, law.following(p, face), p)
        try:
            system = _System(qp, on, oblique(eased, on.C), at)
            system.enter(length, norm, UNSEEN * target)
            length = min(system.solve(share, FINAL * target) or length, 1.0)
        except FactorError:
            break
        past = [*past[1 - MEMORY :], residual]
        at, last = _searched(qp, law, at, system.end(), norm, max(past)), residual
    return None, step + 1


def _searched(qp: QP, law: Law, at: LawPoint, end: LawPoint, norm: float, most: float) -> LawPoint:
    """Halve the step until it does not raise the residual.

    Where F is known of both ends, it is on all of the way: nothing is multiplied.
    """
    length = 1.0
    while length > LEAST:
        there = at.towards(end, length)
        if residual_of(qp, law, there, norm) <= most:
            return there
        length *= 0.5
    return end


def follow_friction(
    qp: QP,
    law: Law,
    oblique: Callable[[Face, csr_array], Oblique],
    at: LawPoint,
    target: float,
    norm: float,
    loose: float,
) -> tuple[LawPoint | None, int]:
    """Solve the law along the path of its solutions for growing shares of its coefficients.

    Without friction the solution is unique, and where bodies are held the path that begins there is
    bounded, so that it leads on to the whole coefficients (Allgower, Georg, Introduction to
    Numerical Continuation Methods, 2003, chapter 11). The share grows by twice the last step, by a
    quarter of it where Newton's method fails. It gives up where the path turns back. Solves are
    exacter than those of ``newton_on_law`` alone; that may be enough, and is tried first.
    Collective.

    Args:
        qp: The program; its set is not looked at.
        law: The sets.
        oblique: Makes the projectors of a face and of what follows it.
        at: Where to start.
        target: As of ``newton_on_law``, at the end.
        norm: ‖F‖, or an estimate.
        loose: The same on the way.

    Returns:
        Where it has ended, None if it gave up; and the steps taken.
    """
    whole, steps = newton_on_law(qp, law, oblique, at, target, norm, MOST_A_SHARE, EXACT)
    if whole is not None:
        return whole, steps
    point, taken = newton_on_law(qp, law.with_share(0.0), oblique, at, loose, norm, most=EXACT)
    steps, share, length = steps + taken, 0.0, 1.0
    while point is not None and share < 1.0 and length >= SHORTEST and steps < MOST_ON_PATH:
        new = min(share + length, 1.0)
        goal = target if new == 1.0 else loose
        given = qp, law.with_share(new), oblique, point, goal, norm
        end, taken = newton_on_law(*given, MOST_A_SHARE, EXACT)
        steps += taken
        if end is None:
            length *= 0.25
        else:
            point, share, length = end, new, 2.0 * length
    return (point if share == 1.0 else None), steps


def residual_of(qp: QP, law: Law, at: LawPoint, norm: float) -> float:
    """‖F‖ times what λ misses of the law and of Gλ = e, the same on all ranks. Collective."""
    return norm * _missed(qp, law.nearest(at.lam - at.s / norm)[1], at.lam)


def _missed(qp: QP, p: Array, lam: Array) -> float:
    """√(‖λ − p‖² + ‖Gᵀ(GGᵀ)⁻¹(e − Gλ)‖²), the same on all ranks. Collective."""
    x = qp.d.duplicate()
    x.array[:] = lam
    qp.coarse.combine(qp.coarse.solve(qp.coarse.residual(x)), x)
    missed = norm_over(qp.d.getComm().tompi4py(), np.concatenate((p - lam, x.array_r)))
    x.destroy()
    return missed


class _System:
    """Steps 3 and 4: on the face Zᵀ(Fλ − d − Gᵀμ) + κu = 0 and Gλ = e, λ = λ₁ + (I + C)u.

    Args:
        qp: The program.
        on: The face.
        oblique: Its projectors.
        at: Where to come from.
    """

    def __init__(self, qp: QP, on: OnFace, oblique: Oblique, at: LawPoint) -> None:
        self._qp, self._on, self._oblique, self._mu = qp, on, oblique, at.mu
        self._comm = qp.d.getComm().tompi4py()
        self._F = _on_arrays(qp.F, qp.d)
        self._made = qp.preconditioner_on(on.face) if qp.preconditioner_on else None
        self._M = _on_arrays(self._made, qp.d) if self._made else on.face.restricted
        # Step 3: λ₁ on the face, u₀ that restores Gλ = e; s is of λ before
        self._work = qp.d.duplicate()
        lam = self._work.array[:] = on.entered(at.lam)
        self._u = oblique.restoring(qp.coarse.residual(self._work))
        self._lam, self._s = lam + on.followed(self._u), at.s
        self._way = self._lam - at.lam
        self._known = known_on(qp.recycled, on, oblique.project)

    def enter(self, length: float, norm: float, seen: float) -> None:
        """Multiply F by the correction onto the face, where its image exceeds ``seen``.

        Beside it goes a first direction, for the same multiplication, so far as those before went;
        but not beside a way that may be more than what is to be solved for.

        Args:
            length: Step along a residual, preconditioned; 0: none is known.
            norm: ‖F‖.
            seen: What is seen.
        """
        size = norm * norm_over(self._comm, self._way)
        if size <= seen:
            return
        self._solve(np.inf)
        b = self._left()
        if length and bcast_from_root(self._comm, size <= BESIDE * norm_over(self._comm, b)):
            z = length * self._precondition(b)
            self._go(z, np.zeros_like(z))
            self._way = self._way + self._on.followed(z)
        image = self._F(self._way)
        self._s = self._s + image
        if self._qp.coarse.dimension == 0:  # else it restores Gλ = e
            keep(self._qp.recycled, self._way, image)

    def solve(self, share: float, least: float) -> float:
        """Step 4: u by conjugate residuals.

        Args:
            share: Of the residual: what is left of it.
            least: No solve leaves less.

        Returns:
            The length of the steps.
        """
        gone = self._solve(max(share * norm_over(self._comm, self._left()), least))
        for z, image in zip(gone.new.Z, gone.new.images, strict=True):
            keep(self._qp.recycled, self._on.followed(z), image)
        return gone.length

    def end(self) -> LawPoint:
        """Return the present point, and free work vectors."""
        mu = self._oblique.coordinates(self._s + self._on.bend(self._u))
        self._qp.coarse.combine(mu, self._work)
        at = LawPoint(self._lam, self._s - self._work.array_r, self._mu + mu)
        for item in (self._work, self._made):
            if item is not None:
                item.destroy()
        return at

    def _solve(self, size: float) -> GCRResult:
        """Reduce the residual to a size; without a size by known directions alone."""
        b, known = self._left(), self._known
        gone = gcr(self._apply, self._precondition, b, size, MOST_DIRECTIONS, self._comm, known)
        self._go(gone.u, gone.image)
        return gone

    def _go(self, u: Array, image: Array) -> None:
        self._u, self._lam = self._u + u, self._lam + self._on.followed(u)
        self._s = self._s + image

    def _left(self) -> Array:
        """Return the residual."""
        return -self._oblique.project(self._s + self._on.bend(self._u))

    def _apply(self, z: Array) -> tuple[Array, Array]:
        Fz = self._F(self._on.followed(z))
        return self._oblique.project(Fz + self._on.bend(z)), Fz

    def _precondition(self, r: Array) -> Array:
        return self._oblique.project(self._M(r))


def _on_arrays(A: Operator | FaceOperator, like: PETSc.Vec) -> Callable[[Array], Array]:
    """Return an operator between this rank's parts of vectors."""

    def mult(values: Array) -> Array:
        x, y = like.duplicate(), like.duplicate()
        x.array[:] = values
        A.mult(x, y)
        result = np.array(y.array_r)
        x.destroy()
        y.destroy()
        return result

    return mult
