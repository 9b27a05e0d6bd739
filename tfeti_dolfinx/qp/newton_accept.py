"""Where block Newton goes: a step is accepted where q falls enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.newton_curved import (
    PARTS,
    brought_back,
    gradient_on,
    is_curved,
    part_of_way,
    projected_part,
    slipping_work,
)
from tfeti_dolfinx.qp.newton_faces import FaceSolver
from tfeti_dolfinx.qp.newton_iterate import ROUNDING, Iterate
from tfeti_dolfinx.qp.pcpg import SHORT
from tfeti_dolfinx.qp.problem import Point
from tfeti_dolfinx.qp.trial import Trial

# of what the gradient step promises at least, (ᾱ/2)‖g^P‖²: a step must lower q by that share
ENOUGH = 0.1
# of a way along a face that is curved, where q is not low enough at its end
SHORTER = 0.5
# of the way to the first bound: what ends there is put on it, and not left inside by rounding
PAST = 1.0 + 1e-14
# solves on a face that stays, after the one at whose end q was not low enough
LONGER = 2
# solves on smaller and smaller faces that are few enough to let rows go one by one in the next step
FEW_ROUNDS = 10


def _enough(state: Iterate) -> float:
    """What a step has to lower q by."""
    known = np.isfinite(state.residual)
    return ENOUGH * 0.5 / state.norm * state.residual**2 if known else 0.0


def longer(state: Iterate, trial: Trial, faces: FaceSolver) -> Trial:
    """Solve on where the face has changed under way, and stays, but q is not low enough.

    What restores Gλ = e after rows are dropped raises q; some more steps of conjugate gradients
    lower it again. Collective.

    Args:
        state: The iterate.
        trial: What solves on faces have come to; taken over.
        faces: The solver.

    Returns:
        The trial, maybe with another end.
    """
    for _ in range(LONGER):
        changed = trial.feasible and trial.rounds > 1 and not faces.dependent.contradicts
        if not (changed and agreed(state.comm, state.gain(trial.last) < _enough(state))):
            break
        face = _face_at(state, trial.last, faces)
        if not faces.stays_on(face):
            break
        faces.settle()
        more = faces.solve(trial.last, face, faces.left)
        more.first.destroy()
        trial.last.destroy()
        trial = replace(trial, last=more.last, feasible=more.feasible)
    return trial


def _face_at(state: Iterate, at: Point, faces: FaceSolver) -> Face:
    """The face of a point, with multipliers of the face entered."""
    s = gradient_on(state.qp, faces.coarse, at.g)
    face = state.qp.feasible.face(at.lam.array_r, s.array_r)
    s.destroy()
    return face


def accept(state: Iterate, trial: Trial, faces: FaceSolver) -> bool:
    """Go where q falls enough: trial, the feasible part of its first step, or downhill. Collective.

    Args:
        state: The iterate; moved.
        trial: What solves on faces have come to.
        faces: The solver; it is told whether it may go on from there, and whether to let rows go
            as boldly next time.

    Returns:
        Whether q could be lowered.
    """
    known, enough = np.isfinite(state.residual), _enough(state)
    gain = state.gain(trial.last)
    hidden = ROUNDING * slipping_work(state.point.lam, state.s, trial.face)
    # what is left is not on the face, but maybe Gλ ≠ e
    stays = gain <= 0.0 and state.idle > (0 if gain == 0.0 else 1)
    taken = trial.feasible and agreed(state.comm, gain >= enough - hidden and not stays)
    raised = not taken and trial.rounds > 1
    faces.cautious = raised or (faces.cautious and trial.rounds <= FEW_ROUNDS)
    if taken:
        state.take(trial.last, gain)
        faces.settle()
        return True
    faces.forget()
    if agreed(state.comm, gain == 0.0):  # nothing has moved
        return _descend(state, known, faces)
    length = trial.feasible_part(state.qp.feasible, state.point)
    curved = is_curved(state.qp, trial.face)
    shares = [length] if not curved or trial.rounds > 1 else []
    shares += [SHORTER * length, SHORTER**2 * length] if curved else []
    for share in PARTS if curved else ():
        if _went_to(state, projected_part(state.qp, state.point, trial.first, share), enough):
            return True
    taken = any(_shortened(state, trial, share, curved, enough) for share in shares)
    return taken or _descend(state, known, faces)


def _shortened(state: Iterate, trial: Trial, length: float, curved: bool, enough: float) -> bool:
    """Go a part of the first solve's way, if q falls enough there."""
    shorter, held = part_of_way(state.point, trial.first, PAST * length), length > 0.0
    if curved:
        held = brought_back(state.qp, trial.face, shorter) and held
    else:
        shorter.lam.array[:] = state.qp.feasible.project(shorter.lam.array_r)
    return _went_to(state, shorter, enough, held)


def _went_to(state: Iterate, to: Point, enough: float, may: bool = True) -> bool:
    """Go there if q falls enough; the point is taken over."""
    gain = state.gain(to)
    taken = agreed(state.comm, may and gain >= enough)
    if taken:
        state.take(to, gain)
    to.destroy()
    return taken


def _descend(state: Iterate, known: bool, faces: FaceSolver) -> bool:
    """The projected gradient step, or the part of it where q is least."""
    if not known:
        state.look(faces)
    assert state.back is not None
    p, Fp = state.back.copy(), state.s.duplicate()
    p.axpy(-1.0, state.point.lam)
    state.qp.F.mult(p, Fp)
    slope, curvature, size = -state.s.dot(p), p.dot(Fp), p.dot(p)
    if size > SHORT**2 * state.point.lam.dot(state.point.lam):
        faces.saw(curvature, size)
    length = min(1.0, slope / curvature) if curvature > 0.0 else 1.0
    moved = agreed(state.comm, size > 0.0 and slope > 0.0)
    if moved:
        state.went_down(length * slope)
        state.point.move(length, p, Fp)
        state.point.lam.array[:] = state.qp.feasible.project(state.point.lam.array_r)
    p.destroy()
    Fp.destroy()
    return moved
