"""Contact of bodies with mass: Newmark's trapezoidal rule, plain or contact-stabilised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.assembly import Forms
from tfeti_dolfinx.checks import checked_flag
from tfeti_dolfinx.contact.partners import ContactPartner
from tfeti_dolfinx.contact_state import Multipliers
from tfeti_dolfinx.elasticity import Modulus
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.gluing.glue import Gluing
from tfeti_dolfinx.inertia import InertialForms, check_copies, mass_form
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.predictor import Predictor
from tfeti_dolfinx.problem import ContactProblem
from tfeti_dolfinx.saved_state import SavedState
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.work import balance, contact_forces


class ContactDynamics(ContactProblem):
    """Linear elasticity with contact of bodies with mass, step by step.

    A step of the size τ solves one contact problem with K/2 + 2M/τ², and ends at u⁺ and v⁺. Contact
    is implicit: no node overlaps at the end of a step, and its forces, λ, are means over the step.
    ``LoadSteps`` goes through many, or by hand: ``take_step(size)``, ``solve()``, ``accept()``.
    All is collective. Since F is that of the steps before, 200 directions of earlier steps
    are kept, unless the option ``recycle`` is given.

    With fixed obstacles and supports and no friction the energy E = vᵀMv/2 + uᵀKu/2 changes by the
    work of the load less λᵀ(g − Bu): contact adds none, and takes some where it closes. Forces of
    the plain step oscillate where bodies touch. The stabilised one (Deuflhard, Krause, Ertel) moves
    from where inertia alone would bring the bodies to the nearest place that contact allows, in
    M, and from there on; it takes a little energy at each impact.

    Args:
        a: Bilinear form of the stiffness.
        L: Linear form of the load. Its values when the problem is made are those at the begin of
            the first step, at each solve those at the end of the step; between them it is linear.
        bcs: Dirichlet conditions, at the end of the step.
        contacts: Obstacles and pairs. Friction acts on what slips in a step.
        decomposition: The torn mesh.
        mass: Mass per volume, a number, a scalar in UFL or numbers for all volumes by names, for
            M = ∫ρ u·v. Or a bilinear form.
        velocity: Velocity at the begin, a function; default 0.
        stabilised: Whether steps are contact-stabilised.
        lumped: Whether a density is integrated at the vertices, which makes M diagonal; of elements
            of degree 1 only: vertices alone are too few for others.
        others: As for ``ContactProblem``. What ``u`` has is the displacement at the begin.

    Attributes:
        u: The displacement at the end of the step.

    ``report.motion`` has energies and work of the last step, see ``work.balance``, and
    ``report.contact_forces`` the resultants on the contacts.

    Raises:
        InputError: What is given does not fit; the message names it.
    """

    defaults: ClassVar[Mapping[str, Any]] = {"recycle": 200}

    def __init__(
        self,
        a: ufl.Form,
        L: ufl.Form,
        bcs: Sequence[fem.DirichletBC],
        contacts: Sequence[ContactPartner],
        decomposition: Decomposition,
        *,
        mass: Modulus | ufl.Form,
        velocity: fem.Function | None = None,
        stabilised: bool = False,
        lumped: bool = False,
        **others: Any,
    ) -> None:
        self._stabilised, self._lumped = stabilised, lumped
        self._mass, self._velocity = mass, velocity
        self._with_thickness = others.get("thickness", 1.0)
        super().__init__(a, L, bcs, contacts, decomposition, **others)
        if self.options.rtol == "auto":
            raise InputError("rtol auto: errors of steps in time are not estimated; expected one")
        v = np.zeros_like(self.u.x.array)
        if velocity is not None:
            v = self._checked_u(velocity, self.dofs.V, "velocity").x.array
        check_copies(self.u.x.array, self.dofs, "u, the displacement at the begin,")
        check_copies(v, self.dofs, "velocity")
        self._forms_in_time.move(np.array(self.u.x.array), np.array(v))
        self._first = np.array(self.u.x.array)
        self._predictor: Predictor | None = None
        if self._stabilised:
            self._predictor = Predictor(self.dofs, decomposition, self._settings)

    def _given_besides(self) -> dict[str, Any]:
        flags = {"stabilised": self._stabilised, "lumped": self._lumped}
        for name, flag in flags.items():
            checked_flag(flag, name)
        return {**flags, "mass": self._mass, "velocity": self._velocity}

    def _forms(self, a: ufl.Form, L: ufl.Form, V: fem.FunctionSpace, *options: Any) -> Forms:
        mass = self._mass
        if isinstance(mass, ufl.Form) and self._lumped:
            raise InputError("lumped=True with a form of the mass; expected a density")
        if not isinstance(mass, ufl.Form):
            mass = mass_form(mass, V, self.decomposition, self._with_thickness, self._lumped)
        return InertialForms(mass, a, L, V, self.decomposition, *options)

    @property
    def _forms_in_time(self) -> InertialForms:
        forms = self._system.forms
        assert isinstance(forms, InertialForms)
        return forms

    def take_step(self, size: float) -> None:
        """Say how long the next steps are. Another size than before makes and factors all anew.

        Raises:
            InputError: It is not a positive number, or another one on another rank.
        """
        self._forms_in_time.take_step(size)

    def solve(self) -> fem.Function:
        """Solve for the end of the step; see ``ContactProblem.solve``.

        Raises:
            InputError: As there, or the step has no size yet.
        """
        super().solve()
        self._look()
        return self.u

    def _set_out(self) -> None:
        motion = self._forms_in_time.motion
        motion.towards = free = motion.free
        if self._predictor is not None:
            motion.towards = self._predicted(self._predictor, free)

    def accept(self) -> None:
        """Take the last solution as the end of the step: the next one begins there.

        Raises:
            InputError: As ``ContactProblem.accept``.
        """
        before, _ = self._accepted
        super().accept()
        if self.solution is before:
            return
        assert self.solution.v is not None
        self._forms_in_time.move(np.array(self.u.x.array), self.solution.v)

    def _return(self) -> None:
        super()._return()
        if self._solution is None:
            self.u.x.array[:] = self._first

    def state(self) -> SavedState:
        """The last accepted solution as arrays of this rank, for ``restore``."""
        motion, state = self._forms_in_time.motion, super().state()
        moving = {"velocity": motion.v, "load": motion.load, "size": np.array(motion.size)}
        state = replace(state, **moving)
        if self._predictor is None:
            return state
        predicted, image = self._predictor.start
        return replace(state, predicted=predicted, predicted_image=image)

    def restore(self, state: SavedState) -> None:
        """Go on where another run of the same program has been; the step must have its size.

        Raises:
            InputError: As ``ContactProblem.restore``, or the state is of a problem without mass.
        """
        super().restore(state)
        self.solution.v = state.velocity
        known = any_rank(self.decomposition.comm, state.predicted.size > 0)
        if self._predictor is not None and known:
            start = state.predicted, state.predicted_image
            self._predictor.start_from(self._system.gluing, *start)

    def _check_state(self, state: SavedState) -> None:
        super()._check_state(state)
        size = len(self.u.x.array)
        if state.velocity.shape != (size,) or state.load.shape != (size,):
            raise InputError("the state is of a problem without mass; expected velocities")

    def _take_motion(self, state: SavedState) -> None:
        forms = self._forms_in_time
        forms.move(self.dofs.to_dolfinx(state.u), state.velocity, state.load)
        forms.motion.towards = forms.motion.free
        if state.size > 0.0:  # equal steps of a series differ by rounding, factors are of the first
            forms.motion.size = float(state.size)

    def destroy(self) -> None:
        """Destroy the PETSc objects; solution and report stay."""
        super().destroy()
        if self._predictor is not None:
            self._predictor.destroy()

    def _make_solution(self, u: Array, multipliers: Multipliers, gluing: Gluing) -> Solution:
        solution = super()._make_solution(u, multipliers, gluing)
        solution.v = self._forms_in_time.motion.velocity(self.dofs.to_dolfinx(u))
        return solution

    def _predicted(self, predictor: Predictor, free: Array) -> Array:
        """Where contact lets the bodies go without elasticity."""
        system, forms = self._system, self._forms_in_time
        system.look_for_changes()
        system.make(self.report)
        if system.search.take_in_overlapping(self.dofs.to_primal(free), 0.0):
            system.change("rows")
            system.make(self.report)
        return predictor.nearest(free, forms.matrices[1], system.gluing)

    def _look(self) -> None:
        """Put energies, work and forces into the report."""
        report, forms = self.report, self._forms_in_time
        report.motion = balance(forms, self._system.dual, self.solution)
        report.contact_forces = contact_forces(self.solution)
        if self._predictor is not None:
            count = float(self._predictor.multiplications)
            report.motion["predictor_multiplications"] = count
