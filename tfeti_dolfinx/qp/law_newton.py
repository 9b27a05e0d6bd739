"""Newton's method on a law of friction whose bounds move with the forces of normals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.parallel import norm_over
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.gcr import gcr
from tfeti_dolfinx.qp.law import Law, OnFace
from tfeti_dolfinx.qp.law_recycled import keep, known_on
from tfeti_dolfinx.qp.oblique import Oblique
from tfeti_dolfinx.qp.problem import QP, FaceOperator, Operator

# steps; and steps in a row without a residual below so much of the least one, before one gives up
MOST_STEPS, PATIENCE, LESS = 40, 10, 0.98
# directions of one solve
MOST_DIRECTIONS = 80
# what a solve leaves of its residual: less where the last step has brought that far down; of the
# target: no solve leaves less
SHARE, FOLLOWED, FINAL = 0.3, 0.3, 0.3
# of the target: what F makes of a way onto a face that is too short to be multiplied
UNSEEN = 0.1
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


class Turning:
    """What slips, and where to, from step to step.

    Args:
        law: The sets.
    """

    def __init__(self, law: Law) -> None:
        self._law = law
        self._slips = np.zeros(len(law.normals), dtype=bool)
        self._to: Array = np.zeros(law.tangents.shape)

    def face(self, feasible: FeasibleSet, p: Array, s: Array) -> tuple[Array, Face]:
        """p and its face under s; what slipped the other way a step ago sticks."""
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
) -> tuple[LawPoint | None, int]:
    """Solve λ = P(λ − s/‖F‖), P the projection onto Ω(λ_N − s_N/‖F‖), and Gλ = e. Collective.

    The natural map of Coulomb's law, by a semismooth Newton method (Alart, Curnier, Comput.
    Methods Appl. Mech. Engrg. 92, 1991; Hüeber, Stadler, Wohlmuth, SIAM J. Sci. Comput. 30, 2008).
    No cost falls on the way, and it may fail: whoever calls it has something else to try.

    Args:
        qp: The program; its set is not looked at.
        law: The sets.
        oblique: Makes the projectors of a face and of what follows it.
        at: Where to start.
        target: Ends where ‖F‖‖λ − P(λ − s/‖F‖)‖, and ‖F‖ times the distance to Gλ = e, are that.
        norm: ‖F‖, or an estimate.

    Returns:
        Where it has ended, None if it gave up; and the steps taken.
    """
    last, best, idle = 0.0, np.inf, 0
    turning = Turning(law)
    for step in range(MOST_STEPS):
        # Step 1: what a gradient step, brought back, moves, and what Gλ lacks
        feasible, p = law.nearest(at.lam - at.s / norm)
        residual = norm * _missed(qp, p, at.lam)
        if residual <= target:
            return at, step
        idle = 0 if residual < LESS * best else idle + 1
        best = min(best, residual)
        if idle > PATIENCE or not np.isfinite(residual):
            break
        # Step 2: the face there
        p, face = turning.face(feasible, p, at.s)
        # Steps 3 and 4: onto the face, and a solve there
        eased = face.with_directions(np.flatnonzero(face.curvature <= HARD * norm))
        share = min(SHARE, FOLLOWED * residual / last) if step else SHARE
        on = OnFace(eased, law.following(p, face), p)
        try:
            at = _solve_on(qp, on, oblique(eased, on.C), at, (share, target, norm))
        except FactorError:
            break
        last = residual
    return None, step + 1


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


def _solve_on(
    qp: QP, on: OnFace, oblique: Oblique, at: LawPoint, aim: tuple[float, float, float]
) -> LawPoint:
    """Steps 3 and 4: on the face Zᵀ(Fλ − d − Gᵀμ) + κu = 0 and Gλ = e, λ = λ₁ + (I + C)u.

    Multiplies by F once for the way onto the face, where that is seen, and once for each direction.
    """
    comm, face, F = qp.d.getComm().tompi4py(), on.face, _on_arrays(qp.F, qp.d)
    preconditioner = qp.preconditioner_on(face) if qp.preconditioner_on else None
    M = _on_arrays(preconditioner, qp.d) if preconditioner else face.restricted
    # Step 3: λ₁ on the face, u₀ that restores Gλ = e
    lam, x = on.entered(at.lam), qp.d.duplicate()
    x.array[:] = lam
    u = oblique.restoring(qp.coarse.residual(x))
    lam = lam + on.followed(u)
    s, way = at.s, lam - at.lam
    share, target, norm = aim
    if norm * norm_over(comm, way) > UNSEEN * target:
        s = s + F(way)

    # Step 4: u by conjugate residuals
    def apply(z: Array) -> tuple[Array, Array]:
        Fz = F(on.followed(z))
        return oblique.project(Fz + on.bend(z)), Fz

    b = -oblique.project(s + on.bend(u))
    size = max(share * norm_over(comm, b), FINAL * target)
    known = known_on(qp.recycled, on, oblique.project)
    gone = gcr(apply, lambda r: oblique.project(M(r)), b, size, MOST_DIRECTIONS, comm, known)
    keep(qp.recycled, on, gone.new)
    u, lam, s = u + gone.u, lam + on.followed(gone.u), s + gone.image
    mu = oblique.coordinates(s + on.bend(u))
    qp.coarse.combine(mu, x)
    at = LawPoint(lam, s - x.array_r, at.mu + mu)
    for item in (x, preconditioner):
        if item is not None:
            item.destroy()
    return at


def _on_arrays(A: Operator | FaceOperator, like: PETSc.Vec) -> Callable[[Array], Array]:
    """An operator between this rank's parts of vectors."""

    def mult(values: Array) -> Array:
        x, y = like.duplicate(), like.duplicate()
        x.array[:] = values
        A.mult(x, y)
        result = np.array(y.array_r)
        x.destroy()
        y.destroy()
        return result

    return mult
