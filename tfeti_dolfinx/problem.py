"""The user's door: a contact problem from forms, conditions and contacts to a solution."""

import logging
import re
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.accuracy import Diagnostics, Estimates, estimate, goal_of, notes_of
from tfeti_dolfinx.common.agreement import agreeing, as_json, fields_in, sums_of
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import require_real_petsc
from tfeti_dolfinx.common.logging import stage
from tfeti_dolfinx.common.validation import checked_number, checked_type
from tfeti_dolfinx.constraints.gluing import Gluing, WarmStart
from tfeti_dolfinx.contact.partner import ContactPartner, Gap, checked_contacts, gaps_by_position
from tfeti_dolfinx.errors import ConvergenceError, InputError, NoSolutionError, TfetiError
from tfeti_dolfinx.extensions import Extensions, check_method, guarded
from tfeti_dolfinx.feti.dual import Dual
from tfeti_dolfinx.feti.recovery import let_go
from tfeti_dolfinx.forms.assembly import Forms
from tfeti_dolfinx.forms.checks import (
    check_mesh,
    check_same_space,
    checked_function,
    displacement_space,
    is_axisymmetric,
)
from tfeti_dolfinx.forms.dirichlet import check_conditions, listed_conditions
from tfeti_dolfinx.forms.fields import Freezable, Stress, checked_stress, checked_thickness
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.options import factor_options, parse_options
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.report import Outcome, Report, SolverCounts, added
from tfeti_dolfinx.saved_state import SavedState, check_state
from tfeti_dolfinx.settings import Settings
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.solve.coulomb import solve_with_friction
from tfeti_dolfinx.solve.solver import conclude
from tfeti_dolfinx.subdomains.factor import added_options
from tfeti_dolfinx.subdomains.subdomains import SubdomainMethod, Subdomains
from tfeti_dolfinx.system import System

log = logging.getLogger(__name__)

MAX_ROUNDS = 20  # of solves with more and more contact rows


