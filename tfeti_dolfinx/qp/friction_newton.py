"""Newton's method on Coulomb's law itself, by generalised conjugate residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import norm_over, steering, summed
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.qp.coarse import Oblique
from tfeti_dolfinx.qp.problem import QP, FaceOperator, Operator
from tfeti_dolfinx.qp.recycling import RecycledOnFace, triangle
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status


@dataclass(frozen=True)
class FrictionParameters:
    """Parameters of Newton's method on Coulomb's law.

    Attributes:
        max_steps: Most steps.
        patience: So many steps in a row without progress, and the method has failed.
        progress: A residual below this share of the least one is progress.
        memory: A step may not exceed the largest residual of so many steps before.
        shortest: Steps are halved down to this share.
        reduction: What a solve leaves of its residual at most.
        followed: Of the share that the last step has left: what a solve leaves, so that the end is
            superlinear; and of the target: no solve leaves less.
        max_directions: Most directions of one solve.
        unseen: Of the target: F of a way onto a face that is shorter, times ‖F‖, is not computed.
        beside: Of the residual: beside a way up to which, times ‖F‖, a direction is gone for the
            same multiplication. A longer way makes a residual of its own.
        hard: Times ‖F‖: directions that bend more are held.
        new: Of Az: what earlier directions leave of it, less is rounding.
        gain: Of the residual: what a direction takes from it, less is no gain.
        rounding: Of a residual: no λ that has it comes lower.
        path_reduction: What solves on the path of growing friction leave of their residual: beside
            soft motions ``reduction`` leaves all others.
        path_steps: Most steps for one share of the coefficients.
        path_length: Most steps on the whole path.
        path_shortest: Its shortest step.
    """

    max_steps: int = 80
    patience: int = 10
    progress: float = 0.98
    memory: int = 5
    shortest: float = 0.01
    reduction: float = 0.3
    followed: float = 0.3
    max_directions: int = 80
    unseen: float = 0.1
    beside: float = 2.0
    hard: float = 10.0
    new: float = 1e-7
    gain: float = 1e-8
    rounding: float = 1e-16
    path_reduction: float = 1e-3
    path_steps: int = 25
    path_length: int = 200
    path_shortest: float = 1e-4


DEFAULT = FrictionParameters()

# --- The law ----------------------------------------------------------------------------------


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

    def nearest(self, y: Array) -> tuple[FeasibleSet, Array]:
        """Ω(y_N⁺), and the nearest point to y in it."""
        feasible = self.at(self.share * np.maximum(y[self.normals], 0.0))
        return feasible, feasible.project(y)

    def following(self, p: Array, face: Face) -> csr_array:
        """C: where points slip λ_T follows λ_N, λ_T = Cλ with the direction of p. Shape ``(m, m)``.

        Args:
            p: A point of Ω(p_N).
            face: Its face.
        """
        at = np.flatnonzero(np.any(face.status[self.tangents] == Status.SLIP, axis=1))
        rows, columns = self.tangents[at], self.normals[at]
        values = p[rows] / p[columns][:, None]
        index = rows.ravel(), np.repeat(columns, rows.shape[1])
        return csr_array((values.ravel(), index), shape=(len(p), len(p)))


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
        ends = (self.lam, other.lam), (self.s, other.s), (self.mu, other.mu)
        return LawPoint(*((1.0 - length) * a + length * b for a, b in ends))


@dataclass(frozen=True)
class LawProgram:
    """The law and Gλ = e, as one equation. All methods are collective.

    With y = λ − s/‖F‖ and P the projection onto Ω(y_N⁺) it is the natural map of Coulomb's law:
    λ = P(y) and Gλ = e.

    Attributes:
        qp: F, d and G; its set is not looked at.
        law: The sets.
        oblique: Makes the projectors of a face and of what follows it.
        norm: ‖F‖, or an estimate.
    """

    qp: QP
    law: Law
    oblique: Callable[[Face, csr_array], Oblique]
    norm: float

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator."""
        return self.qp.d.getComm().tompi4py()

    def with_share(self, share: float) -> LawProgram:
        """Return it with this share of all coefficients; 0 is contact without friction."""
        return replace(self, law=replace(self.law, share=share))

    def nearest(self, at: LawPoint) -> tuple[FeasibleSet, Array]:
        """Ω(y_N⁺) and P(y)."""
        return self.law.nearest(at.lam - at.s / self.norm)

    def missed(self, p: Array, lam: Array) -> float:
        """‖F‖ √(‖λ − p‖² + ‖Gᵀ(GGᵀ)⁻¹(e − Gλ)‖²), the same on all ranks."""
        x, coarse = self.qp.d.duplicate(), self.qp.coarse
        x.array[:] = lam
        coarse.combine(coarse.solve(coarse.residual(x)), x)
        missed = norm_over(self.comm, np.concatenate((p - lam, x.array_r)))
        x.destroy()
        return self.norm * missed

    def residual(self, at: LawPoint) -> float:
        """‖F‖ times what λ misses of the law and of Gλ = e, the same on all ranks."""
        return self.missed(self.nearest(at)[1], at.lam)


