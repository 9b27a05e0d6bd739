"""Newton's method on Coulomb's law itself, by generalised conjugate residuals."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import EPSILON, Array
from tfeti_dolfinx.common.parallel import dot_over, norm_over, steering, summed
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.qp.coarse import HELD, Coarse
from tfeti_dolfinx.qp.problem import QP
from tfeti_dolfinx.qp.recycling import Recycled, right_singular
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status


@dataclass(frozen=True)
class FrictionParameters:
    """Parameters of Newton's method on Coulomb's law."""

    max_steps: int = 80  # most steps
    patience: int = 10  # so many steps in a row without progress, and the method has failed
    progress: float = 0.98  # a residual below this share of the least one is progress
    memory: int = 5  # a step may not exceed the largest residual of so many steps before
    shortest: float = 0.01  # steps are halved down to this share
    reduction: float = 0.3  # what a solve leaves of its residual at most
    # of the share that the last step has left: what a solve leaves, so that the end is superlinear;
    # and of the target: no solve leaves less
    followed: float = 0.3
    max_directions: int = 80  # most directions of one solve
    # of the target: F of a correction onto a face that is shorter, times ‖F‖, is not computed
    unseen: float = 0.1
    hard: float = 3.0  # times ‖F‖: directions that bend more are scaled down to it
    new: float = 1e-7  # of Az: what earlier directions leave of it, less is rounding
    gain: float = 1e-8  # of the residual: what a direction takes from it, less is no gain
    rounding: float = 1e-16  # of a residual: no λ that has it comes lower


PARAMETERS = FrictionParameters()

# --- The law ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Following:
    """C: rows that follow others, (Cλ)_i = c_i λ_j with one j of each; other rows are 0."""

    rows: Array  # i, shape (q,)
    leaders: Array  # j, shape (q,)
    ratios: Array  # c_i, shape (q,)

    def __matmul__(self, x: Array) -> Array:
        """Return C x, shapes ``(m,)`` or ``(m, q)``."""
        y = np.zeros(x.shape)
        y[self.rows] = (self.ratios * x[self.leaders].T).T
        return y

    def followed(self, u: Array) -> Array:
        """Return (I + C)u, shapes ``(m,)`` or ``(m, q)``."""
        return np.asarray(u + self @ u)


@dataclass(frozen=True)
class Law:
    """λ ∈ Ω(λ_N), on this rank's rows: the set of a point's λ_T is λ_N times one of its own."""

    at: Callable[[Array], FeasibleSet]  # makes Ω of the λ_N of all points, shape (p,)
    normals: Array  # row of λ_N of each point, shape (p,)
    tangents: Array  # rows of its λ_T, shape (p, k)

    def following(self, p: Array, face: Face) -> Following:
        """C: where points slip λ_T follows λ_N, λ_T = Cλ with the direction of p.

        p is a point of Ω(p_N), and ``face`` its face.
        """
        at = np.flatnonzero(np.any(face.status[self.tangents] == Status.SLIP, axis=1))
        rows = self.tangents[at].ravel()
        leaders = np.repeat(self.normals[at], self.tangents.shape[1])
        return Following(rows, leaders, p[rows] / p[leaders])


@dataclass(frozen=True)
class LawPoint:
    """Multipliers, this rank's part."""

    lam: Array  # λ
    s: Array  # Fλ − d − Gᵀμ
    mu: Array  # μ, replicated


@dataclass(frozen=True)
class LawProgram:
    """The law and Gλ = e, as one equation. All methods are collective.

    With y = λ − ρs/‖F‖ and P the projection onto Ω(y_N⁺) it is the natural map of Coulomb's law:
    λ = P(y) and Gλ = e, whatever ρ > 0 each point has.
    """

    qp: QP  # F, d and G; its set is not looked at
    law: Law  # the sets
    oblique: Callable[[Face, Following], Coarse]  # Gλ = e of λ = (I + C)u, u in a face
    norm: float  # ‖F‖, or an estimate
    # ρ of rows: more than 1 where rows that F knows nothing of slip, and have to reach their bound
    reach: Array | float = 1.0

    def natural_map(self, at: LawPoint) -> tuple[FeasibleSet, Array, float]:
        """Return Ω(y_N⁺), p = P(y), and ‖F‖ times what λ misses of the law and of Gλ = e.

        That is ‖F‖ √(‖λ − p‖² + ‖Gᵀ(GGᵀ)⁻¹(e − Gλ)‖²), the same on all ranks; but no less than what
        rounding leaves of s, as of bodies that nothing holds and that have gone far away.
        """
        coarse, y = self.qp.coarse, at.lam - self.reach * at.s / self.norm
        feasible = self.law.at(np.maximum(y[self.law.normals], 0.0))
        p = feasible.project(y)
        balancing = coarse.combined(coarse.solve(coarse.residual(at.lam)))
        missed = np.concatenate((p - at.lam, balancing))
        square, terms = dot_over(coarse.comm, (missed, missed), (at.s, at.s))
        return feasible, p, max(self.norm * square**0.5, EPSILON * terms**0.5)


