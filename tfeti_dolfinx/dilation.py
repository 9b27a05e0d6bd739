"""Coulomb's law by gaps that grow with slips: De Saxcé's fixed point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.dual.dual import Dual
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.options import Options
from tfeti_dolfinx.parallel import agreed, norm_over, summed
from tfeti_dolfinx.qp.acceleration import Anderson
from tfeti_dolfinx.qp.cones import Cones
from tfeti_dolfinx.qp.discs import Ellipses
from tfeti_dolfinx.qp.feasible_sets import Bounds, Product
from tfeti_dolfinx.qp.homogenised import homogenise, image
from tfeti_dolfinx.qp.newton import newton
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Start
from tfeti_dolfinx.qp.stopping import ResidualRule

# Of the first residual, and of the last change of the slips: what a problem is solved to
FIRST, SHARE = 1e-4, 1e-3
# changes of slips that are remembered: the map is piecewise nearly linear
DEPTH = 3
# times the last change: the longest step; of the slips: the farthest way back
LEAP, BACK = 30.0, 0.1
# problems in a row whose change is not half of the least before; then bodies slide on without end
PATIENCE = 12
# problems in a row that are not solved: the second one goes on where the first has ended
UNSOLVED = 2
# steps of one problem: beyond that it is not solved
MOST_STEPS = 500
# times the first slips: more of them are no measure of changes, since they may grow without end
FARTHER = 100.0
# times the first slips: so many of them, and still no rest, are bodies that slide
GROWN = 10.0


class DilatedGaps:
    """Forces within Coulomb's cones, from problems in which each gap grows by the slip there.

    With q_i the slip, a gap of g_i + w_i, w_i = ‖μ_i q_i‖, makes Coulomb's law the optimality of
    min ½λᵀFλ − λᵀd over all cones ‖τ_i/μ_i‖ ≤ λ_N,i at once (De Saxcé). Each of these problems is
    convex, and has a solution wherever forces within the law can balance the load, if gaps do not
    exclude each other; with bounds in the place of cones that is so for some bounds only. w is
    iterated to its fixed point (Acary, Cadoux, Lemaréchal, Malick, Z. Angew. Math. Mech. 91, 2011).

    Args:
        dual: The dual problem.
        lam: Forces within the law that balance the load, on this rank's rows.
        options: Parameters of block Newton. Creation and all methods are collective.

    Attributes:
        lam: The last forces, on this rank's rows.
        mu: Multipliers of Gλ = e there.
        astray: Whether slips grow without end, or do not come to rest, or problems are not solved.
        slides: Whether they have grown.
    """

    def __init__(self, dual: Dual, lam: Array, options: Options) -> None:
        self._dual, self._options, self._comm = dual, options, dual.coarse.comm
        constraints, at = dual.constraints, dual.constraints.pressed
        self._tangents, self._mu = constraints.sets.tangents[at], constraints.coefficients[at]
        self._rows = constraints.pressed_by[at]
        self.lam = lam
        self.mu: Array = np.zeros(dual.coarse.dimension)
        self._w: Array = np.zeros(len(at))
        self._anderson = Anderson(self._products, DEPTH)
        self._change, self._first = np.inf, 0.0
        self.astray, self.slides, self._unsolved = False, False, 0

    def settle(self, share: float) -> Array:
        """Iterate until slips change by less than a share; returns the λ_N under the law."""
        best, idle = np.inf, 0
        while idle < PATIENCE and self._unsolved < UNSOLVED:
            slips = self._slips()
            size, self._change = self._size(slips), self._size(slips - self._w)
            self._first = self._first or size
            if self._change <= share * min(size, FARTHER * self._first):
                return np.array(self.lam[self._rows])
            idle += 1
            if self._change <= 0.5 * best:
                best, idle = self._change, 0
            self._advance(slips)
        self.astray, self.slides = True, self._size(self._w) > GROWN * self._first
        return np.array(self.lam[self._rows])

    def _advance(self, slips: Array) -> None:
        """The accelerated step, not too long; a plain one where that would go far back."""
        plain = slips - self._w
        step = self._anderson.next(self._w, slips) - self._w
        along = self._products(step[:, None], plain[:, None])[0, 0]
        if along <= 0.0 and self._size(step) > BACK * self._size(self._w):
            step = plain
        longest = LEAP * self._change
        self._w = np.maximum(self._w + min(1.0, longest / max(self._size(step), TINY)) * step, 0.0)

    def _slips(self) -> Array:
        """‖μ_i q_i‖ at the solution with the present gaps; keeps its forces."""
        given = self._dual.qp()
        d, lam = given.d.duplicate(), given.d.duplicate()
        given.coarse.combine(self.mu, d)  # with the last Gᵀμ in d only what changes is left to find
        d.axpy(1.0, given.d)
        d.array[self._rows] -= self._w
        lam.array[:] = self.lam
        qp: QP = replace(given, d=d, feasible=cone_set(self._dual.constraints))
        at = image(qp.F, lam)
        homogenised, start = homogenise(qp, at), Start(lam, np.zeros_like(self.mu))
        tolerance = FIRST * homogenised.scale.reference
        if np.isfinite(self._change):
            tolerance = min(tolerance, SHARE * self._change)
        rule = ResidualRule(max(tolerance, homogenised.scale.rounding))
        most = min(self._options.max_it, MOST_STEPS)
        result = newton(qp, homogenised, rule, self._options.newton, max_it=most, start=start)
        self._dual.saw(result.norm)
        late = result.reason == ConvergedReason.DIVERGED_ITS
        self._unsolved = self._unsolved + 1 if late else 0
        self.lam, self.mu = np.array(result.lam.array_r), self.mu + result.mu
        slips = np.linalg.norm(self._mu * result.gradient.array_r[self._tangents], axis=1)
        homogenised.destroy()
        at.destroy()
        result.destroy()
        d.destroy()
        return np.asarray(slips)

    def _size(self, x: Array) -> float:
        return norm_over(self._comm, x)

    def _products(self, A: Array, B: Array) -> Array:
        return agreed(self._comm, summed(self._comm, A.T @ B))


def cone_set(constraints: Constraints) -> Product:
    """λ_N ≥ 0, given bounds, and Coulomb's law for normal and tangents together."""
    sets, pressed = constraints.sets, constraints.pressed
    above = constraints.pressed_by[pressed]
    given = np.setdiff1d(np.arange(len(sets.tangents)), pressed)
    rows = np.column_stack((above, sets.tangents[pressed]))
    return Product(
        [
            (np.setdiff1d(sets.normals, above), Bounds()),
            (sets.tangents[given].ravel(), Ellipses(constraints.limits[given])),
            (rows.ravel(), Cones(constraints.coefficients[pressed])),
        ]
    )
