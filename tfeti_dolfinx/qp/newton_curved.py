"""Faces that are curved, as where nodes slip: what block Newton does there besides."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.qp.coarse import HELD, Coarse, imbalance
from tfeti_dolfinx.qp.faces import Face, Status, without_slip
from tfeti_dolfinx.qp.homogenised import restored
from tfeti_dolfinx.qp.nearest import WithinFace, nearest
from tfeti_dolfinx.qp.problem import QP, Operator, Point

# of Gλ = e: what is left after a first try to restore it, as where rows hardly hold, is worth a
# second one
EXACT = 1e-13
# points looked at on the way back to circles: it is short, or there is no such way
BACK = 30
# of a way along a face that is curved, with all that leaves Ω brought back, which lets go many
# nodes at once
PARTS = (0.5, 0.125)


class Bent:
    """F + Z diag(κ) Zᵀ: along a face that bends, to second order, q has this Hessian.

    Args:
        F: The operator.
        face: The face.
    """

    def __init__(self, F: Operator, face: Face) -> None:
        self._F, self._face = F, face

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = (F + Z diag(κ) Zᵀ)x. Collective."""
        self._F.mult(x, y)
        y.array[:] += self.bend(x.array_r)

    def bend(self, x: Array) -> Array:
        """Z diag(κ) Zᵀx."""
        return np.asarray(self._face.Z @ (self._face.curvature * (self._face.Z.T @ x)))


def is_curved(qp: QP, face: Face) -> bool:
    """Whether a row of some rank slips along a boundary. Collective."""
    return any_rank(qp.d.getComm().tompi4py(), face.curved)


def is_rubbing(qp: QP, face: Face) -> bool:
    """Whether a row of some rank sticks or slips. Collective."""
    rubbing = np.isin(face.status, (Status.STICK, Status.SLIP))
    return any_rank(qp.d.getComm().tompi4py(), bool(np.any(rubbing)))


def has_left(qp: QP, face: Face, x: Array) -> bool:
    """Whether rows that do not slip are outside of Ω. Collective."""
    left = without_slip(face, qp.feasible.project(x) - x)
    return any_rank(qp.d.getComm().tompi4py(), bool(np.any(left != 0.0)))


def restored_on(qp: QP, coarse: Coarse, face: Face, lam: PETSc.Vec) -> PETSc.Vec:
    """λ + ZG_fᵀ(G_fG_fᵀ)⁺(e − Gλ); twice where its factor leaves much. Collective.

    Args:
        qp: The program.
        coarse: Projectors of the face.
        face: The face.
        lam: A point of the face.
    """
    near = _restored_once(qp, coarse, face, lam)
    if imbalance_on(qp, coarse, face, near) > EXACT:
        once, near = near, _restored_once(qp, coarse, face, near)
        once.destroy()
    return near


def _restored_once(qp: QP, coarse: Coarse, face: Face, lam: PETSc.Vec) -> PETSc.Vec:
    if not _is_beside(face, lam):
        return restored(coarse, lam)
    near = lam.duplicate()
    coarse.combine(coarse.solve(qp.coarse.residual(lam)), near)
    near.axpy(1.0, lam)
    return near


def imbalance_on(qp: QP, coarse: Coarse, face: Face, lam: PETSc.Vec) -> float:
    """How far Gλ is from e: the worst entry beside its terms, 1 at most. Collective."""
    return imbalance(qp.coarse if _is_beside(face, lam) else coarse, lam)


def _is_beside(face: Face, lam: PETSc.Vec) -> bool:
    """Whether λ is not 0 in directions that are not the face's, as where rows slip."""
    fixed = lam.array_r - face.restricted(lam.array_r)
    return any_rank(lam.getComm().tompi4py(), bool(np.any(fixed)))


def bent_at(qp: QP, coarse: Coarse, face: Face, on: Array, g: PETSc.Vec) -> Face:
    """A face with the curvature that belongs to another gradient. Collective.

    Args:
        qp: The program.
        coarse: Projectors of the face.
        face: The face.
        on: A point that has this face, shape ``(m,)``.
        g: Fλ − d.
    """
    s = gradient_on(qp, coarse, g)
    curvature = qp.feasible.face(on, s.array_r).curvature
    s.destroy()
    return Face(face.Z, curvature, face.status)