# --- Newton's method --------------------------------------------------------------------------


def newton_on_law(program: LawProgram, at: LawPoint, target: float) -> tuple[LawPoint | None, int]:
    """Solve the natural map of Coulomb's law by a semismooth Newton method. Collective.

    Alart, Curnier, Comput. Methods Appl. Mech. Engrg. 92 (1991); Hüeber, Stadler, Wohlmuth, SIAM J.
    Sci. Comput. 30 (2008). A step multiplies by F once for the correction onto its face, if that
    can be seen, and once for each direction of its solve. It may fail: have something else to try.
    Return where the residual, ‖F‖ times what is missed, has come down to ``target``, None if it
    gave up; and the steps taken.
    """
    best, idle, past = np.inf, 0, list[float]()
    # Step 1: the natural map: what a gradient step, brought back, moves, and what Gλ lacks
    moved = program.natural_map(at)
    for step in range(PARAMETERS.max_steps):
        feasible, p, residual = moved
        if residual <= target:
            return at, step
        idle = 0 if residual < PARAMETERS.progress * best else idle + 1
        best = min(best, residual)
        if idle > PARAMETERS.patience or not PARAMETERS.rounding * residual <= target:
            return None, step
        # Step 2: the face of p, and what follows where points slip
        face = feasible.face(p, at.s)
        on = OnFace(face, program.law.following(p, face), p)
        # Step 3: the system there
        share = PARAMETERS.reduction
        if past:
            share = min(share, PARAMETERS.followed * residual / past[-1])
        try:
            end = _solved_on_face(program, on, at, share, target)
        except FactorError:
            return None, step + 1
        # Step 4: halve the step until its residual is none of the largest; F is known on all of it
        past = [*past[1 - PARAMETERS.memory :], residual]
        part, there, whole = 1.0, end, program.natural_map(end)
        moved = whole
        while not moved[2] <= max(past):
            part *= 0.5
            if part <= PARAMETERS.shortest:
                there, moved = end, whole
                break
            ends = (at.lam, end.lam), (at.s, end.s), (at.mu, end.mu)
            there = LawPoint(*((1.0 - part) * a + part * b for a, b in ends))
            moved = program.natural_map(there)
        at = there
    return None, PARAMETERS.max_steps


# --- The system of a step ---------------------------------------------------------------------


@dataclass(frozen=True)
class OnFace:
    """The face of a Newton step, its point p, and C: what follows it."""

    face: Face
    C: Following
    p: Array

    def entered(self, lam: Array) -> Array:
        """Return λ with open and slipping entries set to those of p, coupled ones following."""
        held = (self.face.status == Status.OPEN) | (self.face.status == Status.SLIP)
        on = np.where(held, self.p, lam)
        on[self.C.rows] = self.C.ratios * lam[self.C.leaders]
        return on


def _solved_on_face(
    program: LawProgram, on: OnFace, at: LawPoint, share: float, target: float
) -> LawPoint:
    """Solve Zᵀ(Fλ − d − Gᵀμ) + κu = 0, Gλ = e on a face, λ = λ₁ + (I + C)u, but for a share."""
    qp, comm = program.qp, program.qp.coarse.comm
    # t/√w in the place of t: what bends hard takes over no step, and is there to balance loads
    w = np.maximum(1.0, on.face.curvature / (PARAMETERS.hard * program.norm))
    scaled = replace(on.face, tangents=(on.face.tangents.T / np.sqrt(w)).T)
    oblique = program.oblique(scaled, on.C)
    M = qp.preconditioner_on(on.face) if qp.preconditioner_on else None

    def apply(z: Array) -> tuple[Array, Array]:
        Fz = qp.F(on.C.followed(z))
        return oblique.project(Fz + on.face.bend(z)), Fz

    def precondition(r: Array) -> Array:
        z = on.face.restricted(r) if M is None else M(r)
        return oblique.project(z + on.face.along_tangents(z, w - 1.0))

    # Step 3a: λ₁ on the face, and u that restores Gλ = e; s is of λ before
    lam, s = on.entered(at.lam), at.s
    u = oblique.combined(oblique.solve(qp.coarse.residual(lam)))
    correction = lam + on.C.followed(u) - at.lam
    basis = known_on(qp.recycled, on, oblique.project)
    size = program.norm * norm_over(comm, correction)
    if size > PARAMETERS.unseen * target:
        # Step 3b: F of the correction, if it can be seen
        image = qp.F(correction)
        s = s + image
        if qp.recycled is not None and qp.coarse.dimension == 0:  # else it restores Gλ = e
            qp.recycled.keep(correction, image)
    # Step 3c: conjugate residuals
    b = -oblique.project(s + on.face.bend(u))
    goal = max(share * norm_over(comm, b), PARAMETERS.followed * target)
    known = basis.shape[1]
    z, image, basis = gcr(apply, precondition, b, goal, basis, comm)
    u, s = u + z, s + image
    if qp.recycled is not None:
        _, new, images = basis[:, known:]
        directions = on.C.followed(new.T)
        # where a face holds a motion by nothing but rounding they do not keep Gλ = e
        kept: Array = np.ones(len(new), dtype=bool)
        if qp.coarse.dimension:
            missed, terms = np.abs(qp.coarse.G(directions)), qp.coarse.terms(directions)
            kept = steering(comm, *np.all(missed <= HELD * terms.max(axis=0), axis=0)) > 0.0
        for p, image in zip(directions.T[kept], images[kept], strict=True):
            qp.recycled.keep(p, image)
    mu = oblique.coordinates(s + on.face.bend(u))
    return LawPoint(lam + on.C.followed(u), s - qp.coarse.combined(mu), at.mu + mu)


