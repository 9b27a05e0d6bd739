"""PCPG: preconditioned conjugate projected gradients, for programs without inequalities."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed, summed
from tfeti_dolfinx.qp.directions import Conjugates, Directions
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.monitors import Monitor, no_monitor
from tfeti_dolfinx.qp.plateau import Plateau
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Point, QPResult, Steps
from tfeti_dolfinx.qp.stopping import StoppingRule

# of rᵀz, which is rᵀp as long as r is orthogonal to all directions before; else CG begins anew
DRIFTED = 0.5
# of λ: a way that is shorter may be rounding of Gλ = e
SHORT = 1e-6
# of ‖P g‖ where directions have ended before: then it is worth the way to begin anew
DIGIT = 0.1


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
    the projector of ``qp.coarse``: on a face λ moves in the face alone. Multiplies by F, and by
    the preconditioner, once per step, and once more where the rule finds that g has drifted, or
    where neither ‖P g‖ nor q has come down for long. A step makes three global reductions: one
    with each projection, one for the norm of the residual; one more where there are directions of
    earlier solves.

    ===========================  ===================================================
    reason                       when
    ===========================  ===================================================
    the rule's                   ‖P g‖ ≤ ``rule.tolerance``, and the rule is content
    ``DIVERGED_ITS``             ``max_it`` steps are not enough
    ``DIVERGED_INDEFINITE_MAT``  a direction has no positive curvature
    ``DIVERGED_ROUNDING``        neither ‖P g‖ nor q comes down, with a new g neither
    ===========================  ===================================================

    Args:
        qp: F, d, P and the preconditioner; its feasible set is kept by nobody.
        point: λ and F λ − d on all rows; updated.
        rule: Says when ‖P g‖ is small enough.
        steps: Counts the steps.
        max_it: Most steps in ``steps``.
        monitor: Called after each step.
        directions: What an earlier call at this point, with this ``qp``, has left; updated.

    Returns:
        Why it stopped.
    """
    own = Directions(point.lam) if directions is None else directions
    r, p, Fp, z, past = own.r, own.p, own.Fp, own.z, qp.recycled
    norm, reason = _begun(qp, point, own), ConvergedReason.ITERATING
    least = agreed(qp.d.getComm().tompi4py(), SHORT**2 * point.lam.dot(point.lam))
    progress = Plateau(norm, r.getSize())
    while True:
        # test
        reason, anew = _test(qp, point, rule, progress, norm)
        if rule.drifted or anew:
            point.refresh(qp)
            rule.drifted, own.fresh = False, True
            norm = _begun(qp, point, own)
        if reason == ConvergedReason.ITERATING and steps.cg >= max_it:
            reason = ConvergedReason.DIVERGED_ITS
        if reason != ConvergedReason.ITERATING:
            break
        # precondition and project: z = P M r
        if own.fresh:
            own.kept.clear()
        rz, products = _precondition(qp, r, z, own.kept, norm)
        # direction
        own.kept.take_away(z.array, products)
        z.copy(p)
        if past is not None:
            past.conjugate(p)
        # step
        qp.F.mult(p, Fp)
        Fp.copy(z)
        pFp, pp, (rp,) = qp.coarse.project_against(z, p, np.array([r.array_r @ p.array_r]))
        PFp = np.array(z.array_r)
        z.aypx(-rp / pFp if pFp else 0.0, r)
        squared, rz, rp, pFp = _square(z, rz, rp, pFp)
        short = bool(pFp) and (rp / pFp) ** 2 * pp < least
        if not (own.seen(pFp, pp, short) and own.stands_out(rz, norm**2)):
            own.fresh, reason = True, _examined(qp, point, rule, norm)
            if reason == ConvergedReason.ITERATING:
                reason = ConvergedReason.DIVERGED_INDEFINITE_MAT
            break
        point.move(rp / pFp, p, Fp)
        own.kept.keep(p.array_r, PFp, pFp)
        if past is not None:
            past.remember(p, Fp, pFp)
        z.copy(r)
        own.fresh, norm = abs(rp - rz) > DRIFTED * rz, float(np.sqrt(squared))
        steps.cg += 1
        progress.step(norm, 0.5 * rp**2 / pFp)
        monitor(steps, "cg", point.lam, norm, 0.0)
    if past is not None:
        past.keep()
    if directions is None:
        own.destroy()
    return reason


def _test(
    qp: QP, point: Point, rule: StoppingRule, progress: Plateau, norm: float
) -> tuple[ConvergedReason, bool]:
    """Return why PCPG stops here, and whether the gradient is made anew instead. Collective."""
    reason = ConvergedReason.ITERATING
    if norm <= rule.tolerance:
        reason = _examined(qp, point, rule, norm)
    if reason != ConvergedReason.ITERATING or not progress.ended(qp, point):
        return reason, False
    if progress.once_more():
        return reason, True
    return ConvergedReason.DIVERGED_ROUNDING, False


