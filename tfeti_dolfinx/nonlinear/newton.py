"""Newton's method with the contact inside: tolerances, models that are kept, acceleration."""

from dataclasses import dataclass, field

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import bcast_from_root, summed


@dataclass(frozen=True)
class NewtonTolerances:
    """Tolerances of Newton's method with the contact inside.

    Attributes:
        max_it: Most linearised problems in a load step.
        safety: What the next increment is expected to be is multiplied with, before it is compared
            with the tolerance.
        forcing: Share of the expected increment to which a linearised problem is solved (the
            forcing term of Eisenstat and Walker); None: 1.5, in finite strain 0.3, where a rough
            displacement opens contacts that the next step has to close again, and makes tangents
            and places anew.
        loosest: Relative tolerance of a linearised problem at most; None: 0.1, in finite strain
            0.01.
        finer: In small strain, where an increment is more than ``slow`` of the last one, the next
            problem's tolerance is at most this share of the last one's: increments may be errors of
            linearised problems, as of where a body is that slides on all sides.
        steepest: In small strain forcing expects the next increment to be at least this share of
            the last one: the slope along one step does not see all that is left. Nor does the end.
        flattest: And at most this: at that of a kept tangent a new one would be solved to more
            than it moves.
        near: In small strain a linearised problem that comes within this factor of ``rtol`` is the
            last but one, as a rule. In finite strain increments within it say nothing of
            ``turning``: they are what tolerances of linearised problems leave, too.
        last: It is solved to this factor of ``rtol``, which leaves little to the last one.
        nothing: Of the displacement where the load step began: less is rounding of 0, as of bodies
            that are let go.
        negligible: Of ``rtol`` and of a body's displacement there: less is no part of the answer,
            as in bodies that are unloaded.
        nowhere: Of the length of the model, in finite strain: less is rounding of where bodies are.
        curvature: A step is shortened where the residual along it, contact forces included, has
            at its end more than this share of its value at its begin, with the other sign; None:
            0.3, in finite strain 0.5, where places are new after a shortened step.
        max_line_search: Most residuals that a line search assembles.
        rounding: Share of dᵀD d, D the diagonal of J, that is rounding of dᵀJ d: a rigid step has
            no energy.
        shortest: Length at which a step that turns cells inside out is given up.
        settled: In small strain a tangent is kept, with its factors, where the last increment was
            at most this share of the load step's first one: its directions of conjugate gradients
            then serve the next problems, too.
        frozen: In finite strain tangent and places are kept until the increment is at most this
            share of the first one that they gave.
        turning: Where the first increment with new places is more than this share of that with the
            last ones, contact changes more by where bodies are than by their stresses: from then on
            places are new for each linearised problem.
        anderson: Earlier iterates that Anderson's acceleration combines; 0: none, it is off.
        dependent: Eigenvalues of the Gram matrix of its differences below this share of the largest
            are taken for 0.
        share: In small strain ready laws of plasticity begin with this share of the elastic moduli
            in their tangents, see ``Regularisation``; 0: none.
        undershot: Of the residual along a step a tangent with a share may leave this much.
        slow: A kept model is made anew where an increment is more than this share of the last one.
        difference: Length of the step, of the displacement, of the difference quotient that a
            given J is compared with where Newton's method has failed.
        another: Of J along a step: a difference beyond it is that of another tangent.
        bends: Of a body's step: less strain makes the step a rigid motion, which is named then.
        turned: Angle by which a body is turned to see whether F is one of finite strain.
        alike: Of the residual of a stretch: residuals nearer to each other are the same.
    """

    max_it: int = 50
    safety: float = 10.0
    forcing: float | None = None
    loosest: float | None = None
    finer: float = 0.1
    steepest: float = 0.1
    flattest: float = 0.25
    near: float = 20.0
    last: float = 2.0
    nothing: float = 1e-12
    negligible: float = 1e-3
    nowhere: float = 1e-13
    curvature: float | None = None
    max_line_search: int = 12
    rounding: float = 1e-11
    shortest: float = 0.01
    settled: float = 0.05
    frozen: float = 0.1
    turning: float = 0.03
    anderson: int = 3
    dependent: float = 1e-12
    share: float = 0.1
    undershot: float = 0.3
    slow: float = 0.7
    difference: float = 1e-6
    another: float = 0.3
    bends: float = 0.1
    turned: float = 0.1
    alike: float = 1e-6


