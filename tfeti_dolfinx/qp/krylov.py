"""PCPG: preconditioned conjugate projected gradients, with its directions."""

from dataclasses import dataclass

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, dot_over, largest, norm_over, summed
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.problem import (
    QP,
    STRANGE,
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
from tfeti_dolfinx.qp.recycling import Along, DirectionStore

# an off-diagonal entry this small in units of the norm ends the method: the space is exhausted
EXHAUSTED = 1e-12


def estimate_norm(F: Operator, coarse: Coarse, steps: int = 15) -> float:
    """‖PFP‖ by Lanczos steps: the largest Ritz value, and its residual on top. Collective.

    The Ritz value alone is a lower bound. There is an eigenvalue within the residual of it, the
    largest one in practice: the sum is an upper bound that is close. The start is random, but
    the same in every run on the same number of ranks. (Parlett, The Symmetric Eigenvalue
    Problem, SIAM 1998, section 13.2.)
    """
    comm, size = coarse.comm, coarse.Gt.shape[0]
    v = coarse.project(np.random.default_rng(comm.rank).standard_normal(size))
    previous, diagonal, beside = np.zeros(size), list[float](), [norm_over(comm, v)]
    while len(diagonal) < steps:
        entries = max(diagonal) + max(beside[1:]) if diagonal else 0.0
        if not beside[-1] > EXHAUSTED * entries:
            break
        v = v / beside[-1]
        w = coarse.project(F(v))
        diagonal += dot_over(comm, (w, v))
        w = w - diagonal[-1] * v
        if len(diagonal) > 1:
            w -= beside[-1] * previous
        beside.append(norm_over(comm, w))
        previous, v = v, w
    if not diagonal:
        return 0.0
    off = np.array(beside[1:-1])
    values, vectors = np.linalg.eigh(np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1))
    return bcast_from_root(comm, float(values[-1] + beside[-1] * abs(vectors[-1, -1])))


# --- Store of conjugate directions ------------------------------------------------------------


@dataclass(frozen=True)
class PcpgParameters:
    """Tolerances of PCPG."""

    # of the largest curvature of a direction, and of what the preconditioner makes of a residual:
    # less is rounding, as where rows depend on each other
    flat: float = 1e-13
    numbers: int = 24_000_000  # what a rank keeps of directions at most: 192 MB
    # of rᵀz, which is rᵀp as long as r is orthogonal to all directions before; else conjugate
    # gradients begin anew
    drifted: float = 0.5
    # whether a direction is made conjugate to all before it, not to the last alone
    keeps: bool = True