def gradient_on(qp: QP, coarse: Coarse, g: PETSc.Vec) -> PETSc.Vec:
    """Fλ − d − Gᵀμ with the μ of a face, the caller's own. Collective."""
    s = g.duplicate()
    qp.coarse.combine(coarse.coordinates(g), s)
    s.aypx(-1.0, g)
    return s


def slipping_work(lam: PETSc.Vec, s: PETSc.Vec, face: Face) -> float:
    """Σ|s_iλ_i| over what slips, where both are large: rounding of it hides changes of q.

    Collective.
    """
    own = np.abs(lam.array_r * s.array_r)
    slip = float(np.sum(own - without_slip(face, own)))
    return float(lam.getComm().tompi4py().allreduce(slip))


def slipping_start(
    qp: QP, at: Point, face: Face, back: PETSc.Vec, pressed: Face
) -> tuple[Point, Face]:
    """A copy of a point with its face, or ``back`` with its own where that slips first. Collective.

    Near its circle a point that sticks, and whose gradient points outwards, would leave by far, in
    a direction of no use. So would, with friction, one that touches with less force than it is open
    by: at a start from elsewhere these are few, with forces that restoring Gλ = e has left.
    Multiplies by F once where it begins at ``back``.
    """
    start = at.copy()
    early = (face.status == Status.STICK) & (pressed.status == Status.SLIP)
    if is_rubbing(qp, face):
        early |= (face.status == Status.TOUCHING) & (pressed.status == Status.OPEN)
    if not any_rank(qp.d.getComm().tompi4py(), bool(np.any(early))):
        return start, face
    moved_to(qp, start, back.copy())
    return start, pressed


def part_of_way(at: Point, end: Point, share: float) -> Point:
    """The point so far from ``at`` to ``end``, the caller's own. Collective."""
    part = at.copy()
    for kept, last in ((part.lam, end.lam), (part.g, end.g)):
        kept.scale(1.0 - share)
        kept.axpy(share, last)
    return part


def projected_part(qp: QP, at: Point, end: Point, share: float) -> Point:
    """The nearest feasible point to a part of a way. Collective; multiplies by F once."""
    part = part_of_way(at, end, share)
    found = nearest(qp.coarse, qp.feasible, part.lam)
    moved_to(qp, part, found.lam)
    return part


def moved_to(qp: QP, z: Point, lam: PETSc.Vec) -> None:
    """Take z to λ, which is destroyed, and its gradient with it; multiplies by F once."""
    way, image = lam.copy(), z.g.duplicate()
    way.axpy(-1.0, z.lam)
    qp.F.mult(way, image)
    lam.copy(z.lam)
    z.g.axpy(1.0, image)
    for vec in (way, image, lam):
        vec.destroy()


def brought_back(qp: QP, face: Face, z: Point, near: PETSc.Vec | None = None) -> bool:
    """Bring z back to where slipping rows are on their boundary and Gz = e. Collective.

    Multiplies by F once.

    Args:
        qp: The program.
        face: The face.
        z: The point.
        near: What it is brought near to, itself by default.

    Returns:
        Whether there is such a point near by.
    """
    within = WithinFace(qp.feasible, face, slipping=True)
    found = nearest(qp.coarse, within, z.lam if near is None else near, max_trials=BACK)
    held = imbalance(qp.coarse, found.lam) <= HELD
    moved_to(qp, z, found.lam)
    return held


def brought_into(qp: QP, face: Face, z: Point) -> bool:
    """Bring z to the nearest point with Gz = e and open rows at 0. Collective.

    Where circles are small beside what Gz lacks, no points of them may balance it; of the discs
    some do. Multiplies by F once.

    Args:
        qp: The program.
        face: The face.
        z: The point.

    Returns:
        Whether there is such a point.
    """
    found = nearest(qp.coarse, WithinFace(qp.feasible, face), z.lam)
    held = imbalance(qp.coarse, found.lam) <= HELD
    moved_to(qp, z, found.lam)
    return held
