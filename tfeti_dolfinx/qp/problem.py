"""The quadratic program, and what its solvers have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, field
from enum import IntEnum
from functools import partial
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, dot_over, norm_over
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.recycling import Recycled
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status, face_at

# --- The quadratic program and its result -----------------------------------------------------
# Vectors are this rank's parts, in the layout of all rows, shape ``(m,)``.

# A x of a symmetric A, as a new vector; collective
Operator = Callable[[Array], Array]


class FaceOperator(Protocol):
    """An operator that belongs to a face."""

    def __call__(self, x: Array) -> Array:
        """A x. Collective."""

    def destroy(self) -> None:
        """Free what it holds. Collective."""


@dataclass(frozen=True)
class Point:
    """Multipliers and their gradient."""

    lam: Array  # λ
    g: Array  # F λ − d, on all rows


@dataclass(frozen=True)
class QP:
    """min ½λᵀFλ − λᵀd subject to Gλ = e, λ ∈ Ω."""

    F: Operator  # symmetric positive semidefinite operator
    d: Array  # linear term
    coarse: Coarse  # projectors of G, and a particular solution of Gλ = e
    feasible: FeasibleSet  # the set Ω
    preconditioner: Operator | None = None  # approximate inverse of F, or None
    # estimate of ‖PFP‖ for solvers whose step lengths are relative to it; for others the largest
    # Rayleigh quotient of F that earlier solves have seen; 0 if there were none
    norm: float = 0.0
    # gives an approximate inverse of ZᵀFZ for a face Z, between vectors of the face in the layout
    # of all rows, until it is asked for another; or None
    preconditioner_on: Callable[[Face], Operator] | None = None
    # directions of earlier solves, which those of PCPG are made F-orthogonal to
    recycled: Recycled | None = None
    # forces of a rank's rows if each were a spring that its gap presses, as stiff as bodies are
    # where so many rows carry together; None: unknown
    foundation: Callable[[int], Array] | None = None
    sprung: bool = False  # whether rows of soft springs are among those that balance the load
    # F to single precision, for steps whose residuals an exact F sets right now and then; None: F
    rough: Operator | None = None

    def roughly(self, x: Array) -> Array:
        """Return Fx to single precision or better, whichever costs less. Collective."""
        return self.F(x) if self.rough is None else self.rough(x)

    def moved(self, at: Point, lam: Array) -> Point:
        """Return λ with Fλ − d, known at another point; multiply once. Collective."""
        if self.rough is None:
            return Point(lam, self.F(lam) - self.d)
        return Point(lam, at.g + self.rough(lam - at.lam))  # its error is that of the way alone

    def dot(self, *pairs: tuple[Array, Array]) -> list[float]:
        """Return xᵀy of pairs of vectors, rank 0's on every rank. Collective."""
        return dot_over(self.coarse.comm, *pairs)


class ConvergedReason(IntEnum):
    """Reasons of a solver to stop; positive: converged. Values as in KSPConvergedReason, if there.

    ITERATING: it has not stopped.
    CONVERGED_FRICTION_RTOL: the bounds of Coulomb's friction are at rest to ``friction_rtol``, and
        u is right to rtol for them, but what they leave of the law is more than rtol allows.
    DIVERGED_ROUNDING: residuals cannot be brought down any further in floating point.
    DIVERGED_STALLED: Gλ = e comes no nearer, as if nothing in Ω fulfilled it.
    DIVERGED_FRICTION: the bounds of friction do not come to rest.
    DIVERGED_CONTRADICTION: q falls forever along forces that F and G do not see: rows that depend
        on each other exclude each other.
    """

    CONVERGED_RTOL = 2
    CONVERGED_ATOL = 3
    CONVERGED_FRICTION_RTOL = 20
    ITERATING = 0
    DIVERGED_ITS = -3
    DIVERGED_INDEFINITE_MAT = -10
    DIVERGED_ROUNDING = -20
    DIVERGED_STALLED = -21
    DIVERGED_CONTRADICTION = -22
    DIVERGED_FRICTION = -23