class Directions:
    """State of PCPG between calls, from which it continues where it stopped.

    Attributes:
        r: Residual −P g.
        p: The last direction.
        fresh: Whether the next direction is the first.
        kept: Directions, and what PF makes of them, that the next one is made conjugate to: with
            ``parameters.keeps`` all that memory lasts for. In exact arithmetic it is conjugate to
            all if it is to the last one; rounding undoes that where F is ill conditioned on a face
            (Farhat, Crivelli, Roux, Comput. Methods Appl. Mech. Engrg. 117, 1994, for FETI).
        norm: Largest Rayleigh quotient of F that a direction has shown; at most ‖PFP‖.
        helped: Largest rᵀz/rᵀr so far.
    """

    def __init__(self, qp: QP, parameters: PcpgParameters = PcpgParameters()) -> None:
        self.parameters = parameters
        self.r, self.p = np.zeros(len(qp.d)), np.zeros(len(qp.d))
        self.fresh, self.norm, self.helped = True, 0.0, 0.0
        rows = int(largest(qp.coarse.comm, np.array([len(qp.d)])))
        most = max(parameters.numbers // (2 * max(rows, 1)), 1) if parameters.keeps else 1
        self.kept = DirectionStore(most, len(qp.d))

    def record_curvature(self, pFp: float, pp: float) -> bool:
        """Take it into the estimate of ‖F‖; return whether pᵀFp is positive beyond rounding."""
        self.norm = max(self.norm, pFp / pp if pp > 0.0 else 0.0)
        return pFp > self.parameters.flat * self.norm * pp


# --- PCPG: preconditioned conjugate projected gradients ---------------------------------------


def pcpg(
    qp: QP,
    point: Point,
    rule: StoppingRule,
    steps: Steps,
    max_it: int,
    monitor: Monitor = no_monitor,
    directions: Directions | None = None,
) -> tuple[Point, ConvergedReason]:
    """Minimise ½λᵀFλ − λᵀd over λ + range(P), from a point on. Collective.

    Farhat, Mandel, Roux, Comput. Methods Appl. Mech. Engrg. 115 (1994) 365–385, section 3. P is
    the projector of ``qp.coarse``: on a face λ moves in the face alone; the feasible set is kept by
    nobody. Multiplies by F, and by the preconditioner, once per step. A step makes three global
    reductions: one with each projection, one for the norm of the residual; one more where there are
    directions of earlier solves. Return the end, and why it is one.

    ===========================  ===================================================
    reason                       when
    ===========================  ===================================================
    the rule's                   ‖P g‖ ≤ ``rule.tolerance``, and the rule is content
    ``DIVERGED_ITS``             ``max_it`` steps are not enough
    ``DIVERGED_INDEFINITE_MAT``  a direction has no positive curvature
    ===========================  ===================================================

    ``directions``, which are updated, are what an earlier call at this point with this ``qp`` has
    left.
    """
    own, comm = Directions(qp) if directions is None else directions, qp.coarse.comm
    given = own.parameters
    recycled, (point, past, norm) = qp.recycled, _along_recycled(qp, point, own)
    new = list[tuple[Array, Array, float]]()  # the past stays as it is during a solve
    while True:
        # test
        small = norm <= rule.tolerance
        reason = _examined(qp, point, rule, norm) if small else ConvergedReason.ITERATING
        if small and reason == ConvergedReason.ITERATING and qp.rough is not None:
            point = point if rule.gradient is None else Point(point.lam, rule.gradient)
            point, past, norm = _along_recycled(qp, point, own)
        if reason == ConvergedReason.ITERATING and steps.cg >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
        if reason != ConvergedReason.ITERATING:
            break
        # precondition and project: z = P M r, and rᵀz
        if own.fresh:
            own.kept.clear()
        r, kept = own.r, own.kept
        if qp.preconditioner is None:
            z, rz, products = r, norm**2, summed(comm, kept.images @ r)
        else:
            z = qp.preconditioner(r)
            z, rz, _, products = qp.coarse.project_against(z, r, kept.images @ z)
        # direction
        p = z - products @ kept.directions
        if past is not None and recycled is not None:
            p = p - past(p, recycled.images)[0]
        # step
        Fp = qp.roughly(p)
        PFp, pFp, pp, (rp,) = qp.coarse.project_against(Fp, p, np.array([r @ p]))
        own.p, left = p, r - (rp / pFp if pFp else 0.0) * PFp
        # ‖r‖², and rank 0's numbers, since loops end by them
        known = (rz, rp, pFp) if comm.rank == 0 else np.zeros(3)
        squared, rz, rp, pFp = summed(comm, np.array([left @ left, *known]))
        own.helped = max(own.helped, rz / norm**2 if norm > 0.0 else 0.0)
        if not (own.record_curvature(pFp, pp) and rz > given.flat * own.helped * norm**2):
            own.fresh = True
            reason = _examined(qp, point, rule, norm) or ConvergedReason.DIVERGED_INDEFINITE_MAT
            break
        point = Point(point.lam + rp / pFp * p, point.g + rp / pFp * Fp)
        kept.put(p / np.sqrt(pFp), PFp / np.sqrt(pFp))
        if recycled is not None:
            new = [*new[1 - recycled.capacity :], (p, Fp, pFp)]
        own.r = left
        drifts, norm = abs(rp - rz) > given.drifted * rz, float(np.sqrt(squared))
        # images of earlier solves are too inexact where r is not even orthogonal to a first p
        past, own.fresh = None if drifts and own.fresh else past, drifts
        steps.cg += 1
        monitor(steps, "cg", point.lam, norm, 0.0)
    for direction in new:
        recycled.add(*direction)  # type: ignore[union-attr]
    return point, reason


def solve_by_pcpg(
    qp: QP,
    start: Start,
    rule: StoppingRule,
    parameters: PcpgParameters = PcpgParameters(),
    *,
    max_it: int = 10_000,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½λᵀFλ − λᵀd, Gλ = e, from λ̄ on. Collective.

    Stops as ``pcpg`` does; with ``DIVERGED_ROUNDING`` where residuals are rounding, too, and a
    direction has no positive curvature. Inequalities are not looked at, nor is an earlier λ.

    >>> import numpy as np
    >>> from tfeti_dolfinx.testing import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Product
    >>> from tfeti_dolfinx.qp.problem import StoppingRule, homogenise
    >>> F, d = np.diag([1.0, 2.0, 4.0]).__matmul__, np.array([1.0, 1.0, 2.0])
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Product())
    >>> result = solve_by_pcpg(qp, homogenise(qp), StoppingRule(1e-12))
    >>> result.reason.name, result.lam.round(6).tolist()
    ('CONVERGED_RTOL', [0.428571, 0.214286, 0.357143])
    """
    steps = Steps()
    monitor(steps, "start", start.at.lam, norm_over(qp.coarse.comm, start.b), 0.0)
    directions = Directions(qp, parameters)
    point, reason = pcpg(qp, start.at, rule, steps, max_it, monitor, directions)
    g = qp.coarse.project(point.g)
    norm = norm_over(qp.coarse.comm, g)
    rounds = norm <= STRANGE * start.rounding
    if reason == ConvergedReason.DIVERGED_INDEFINITE_MAT and rounds:
        reason = ConvergedReason.DIVERGED_ROUNDING
    return QPResult(
        lam=point.lam,
        mu=qp.coarse.coordinates(g),
        gradient=g,
        face=qp.feasible.face(point.lam, g),
        reason=reason,
        projected_gradient=norm,
        equality=qp.coarse.norm_Q(point.lam - start.at.lam),
        reference=start.reference,
        norm=0.0,
        steps=steps,
    )


def _examined(qp: QP, point: Point, rule: StoppingRule, norm: float) -> ConvergedReason:
    """Apply the stopping rule to the point; what ‖F‖ is nothing tells."""
    face = qp.feasible.face(point.lam, point.g)
    return rule.examine(point.lam, point.g, face, norm, 0.0)


def _along_recycled(qp: QP, point: Point, own: Directions) -> tuple[Point, Along | None, float]:
    """Minimise q over directions of earlier solves; return where, steps along them, and ‖P g‖.

    ``own`` begins there, with r = −P g. Projected twice: the preconditioner does not see what G's
    factor leaves of Gᵀμ the first time.
    """
    project, recycled, past = qp.coarse.project, qp.recycled, None
    held = None if qp.coarse.face is None else qp.coarse.face.held
    own.r = project(project(-point.g))
    if recycled is not None and (past := recycled.on_face(held)) is not None:
        step, b = past(own.r, recycled.directions)
        # rounding of many directions is none of Gλ = e
        point = Point(point.lam + project(step), point.g + recycled.images.T @ b)
        own.fresh, own.r = True, project(project(-point.g))
    return point, past, norm_over(qp.coarse.comm, own.r)
