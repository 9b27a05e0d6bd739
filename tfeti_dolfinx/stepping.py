"""The solutions of a problem: the last one, and the one that a load step has ended with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import ufl
from dolfinx import fem

from tfeti_dolfinx.agreement import agreeing
from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.partners import ContactPartner
from tfeti_dolfinx.contact_state import Multipliers
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import Settings
from tfeti_dolfinx.fields import Stress, checked_stress
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.report import Report
from tfeti_dolfinx.saved_state import SavedState, check_state
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.solver import learn
from tfeti_dolfinx.system import System

# rows, their λ, and the multipliers of Gλ = e
Start = tuple[Gluing, Array, Array]


class Stepping:
    """What of ``ContactProblem`` concerns load steps: what it has found, and where to go on.

    Attributes:
        defaults: Options, by name, that have other defaults than their own.
    """

    defaults: ClassVar[Mapping[str, Any]] = {}

    u: fem.Function
    dofs: TornDofs
    decomposition: Decomposition
    contacts: list[ContactPartner]
    report: Report
    _settings: Settings
    _system: System
    bcs: list[fem.DirichletBC]
    _given_stress: Stress | None
    _stress: Stress | None = None
    _thickness: Any
    _solution: Solution | None = None
    _start: Start | None = None
    _accepted: tuple[Solution | None, Start | None] = (None, None)

    @property
    def solution(self) -> Solution:
        """Fields and contact states.

        Raises:
            InputError: There is none before ``solve``.
        """
        if self._solution is None:
            raise InputError("there is no solution yet; expected a call of solve() before")
        return self._solution

    def take_step(self, size: float) -> None:
        """Say how long the next load step is: without inertia it does not matter."""

    def accept(self) -> None:
        """Take the last solution as the end of a load step. Collective.

        Friction acts on slips from there on (quasi-static), and ``go_back`` returns there.

        Raises:
            InputError: There is no solution, or the solver stopped before its tolerance.
        """
        with agreeing(self.decomposition.comm, "accept"):
            solution = self.solution
            if self._start is None:
                raise InputError("the last solve has not converged; expected one that has")
        if solution is self._accepted[0] or self._start is None:
            return
        self._system.count_slips_from(solution.u)
        self._accepted = (solution, self._start)

    def go_back(self) -> None:
        """Return to the last accepted solution, or to none. Collective.

        The next ``solve`` starts from there. Loads, values and gaps stay as they are.
        """
        with agreeing(self.decomposition.comm, "go_back"):
            self._return()

    def _return(self) -> None:
        """Return to the last accepted solution. Not collective."""
        self._solution, self._start = self._accepted
        last = self._solution
        self.u.x.array[:] = 0.0 if last is None else self.dofs.to_dolfinx(last.u)

    def state(self) -> SavedState:
        """The last accepted solution as arrays of this rank, for ``restore``. Collective.

        Raises:
            InputError: No solution was accepted.
        """
        solution, start = self._accepted
        with agreeing(self.decomposition.comm, "state"):
            if solution is None or start is None:
                raise InputError("there is no state yet; expected a call of accept() before")
        assert solution is not None
        assert start is not None
        (reach, _), dual = self._system.search.rows(), self._system.dual
        state = SavedState.of(solution, start[2], dual.seen, reach)
        if dual.constraints is not start[0].constraints:
            return state
        state = replace(state, image=dual.last.known(self.dofs.comm, start[1]))
        if dual.recycled is None:
            return state
        return replace(state, directions=dual.recycled.in_order())

    def restore(self, state: SavedState) -> None:
        """Go on where another run of the same program, on as many ranks, has been. Collective.

        Constants, functions, values, gaps and points must be those that the state was found with.

        Args:
            state: What ``state`` returned on this rank.

        Raises:
            InputError: The state is of another mesh, other contacts or other ranks, or broken.
        """
        with agreeing(self.decomposition.comm, "restore") as given:
            self._check_state(state)
            given |= {**self._given(), "state": state.common()}
            self._look_at_stress()
        self._take_motion(state)
        system = self._system
        system.know_rows(list(state.reach), state.groups())
        system.look_for_changes()
        dual = system.make(self.report)
        dual.saw(float(state.norm))
        gluing = replace(system.gluing, slip=state.slip)
        state.check_rows(gluing)
        learn(dual, self._settings.options)
        if dual.recycled is not None:
            dual.recycled.take(state.directions)
        dual.last.take(self.dofs.comm, state.lam, state.image)
        solution = self._make_solution(state.u, state.multipliers(), gluing)
        self._accepted = (solution, (gluing, state.lam, state.mu))
        self._return()
        system.count_slips_from(solution.u)

    def _check_state(self, state: SavedState) -> None:
        """Raise unless a state may be one of this problem. Not collective.

        Raises:
            InputError: It is broken, or of something else.
        """
        check_state(state, self.dofs, self.decomposition, len(self.contacts))

    def _take_motion(self, state: SavedState) -> None:
        """Move as the bodies of a state do: without inertia not at all."""

    def _meet(self, call: str) -> None:
        """Begin a call: see that all ranks make it, with the same data. Collective.

        Raises:
            InputError: They do not, or the stress fails.
        """
        with agreeing(self.decomposition.comm, call) as given:
            given |= self._given()
            self._look_at_stress()

    def _given(self) -> dict[str, Any]:
        """What determines the solution, as it is now, by name. Not collective."""
        about = {"bcs": self.bcs, "contacts": self.contacts, "thickness": self._thickness}
        return {**self._system.forms.given, **about}

    def _look_at_stress(self) -> Any:
        """The user's stress of ``u`` in UFL, which solutions take until the next look.

        Not collective: it is looked at where what it raises is raised on all ranks.

        Raises:
            InputError: As ``checked_stress``.
        """
        if self._given_stress is None:
            return None
        sigma, own = checked_stress(self._given_stress, self.u), self.u
        self._stress = lambda u: ufl.replace(sigma, {own: u})
        return sigma

    def _make_solution(self, u: Array, multipliers: Multipliers, gluing: Gluing) -> Solution:
        solution = Solution(
            u=u,
            multipliers=multipliers,
            decomposition=self.decomposition,
            gluing=gluing,
            contacts=list(self._system.search.contacts),
            stress=self._stress,
            thickness=self._thickness,
        )
        solution.boundary = self._system.replaced.solved(u)
        return solution
