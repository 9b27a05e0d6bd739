"""The iterate of block Newton: what it lacks to be optimal, and where q falls."""

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
from tfeti_dolfinx.qp.newton_curved import (
    brought_back,
    brought_parts,
    is_curved,
    part_of_way,
    projected_part,
    slipping_start,
    slipping_work,
)
from tfeti_dolfinx.qp.newton_faces import FaceSolver
from tfeti_dolfinx.qp.pcpg import SHORT
from tfeti_dolfinx.qp.problem import QP, ConvergedReason, Point, QPResult, Steps
from tfeti_dolfinx.qp.trial import Trial

# of what the gradient step promises at least, (ᾱ/2)‖g^P‖²: a step must lower q by that share
ENOUGH = 0.1
# of Fλ − d: where Gᵀμ is nearly all of it, as where gaps are large, it is taken out of d
MOST = 0.1
# times Fλ − d: multipliers that are larger are rounding, for Gᵀμ is to be as large as that
WILD = 1e3
# of a way along a face that is curved, where q is not low enough at its end
SHORTER = 0.5
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

    Attributes:
        qp: The same program, but for a d' = d + Gᵀμ', which adds a constant to q.
        point: λ and Fλ − d'.
        s: Multipliers of Ω: Fλ − d' − Gᵀμ; 0 where λ is free, if it is optimal.
        mu: Multipliers μ of Gλ = e in the program with d'.
        back: The nearest feasible point to λ − ᾱ(Fλ − d).
        residual: ‖g^P‖, g^P = (λ − back)/ᾱ.
        norm: Estimate of ‖F‖; ᾱ is its inverse.
        rounding: What rounding may make of ‖g^P‖ alone.
    """

    def __init__(self, qp: QP, homogenised: Homogenised) -> None:
        self._given, self._homogenised = qp, homogenised
        self.qp = self._qp = replace(qp, d=qp.d.copy())
        self._comm = qp.d.getComm().tompi4py()
        self.point = Point(homogenised.lam_bar.copy(), homogenised.gradient.copy())
        self.s, self._work = qp.d.duplicate(), qp.d.duplicate()
        self.back: PETSc.Vec | None = None
        self.mu: Array = np.zeros(qp.coarse.dimension)
        self._taken: Array = np.zeros(qp.coarse.dimension)
        self._set_multipliers()
        self.residual, self._best, self.norm, self.rounding = np.inf, np.inf, 1.0, 0.0
        self._idle = self._slow = 0

    def face(self) -> Face:
        """The face of λ."""
        return self._qp.feasible.face(self.point.lam.array_r, self.s.array_r)

    def pressed_face(self) -> Face:
        """The face of ``back``: a row that carries less than it is open by, λ_i < ᾱs_i, is open.

        Where forces are rounding of 0 they do not say which rows touch.
        """
        if self.back is None:
            return self.face()
        return self._qp.feasible.face(self.back.array_r, self.s.array_r)

    def multipliers_on(self, faces: FaceSolver) -> None:
        """μ and s that belong to the face entered.

        A face that lacks rank says nothing of motions that it leaves free, but its factor may.
        """
        last, self.mu = self.mu, faces.coarse.coordinates(self.point.g)
        self._set_multipliers()
        self.mu = self.mu + faces.coarse.coordinates(self.s)  # rounding of Fλ − d, not of s
        self._set_multipliers()
        if agreed(self._comm, self.s.norm() > WILD * self.point.g.norm()):
            self.mu = last
            self._set_multipliers()

    def look(self, faces: FaceSolver) -> None:
        """Optimality: how far a gradient step, brought back to the feasible set, moves."""
        self._set_multipliers()
        if faces.norm == 0.0:
            faces.see(self.point, self.s)
        self.norm = faces.norm or 1.0
        if faces.settled:
            self.multipliers_on(faces)
        target = self.point.lam.copy()
        target.axpy(-1.0 / self.norm, self.s)  # not Fλ − d: what Gᵀμ takes from it may be large
        found = nearest(self._qp.coarse, self._qp.feasible, target)
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
        self.rounding = agreed(self._comm, LOST * self.norm * self.point.lam.norm())
        self._idle, self._slow = self._idle + 1, self._slow + 1
        if self.residual <= 0.5 * self._best:
            self._best, self._idle, self._slow = self.residual, 0, 0

    def _set_multipliers(self) -> None:
        self._qp.coarse.combine(self.mu, self.s)
        self.s.aypx(-1.0, self.point.g)

    def _take_out(self) -> None:
        """Put Gᵀμ into d', where it is most of Fλ − d'. q changes by a constant."""
        if agreed(self._comm, self.s.norm() > MOST * self.point.g.norm()):
            return
        self._taken, self.mu = self._taken + self.mu, np.zeros_like(self.mu)
        self._qp.coarse.combine(self._taken, self._qp.d)
        self._qp.d.axpy(1.0, self._given.d)
        self.s.copy(self.point.g)

    def wanted_face(self, gamma: float, faces: FaceSolver) -> Face:
        """What carries force, and what wants to, if that is most of what is wrong.

        The rest is what PCPG has left on the face, if it has stopped at λ.
        """
        lam, s, feasible = self.point.lam.array_r, self.s.array_r, self._qp.feasible
        phi, beta = feasible.split(lam, s)
        phi = feasible.reduced(lam, phi, 1.0 / self.norm)  # what soon stops at a bound is little
        within = self.face().restricted(beta)  # along a boundary that is curved
        beta = beta - within
        sums = np.array([phi @ phi + within @ within, beta @ beta])
        free, chopped = self._comm.allreduce(sums, op=MPI.SUM)
        if faces.settled:
            free = faces.left**2
        if agreed(self._comm, chopped > gamma**2 * free):
            moved = feasible.project(lam - beta / self.norm)
            return feasible.face(0.5 * (lam + moved), s)
        return self.face()

    def begun(self, face: Face) -> tuple[Point, Face]:
        """Where the solve on a face starts, and on which: λ, or ``back`` where more slips there."""
        back = self.point.lam if self.back is None else self.back
        return slipping_start(self.qp, self.point, face, back, self.pressed_face())

    def accept(self, trial: Trial, faces: FaceSolver) -> bool:
        """Go where q falls enough: trial, the feasible part of its first step, or downhill.

        Returns:
            Whether q could be lowered.
        """
        known = np.isfinite(self.residual)
        enough = ENOUGH * 0.5 / self.norm * self.residual**2 if known else 0.0
        gain = self.gain(trial.last)
        import os
        more = int(os.environ.get("MORE", "2"))
        while more and trial.feasible and trial.rounds > 1 and agreed(self._comm, gain < enough) and not faces.contradicts:
            longer = faces.go_on(trial)
            if longer is None:
                break
            trial, gain, more = longer, self.gain(longer.last), more - 1
        hidden = ROUNDING * slipping_work(self.point.lam, self.s, trial.face)
        stays = gain <= 0.0 and self._idle > 1  # what is left is not on the face, but maybe Gλ ≠ e
        if trial.feasible and agreed(self._comm, gain >= enough - hidden and not stays):
            self._take(trial.last, gain)
            faces.settle()
            return True
        faces.forget()
        length = trial.feasible_part(self._qp.feasible, self.point)
        curved = is_curved(self.qp, trial.face)
        shares = [length] if not curved or trial.rounds > 1 else []
        shares += [SHORTER * length, SHORTER**2 * length] if curved else []
        for share in agreed(self._comm, brought_parts(curved, length, self._slow > 0)):
            if self._went_to(projected_part(self.qp, self.point, trial.first, share), enough):
                return True
        taken = any(self._shortened(trial, share, curved, enough) for share in shares)
        return taken or self._descend(known, faces)

    def _shortened(self, trial: Trial, length: float, curved: bool, enough: float) -> bool:
        """Go a part of the first solve's way, if q falls enough there."""
        shorter, held = part_of_way(self.point, trial.first, length), length > 0.0
        if curved:
            held = brought_back(self.qp, trial.face, shorter) and held
        else:
            shorter.lam.array[:] = self._qp.feasible.project(shorter.lam.array_r)
        return self._went_to(shorter, enough, held)

    def _went_to(self, to: Point, enough: float, may: bool = True) -> bool:
        """Go there if q falls enough; the point is taken over."""
        gain = self.gain(to)
        taken = agreed(self._comm, may and gain >= enough)
        if taken:
            self._take(to, gain)
        to.destroy()
        return taken

    @property
    def stalled(self) -> bool:
        """Whether q and ‖g^P‖ have not come down any more for long."""
        return agreed(self._comm, self._idle >= PATIENCE or self._slow >= LONG)

    def _take(self, to: Point, gain: float) -> None:
        """Go there; a gain that stands out from the rounding of q is worth more steps."""
        self._went_down(gain)
        self.point.take(to)

    def _went_down(self, gain: float) -> None:
        """See whether q came down by what is no rounding of it."""
        sizes = abs(self.point.lam.dot(self.point.g)) + abs(self.point.lam.dot(self._qp.d))
        if gain > (0.0 if self.residual > FAR * self.rounding else ROUNDING * sizes):
            self._idle = 0

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

    def _descend(self, known: bool, faces: FaceSolver) -> bool:
        """The projected gradient step, or the part of it where q is least."""
        if not known:
            self.look(faces)
        assert self.back is not None
        p, Fp = self.back.copy(), self._work
        p.axpy(-1.0, self.point.lam)
        self._qp.F.mult(p, Fp)
        slope, curvature, size = -self.s.dot(p), p.dot(Fp), p.dot(p)
        if size > SHORT**2 * self.point.lam.dot(self.point.lam):
            faces.saw(curvature, size)
        length = min(1.0, slope / curvature) if curvature > 0.0 else 1.0
        moved = agreed(self._comm, size > 0.0 and slope > 0.0)
        if moved:
            self._went_down(length * slope)
            self.point.move(length, p, Fp)
            self.point.lam.array[:] = self._qp.feasible.project(self.point.lam.array_r)
        p.destroy()
        return moved

    def result(self, reason: ConvergedReason, steps: Steps) -> QPResult:
        """The answer; takes λ and s over."""
        moved = self.point.lam.copy()
        moved.axpy(-1.0, self._homogenised.lam_bar)
        equality = self._qp.coarse.norm_Q(moved)
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
        for vec in (self.s, self._work, self._qp.d, self.back):
            if vec is not None:
                vec.destroy()
