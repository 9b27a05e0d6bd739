"""PCPG: preconditioned conjugate projected gradients, with its directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, summed
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.problem import (
    QP,
    ConvergedReason,
    Monitor,
    Operator,
    Point,
    QPResult,
    Start,
    Steps,
    StoppingRule,
    no_monitor,
)
from tfeti_dolfinx.qp.recycling import DirectionStore, RecycledOnFace
from tfeti_dolfinx.qp.sets import Face

# --- Estimate of ‖PFP‖ ------------------------------------------------------------------------

# an off-diagonal entry this small in units of the norm ends the method: the space is exhausted
EXHAUSTED = 1e-12


def estimate_norm(F: Operator, coarse: Coarse, like: PETSc.Vec, steps: int = 15) -> float:
    """‖PFP‖ by Lanczos steps: the largest Ritz value, and its residual on top. Collective.

    The Ritz value alone is a lower bound. There is an eigenvalue within the residual of it, the
    largest one in practice: the sum is an upper bound that is close. The start is random, but
    the same in every run on the same number of ranks. (Parlett, The Symmetric Eigenvalue
    Problem, SIAM 1998, section 13.2.)
    """
    v, previous, w = (like.duplicate() for _ in range(3))
    rng = np.random.default_rng(like.getComm().getRank())
    v.array[:] = rng.standard_normal(v.getLocalSize())
    coarse.project(v)
    previous.set(0.0)
    diagonal: list[float] = []
    beside: list[float] = [v.norm()]
    comm = like.getComm().tompi4py()
    while len(diagonal) < steps and bcast_from_root(
        comm, beside[-1] > EXHAUSTED * _size(diagonal, beside)
    ):
        v.scale(1.0 / beside[-1])
        F.mult(v, w)
        coarse.project(w)
        diagonal.append(w.dot(v))
        w.axpy(-diagonal[-1], v)
        if len(diagonal) > 1:
            w.axpy(-beside[-1], previous)
        beside.append(w.norm())
        previous, v, w = v, w, previous
    for vec in (v, previous, w):
        vec.destroy()
    if not diagonal:
        return 0.0
    off = np.array(beside[1:-1])
    values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1))
    return bcast_from_root(comm, float(values[-1] + beside[-1] * abs(vectors[-1, -1])))


def _size(diagonal: list[float], beside: list[float]) -> float:
    """Return the size of the entries so far; 0 before the first step."""
    return max(diagonal) + max(beside[1:]) if diagonal else 0.0


# --- Store of conjugate directions ------------------------------------------------------------


@dataclass(frozen=True)
class PcpgParameters:
    """Tolerances of PCPG.

    Attributes:
        flat: Of the largest curvature of a direction, and of what the preconditioner makes of a
            residual: less is rounding, as where rows depend on each other.
        numbers: What a rank keeps of directions at most: 192 MB.
        plateau: So many steps in which neither ‖r‖ comes down to a half nor q by what stands out
            from its rounding have met rounding: at that pace 10 000 steps would bring 6 digits at
            best; twice as many as there are rows, and a few, have it too.
        few: Those.
        rounding: Of the terms of q.
        drifted: Of rᵀz, which is rᵀp as long as r is orthogonal to all directions before; else
            conjugate gradients begin anew.
        short: Of λ: a way that is shorter may be rounding of Gλ = e.
    """

    flat: float = 1e-13
    numbers: int = 24_000_000
    plateau: int = 500
    few: int = 20
    rounding: float = 1e-15
    drifted: float = 0.5
    short: float = 1e-6


DEFAULT = PcpgParameters()


class Directions:
    """State of PCPG between calls, from which it continues where it stopped.

    Attributes:
        r: Residual −P g.
        p: The last direction.
        fresh: Whether the next direction is the first.
        kept: Directions, and what PF makes of them, that the next one is made conjugate to: with
            ``keeps`` all that memory lasts for. In exact arithmetic it is conjugate to all if it is
            to the last one; rounding undoes that where F is ill conditioned on a face (Farhat,
            Crivelli, Roux, Comput. Methods Appl. Mech. Engrg. 117, 1994, for FETI).
        norm: Largest Rayleigh quotient of F that a direction has shown; at most ‖PFP‖.
        helped: Largest rᵀz/rᵀr so far.
    """

    def __init__(self, like: PETSc.Vec, keeps: bool = True) -> None:
        self.r, self.p, self.Fp, self.z = (like.duplicate() for _ in range(4))
        self.fresh, self.norm, self.helped = True, 0.0, 0.0
        rows = like.getComm().tompi4py().allreduce(like.getLocalSize(), op=MPI.MAX)
        most = max(DEFAULT.numbers // (2 * max(rows, 1)), 1) if keeps else 1
        self.kept = DirectionStore(most, like.getLocalSize())

    def seen(self, pFp: float, pp: float, short: bool = False) -> bool:
        """Update the estimate of ‖F‖; return whether pᵀFp is positive beyond rounding.

        Of a short step, which may be rounding of Gλ = e, F makes far too much to learn ‖F‖ from.
        """
        if not short:
            self.norm = max(self.norm, pFp / pp if pp > 0.0 else 0.0)
        return pFp > DEFAULT.flat * self.norm * pp

    def stands_out(self, rz: float, rr: float) -> bool:
        """Return whether rᵀz, z the preconditioned residual, is positive beyond rounding."""
        self.helped = max(self.helped, rz / rr if rr > 0.0 else 0.0)
        return rz > DEFAULT.flat * self.helped * rr

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        for vec in (self.r, self.p, self.Fp, self.z):
            vec.destroy()


# --- Detection of stagnation ------------------------------------------------------------------


class Progress:
    """Tells when neither residuals, from ‖r‖ = ``norm`` on, nor q have decreased for long."""

    def __init__(self, norm: float, rows: int) -> None:
        self._most = min(DEFAULT.plateau, 2 * rows + DEFAULT.few)
        self._best, self._steps, self._gain = norm, 0, 0.0

    def step(self, norm: float, gain: float) -> None:
        """Record a step that lowers q by ``gain`` and ends with ‖r‖ = ``norm``."""
        self._steps, self._gain = self._steps + 1, self._gain + gain
        if norm <= 0.5 * self._best:
            self._best, self._steps, self._gain = norm, 0, 0.0

    def stagnates(self, qp: QP, point: Point) -> bool:
        """Return whether nothing has decreased for long. Collective if many steps were made."""
        if self._steps < self._most:
            return False
        sizes = abs(point.lam.dot(point.g)) + abs(point.lam.dot(qp.d))
        gain, self._steps, self._gain = self._gain, 0, 0.0
        return bcast_from_root(point.lam.getComm().tompi4py(), gain <= DEFAULT.rounding * sizes)


# --- PCPG: preconditioned conjugate projected gradients ---------------------------------------


def pcpg(
    qp: QP,
    point: Point,
    rule: StoppingRule,
    steps: Steps,
    max_it: int,
    monitor: Monitor = no_monitor,
    directions: Directions | None = None,
) -> ConvergedReason:
    """Minimise ½λᵀFλ − λᵀd over λ + range(P), from a point on and in place. Collective.

    Farhat, Mandel, Roux, Comput. Methods Appl. Mech. Engrg. 115 (1994) 365–385, section 3. P is
    the projector of ``qp.coarse``: on a face λ moves in the face alone; the feasible set is kept by
    nobody. Multiplies by F, and by the preconditioner, once per step, and once more where the rule
    finds that g has drifted. A step makes three global reductions: one with each projection, one
    for the norm of the residual; one more where there are directions of earlier solves.

    ===========================  ===================================================
    reason                       when
    ===========================  ===================================================
    the rule's                   ‖P g‖ ≤ ``rule.tolerance``, and the rule is content
    ``DIVERGED_ITS``             ``max_it`` steps are not enough
    ``DIVERGED_INDEFINITE_MAT``  a direction has no positive curvature
    ``DIVERGED_ROUNDING``        neither ‖P g‖ nor q has come down for long
    ===========================  ===================================================

    ``directions``, which are updated, are what an earlier call at this point with this ``qp`` has
    left.
    """
    own = Directions(point.lam, qp.keeps) if directions is None else directions
    r, p, Fp, z, comm = own.r, own.p, own.Fp, own.z, point.lam.getComm().tompi4py()
    recycled, (past, norm) = qp.recycled, _begun(qp, point, own)
    new = list[tuple[Array, Array, float]]()  # the past stays as it is during a solve
    least = bcast_from_root(comm, DEFAULT.short**2 * point.lam.dot(point.lam))
    progress = Progress(norm, r.getSize())
    while True:
        # test
        reason = (
            _examined(qp, point, rule, norm)
            if norm <= rule.tolerance
            else ConvergedReason.ITERATING
        )
        if rule.drifted:
            point.refresh(qp)
            rule.drifted, own.fresh = False, True
            past, norm = _begun(qp, point, own)
        if reason == ConvergedReason.ITERATING and progress.stagnates(qp, point):
            reason = ConvergedReason.DIVERGED_ROUNDING
        if reason == ConvergedReason.ITERATING and steps.cg >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
        if reason != ConvergedReason.ITERATING:
            break
        # precondition and project: z = P M r
        if own.fresh:
            own.kept.clear()
        rz, products = _precondition(qp, r, z, own.kept, norm)
        # direction
        p.array[:] = z.array_r - products @ own.kept.directions
        if past is not None:
            p.array[:] = past.conjugate(p.array_r)
        # step
        qp.F.mult(p, Fp)
        Fp.copy(z)
        pFp, pp, (rp,) = qp.coarse.project_against(z, p, np.array([r.array_r @ p.array_r]))
        PFp = np.array(z.array_r)
        z.aypx(-rp / pFp if pFp else 0.0, r)
        squared, rz, rp, pFp = _square(z, rz, rp, pFp)
        short = bool(pFp) and (rp / pFp) ** 2 * pp < least
        if not (own.seen(pFp, pp, short) and own.stands_out(rz, norm**2)):
            own.fresh = True
            reason = _examined(qp, point, rule, norm) or ConvergedReason.DIVERGED_INDEFINITE_MAT
            break
        point.move(rp / pFp, p, Fp)
        own.kept.put(p.array_r / np.sqrt(pFp), PFp / np.sqrt(pFp))
        if recycled is not None:
            new = [*new[1 - recycled.capacity :], (p.array.copy(), Fp.array.copy(), pFp)]
        z.copy(r)
        own.fresh, norm = abs(rp - rz) > DEFAULT.drifted * rz, float(np.sqrt(squared))
        steps.cg += 1
        progress.step(norm, 0.5 * rp**2 / pFp)
        monitor(steps, "cg", point.lam, norm, 0.0)
    if recycled is not None:
        recycled.add_all(new)
    if directions is None:
        own.destroy()
    return reason


def solve_by_pcpg(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    parameters: PcpgParameters = DEFAULT,
    *,
    max_it: int = 10_000,
    start: Start | None = None,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½λᵀFλ − λᵀd, Gλ = e, from λ̄ on. Collective.

    Stops as ``pcpg`` does; with ``DIVERGED_ROUNDING`` where residuals are rounding, too, and a
    direction has no positive curvature. Inequalities are not looked at, nor is ``start`` beside λ̄.

    >>> import numpy as np
    >>> from petsc4py import PETSc
    >>> from tfeti_dolfinx.qp.coarse import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Product
    >>> from tfeti_dolfinx.qp.homogenised import homogenise
    >>> from tfeti_dolfinx.qp.problem import ResidualRule
    >>> F = PETSc.Mat().createDense((3, 3), array=np.diag([1.0, 2.0, 4.0]), comm=PETSc.COMM_SELF)
    >>> d = PETSc.Vec().createWithArray(np.array([1.0, 1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Product())
    >>> result = solve_by_pcpg(qp, homogenise(qp), ResidualRule(1e-12))
    >>> result.reason.name, result.lam.array.round(6).tolist()
    ('CONVERGED_RTOL', [0.428571, 0.214286, 0.357143])
    """
    lam, g, steps = homogenised.lam_bar.copy(), homogenised.gradient.copy(), Steps()
    monitor(steps, "start", lam, homogenised.b.norm(), 0.0)
    reason = pcpg(qp, Point(lam, g), rule, steps, max_it, monitor)
    qp.coarse.project(g)
    norm = g.norm()
    if reason == ConvergedReason.DIVERGED_INDEFINITE_MAT and homogenised.is_rounding(norm):
        reason = ConvergedReason.DIVERGED_ROUNDING
    moved = lam.copy()
    moved.axpy(-1.0, homogenised.lam_bar)
    result = QPResult(
        lam=lam,
        mu=qp.coarse.coordinates(g),
        gradient=g,
        face=_face(qp, lam, g),
        reason=reason,
        projected_gradient=norm,
        equality=qp.coarse.norm_Q(moved),
        reference=homogenised.scale.reference,
        norm=0.0,
        steps=steps,
    )
    moved.destroy()
    return result


