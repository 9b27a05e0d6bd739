"""Newton's method on Coulomb's law, from a solution of a problem with given bounds."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.citations import cite
from tfeti_dolfinx.dual.dual import Dual, contact_set
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import agreed, norm_over
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.law import Law
from tfeti_dolfinx.qp.law_newton import (
    UNSEEN,
    LawPoint,
    follow_friction,
    newton_on_law,
    residual_of,
)
from tfeti_dolfinx.qp.oblique import NoOblique, Oblique
from tfeti_dolfinx.qp.problem import QP
from tfeti_dolfinx.solver import learn

# how often it may end and its bounds not be at rest; the factor on its target each time, and at
# least on its residual; of ‖F‖‖λ‖: what rounding leaves of that
TRIES, FINER, ROUNDING = 4, 0.03, 2e-16
# of the first residual: what points on the path of growing friction are solved to
LOOSE = 1e-3


class NewtonOnCoulomb:
    """Newton's method on the law of a scene, tried until it fails. All methods are collective.

    Args:
        dual: The dual problem.
        options: Options.
        qp_type: The solver of problems with given bounds.

    Attributes:
        steps: Steps so far.
    """

    def __init__(self, dual: Dual, options: Options, qp_type: str) -> None:
        kind = options.friction_type
        self._dual, self._rtol, self.steps = dual, options.number, 0
        self._tries = TRIES if kind == "newton" or (kind == "auto" and qp_type == "newton") else 0
        self._share, self._options = 1.0, options
        self._recycled = dual.recycled
        # the same load again: the last bounds are right
        self._rests = dual.last.is_of(dual.d, dual.coarse.e)

    @property
    def may_try(self) -> bool:
        """Whether it is wanted, has not failed, and may end nearer to the law."""
        return self._tries > 0

    def give_up(self) -> None:
        """Try no more, and keep nothing of what has led nowhere."""
        self._tries, self._dual.recycled = 0, self._recycled

    def solve(
        self, start: tuple[Array, Array] | None, aim: float = np.inf
    ) -> tuple[Array, Array] | None:
        """λ on this rank's rows and the multipliers of Gλ = e for which the law holds.

        A step multiplies by F once, and once for each direction of its solve; so does the start,
        where it is not the last solution.

        Args:
            start: Where to start; None: nothing is tried, nor where no solve has seen F yet.
            aim: What residual an answer must have to be right, as far as a look has told.

        Returns:
            None where it is not tried, or fails.
        """
        if start is None or self._tries == 0 or self._dual.seen == 0.0:
            return None
        if self._rests:
            self._rests = False
            return None
        cite("newton on friction")
        learn(self._dual, self._options)  # steps differ by few rows, if by any
        qp, law, norm = self._dual.qp(), self._law(), self._dual.seen
        constraints = self._dual.constraints
        known = constraints.pressures[constraints.pressed]
        residual, first = self._first(qp, law, start)
        target = min(self._target(qp), FINER * residual, aim)
        if target <= ROUNDING * norm * norm_over(self._dual.coarse.comm, start[0]):
            end, steps = None, 0
        else:
            given = qp, law, self._oblique, first, target, norm
            end, steps = newton_on_law(*given)
            if end is None and not self._dual.coarse.unheld.free.any():
                end, more = follow_friction(*given, loose=LOOSE * residual)
                steps += more
        constraints.set_pressures(known)
        self.steps, self._share = self.steps + steps, FINER * self._share
        self._tries -= 1
        if end is None:
            self.give_up()
            return None
        self._pass_on(qp, end, UNSEEN * target / norm)
        return end.lam, end.mu

    def _first(self, qp: QP, law: Law, start: tuple[Array, Array]) -> tuple[float, LawPoint]:
        """The start with its μ, or with that of least squares: the one with the lesser residual."""
        (lam, mu), work = start, qp.d.duplicate()
        work.array[:] = lam
        at = self._dual.last.image(qp.F, work)
        at.Fx.axpy(-1.0, qp.d)
        found = []
        for alpha in (mu, qp.coarse.coordinates(at.Fx)):
            qp.coarse.combine(alpha, work)
            point = LawPoint(np.array(lam), at.Fx.array_r - work.array_r, alpha)
            found.append((residual_of(qp, law, point, self._dual.seen), point))
        at.destroy()
        return min(found, key=lambda one: one[0])

    def _pass_on(self, qp: QP, end: LawPoint, within: float) -> None:
        """F of the end is known, and of what is near for the problem with its bounds."""
        work = qp.d.duplicate()
        qp.coarse.combine(end.mu, work)
        self._dual.last.pass_on(end.lam, end.s + work.array_r + qp.d.array_r, within)
        work.destroy()

    def _target(self, qp: QP) -> float:
        """rtol ‖Pd‖, less each time."""
        Pd = qp.d.copy()
        qp.coarse.project(Pd)
        size = agreed(self._dual.coarse.comm, float(Pd.norm()))
        Pd.destroy()
        return self._share * self._rtol * size

    def _oblique(self, face: Face, C: csr_array) -> Oblique:
        coarse = self._dual.coarse
        return coarse.oblique(face, C) if coarse.dimension else NoOblique(face)

    def _law(self) -> Law:
        constraints = self._dual.constraints
        at = constraints.pressed

        def bounded(pressures: Array) -> FeasibleSet:
            constraints.set_pressures(pressures)
            return contact_set(constraints)

        return Law(bounded, constraints.pressed_by[at], constraints.sets.tangents[at])