# --- Newton's method --------------------------------------------------------------------------


def newton_on_law(
    program: LawProgram,
    at: LawPoint,
    target: float,
    parameters: FrictionParameters = DEFAULT,
) -> tuple[LawPoint | None, int]:
    """Solve the natural map of Coulomb's law by a semismooth Newton method. Collective.

    Alart, Curnier, Comput. Methods Appl. Mech. Engrg. 92 (1991); Hüeber, Stadler, Wohlmuth, SIAM
    J. Sci. Comput. 30 (2008). A step multiplies by F once for the way onto its face, if that can be
    seen, and once for each direction of its solve. It may fail: have something else to try.

    Args:
        program: The law.
        at: Where to start.
        target: Ends where the residual, ‖F‖ times what is missed, has come down to that.
        parameters: Parameters.

    Returns:
        Where it has ended, None if it gave up; and the steps taken.
    """
    length, best, idle, past = 0.0, np.inf, 0, list[float]()
    for step in range(parameters.max_steps):
        # Step 1: the natural map: what a gradient step, brought back, moves, and what Gλ lacks
        feasible, p = program.nearest(at)
        residual = program.missed(p, at.lam)
        if residual <= target:
            return at, step
        idle = 0 if residual < parameters.progress * best else idle + 1
        best = min(best, residual)
        if idle > parameters.patience or not parameters.rounding * residual <= target:
            return None, step
        # Step 2: the face of p, and what follows where points slip; P itself turns what bends hard
        face = feasible.face(p, at.s)
        soft = np.flatnonzero(face.curvature <= parameters.hard * program.norm)
        on = OnFace(face.with_directions(soft), program.law.following(p, face), p)
        share = parameters.reduction
        if past:
            share = min(share, parameters.followed * residual / past[-1])
        try:
            # Step 3: onto the face
            system = _System(program, on, at, parameters)
            system.enter(length, parameters.unseen * target)
            # Step 4: the system there
            length = min(system.solve(share, parameters.followed * target) or length, 1.0)
        except FactorError:
            return None, step + 1
        end = system.end()
        # Step 5: halve the step until its residual is none of the largest; F is known on all of it
        past = [*past[1 - parameters.memory :], residual]
        part, there = 1.0, end
        while not program.residual(there) <= max(past):
            part *= 0.5
            if part <= parameters.shortest:
                there = end
                break
            there = at.towards(end, part)
        at = there
    return None, parameters.max_steps


def follow_friction(
    program: LawProgram,
    at: LawPoint,
    target: float,
    loose: float,
    parameters: FrictionParameters = DEFAULT,
) -> tuple[LawPoint | None, int]:
    """Solve the law along the path of its solutions for growing shares of its coefficients.

    Without friction the solution is unique, and where bodies are held the path that begins there is
    bounded, so that it leads on to the whole coefficients (Allgower, Georg, Introduction to
    Numerical Continuation Methods, 2003, chapter 11). The share grows by twice the last step, by a
    quarter of it where Newton's method fails; it gives up where the path turns back. Collective.

    Args:
        program: The law.
        at: Where to start.
        target: As of ``newton_on_law``, at the end.
        loose: The same on the way.
        parameters: Parameters.

    Returns:
        Where it has ended, None if it gave up; and the steps taken.
    """
    exact = replace(parameters, reduction=parameters.path_reduction)
    short = replace(exact, max_steps=parameters.path_steps)
    # Step 1: exacter solves alone may be enough
    whole, steps = newton_on_law(program, at, target, short)
    if whole is not None:
        return whole, steps
    # Step 2: without friction
    point, taken = newton_on_law(program.with_share(0.0), at, loose, exact)
    steps += taken
    # Step 3: all of it at once, or less
    share, length = 0.0, 1.0
    while point is not None and share < 1.0 and length >= parameters.path_shortest:
        if steps >= parameters.path_length:
            break
        new = min(share + length, 1.0)
        goal = target if new == 1.0 else loose
        end, taken = newton_on_law(program.with_share(new), point, goal, short)
        steps += taken
        if end is None:
            length *= 0.25
        else:
            point, share, length = end, new, 2.0 * length
    return (point if share == 1.0 else None), steps


