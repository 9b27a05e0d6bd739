"""Newton's method on Coulomb's law, from a solution of a problem with given bounds."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.citations import cite
from tfeti_dolfinx.dual.dual import Dual, contact_set
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.feasible_sets import FeasibleSet
from tfeti_dolfinx.qp.law import Law
from tfeti_dolfinx.qp.law_newton import LawPoint, newton_on_law, residual_of
from tfeti_dolfinx.qp.oblique import NoOblique, Oblique

# how often it may end and its bounds not be at rest, and the factor on its target each time
TRIES, FINER = 4, 0.03


class NewtonOnCoulomb:
    """Newton's method on the law of a scene, tried until it fails.

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
        self._share = 1.0

    def solve(self, start: tuple[Array, Array] | None) -> tuple[Array, Array] | None:
        """λ on this rank's rows and the multipliers of Gλ = e for which the law holds. Collective.

        Multiplies by F in each step, and once where it does not start at the last solution.

        Args:
            start: Where to start; None: nothing is tried, nor where no solve has
                seen F yet.

        Returns:
            None where it is not tried, or fails.
        """
        if start is None or self._tries == 0 or self._dual.seen == 0.0:
            return None
        cite("newton on friction")
        dual, (lam, mu) = self._dual, start
        known = dual.constraints.pressures[dual.constraints.pressed]
        qp, work, at = dual.qp(), dual.d.copy(), dual.d.duplicate()
        qp.coarse.project(work)
        target = self._share * self._rtol * agreed(dual.coarse.comm, float(work.norm()))
        at.array[:] = lam
        image = dual.last.image(dual.F, at).Fx
        image.axpy(-1.0, dual.d)
        norm, law, points = dual.seen, self._law(), []
        for alpha in (mu, qp.coarse.coordinates(image)):
            qp.coarse.combine(alpha, work)
            point = LawPoint(np.array(lam), image.array_r - work.array_r, alpha)
            points.append((residual_of(qp, law, point, norm), point))
        for item in (work, at, image):
            item.destroy()
        first = min(points, key=lambda one: one[0])[1]
        end, steps = newton_on_law(qp, law, self._oblique, first, target, norm)
        self.steps += steps
        self._share *= FINER
        dual.constraints.set_pressures(known)
        self._tries = 0 if end is None else self._tries - 1
        return None if end is None else (end.lam, end.mu)

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
