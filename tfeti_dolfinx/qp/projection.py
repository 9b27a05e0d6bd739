"""The nearest point of {λ ∈ Ω, Gλ = e}: coarse factors, and no multiplication by F."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, summed
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
    # of the same: below it a step that leaves more than `slow` has met the damping, a kink, or
    # rounding
    nearly: float = 1e-6
    slow: float = 0.1  # share of what is left
    # so many such steps in a row, with the least damping, and rounding has ended it
    slowly: int = 8
    # of GGᵀ, added to G_f G_fᵀ: keeps steps regular where few rows carry a force, and is small
    # beside 1, so that they stay Newton's
    damping: float = 1e-8
    least_damping: float = 1e-14  # the smallest that a factor bears: where bodies are hardly held
    # factor on the damping after a whole step that has met no row but it: those of the face may be
    # so soft beside open ones that they hold by less
    eased: float = 0.01
    shortest: float = 1e-8  # of Newton's step: less changes nothing that is left above rounding
    # of the slope at its start: a whole step that leaves as much has met only the damping
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
    >>> from tfeti_dolfinx.qp.coarse import DenseCoarse
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
        # halve the step until it does not raise the cost; where that still falls at the end of a
        # step, it fell along all of it, as it is convex, however rounding hides its difference
        start, length = trial, 1.0
        while True:
            trial, trials = _trial(coarse, feasible, y, start.alpha + length * step), trials + 1
            fell = trial.cost <= start.cost + parameters.rounding * abs(start.cost)
            fell = fell or float(trial.residual @ step) >= 0.0
            if bcast_from_root(comm, fell or length <= parameters.shortest):
                break
            length *= 0.5
        left = float(trial.residual @ step)
        whole = bcast_from_root(comm, length == 1.0 and left > parameters.left * slope)
        unmet = unmet + 1 if whole else 0
        if whole:
            damping = max(parameters.eased * damping, parameters.least_damping)
        elif length < 1.0 and slowly == 0:
            damping = parameters.damping
        near = trial.left <= parameters.nearly * scale
        slow = bcast_from_root(comm, near and trial.left > parameters.slow * least)
        slowly, least = slowly + 1 if slow else 0, min(least, trial.left)
        if bcast_from_root(comm, length <= parameters.shortest) or slowly > parameters.slowly:
            break
        if slow:
            damping = parameters.least_damping
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
        stays = np.any(self._open[face.tangent_rows] & (face.tangents != 0.0), axis=1)
        return replace(face.with_tangents(~stays), free=face.free & ~self._open, status=status)


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