# --- Generalised conjugate residuals ----------------------------------------------------------


def gcr(
    apply: Callable[[Array], tuple[Array, Array]],
    precondition: Callable[[Array], Array],
    b: Array,
    target: float,
    basis: Array,
    comm: MPI.Intracomm,
) -> tuple[Array, Array, Array]:
    """Make ‖b − Au‖ least over more and more directions, from u = 0 on. Collective.

    Eisenstat, Elman, Schultz, SIAM J. Numer. Anal. 20 (1983) 345–357. A step multiplies by A once,
    and has one reduction and one broadcast beside what A and M need.

    Args:
        apply: Gives Az, and what else is linear in z and wanted of u: its image.
        precondition: M.
        b: Right side, this rank's part, shape ``(n,)``.
        target: Ends at ‖b − Au‖ ≤ target.
        basis: q = Az, orthonormal over all ranks, z and images of directions to begin with, shape
            ``(3, k, n)``.
        comm: Communicator.

    Returns:
        u, its image, and all directions; new ones, each for one multiplication, come last.
    """
    Q, Z, images = basis
    c = summed(comm, Q @ b)
    u, image, r = c @ Z, c @ images, b - c @ Q
    size, most = norm_over(comm, r), basis.shape[1] + PARAMETERS.max_directions
    while size > target and basis.shape[1] < most:
        # Step 1: the preconditioned residual, made orthogonal to all before
        z = precondition(r)
        q, w = apply(z)
        sums = summed(comm, np.concatenate((Q @ q, (q @ q, q @ r, r @ r))))
        c, (square, along, left) = sums[:-3], sums[-3:]
        length = float(np.sqrt(max(square - c @ c, 0.0)))
        step = along / length if length > PARAMETERS.new * np.sqrt(square) else 0.0
        after = float(np.sqrt(max(left - step**2, 0.0)))
        length, step, after = (float(x) for x in steering(comm, length, step, after))
        if abs(step) <= PARAMETERS.gain * size:
            break
        # Step 2: the least residual along it
        new = np.stack((q - c @ Q, z - c @ Z, w - c @ images)) / length
        basis = np.concatenate((basis, new[:, None]), axis=1)
        Q, Z, images = basis
        u, image, r = u + step * new[1], image + step * new[2], r - step * new[0]
        size = after
    return u, image, basis


def known_on(past: Recycled | None, on: OnFace, project: Callable[[Array], Array]) -> Array:
    """Return known products Au = P(F(I + C)u + κu) from directions WN = (I + C)U of past solves.

    Farhat, Crivelli, Roux (``Recycled``); as Carvalho, Gratton, Lago, Vasseur, SIAM J. Sci. Comput.
    33 (2011) 2463–2490 begin residuals. What others leave of an image, less than ``new`` of the
    largest, is rounding. Multiplies by nothing. Collective. Return AU, orthonormal, U, and FWN
    combined likewise, as rows, shape ``(3, k, m)``.
    """
    nothing = np.zeros((3, 0, len(on.p)))
    if past is None or past.count == 0:
        return nothing
    W, FW = past.directions.T, past.images.T
    U = on.face.restricted(W - on.C @ W)
    N = past.without(W - on.C.followed(U))
    if N.shape[1] == 0:
        return nothing
    U, FU = U @ N, FW @ N
    AU = project(FU + on.face.bend(U))
    sizes, Vt = right_singular(past.comm, AU)
    kept = sizes > PARAMETERS.new * sizes[0]
    T = Vt[kept].T / sizes[kept]
    return np.stack([(X @ T).T for X in (AU, U, FU)])