class ContactProblem:
    """Linear elasticity with contact on a torn mesh, solved by Total FETI.

    Mirrors ``dolfinx.fem.petsc.LinearProblem``; all is collective. The package has an example.

    Args:
        a: Bilinear form on a Lagrange space of the torn mesh.
        L: Linear form; for no load ``ufl.ZeroBaseForm((v,))``.
        bcs: Dirichlet conditions; their values hold on all torn copies of a node.
        contacts: Obstacles and pairs of surfaces; none for a linear problem.
        decomposition: The torn mesh.
        stress: From a displacement to its 3×3 stress in UFL, for stress fields.
        thickness: What the forms were multiplied with, a number or a scalar in UFL: a thickness
            in 2D, 2πr if axisymmetric. Contact pressures are forces over areas times it.
        u: Function that takes the solution; default a new one.
        petsc_options: Options, with or without the prefix; the command line beats them.
        petsc_options_prefix: Prefix of the options.
        form_compiler_options: As in DOLFINx.
        jit_options: As in DOLFINx.
        extensions: Parts of one's own: a Block, a feasible set, a preconditioner, a K⁺, a monitor.
        boundary_elements: Which volumes get boundary elements.

    Attributes:
        form_name: Name of the bilinear form, for messages.
        u: The displacement of the last solve.
        report: Sizes, counters, residuals and times of the last solve.
        options: The options.
        dofs: Dof maps.
        time: What laws of rigid bodies are functions of; ``LoadSteps`` sets it.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    form_name: ClassVar[str] = "a"
    _system: System[Forms]
    # input whose functions are not those of the solution
    _unknown_before: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form,
        bcs: Sequence[fem.DirichletBC],
        contacts: Sequence[ContactPartner],
        decomposition: Decomposition,
        *,
        stress: Stress | None = None,
        thickness: Any = 1.0,
        u: fem.Function | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        petsc_options_prefix: str = "tfeti_",
        form_compiler_options: dict[str, Any] | None = None,
        jit_options: dict[str, Any] | None = None,
        extensions: Extensions | None = None,
        boundary_elements: SubdomainMethod | None = None,
    ) -> None:
        checked_type(
            decomposition, Decomposition, "decomposition", "what decompose or read_gmsh return"
        )
        self.decomposition, comm = decomposition, decomposition.comm
        with agreeing(comm, type(self).__name__) as given:
            require_real_petsc()
            self.options = parse_options(petsc_options, petsc_options_prefix)
            extensions = Extensions() if extensions is None else extensions
            checked_type(extensions, Extensions, "extensions", "tfeti_dolfinx.Extensions")
            for_factors = factor_options(petsc_options, petsc_options_prefix)
            own = guarded(extensions, self.options, comm)
            self._settings = Settings(self.options, petsc_options_prefix, for_factors, own)
            self.contacts = checked_contacts(contacts)
            self.bcs = listed_conditions(bcs)
            given |= {"a": a, "L": L, "bcs": self.bcs, "contacts": contacts, "thickness": thickness}
            given |= {"stress": stress, "u": u, "boundary_elements": boundary_elements}
            given |= {"form_compiler_options": form_compiler_options}
            given |= self._settings.given | self._given_besides()
        V = displacement_space(a, decomposition, self.form_name)
        self._seconds = dict(decomposition.seconds)  # of the next solve
        with stage("constraints", self._seconds):
            self.dofs = TornDofs(V, decomposition)
            check_conditions(self.bcs, self.dofs)
        self.u = fem.Function(V, name="displacement") if u is None else checked_function(u, V, "u")
        self._first = np.array(self.u.x.array)
        self._given_stress = stress
        self._stress: Freezable | None = None
        if stress is not None:
            with agreeing(comm, "stress(u)") as given:
                given["stress(u)"] = sigma = self._look_at_stress()
                check_mesh(sigma, "stress", decomposition.mesh)
        elif self.options.rtol == "auto":
            raise InputError(
                f"-{petsc_options_prefix}rtol auto: the problem has no stress to estimate the "
                "discretisation error from; expected ContactProblem(..., stress=sigma)"
            )
        self._counts, self._outcome = SolverCounts(), Outcome()
        self._rounding = 0.0  # of ‖u‖_K, in the last solution
        self._in_all: dict[str, float] = {}
        self._logged: set[str] = set()  # warnings
        self._solution: Solution | None = None
        self._let_go: Array = np.zeros(0, dtype=bool)  # flags of bodies that contact has let go
        self._start: WarmStart | None = None
        self._accepted: tuple[Solution, WarmStart] | None = None
        self._boundary_elements = boundary_elements
        self._thickness = checked_thickness(thickness, decomposition)
        if self.contacts:
            self.dofs.axisymmetric = is_axisymmetric(a, self.form_name, self._thickness)
        self.report = Report(seconds=self._seconds)
        with stage("assembly", self._seconds):
            forms = self._forms(a, L, V, form_compiler_options, jit_options)
        forms.thickness = self._thickness
        self._diagnostics = Diagnostics(self.dofs)
        if boundary_elements is not None:
            check_method(boundary_elements, extensions)
        self._system = System(
            forms, self.bcs, self.contacts, self.dofs, self._settings, boundary_elements
        )

    @property
    def solution(self) -> Solution:
        """Fields and contact states.

        Raises:
            InputError: There is none before ``solve``.
        """
        if self._solution is None:
            raise InputError("there is no solution yet; expected a call of solve() before")
        return self._solution

    @property
    def dual(self) -> Dual:
        """The dual problem of the last solve, for experts.

        Raises:
            InputError: There is none before ``solve``, and after ``destroy``.
        """
        return self._system.dual

    @property
    def time(self) -> float:
        """Time of the laws of rigid bodies, 0 at first."""
        return self._system.time

    @time.setter
    def time(self, time: float) -> None:
        self._system.time = checked_number(time, "time")

    # -------------------------------------------------------------------- solve

    def solve(self) -> fem.Function:
        """Solve the problem.

        What a solve has made is kept. Constants and functions in the forms, Dirichlet values and
        the points of the mesh may change between two solves: only what depends on them is made
        again, and the solver starts from the last solution. See ``update`` for new forms.

        Returns:
            The displacement, on the torn mesh.

        Raises:
            InputError: Dirichlet values, contacts, stiffness or load do not fit.
            NoSolutionError: The problem has no solution.
            ConvergenceError: The solver stopped before its tolerance.
            FactorError: A matrix could not be factored.
        """
        self._meet("solve")
        self._counts, self._outcome = SolverCounts(), Outcome()
        rows = self._system.rows()
        try:
            self._find()
        except TfetiError as error:  # on all ranks
            if self._counts.late_contact_rows:  # of a place where bodies are not
                self._system.know_rows(rows)
            if isinstance(error, NoSolutionError):
                self._outcome = replace(self._outcome, converged_reason="NO_SOLUTION")
            self._start = None  # what was found before is no end of this load step
            self._compose_report()
            raise
        self._compose_report()
        self._report_motion()
        self._log_warnings()
        if self.options.view and self.decomposition.comm.rank == 0:
            options = self.options.view_text(self._settings.prefix)
            print(options, self.report.details(), sep="\n", flush=True)
        return self.u

    def _find(self) -> None:
        """Find the solution, with the data that ranks have met with. Collective."""
        self._system.look_for_changes()
        self._predict()
        self._solve_in_rounds()

    def _solve_in_rounds(self) -> None:
        """Solve, with more and more contact rows, until no node without a row overlaps."""
        system = self._system
        for _ in range(MAX_ROUNDS):
            try:
                solution, overlap = self._solve_rows()
            except NoSolutionError as error:  # on all ranks: what is far may hold the body yet
                with stage("contact", self._seconds):
                    new = system.search.widen()
                if new == 0:
                    if unmet := system.search.unmet():
                        text = f"{error}; never in contact: {', '.join(unmet)}"
                        raise NoSolutionError(text) from error
                    raise
            else:
                with stage("contact", self._seconds):
                    new = system.search.take_in_overlapping(solution.u, overlap)
                if new == 0:
                    return
            system.change("constraints")
            self._counts.late_contact_rows += new
        raise ConvergenceError(f"nodes out of reach still overlap after {MAX_ROUNDS} rounds")

    def _solve_rows(self) -> tuple[Solution, float]:
        """Solve with the present rows, from the last solution on; return what may overlap, too."""
        system, seconds, d = self._system, self._seconds, self.decomposition
        system.make(seconds)
        dual, gluing = system.dual, system.gluing
        now = self.options
        options = replace(system.options, rtol=now.rtol, atol=now.atol, warnings=now.warnings)
        dual.begin_solve(system.displacement_at_begin(), self._negligible(dual.subdomains))
        # 1. the multipliers
        with stage("solve", seconds):
            start = None
            if (before := self._start) is not None:
                dual.learn()
                mu = before.mu if before.kplus_number == system.kplus_number else np.zeros(0)
                start = gluing.multipliers(before.gluing, before.lam), mu
                start = None if dual.is_far(*start) else start
            goal = None
            if options.rtol == "auto" and self._given_stress is not None:
                goal = goal_of(self._given_stress, self.dofs, self._thickness)
            given, own = self._settings, self._settings.extensions
            with added_options(given.prefix, given.factor_options):  # of faces, and of a late S
                solved = solve_with_friction(dual, options, start, own.monitor, goal, own.stopping)
        result, accuracy, friction = solved
        state, lam = accuracy.recovered, result.lam.copy()
        self._let_go = np.zeros(0, dtype=bool)
        if state.loose.count > dual.coarse.free_motions.count:
            self._let_go = state.loose.moving
            if result.reason > 0:  # forces of contact there are the solver's error
                lam[let_go(dual.coarse, state)] = 0.0
        # 2. their displacement
        with stage("recovery", seconds):
            nodal = dual.subdomains.num_nodal
            system.tools.take(accuracy.u[nodal:])
            solution = self._make_solution(accuracy.u[:nodal], lam, result.face, gluing)
            self._solution = solution
            self.u.x.array[:] = self.dofs.to_dolfinx(solution.u)
        end = WarmStart(gluing, lam, result.mu, system.kplus_number)
        self._start = end if result.reason > 0 else None
        # 3. what the report says of it
        counts = SolverCounts.of_run(dual, result, friction)
        self._counts = SolverCounts(**added(vars(self._counts), vars(counts)))
        contacts = gluing.contacts_of(result.excluding) if result.reason <= 0 else []
        excluding = system.search.named(contacts)
        loose = dual.coarse.nearly_free(state.loose) if options.warnings else []
        self._rounding = accuracy.allowed.rounding
        outcome = Outcome.of_answer(solution, dual, *solved, excluding, loose)
        outcome.solver = f"{options.qp_type} + {options.pc_type}"
        if options.warnings:
            energy, rtol = accuracy.measures.energies, options.number
            outcome.warnings = self._diagnostics.found(dual, solution, outcome, energy, rtol)
        outcome.notes, self._outcome = notes_of(outcome, solution), outcome
        body = [*d.body_names, *system.tools.free_names][friction.body]
        said = outcome.warnings + outcome.notes
        conclude(result, accuracy, now, d.comm, excluding, body, friction.slides, said)
        return solution, accuracy.allowed.overlap

    def _log_warnings(self) -> None:
        """Log warnings on rank 0, each once, whatever figures are in what it says of its bodies."""
        unmet = "contact {} has nothing within reach=, and no constraints".format
        for text in [*self.report.warnings, *map(unmet, self.report.unmet_contacts)]:
            bodies, _, says = text.partition(": ")
            kind = bodies + re.sub(r"[-+.\d]+(e[-+]?\d+)?", "#", says)
            if kind not in self._logged and self.decomposition.comm.rank == 0:
                log.warning("%s", text)
            self._logged.add(kind)

    def _compose_report(self) -> None:
        """Compose the report of a solve, from records of its stages. Collective."""
        records = self._system.sizes(), self._system.take_counts(), self._counts, self._outcome
        report = Report.composed(records, self._seconds, self._in_all, self.dofs.comm)
        vars(self.report).update(vars(report))  # a program may hold it over many solves
        self._seconds, self._in_all = {}, report.in_all

    def _make_solution(self, u: Array, lam: Array, face: Face, gluing: Gluing) -> Solution:
        system, tools = self._system, self._system.tools
        if tools:
            motion = tools.motion(gluing.records, found=True)
            gluing = replace(gluing, records=replace(gluing.records, motion=motion))
        return Solution(
            u,
            lam,
            face,
            gluing,
            system.search.contacts,
            stress=None if self._stress is None else self._stress.frozen(),
            thickness=self._thickness,
            finite=system.origin is not None,
            boundary=system.elements.solved(u),
            tool_motions=tools.motions(),
            friction=system.known_friction,
        )

    # ------------------------------------------------------- after a solve

    def estimate(self) -> Estimates:
        """Estimate the errors of the last solution in energy. It costs what it says.

        Returns:
            The estimates, which ``report`` then has, too, with a warning where they are of no use.

        Raises:
            InputError: There is no solution, or its constraints have changed.
            FactorError: A matrix could not be factored.
        """
        self._meet("estimate")
        found = estimate(self._system, self.solution, self._rounding, self.report)
        self._log_warnings()
        return found

    def update(
        self,
        *,
        load: ufl.Form | None = None,
        values: Sequence[fem.DirichletBC] | None = None,
        stiffness: ufl.Form | None = None,
        gap: Mapping[int | str, Gap] | None = None,
    ) -> None:
        """Take other forms or conditions; the next ``solve`` makes again what depends on them.

        Not needed where constants, functions or Dirichlet values have only got other values:
        ``solve`` sees that itself. Of conditions on the same unknowns only the values count; a
        new load, new values or new gaps need no constraints and no factor, a new stiffness no
        search: with ``secondary="auto"`` the sides of a pair stay those of the first stiffness.

        Args:
            load: A linear form instead of ``L``.
            values: Dirichlet conditions instead of ``bcs``.
            stiffness: A bilinear form on the same space instead of ``a``.
            gap: For contacts, by position or name, what their ``gap=`` is from here on. Nodes
                without a constraint that come to overlap get theirs.

        Raises:
            InputError: Something given does not fit; the message names it. Nothing has changed.
        """
        with agreeing(self.decomposition.comm, "update") as given:
            conditions = None if values is None else listed_conditions(values)
            given |= {"load": load, "values": conditions, "stiffness": stiffness, "gap": gap}
        V, forms = self.dofs.V, copy(self._system.forms)
        if conditions is not None:
            check_conditions(conditions, self.dofs)
        if stiffness is not None:
            check_same_space(displacement_space(stiffness, self.decomposition), V, "stiffness", "a")
            forms.replace_stiffness(stiffness)
        if load is not None:
            forms.replace_load(load)
        if gap is not None:
            self.contacts = self._system.set_gaps(gaps_by_position(self.contacts, gap))
        self._system.forms = forms
        self.bcs[:] = self.bcs if conditions is None else conditions

    def digest(self) -> dict[str, Any]:
        """Describe what determines the solution, for checkpoints: short, and as JSON takes it.

        Collective. The forms and the values of their constants, contacts, conditions, mass and
        mesh, as they are when it is called; of functions on the mesh sums over it, of callables
        their names, of rigid bodies what laws give at ``time``. Options and ``stress`` are not.
        ``agreement.check_same_problem`` compares two of them.
        """
        d = self.decomposition
        with agreeing(d.comm, "digest") as given:
            given |= {**self._given(), **self._system.tools.laws(self.time)}
        known = {name: x for name, x in given.items() if name not in self._unknown_before}
        fields = fields_in(known)
        mesh = {"type": "mesh", "subdomains": d.num_subdomains, "bodies": d.num_bodies}
        sums = sums_of(d.comm, [d.mesh.geometry.x, *fields.values()])
        found = {name: as_json(value) for name, value in given.items()}
        found["mesh"] = {**mesh, "points": sums[0]}
        found["sums over functions"] = dict(zip(fields, sums[1:], strict=True))
        return found

    def destroy(self) -> None:
        """Destroy the PETSc objects; solution and report stay. ``solve`` makes them anew.

        Collective.
        """
        with agreeing(self.decomposition.comm, "destroy"):
            pass
        self._system.destroy()

    # -------------------------------------------------------------- load steps

    def take_step(self, size: float) -> None:
        """Say how long the next load step is: without inertia only that steps are taken matters."""
        self._system.factory.mixed = False  # single precision pays in one alone

    def accept(self) -> None:
        """Take the last solution as the end of a load step. Collective.

        Friction acts on slips from there on (quasi-static), and ``go_back`` returns there.

        Raises:
            InputError: There is no solution, or the last solve has raised an error.
        """
        with agreeing(self.decomposition.comm, "accept"):
            solution, start = self.solution, self._start
            if start is None:
                raise InputError("the last solve has not converged; expected one that has")
        if start is None or (self._accepted and self._accepted[0] is solution):
            return
        self._system.tools.begin_here()
        self._system.count_slips_from(solution)
        self._accepted = (solution, start)
        self._begin_next()

    def go_back(self) -> None:
        """Return to the last accepted solution, or to what ``u`` was at first. Collective.

        The next ``solve`` starts from there. Loads, values and gaps stay as they are.
        """
        with agreeing(self.decomposition.comm, "go_back"):
            pass
        self._solution, self._start = self._accepted or (None, None)
        self._system.tools.go_back()
        last = self._solution
        self.u.x.array[:] = self._first if last is None else self.dofs.to_dolfinx(last.u)

    def state(self) -> SavedState:
        """Return the last accepted solution as arrays of this rank, for ``restore``. Collective.

        Raises:
            InputError: No solution was accepted.
        """
        with agreeing(self.decomposition.comm, "state"):
            if self._accepted is None:
                raise InputError("there is no state yet; expected a call of accept() before")
        assert self._accepted is not None
        solution, start = self._accepted
        (reach, _), dual = self._system.search.rows(), self._system.dual
        state = SavedState.of(solution, start.mu, dual, reach)
        state = replace(state, tools=np.array([t.motion for t in solution.tool_motions]).ravel())
        if dual.constraints.B is not start.gluing.constraints.B:
            return state
        state = replace(state, image=dual.last.multiple(self.dofs.comm, start.lam))
        kept = dual.recycled
        return state if kept is None else replace(state, directions=kept.in_order())

    def restore(self, state: SavedState) -> None:
        """Go on where another run of the same program has been. Collective.

        Constants, functions, gaps and points must be those that the state was found with; laws of
        rigid bodies and values of Dirichlet conditions may be others.

        Args:
            state: What ``state`` returned on this rank.

        Raises:
            InputError: The state is of another mesh, space, other contacts or other ranks.
        """
        with agreeing(self.decomposition.comm, "restore") as given:
            self._check_state(state)
            given |= {**self._given(), "state": state.common()}
            self._look_at_stress()
            state = state.on_nodes(self.dofs)
        system = self._system
        system.tools.go_back(state.tools)
        self._take_motion(state)
        sides = list(map(int, state.secondary))
        system.know_rows((list(state.reach), state.groups(self.dofs)), sides)
        system.look_for_changes()
        system.tools.go_back(state.tools)  # by now laws may have others
        system.make(self._seconds)
        dual = system.dual
        dual.norm, dual.law_target = max(dual.norm, float(state.norm)), tuple(state.law_target)
        state = state.on_rows(system.gluing)
        # what conditions prescribed then: by now they may have other values
        values = self.dofs.reduce(state.u.reshape(-1, self.dofs.bs), np.maximum)
        held = replace(p := system.gluing.prescribed, value=np.where(p.flag, values, 0.0))
        gluing = replace(system.gluing, slip=state.slip, prescribed=held)
        dual.learn()
        if dual.recycled is not None:
            dual.recycled.take(state.directions)
        dual.know(state.lam, state.image)
        # a face that only knows what rows do
        face = Face(np.zeros(len(state.lam), dtype=bool), state.status)
        solution = self._make_solution(state.u, state.lam, face, gluing)
        start = WarmStart(gluing, state.lam, state.mu, system.kplus_number)
        self._accepted = solution, start
        self.go_back()
        system.count_slips_from(solution)

    # ------------------------------------- what bodies with mass and nonlinear ones add

    def _forms(self, a: ufl.Form, L: ufl.Form, V: fem.FunctionSpace, *options: Any) -> Forms:
        """Compile the forms of the matrix and the load."""
        return Forms(a, L, V, self.decomposition, *options)

    def _given_besides(self) -> dict[str, Any]:
        """Return other input, checked, that ranks must have alike."""
        return {}

    def _negligible(self, subdomains: Subdomains) -> Array | float:
        """Return displacements of bodies that count as none: without a load step before, 0."""
        return 0.0

    def _predict(self) -> None:
        """Set the prediction of a step; nothing without inertia."""

    def _report_motion(self) -> None:
        """Add energies, work and forces to a report; nothing without inertia. Collective."""

    def _begin_next(self) -> None:
        """Begin the next load step where one has ended: without inertia nothing is to do."""

    def _check_state(self, state: SavedState) -> None:
        """Raise an InputError where a state is of something else. Not collective."""
        check_state(state, self.dofs, len(self.contacts))

    def _take_motion(self, state: SavedState) -> None:
        """Move as the bodies of a state do: without inertia not at all."""

    # ------------------------------------------------------------------- checks

    def _meet(self, call: str) -> None:
        """Begin a call: check that all ranks make it with the same data. Collective."""
        with agreeing(self.decomposition.comm, call) as given:
            given |= self._given()
            self._look_at_stress()

    def _given(self) -> dict[str, Any]:
        """Return what determines the solution at present, by name. Not collective."""
        about = {"bcs": self.bcs, "contacts": self.contacts, "thickness": self._thickness}
        about |= {"boundary_elements": self._boundary_elements}
        return self._system.forms.given | about

    def _look_at_stress(self) -> Any:
        """Return the user's stress of ``u`` in UFL, which solutions take until the next look."""
        if self._given_stress is None:
            return None
        sigma = checked_stress(self._given_stress, self.u)
        if self._stress is None or self._stress.expression is not sigma:
            self._stress = Freezable(sigma, self.u)
        return sigma
