"""The iterate of block Newton: what it lacks to be optimal, and which face it wants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.parallel import agreed
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.homogenised import Homogenised
from tfeti_dolfinx.qp.nearest import nearest
from tfeti_dolfinx.qp.newton_curved import slipping_start
from tfeti_dolfinx.qp.newton_faces import FaceSolver
from tfeti_dolfinx.qp.pcpg import SHORT
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Point, QPResult, Steps

# of Fλ − d: where Gᵀμ is nearly all of it, as where gaps are large, it is taken out of d
MOST = 0.1
# times Fλ − d: multipliers that are larger are rounding, for Gᵀμ is to be as large as that
WILD = 1e3
# so many steps in a row that neither lower q by what stands out from its rounding, nor halve
# ‖g^P‖; so many that do not halve it, whatever q does
PATIENCE, LONG, ROUNDING = 10, 100, 1e-15
# of ‖F‖‖λ‖: what rounding of λ − ᾱs leaves of ‖g^P‖; times that: where each step down is one
LOST, FAR = 2e-15, 1e3


class Iterate:
    """A feasible point, with what it lacks to be optimal.

    Args:
        qp: The program.
        homogenised: Holds the start.
        mu: Multipliers of Gλ = e there, where they are known.

    Attributes:
        qp: The same program, but for a d' = d + Gᵀμ', which adds a constant to q.
        point: λ and Fλ − d'.
        s: Multipliers of Ω: Fλ − d' − Gᵀμ; 0 where λ is free, if it is optimal.
        mu: Multipliers μ of Gλ = e in the program with d'.
        back: The nearest feasible point to λ − ᾱ(Fλ − d).
        residual: ‖g^P‖, g^P = (λ − back)/ᾱ.
        norm: Estimate of ‖F‖; ᾱ is its inverse.
        rounding: What rounding may make of ‖g^P‖ alone.
        idle: So many looks in a row have found neither q nor ‖g^P‖ lower.
        slow: So many have not found ‖g^P‖ halved.
    """

    def __init__(self, qp: QP, homogenised: Homogenised, mu: Array | None = None) -> None:
        self._given, self._homogenised = qp, homogenised
        self.qp = replace(qp, d=qp.d.copy())
        self.comm = qp.d.getComm().tompi4py()
        self.point = Point(homogenised.lam_bar.copy(), homogenised.gradient.copy())
        self.s = qp.d.duplicate()
        self.back: PETSc.Vec | None = None
        self.mu: Array = np.zeros(qp.coarse.dimension) if mu is None else mu
        self._taken: Array = np.zeros(qp.coarse.dimension)
        self._set_multipliers()
        self.residual, self._best, self.norm, self.rounding = np.inf, np.inf, 1.0, 0.0
        self.idle = self.slow = 0

    def face(self) -> Face:
        """The face of λ."""
        return self.qp.feasible.face(self.point.lam.array_r, self.s.array_r)

    def pressed_face(self) -> Face:
        """The face of ``back``: a row that carries less than it is open by, λ_i < ᾱs_i, is open.

        Where forces are rounding of 0 they do not say which rows touch.
        """
        if self.back is None:
            return self.face()
        return self.qp.feasible.face(self.back.array_r, self.s.array_r)

    def multipliers_on(self, faces: FaceSolver) -> None:
        """μ and s that belong to the face entered.

        A face that lacks rank says nothing of motions that it leaves free, but its factor may.
        """
        last, self.mu = self.mu, faces.coarse.coordinates(self.point.g)
        self._set_multipliers()
        self.mu = self.mu + faces.coarse.coordinates(self.s)  # rounding of Fλ − d, not of s
        self._set_multipliers()
        if agreed(self.comm, self.s.norm() > WILD * self.point.g.norm()):
            self.mu = last
            self._set_multipliers()

    def look(self, faces: FaceSolver) -> None:
        """Optimality: how far a gradient step, brought back to the feasible set, moves."""
        self._set_multipliers()
        if faces.norm == 0.0:
            self._learn_norm(faces)
        self.norm = faces.norm or 1.0
        if faces.settled:
            self.multipliers_on(faces)
        target = self.point.lam.copy()
        target.axpy(-1.0 / self.norm, self.s)  # not Fλ − d: what Gᵀμ takes from it may be large
        found = nearest(self.qp.coarse, self.qp.feasible, target)
        self.mu = self.mu + self.norm * found.alpha
        self._set_multipliers()
        self._take_out()
        if self.back is not None:
            self.back.destroy()
        self.back = found.lam
        self.point.lam.copy(target)
        target.axpy(-1.0, self.back)
        self.residual = self.norm * target.norm()
        target.destroy()
        self.rounding = agreed(self.comm, LOST * self.norm * self.point.lam.norm())
        self.idle, self.slow = self.idle + 1, self.slow + 1
        if self.residual <= 0.5 * self._best:
            self._best, self.idle, self.slow = self.residual, 0, 0

    def _learn_norm(self, faces: FaceSolver) -> None:
        """Rayleigh quotients at λ, which alone may be far below ‖F‖, and at Ps."""
        lam, way, image = self.point.lam, self.s.copy(), self.s.duplicate()
        faces.saw(lam.dot(self.point.g) + lam.dot(self.qp.d), lam.dot(lam))
        self.qp.coarse.project(way)
        if agreed(self.comm, way.norm() > SHORT * self.s.norm()):
            self.qp.F.mult(way, image)
            faces.saw(way.dot(image), way.dot(way))
        way.destroy()
        image.destroy()

    def _set_multipliers(self) -> None:
        self.qp.coarse.combine(self.mu, self.s)
        self.s.aypx(-1.0, self.point.g)

    def _take_out(self) -> None:
        """Put Gᵀμ into d', where it is most of Fλ − d'. q changes by a constant."""
        if agreed(self.comm, self.s.norm() > MOST * self.point.g.norm()):
            return
        self._taken, self.mu = self._taken + self.mu, np.zeros_like(self.mu)
        self.qp.coarse.combine(self._taken, self.qp.d)
        self.qp.d.axpy(1.0, self._given.d)
        self.s.copy(self.point.g)

    def wanted_face(self, gamma: float, faces: FaceSolver) -> Face:
        """What carries force, and what wants to, if that is most of what is wrong.

        The rest is what PCPG has left on the face, if it has stopped at λ.
        """
        lam, s, feasible = self.point.lam.array_r, self.s.array_r, self.qp.feasible
        phi, beta = feasible.split(lam, s)
        phi = feasible.reduced(lam, phi, 1.0 / self.norm)  # what soon stops at a bound is little
        within = self.face().restricted(beta)  # along a boundary that is curved
        beta = beta - within
        sums = np.array([phi @ phi + within @ within, beta @ beta])
        free, chopped = self.comm.allreduce(sums, op=MPI.SUM)
        if faces.settled:
            free = faces.left**2
        if agreed(self.comm, chopped > gamma**2 * free):
            moved = feasible.project(lam - beta / self.norm)
            return feasible.face(0.5 * (lam + moved), s)
        return self.face()

    def begun(self, face: Face) -> tuple[Point, Face]:
        """Where the solve on a face starts, and on which: λ, or ``back`` where more slips there."""
        back = self.point.lam if self.back is None else self.back
        return slipping_start(self.qp, self.point, face, back, self.pressed_face())

    @property
    def stalled(self) -> bool:
        """Whether q and ‖g^P‖ have not come down any more for long."""
        return agreed(self.comm, self.idle >= PATIENCE or self.slow >= LONG)

    def take(self, to: Point, gain: float) -> None:
        """Go there; a gain that stands out from the rounding of q is worth more steps."""
        self.went_down(gain)
        self.point.take(to)

    def went_down(self, gain: float) -> None:
        """See whether q came down by what is no rounding of it."""
        sizes = abs(self.point.lam.dot(self.point.g)) + abs(self.point.lam.dot(self.qp.d))
        if gain > (0.0 if self.residual > FAR * self.rounding else ROUNDING * sizes):
            self.idle = 0

    def gain(self, to: Point) -> float:
        """q(λ) − q(to), by differences, and without what Gλ = e makes constant. Collective."""
        apart, gradient = to.lam.copy(), to.g.copy()
        apart.axpy(-1.0, self.point.lam)
        gradient.axpy(-1.0, self.point.g)
        gradient.axpy(2.0, self.s)
        value = -0.5 * float(apart.dot(gradient))
        apart.destroy()
        gradient.destroy()
        return value

    def result(self, reason: ConvergedReason, steps: Steps) -> QPResult:
        """The answer; takes λ and s over."""
        moved = self.point.lam.copy()
        moved.axpy(-1.0, self._homogenised.lam_bar)
        equality = self.qp.coarse.norm_Q(moved)
        moved.destroy()
        return QPResult(
            lam=self.point.lam.copy(),
            mu=self._taken + self.mu,
            gradient=self.s.copy(),
            face=self.pressed_face(),
            reason=reason,
            projected_gradient=self.residual,
            equality=equality,
            reference=self._homogenised.scale.reference,
            norm=self.norm,
            steps=steps,
        )

    def destroy(self) -> None:
        """Destroy the vectors. Collective."""
        self.point.destroy()
        for vec in (self.s, self.qp.d, self.back):
            if vec is not None:
                vec.destroy()