def solve_by_pcpg(
    qp: QP,
    homogenised: Homogenised,
    rule: StoppingRule,
    *,
    max_it: int = 10_000,
    monitor: Monitor = no_monitor,
) -> QPResult:
    """Solve min ½λᵀFλ − λᵀd, Gλ = e, from λ̄ on. Collective.

    Stops as ``pcpg`` does, but begins anew with a new gradient where a direction has no positive
    curvature, as long as the residual is a tenth of what it was there before; besides with

    =====================  ======================================================
    reason                 when
    =====================  ======================================================
    ``DIVERGED_ROUNDING``  no positive curvature, but residuals that are rounding
    =====================  ======================================================

    >>> import numpy as np
    >>> from petsc4py import PETSc
    >>> from tfeti_dolfinx.qp.coarse import DenseCoarse
    >>> from tfeti_dolfinx.qp.feasible_sets import Product
    >>> from tfeti_dolfinx.qp.homogenised import homogenise
    >>> from tfeti_dolfinx.qp.stopping import ResidualRule
    >>> F = PETSc.Mat().createDense((3, 3), array=np.diag([1.0, 2.0, 4.0]), comm=PETSc.COMM_SELF)
    >>> d = PETSc.Vec().createWithArray(np.array([1.0, 1.0, 2.0]), comm=PETSc.COMM_SELF)
    >>> qp = QP(F, d, DenseCoarse(np.ones((1, 3)), np.ones(1)), Product())
    >>> result = solve_by_pcpg(qp, homogenise(qp), ResidualRule(1e-12))
    >>> result.reason.name, result.lam.array.round(6).tolist()
    ('CONVERGED_RTOL', [0.428571, 0.214286, 0.357143])

    Args:
        qp: The program; its feasible set is not looked at.
        homogenised: Its homogenised form, whose λ̄ is the start.
        rule: Says when ‖P(d − Fλ)‖ is small enough.
        max_it: Most steps.
        monitor: Called after each step.

    Returns:
        The multipliers, the gradient Fλ − d up to the range of Gᵀ, the reason, the residuals.
    """
    lam, g, steps = homogenised.lam_bar.copy(), homogenised.gradient.copy(), Steps()
    monitor(steps, "start", lam, homogenised.b.norm(), 0.0)
    reason = _with_new_gradients(qp, Point(lam, g), rule, steps, max_it, monitor)
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


def _with_new_gradients(
    qp: QP, point: Point, rule: StoppingRule, steps: Steps, max_it: int, monitor: Monitor
) -> ConvergedReason:
    """PCPG, which begins anew where directions end, as long as that brings a digit. Collective.

    Rounding of g at a λ that bends subdomains much farther than the solution does may end them.
    """
    least, r = np.inf, point.g.duplicate()
    while True:
        reason = pcpg(qp, point, rule, steps, max_it, monitor)
        norm = agreed(point.lam.getComm().tompi4py(), _residual(qp, point.g, r))
        if reason != ConvergedReason.DIVERGED_INDEFINITE_MAT or norm > DIGIT * least:
            r.destroy()
            return reason
        least = norm
        point.refresh(qp)


def _face(qp: QP, lam: PETSc.Vec, g: PETSc.Vec) -> Face:
    """The face of λ."""
    return qp.feasible.face(lam.array_r, g.array_r)


def _examined(qp: QP, point: Point, rule: StoppingRule, norm: float) -> ConvergedReason:
    """What the rule says of the point."""
    return rule.examine(point.lam, point.g, _face(qp, point.lam, point.g), norm)


def _begun(qp: QP, point: Point, own: Directions) -> float:
    """Go where q is least along directions of earlier solves; make r there. Its norm."""
    norm = _residual(qp, point.g, own.r)
    past = qp.recycled
    if past is not None and past.go(point.lam, point.g, own.r, qp.coarse.project):
        norm, own.fresh = _residual(qp, point.g, own.r), True
    return norm


def _residual(qp: QP, g: PETSc.Vec, r: PETSc.Vec) -> float:
    """r = −P g, and its norm.

    Twice: what G's factor leaves of Gᵀμ the first time is rounding of Fλ − d, not of r, and the
    preconditioner does not see it, so no step would take it away.
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
    qp: QP, r: PETSc.Vec, z: PETSc.Vec, kept: Conjugates, norm: float
) -> tuple[float, Array]:
    """z = P M r, M the preconditioner or the identity; rᵀz, given ‖r‖, and PFp_i·z."""
    if qp.preconditioner is None:
        r.copy(z)
        return norm**2, summed(r.getComm().tompi4py(), kept.products(z.array_r))
    qp.preconditioner.mult(r, z)
    rz, _, products = qp.coarse.project_against(z, r, kept.products(z.array_r))
    return rz, products