@dataclass
class Steps:
    """Steps that a solver has taken, by their kind, and faces."""

    outer: int = 0
    faces: int = 0
    cg: int = 0
    expansion: int = 0
    proportioning: int = 0

    @property
    def inner(self) -> int:
        """All inner steps."""
        return self.cg + self.expansion + self.proportioning

    def plus(self, other: Steps) -> Steps:
        """Return the steps of both."""
        return Steps(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


@dataclass
class QPResult:
    """Result of a QP solver."""

    lam: Array  # the multipliers λ
    mu: Array  # multipliers μ of Gλ = e: the gradient is P(Fλ − d) + Gᵀμ
    gradient: Array  # Fλ − d up to the range of Gᵀ; on bound components the multiplier ν
    face: Face  # the face of λ, in which rows that carry a force are free
    reason: ConvergedReason  # why the solver stopped
    projected_gradient: float  # ‖g^P‖ at the end
    equality: float  # ‖Q x‖ at the end, x the homogenised unknown
    reference: float  # b₀ = ‖P(d − F λ̄₀)‖
    norm: float  # estimate of ‖F‖ that ‖Q x‖ is weighted with; 0 where nothing has shown it
    steps: Steps = field(default_factory=Steps)  # steps taken
    # local rows that exclude each other, or slip, if that is why the solver stopped
    excluding: Array = field(default_factory=lambda: np.empty(0, dtype=np.int64))


# --- Homogenisation: λ = x + λ̄ with Gλ̄ = e, so that Gx = 0 --------------------------------------

# of the terms that a residual is the difference of: what rounding leaves of it at least, and
# below how many times that rounding may be the reason of anything strange
ROUNDING, STRANGE = 1e-14, 1e8
# of open gaps: what drives the others is less, and would be lost in what P spreads of the gaps
FAR_OPEN = 1e-6


def product(F: Operator, comm: MPI.Intracomm, x: Array) -> Array:
    """F x; multiplies once if x ≠ 0. Collective."""
    return F(x) if any_rank(comm, x) else np.zeros(len(x))


@dataclass(frozen=True)
class KnownProduct:
    """A vector x with the product Fx, this rank's parts; empty: none is known."""

    x: Array = field(default_factory=lambda: np.zeros(0))
    Fx: Array = field(default_factory=lambda: np.zeros(0))
    within: float = 0.0  # Fx stands for that of all vectors that are as near to x

    def multiple(self, comm: MPI.Intracomm, x: Array) -> Array:
        """Return F of a multiple of this vector, or an empty array if x is none. Collective."""
        if any_rank(comm, self.x.shape != x.shape):
            return np.zeros(0)
        square, along = dot_over(comm, (self.x, self.x), (self.x, x))
        c = along / square if square else 1.0
        found = norm_over(comm, x - c * self.x) <= ROUNDING * norm_over(comm, x)
        return c * self.Fx if found else np.zeros(0)

    def image(self, F: Operator, comm: MPI.Intracomm, x: Array) -> Array:
        """Return Fx of any x; multiply only where it is not known. Collective."""
        known = self.multiple(comm, x)
        if self.within > 0.0 and not any_rank(comm, x.shape != self.x.shape):
            known = self.Fx if norm_over(comm, x - self.x) <= self.within else known
        return known if any_rank(comm, known.size > 0) else product(F, comm, x)


@dataclass(frozen=True)
class Start:
    """Start of a solver: min ½xᵀPFPx − bᵀx subject to Gx = 0, x + λ̄ ∈ Ω, and an earlier λ."""

    at: Point  # λ̄
    b: Array  # P(d − F λ̄)
    reference: float  # size of residuals, b₀
    rounding: float  # what rounding leaves of b₀ where it should be 0
    lam: Array | None = None  # multipliers of an earlier solve, if there was one
    mu: Array | None = None  # those of Gλ = e, if they are of this K⁺: others say nothing


def homogenise(
    qp: QP, lam: Array | None = None, Fx: Array | None = None, warm: bool = False
) -> Start:
    """Homogenise a quadratic program. Collective.

    Args:
        qp: The program.
        lam: λ̄, a solution of Gλ̄ = e; default λ̄₀.
        Fx: F λ̄; by default it costs a multiplication if λ̄ ≠ 0.
        warm: Whether λ̄ may be the solution. ‖P d‖ and ‖P F λ‖ are equal there, and b₀ is ‖P d‖
            where e = 0: the larger one is taken.
    """
    project, norm = qp.coarse.project, partial(norm_over, qp.coarse.comm)
    lam = qp.coarse.particular() if lam is None else lam
    Fx = product(qp.F, qp.coarse.comm, lam) if Fx is None else Fx
    # 1. b; d on rows that are open without forces: P would spread it over all others
    gradient = Fx - qp.d
    residual = project(gradient)
    face = face_at(qp.feasible, qp.feasible.project(np.zeros(len(qp.d))), -qp.d)
    gaps = np.where(face.free | (face.beta != 0.0), 0.0, qp.d)
    b = project(-gradient - gaps)
    b = b + gaps if norm(b) <= FAR_OPEN * norm(gaps) else -residual
    # 2. the size of residuals, and its rounding, to which open gaps, however wide, do not count
    size = max(norm(project(qp.d)), norm(project(Fx))) if warm else norm(residual)
    face = face_at(qp.feasible, qp.feasible.project(lam), residual)
    # P makes of gaps a gradient of rows that nothing closes yet: d is negative there
    counts = face.free | ((face.beta != 0.0) & (qp.d > 0.0))
    rounding = ROUNDING * sum(norm(np.where(counts, x, 0.0)) for x in (qp.d, Fx))
    return Start(Point(lam, gradient), b, size, rounding)


# --- Stopping rules ---------------------------------------------------------------------------


@dataclass
class StoppingRule:
    """Stopping rule for the residuals of an iterate; this one is content with small residuals.

    A solver compares max(‖g^P‖, ‖F‖‖Qx‖) with ``tolerance`` in every step. Where it is small
    enough, the iterate is examined; an examination that is not content lowers the tolerance.
    """

    tolerance: float  # norm of the residuals from which on an examination is worth its price
    # whether an examination is to wait for solves on faces, whatever they aim at
    waits: bool = False
    # Fλ − d of the iterate examined, if the examination has found it; it is exact
    gradient: Array | None = None

    def examine(
        self, lam: Array, gradient: Array, face: Face, residual: float, norm: float
    ) -> ConvergedReason:
        """Examine an iterate whose residuals are small. Collective.

        ``gradient`` is Fλ − d up to the range of Gᵀ, ``residual`` max(‖g^P‖, ‖F‖‖Qx‖), ``norm``
        ‖F‖, or an estimate, or 0: residuals over it are errors of multipliers. Return why to stop,
        or ITERATING; then ``tolerance`` is below ``residual``.
        """
        small = residual <= self.tolerance
        return ConvergedReason.CONVERGED_RTOL if small else ConvergedReason.ITERATING


# --- Monitors ---------------------------------------------------------------------------------


# called on all ranks after each step, and may communicate: with the steps so far; the kind of this
# one: start, cg, expansion, proportioning, outer; the iterate, this rank's part; ‖g^P‖ there; and
# ‖Q x‖, how far Gλ = e is from being met, negative where it was not computed
Monitor = Callable[[Steps, str, Array, float, float], None]


def no_monitor(*step: Any) -> None:
    """Say nothing."""


def printing(
    comm: MPI.Intracomm, feasible: FeasibleSet, multiplications: Callable[[], int]
) -> Monitor:
    """Print a line per step on rank 0: outer iteration, step, ‖g^P‖, ‖Qx‖ if known, and counts.

    They are of rows that the set constrains and that carry a force, and of multiplications by F.
    """
    if comm.rank == 0:
        print("outer step                |gP|        |Qx|  touching  iterations", flush=True)

    def monitor(steps: Steps, step: str, x: Array, gradient: float, equality: float) -> None:
        face = feasible.face(x, np.zeros(len(x)))
        touching = comm.allreduce(int(np.sum((face.status != Status.FREE) & face.carrying)))
        if comm.rank == 0:
            known = f"{equality:.4e}" if equality > 0.0 else ""
            figures = f"{gradient:.4e}  {known:10s}  {touching:8d}  {multiplications():10d}"
            print(f"{steps.outer:5d} {step:<13s} {figures}", flush=True)

    return monitor