# --- The system of a step ---------------------------------------------------------------------


@dataclass(frozen=True)
class OnFace:
    """Face of a Newton step, with what follows it.

    Attributes:
        face: The face.
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


class _System:
    """Steps 3 and 4: on the face Zᵀ(Fλ − d − Gᵀμ) + κu = 0 and Gλ = e, λ = λ₁ + (I + C)u."""

    def __init__(
        self, program: LawProgram, on: OnFace, at: LawPoint, parameters: FrictionParameters
    ) -> None:
        qp = self._qp = program.qp
        self._on, self._mu, self._parameters = on, at.mu, parameters
        self._norm, self._comm = program.norm, program.comm
        self._oblique = program.oblique(on.face, on.C)
        self._F = _on_arrays(qp.F, qp.d)
        self._made = qp.preconditioner_on(on.face) if qp.preconditioner_on else None
        self._M = _on_arrays(self._made, qp.d) if self._made else on.face.restricted
        # λ₁ on the face, u₀ that restores Gλ = e; s is of λ before
        self._work = qp.d.duplicate()
        lam = self._work.array[:] = on.entered(at.lam)
        self._u = self._oblique.restoring(qp.coarse.residual(self._work))
        self._lam, self._s = lam + on.followed(self._u), at.s
        self._way = self._lam - at.lam
        self._basis = known_on(qp.recycled, on, self._oblique.project)

    def enter(self, length: float, seen: float) -> None:
        """Multiply F by the correction onto the face, where its image exceeds ``seen``.

        Beside a short one goes a first direction, for the same multiplication.

        Args:
            length: Step along a residual, preconditioned; 0: none is known.
            seen: What is seen.
        """
        size = self._norm * norm_over(self._comm, self._way)
        if size <= seen:
            return
        self._reduce(np.inf)  # by known directions, without a multiplication
        b = self._left()
        if length and size <= self._parameters.beside * norm_over(self._comm, b):
            z = length * self._precondition(b)
            self._go(z, np.zeros_like(z))
            self._way = self._way + self._on.followed(z)
        image = self._F(self._way)
        self._s = self._s + image
        if self._qp.coarse.dimension == 0:  # else it restores Gλ = e
            keep(self._qp.recycled, self._way, image)

    def solve(self, share: float, least: float) -> float:
        """Find u by conjugate residuals, down to a share of the residual; no less than ``least``.

        Returns:
            The least step along a direction, 0 without any.
        """
        known = self._basis.count if self._basis is not None else 0
        length = self._reduce(max(share * norm_over(self._comm, self._left()), least))
        if self._basis is not None:
            for z, image in zip(self._basis.Z[known:], self._basis.images[known:], strict=True):
                keep(self._qp.recycled, self._on.followed(z), image)
        return length

    def end(self) -> LawPoint:
        """Return the present point, and free work vectors."""
        mu = self._oblique.coordinates(self._s + self._on.bend(self._u))
        self._qp.coarse.combine(mu, self._work)
        at = LawPoint(self._lam, self._s - self._work.array_r, self._mu + mu)
        for item in (self._work, self._made):
            if item is not None:
                item.destroy()
        return at

    def _reduce(self, target: float) -> float:
        """Reduce the residual; return the least step."""
        gone = gcr(
            self._apply,
            self._precondition,
            self._left(),
            target,
            self._basis,
            self._comm,
            self._parameters,
        )
        self._basis = gone.basis
        self._go(gone.u, gone.image)
        return gone.length

    def _go(self, u: Array, image: Array) -> None:
        self._u, self._lam = self._u + u, self._lam + self._on.followed(u)
        self._s = self._s + image

    def _left(self) -> Array:
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


# --- Generalised conjugate residuals ----------------------------------------------------------


class KrylovBasis:
    """Directions z with q = Az, orthonormal over all ranks, and an image of each; as rows.

    Args:
        rows: q, z and images of those to begin with, this rank's part, shape ``(3, k, n)``.
        room: How many more there may be; what is not filled takes no memory.
    """

    def __init__(self, rows: Array, room: int = DEFAULT.max_directions) -> None:
        self.count = rows.shape[1]
        self._rows = np.empty((3, self.count + room, rows.shape[2]))
        self._rows[:, : self.count] = rows

    @property
    def Q(self) -> Array:
        """Az of each, shape ``(count, n)``."""
        return self._rows[0, : self.count]

    @property
    def Z(self) -> Array:
        """The directions."""
        return self._rows[1, : self.count]

    @property
    def images(self) -> Array:
        """The image given with each Az."""
        return self._rows[2, : self.count]

    def add(self, q: Array, z: Array, image: Array) -> None:
        """Store another direction."""
        self._rows[:, self.count] = q, z, image
        self.count += 1


@dataclass(frozen=True)
class GCRResult:
    """Result of generalised conjugate residuals, started from 0.

    Attributes:
        u: The solution.
        image: What was given with each Az, combined as u is.
        basis: All directions; new ones, each for one multiplication, come last.
        length: The least step along a new one, over Mr less earlier directions; 0 without any.
    """

    u: Array
    image: Array
    basis: KrylovBasis
    length: float


def gcr(
    apply: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    b: Array,
    target: float,
    basis: KrylovBasis | None,
    comm: MPI.Intracomm,
    parameters: FrictionParameters = DEFAULT,
) -> GCRResult:
    """Make ‖b − Au‖ least over more and more directions. Collective.

    Eisenstat, Elman, Schultz, SIAM J. Numer. Anal. 20 (1983) 345–357. A step multiplies by A once,
    and has one reduction and one broadcast beside what A and M need.

    Args:
        apply: Gives Az, and what else is linear in z and wanted of u.
        precondition: M.
        b: Right side, this rank's part.
        target: Ends at ‖b − Au‖ ≤ target.
        basis: Directions to begin with, which grow; None: none.
        comm: Communicator.
        parameters: Parameters.
    """
    known = KrylovBasis(np.zeros((3, 0, len(b)))) if basis is None else basis
    c = summed(comm, known.Q @ b)
    u, image, r = c @ known.Z, c @ known.images, b - c @ known.Q
    size, lengths = norm_over(comm, r), list[float]()
    while size > target and len(lengths) < parameters.max_directions:
        # Step 1: the preconditioned residual, made orthogonal to all before
        z = precondition(r)
        q, w = apply(z)
        sums = summed(comm, np.concatenate((known.Q @ q, (q @ q, q @ r, r @ r))))
        c, (square, along, left) = sums[:-3], sums[-3:]
        length = float(np.sqrt(max(square - c @ c, 0.0)))
        step = along / length if length > parameters.new * np.sqrt(square) else 0.0
        after = float(np.sqrt(max(left - step**2, 0.0)))
        length, step, after = (float(x) for x in steering(comm, length, step, after))
        if abs(step) <= parameters.gain * size:
            break
        q, z, w = q - c @ known.Q, z - c @ known.Z, w - c @ known.images
        # Step 2: the least residual along it
        known.add(q / length, z / length, w / length)
        u, image, r = (
            u + step * known.Z[-1],
            image + step * known.images[-1],
            r - step * known.Q[-1],
        )
        lengths.append(step / length)
        size = after
    return GCRResult(u, image, known, max(min(lengths, default=0.0), 0.0))


def known_on(
    past: RecycledOnFace | None,
    on: OnFace,
    project: Callable[[Array], Array],
    new: float = DEFAULT.new,
) -> KrylovBasis | None:
    """Return known products Au = P(F(I + C)u + κu) from directions WN = (I + C)U of past solves.

    Farhat, Crivelli, Roux (``Recycled``); as Carvalho, Gratton, Lago, Vasseur, SIAM J. Sci.
    Comput. 33 (2011) 2463–2490 begin residuals. Multiplies by nothing. Collective.

    Args:
        past: Directions W; None: there are none.
        on: The face.
        project: P, of shapes ``(m, q)``.
        new: Of the largest image: what others leave of one, less is rounding.

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
    kept = sizes > new * sizes[0]
    T = Vt[kept].T / sizes[kept]
    return KrylovBasis(np.stack([(X @ T).T for X in (AU, U, FU)]))


def keep(past: RecycledOnFace | None, x: Array, Fx: Array) -> None:
    """Store a search direction x, Gx = 0, with Fx. Collective."""
    if past is None:
        return
    (energy,) = steering(past.known.comm, *summed(past.known.comm, np.array([x @ Fx])))
    if energy > 0.0:
        past.known.add(x, Fx, float(energy))