@dataclass
class ModelKeeping:
    """Decides whether the next linearised problem has the model of the last one.

    That is J with its factors, and in finite strain the rows of the same places, too.
    """

    tolerances: NewtonTolerances
    finite: bool
    freezes: bool = True  # whether places are kept: until bodies turn while they are
    # increments: the first of a load step, the first of a model, and the last one
    first: float = 0.0
    of_model: float = 0.0
    before: float = np.inf

    def begin(self) -> None:
        """Begin a load step."""
        self.first, self.of_model, self.before = 0.0, 0.0, np.inf

    def keeps(self, kept: bool, size: float, t: float, near: float) -> bool:
        """Return whether to keep the model after an increment and its length t.

        ``kept``: it is that of the linearised problem before. Increments up to ``near`` are near
        the tolerance.
        """
        tol = self.tolerances
        self.first, slow = self.first or size, kept and size > tol.slow * self.before
        if self.finite:
            if not kept:
                turns = self.of_model > 0.0 and size > max(tol.turning * self.of_model, near)
                self.freezes, self.of_model = self.freezes and not turns, size
            good = self.freezes and (not kept or size > tol.frozen * self.of_model)
        else:
            good = size <= tol.settled * self.first
        self.before = size
        return good and t == 1.0 and not slow


@dataclass
class Regularisation:
    """Decides what share of the elastic moduli plastic points have in the tangent.

    Consistent tangents are soft where a point yields, and a step goes too far where it unloads:
    points yield and unload in turn, and steps are shortened for a few of them. With a share of the
    elastic moduli steps go less far, and linearised problems have moduli that differ less. Where a
    body flows as a whole such a tangent is too stiff. So the share decreases as that of Levenberg's
    and Marquardt's method (Nocedal, Wright, Numerical Optimization, 2006, section 10.3): with a
    stiffness a along a step, and b from the share, b/(a + b) of the residual is left.
    """

    tolerances: NewtonTolerances
    shares: list[fem.Constant]  # of the laws

    def __post_init__(self) -> None:
        for share in self.shares:
            share.value = self.tolerances.share

    def leave(self) -> None:
        """Leave tangents as laws have them from here on, as where Newton's method has failed."""
        for share in self.shares:
            share.value = 0.0

    def follow(self, left: float, kept: bool) -> None:
        """Set the next share, where a step with a tangent of its own leaves so much."""
        most = self.tolerances.undershot
        if left > most and not kept:
            found, wanted = (x / (1.0 - x) for x in (min(left, 0.99), most))  # b/a
            for share in self.shares:
                share.value *= wanted / found


@dataclass
class Anderson:
    """Anderson's acceleration of u ← u + d: the last differences of d in least squares."""

    tolerances: NewtonTolerances
    comm: MPI.Intracomm
    past: list[tuple[Array, Array]] = field(default_factory=list)  # u and d of the last iterates

    def next(self, u: Array, d: Array) -> Array:
        """Return the next iterate after u, whose step is d. Collective."""
        end = moved = u + d
        if self.past:
            places, steps = (np.array(known).T for known in zip(*self.past, strict=True))
            steps = d[:, None] - steps
            gram = summed(self.comm, steps.T @ np.column_stack((steps, d)))
            gram = bcast_from_root(self.comm, gram)
            rcond = self.tolerances.dependent
            share = np.linalg.lstsq(gram[:, :-1], gram[:, -1], rcond=rcond)[0]
            moved = end - (u[:, None] - places + steps) @ share
        most = self.tolerances.anderson
        self.past = [*self.past, (u, d)][-most:] if most else []
        return moved
