"""The nearest point of {λ ∈ Ω, Gλ = e}: coarse factors, and no multiplication by F."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, steering, summed
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status

# far more than what factors leave of Gλ = e
UNBALANCED = 1e-3


@dataclass(frozen=True)
class ProjectionParameters:
    """Parameters of the projection onto {λ ∈ Ω, Gλ = e}."""

    max_trials: int = 300  # points looked at: far more than Newton takes where it converges
    # of the terms of Gλ − e: what the coarse problem's factors leave at best
    balanced: float = 1e-13
    nearly: float = 1e-6  # of the same: below it steps that leave more than `slow` meet rounding
    slow: float = 0.1  # share of what is left
    slowly: int = 8  # so many such steps in a row, and rounding has ended it
    # of GGᵀ, added to G_f G_fᵀ: keeps steps regular where few rows carry a force, and is small
    # beside 1, so that they stay Newton's
    damping: float = 1e-8
    least_damping: float = 1e-14  # the smallest that a factor bears: where bodies are hardly held
    # factor on the damping after a whole step that has met no row but it: those of the face may be
    # so soft beside open ones that they hold by less
    eased: float = 0.01
    # factor on the damping where even `shortest` of a step is too far: up to 1, a gradient step
    harder: float = 1e4
    # of Newton's step, or of a part of it that is too long: a bracket so small is not divided
    shortest: float = 1e-8
    # of the slope at its start: a whole step that leaves as much has met only the damping; a part
    # of one leaves no more
    left: float = 0.5
    # after so many of these in a row nothing in Ω fulfils Gλ = e but for rounding
    patience: int = 10
    rounding: float = 1e-14  # of the cost: what rounding may add to it


DEFAULT = ProjectionParameters()


def project_onto_feasible(
    coarse: Coarse,
    feasible: FeasibleSet | WithinFace,
    y: Array,
    alpha: Array | None = None,
    parameters: ProjectionParameters = DEFAULT,
) -> tuple[Array, Array]:
    """Project y onto {λ ∈ Ω, Gλ = e}, or come as close to that set as possible. Collective.

    It is λ(α) = P_Ω(y + Gᵀα) with Gλ(α) = e. That is where the convex function
    ½‖z‖² − ½‖z − P_Ω(z)‖² − αᵀe of z = y + Gᵀα is least, which a semismooth Newton method with a
    line search finds: each step factors G_f G_fᵀ, f the face of λ(α). Where nothing in Ω fulfils
    Gλ = e, the cost falls without end along steps that no row stops; a few of them end it, and
    ``imbalance`` of λ says so. ``alpha`` is where to begin; default 0. Return this rank's part of
    λ, and α, which all ranks have.

    >>> import numpy as np
    >>> from tfeti_dolfinx.testing import DenseCoarse
    >>> from tfeti_dolfinx.qp.sets import Bounds
    >>> coarse = DenseCoarse(np.ones((1, 2)), np.ones(1))
    >>> project_onto_feasible(coarse, Bounds(), np.array([1.0, -1.0]))[0].tolist()
    [1.0, 0.0]
    """
    comm = coarse.comm
    trial = _trial(coarse, feasible, y, np.zeros(coarse.dimension) if alpha is None else alpha)
    damping, trials, unmet, slowly, least = parameters.damping, 1, 0, 0, trial.left
    while trials < parameters.max_trials and unmet < parameters.patience:
        terms = coarse.terms(trial.lam) + np.abs(coarse.e)
        scale = float(np.sqrt(terms @ terms))
        if bcast_from_root(comm, trial.left <= parameters.balanced * scale):
            break
        face = feasible.face(trial.lam, trial.lam - trial.z)
        step = coarse.damped_solve(face.damped(), trial.residual, damping)
        slope = float(trial.residual @ step)
        trial, length, looks = _along(coarse, feasible, y, trial, step, parameters)
        trials += looks
        if length == 0.0:  # the rows of the face hardly hold
            if damping >= 1.0:
                break
            damping = min(parameters.harder * damping, 1.0)
            continue
        left = float(trial.residual @ step)
        whole = bcast_from_root(comm, length == 1.0 and left > parameters.left * slope)
        unmet = unmet + 1 if whole else 0
        if whole:
            damping = max(parameters.eased * damping, parameters.least_damping)
        elif length < 1.0 or damping > parameters.damping:
            damping = parameters.damping
        near = trial.left <= parameters.nearly * scale
        slow = bcast_from_root(comm, near and trial.left > parameters.slow * least)
        slowly, least = slowly + 1 if slow else 0, min(least, trial.left)
        if slowly > parameters.slowly:
            break
    return trial.lam, trial.alpha


class WithinFace:
    """Points of Ω whose open rows are those of a face, at least.

    With ``slipping`` its slipping rows stay on their boundary, too. They do not make a convex set
    then, but what ``project_onto_feasible`` minimises is convex with any set.
    """

    def __init__(self, feasible: FeasibleSet, face: Face, slipping: bool = False) -> None:
        self._feasible, self._open = feasible, ~face.carrying
        some = np.where(self._open, Status.OPEN, Status.FREE)
        self._status = face.status if slipping else some

    def project(self, x: Array) -> Array:
        """P_Ω(x), but for the rows that stay."""
        return self._feasible.onto(x, self._status)

    def face(self, x: Array, g: Array) -> Face:
        """Return the face of x, without the rows that stay open."""
        face = self._feasible.face(x, g)
        status = np.where(self._open, Status.OPEN, face.status)
        moves = ~np.any(self._open[face.tangent_rows] & (face.tangents != 0.0), axis=1)
        return replace(
            face,
            free=face.free & ~self._open,
            status=status,
            tangent_rows=face.tangent_rows[moves],
            tangents=face.tangents[moves],
            curvature=face.curvature[moves],
        )


@dataclass(frozen=True)
class _Trial:
    """λ(α) = P_Ω(z), e − Gλ(α), the cost there and ‖e − Gλ‖."""

    alpha: Array
    z: Array
    lam: Array
    residual: Array
    cost: float
    left: float


def _trial(coarse: Coarse, feasible: FeasibleSet | WithinFace, y: Array, alpha: Array) -> _Trial:
    z = y + coarse.combined(alpha)
    lam = feasible.project(z)
    own = float(z @ lam) - 0.5 * float(lam @ lam)
    (cost,), residual = summed(coarse.comm, np.array([own])), coarse.residual(lam)
    length = float(np.sqrt(residual @ residual))
    return _Trial(alpha, z, lam, residual, float(cost - alpha @ coarse.e), length)


def _along(
    coarse: Coarse,
    feasible: FeasibleSet | WithinFace,
    y: Array,
    start: _Trial,
    step: Array,
    parameters: ProjectionParameters,
) -> tuple[_Trial, float, int]:
    """Return the point after a step, how much of it was taken, and how many points were tried.

    All of it, if that does not raise the cost; else a bisection looks for where the slope has
    fallen, too: rows that are met on the way may hold far more than those the step is made for.
    """
    slope, length, low, high, trials = float(start.residual @ step), 1.0, 0.0, np.inf, 0
    while True:
        trial, trials = _trial(coarse, feasible, y, start.alpha + length * step), trials + 1
        left = float(trial.residual @ step)
        # as it is convex the cost fell where it still falls, however rounding hides that
        fell = trial.cost <= start.cost + parameters.rounding * abs(start.cost) or left >= 0.0
        met = fell and (length == 1.0 or abs(left) <= parameters.left * slope)
        met, short = (flag > 0.0 for flag in steering(coarse.comm, met, fell and left > 0.0))
        if met:
            return trial, length, trials
        low, high = (length, high) if short else (low, length)
        if high - low <= parameters.shortest * (high if low > 0.0 else 1.0):
            end = _trial(coarse, feasible, y, start.alpha + low * step) if low > 0.0 else start
            return end, low, trials
        length = 0.5 * (low + high)
