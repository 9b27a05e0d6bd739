"""The dual problem of a scene: Blocks and rows in, a quadratic program out."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.parallel import any_rank, largest, norm_over
from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.feti.coarse import CoarseSpace
from tfeti_dolfinx.feti.operator import (
    DualOperator,
    LateDirichlet,
    MakePreconditioner,
    chosen_preconditioner,
    dirichlet_preconditioner,
    mean_stiffness,
    scaled_rows,
)
from tfeti_dolfinx.feti.preconditioner import Deflation, FacePreconditioner, MakeDeflation
from tfeti_dolfinx.feti.solvability import check_solvable
from tfeti_dolfinx.qp.krylov import estimate_norm
from tfeti_dolfinx.qp.problem import QP, KnownProduct
from tfeti_dolfinx.qp.recycling import Recycled
from tfeti_dolfinx.qp.sets import Bounds, Ellipses, FeasibleSet, Product
from tfeti_dolfinx.subdomains.local_operators import LocalOperator
from tfeti_dolfinx.subdomains.subdomains import Subdomains


@dataclass(frozen=True)
class DualLimits:
    """Limits of a dual problem."""

    # times the forces and lengths that load, values and gaps make: multipliers of an earlier
    # problem that are larger would leave so many digits less to the solution
    far: float = 1e3
    # of stiffness, lengths and forces: below it squares leave the range of floating point
    least: float = 1e-130
    most: float = 1e130  # the same above
    parallel: float = 1e-12  # loads whose directions differ by less are held by the same contacts
    # directions kept where options do not say how many: later ones gain hardly anything, and each
    # takes two vectors
    recycled: int = 200
    # in space, stiffness of springs that rows begin on over that of a half space: a ball touches
    # such springs, which do not move their neighbours, on a larger area than a half space
    stiffer: float = 1.5


LIMITS = DualLimits()

# from B and c to the set of multipliers, on all local rows; rows of no set are free, and hold what
# they multiply. A row's force is s_i λ_i (``scale`` and ``tangent_scale`` of ``ContactRows``)
FeasibleLaw = Callable[[Constraints], FeasibleSet]


def contact_set(constraints: Constraints) -> FeasibleSet:
    """λ_N ≥ 0, and λ_T of each condition with friction in its disc or ellipse: no adhesion."""
    sets, normals = constraints.sets, (constraints.sets.normals, Bounds())
    if sets.tangents.size == 0:
        return Product([normals])
    return Product([normals, (sets.tangents.ravel(), Ellipses(constraints.limits))])


class Dual:
    """F, G, d and e of a scene. Creation and all methods are collective.

    Creation raises an InputError where squares of stiffness, load or values leave the range of
    floating point; a NoSolutionError where the load moves a body that nothing holds; a FactorError
    where a matrix could not be factored. ``names`` are those of bodies and of their modes, for
    messages; ``without`` names mechanisms that are switched off (``options.MECHANISMS``);
    ``recycle`` is how many directions of earlier solves are kept, ``"auto"``: none before
    ``learn``.

    Attributes:
        F: B K⁺ Bᵀ; ``rough``: F to single precision where that costs less, else None.
        d: B K⁺ f − c, this rank's part.
        preconditioner: The preconditioner, or None; ``late``: itself, where it may change.
        coarse: The coarse space.
        deflation: Coarse space of the preconditioner, as clusters have one; else None.
        contact_rows: Number of normal and of tangential rows on all ranks.
        norm: Largest estimate of ‖F‖ that solves have come to, 0 before; ``norm_count``: what the
            last ``qp`` has multiplied by F for ‖PFP‖, beside the count of F.
        law_target: Rtol of the last solve by Newton's method on Coulomb's law, and what share of
            the residual of its start was little enough.
        make_feasible: Makes the set of multipliers from B and c.
        feasible: The set Ω of multipliers.
        pressures: The λ_N whose friction bounds Ω under Coulomb's law, of each point of
            ``constraints.sets.tangents``; nan elsewhere, and before ``bound_friction``.
        last: The last solution of block Newton, or without a kernel, with its image; ``solved`` are
            d and e of its program.
        recycled: Directions of earlier solves; None: none are kept.
        begin, negligible: As ``begin_solve`` has it.
    """

    def __init__(
        self,
        constraints: Constraints,
        subdomains: Subdomains,
        names: tuple[Sequence[str], Sequence[str]],
        *,
        preconditioner: MakePreconditioner | None,
        prefix: str,
        feasible: FeasibleLaw,
        deflation: MakeDeflation | None,
        without: Collection[str],
        recycle: int | str,
        dimension: int,
    ) -> None:
        self.constraints, self.subdomains = constraints, subdomains
        self._given = constraints  # before ``bound_friction``
        self._without, self._dimension = without, dimension
        B, weights, comm = constraints.B, constraints.weights, constraints.B.getComm().tompi4py()
        kept = recycle if isinstance(recycle, int) else 0
        # 1. d
        self._stiffness = largest(comm, subdomains.diagonal)
        self._set_linear_term(comm)
        # 2. F, and M on all rows, from B_D
        self.F = DualOperator(B, subdomains.local_operator("pinv"))
        self.rough = None if kept else self.F.rough
        self.preconditioner: DualOperator | None = None
        self._scaled: PETSc.Mat | None = None
        makes_schur = preconditioner in (dirichlet_preconditioner, chosen_preconditioner)
        if preconditioner is not None:
            self._scaled = scaled_rows(B, weights)
            if makes_schur and "smooth_displacements" in without:
                schur = subdomains.local_operator("schur")
                self.preconditioner = DualOperator(self._scaled, schur)
            else:
                self.preconditioner = preconditioner(self._scaled, subdomains)
        self.late = self.preconditioner if isinstance(self.preconditioner, LateDirichlet) else None
        self._schur: LocalOperator | None = None
        if self.preconditioner is not None and makes_schur and self.late is None:
            self._schur = self.preconditioner.local
        # 3. on rows of springs F is 1/σ, M is σ
        sigma = mean_stiffness(subdomains, weights) if subdomains.num_springs else 1.0
        if subdomains.num_springs:
            on_springs: Array = np.zeros(constraints.num_rows)
            on_springs[constraints.sets.springs] = 1.0
            self.F.added = on_springs / sigma
            if self.preconditioner is not None:
                self.preconditioner.added = sigma * on_springs
        # 4. G and e, and M on faces
        of_coarse = f"{prefix}coarse_"
        self.coarse = CoarseSpace(constraints, subdomains, names, sigma, of_coarse)
        self.deflation: Deflation | None = None
        self._on_faces: FacePreconditioner | None = None
        if (M := self.preconditioner) is not None:
            if deflation is not None:
                self.deflation = deflation(B, self.coarse, weights, of_coarse)
            of_faces, diagonal = f"{prefix}face_", subdomains.diagonal
            self._on_faces = FacePreconditioner(M, constraints, diagonal, of_faces, self.deflation)
        # 5. Ω
        self.contact_rows = constraints.contact_rows
        self.make_feasible, self.feasible = feasible, feasible(constraints)
        self.pressures: Array = np.full(len(constraints.sets.tangents), np.nan)
        # 6. what solves leave for later ones, and what ``begin_solve`` tells them
        self._norms, self.norm_count = dict[int, float](), 0
        self.norm, self.last, self.law_target = 0.0, KnownProduct(), (0.0, 0.0)
        self.solved: tuple[Array, Array] = np.zeros(0), np.zeros(0)
        self._learns, self.recycled = recycle == "auto", Recycled(kept, comm) if kept else None
        self.begin: Array | float = 0.0
        self.negligible: Array | float = 0.0
        # 7. the load; what holds it holds its multiples
        self._held_load: Array | None = None
        self._check_solvable()

    def update_load(self, constraints: Constraints) -> None:
        """Take the Blocks' present loads, and the same rows with right sides and friction of now.

        Raise an InputError where squares of load or values leave the range of floating point; a
        NoSolutionError where the load moves a body that nothing holds.
        """
        self.constraints = self._given = constraints
        self._set_linear_term(self.coarse.comm)
        self.coarse.update_load()
        self._check_solvable()

    def _check_solvable(self) -> None:
        """Raise where the load drives a motion that nothing holds. Collective."""
        coarse, comm = self.coarse, self.coarse.comm
        if not coarse.dimension:
            return
        load = coarse.work(coarse.e)
        known, size = self._held_load, float(np.linalg.norm(load))
        if known is not None:
            apart = float(np.linalg.norm(load - size * known))
            if not any_rank(comm, apart > LIMITS.parallel * size):
                return
        self._held_load = None  # what holds a load holds its multiples, but for given limits
        check_solvable(coarse, self._given, self.pulling, load)
        limited = len(self._given.pressed) < len(self._given.sets.tangents)
        if not any_rank(comm, limited or size == 0.0):
            self._held_load = load / size

    @property
    def pulling(self) -> Array:
        """Rows of contact on this rank that may pull, as a set of one's own lets them."""
        normals, pull = self._given.sets.normals, np.full(len(self.d), -1.0)
        return normals[self.make_feasible(self._given).project(pull)[normals] < 0.0]

    def learn(self) -> None:
        """More solves come: keep directions, where options leave that open, and let S pay.

        From then on images are those of F itself: from rough ones solves would begin too far off.
        """
        self.rough = None
        if self._learns and self.recycled is None:
            self.recycled = Recycled(LIMITS.recycled, self.coarse.comm)
        if self.late is not None:
            self.late.lumped_for = 0

    def make_schur(self) -> LocalOperator:
        """Return S of this rank's subdomains: that of the preconditioner, or made for this.

        A late preconditioner is Dirichlet's from then on. Raise a FactorError where the stiffness
        inside of a subdomain could not be factored.
        """
        if self.late is not None:
            self.late.lumped_for = 0
            self.late.make_if_due()
            self._schur = self.late.local
        if self._schur is None:
            made = self.subdomains.local_operator("schur", once=True)
            with raised_on_all_ranks(self.coarse.comm):
                made.prepare()
            self._schur = made
        return self._schur

    def _set_linear_term(self, comm: MPI.Intracomm) -> None:
        """Make d = BK⁺f − c, and raise where squares leave floating point. Collective."""
        response = self.subdomains.pinv_load[self.subdomains.trace]
        self.d = self.constraints.jumps(response) - self.constraints.c
        length = largest(comm, self.driving)
        sizes = {"stiffness": self._stiffness, "displacements": length}
        sizes["forces"] = self._stiffness * length
        if not all(size == 0.0 or LIMITS.least <= size <= LIMITS.most for size in sizes.values()):
            found = ", ".join(f"{name} of {size:.1e}" for name, size in sizes.items())
            raise InputError(
                f"load, prescribed values and overlaps, over the stiffness, make {found}, whose "
                "squares leave the range of floating point; expected units in which all of these "
                f"are 0 or from {LIMITS.least:g} to {LIMITS.most:g}"
            )

    def bound_friction(self, pressures: Array | None) -> None:
        """Take λ_N of each of ``constraints.pressed`` to bound friction with; ∞ sticks.

        None: no rank has a pressed row.
        """
        self.constraints = self._given
        if pressures is not None:
            self.pressures[self._given.pressed] = pressures
            self.constraints = self._given.with_pressures(pressures)
        self.feasible = self.make_feasible(self.constraints)

    def begin_solve(self, begin: Array | float = 0.0, negligible: Array | float = 0.0) -> None:
        """Count multiplications from 0 on, of a solve in a load step.

        ``begin`` is where that began, shape ``(n,)``: bodies that nothing holds stay near;
        ``negligible`` are displacements of bodies that count as none, shape ``(bodies,)``.
        """
        self.begin, self.negligible = begin, negligible
        for operator in (self.F, self.preconditioner):
            if operator is not None:
                operator.count = 0
        self.coarse.factors.count = self.norm_count = 0
        if self.deflation is not None:
            self.deflation.factors.count = 0

    def qp(self, norm_steps: int = 0) -> QP:
        """Return the quadratic program; without kernel it has no coarse problem.

        Ω is made anew, since c may be another. ‖PFP‖ is estimated once, by so many Lanczos steps;
        0: not at all.
        """
        self.feasible = self.make_feasible(self.constraints)
        if norm_steps and norm_steps not in self._norms:
            before = self.F.count
            self._norms[norm_steps] = estimate_norm(self.F, self.coarse, norm_steps)
            self.norm_count, self.F.count = self.F.count - before, before
        on = self._on_faces
        return QP(
            self.F,
            self.d,
            self.coarse,
            self.feasible,
            preconditioner=None if on is None else on.on_all_rows(),
            norm=self._norms.get(norm_steps, self.norm),
            preconditioner_on=None if on is None else on.on_face,
            recycled=self.recycled,
            sprung=self.subdomains.num_springs > 0,
            rough=self.rough,
            foundation=None if "foundation" in self._without else self.foundation,
        )

    def foundation(self, count: int) -> Array:
        """Return −σc/n^(1/(d − 1)) for n rows that carry together, on local rows. Collective.

        One scaled row has about the stiffness σ of its nodes. Under n neighbours that are pressed
        alike a half space gives way by so many times as much, as their width says; in space σ is
        half as large again.
        """
        sigma = mean_stiffness(self.subdomains, self.constraints.weights)
        if self._dimension > 2:
            sigma *= LIMITS.stiffer
        softer = count ** (1.0 / max(self._dimension - 1, 1))
        return np.asarray(-sigma / softer * self.constraints.c)

    @property
    def driving(self) -> Array:
        """The part of d due to load, prescribed values, slips and overlaps; local rows."""
        c, normals = self.constraints.c, self.constraints.sets.normals
        d = np.array(self.d)
        d[normals] += np.maximum(c[normals], 0.0)
        return d

    def is_far(self, lam: Array, mu: Array) -> bool:
        """Return whether multipliers far exceed what the data explain, as after unloading.

        Forces and lengths both are: λ beside the least that balances the load; Fλ and Gᵀμ beside
        what drives the problem. The solution would be their small difference, with their rounding.
        Multiplies by F at most once, and not where λ is the last solution.
        """
        comm, coarse = self.coarse.comm, self.coarse
        least = coarse.particular()
        if 0.0 < norm_over(comm, lam) <= LIMITS.far * norm_over(comm, least):
            return False
        known = coarse.combined(mu) if len(mu) == coarse.dimension else least
        Fx = self.last.image(self.F, comm, lam)
        self.last = KnownProduct(lam, Fx)
        lengths = norm_over(comm, known) + norm_over(comm, Fx)
        return lengths > LIMITS.far * norm_over(comm, self.driving)

    def know(self, lam: Array, image: Array) -> None:
        """Take Fλ of another run, if some rank has it. Collective."""
        if any_rank(self.coarse.comm, image.size > 0):
            self.last = KnownProduct(lam, image)

    def destroy(self) -> None:
        """Destroy the PETSc objects."""
        own = (self.F, self._on_faces, self.deflation, self.preconditioner, self._scaled)
        for item in own:
            if item is not None:
                item.destroy()