def _face(qp: QP, lam: PETSc.Vec, g: PETSc.Vec) -> Face:
    """Return the face of λ."""
    return qp.feasible.face(lam.array_r, g.array_r)


def _examined(qp: QP, point: Point, rule: StoppingRule, norm: float) -> ConvergedReason:
    """Apply the stopping rule to the point."""
    return rule.examine(point.lam, point.g, _face(qp, point.lam, point.g), norm)


def _begun(qp: QP, point: Point, own: Directions) -> tuple[RecycledOnFace | None, float]:
    """Minimise q over directions of earlier solves; return these, if any, and ‖r‖."""
    norm = _residual(qp, point.g, own.r)
    if qp.recycled is None or qp.recycled.count == 0:
        return None, norm
    past = RecycledOnFace(qp.recycled, qp.held)
    if past.count == 0:
        return None, norm
    own.p.array[:], image = past.least(own.r.array_r)
    qp.coarse.project(own.p)  # rounding of many directions is none of Gλ = e
    point.lam.axpy(1.0, own.p)
    point.g.array[:] += image
    own.fresh = True
    return past, _residual(qp, point.g, own.r)


def _residual(qp: QP, g: PETSc.Vec, r: PETSc.Vec) -> float:
    """r = −P g, and its norm.

    Twice: the preconditioner does not see what G's factor leaves of Gᵀμ the first time.
    """
    g.copy(r)
    r.scale(-1.0)
    qp.coarse.project(r)
    qp.coarse.project(r)
    return float(r.norm())


def _square(x: PETSc.Vec, *known: float) -> Array:
    """‖x‖², and rank 0's numbers, since loops end by them. Collective, one reduction."""
    comm = x.getComm().tompi4py()
    sums = np.array([x.array_r @ x.array_r, *(known if comm.rank == 0 else np.zeros(len(known)))])
    return summed(comm, sums)


def _precondition(
    qp: QP, r: PETSc.Vec, z: PETSc.Vec, kept: DirectionStore, norm: float
) -> tuple[float, Array]:
    """z = P M r, M the preconditioner or the identity; rᵀz, given ‖r‖, and PFp_i·z."""
    if qp.preconditioner is None:
        r.copy(z)
        return norm**2, summed(r.getComm().tompi4py(), kept.images @ z.array_r)
    qp.preconditioner.mult(r, z)
    rz, _, products = qp.coarse.project_against(z, r, kept.images @ z.array_r)
    return rz, products
