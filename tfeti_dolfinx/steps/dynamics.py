"""Bodies with mass: contact-stabilised steps in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.parallel import any_rank, summed
from tfeti_dolfinx.common.validation import checked_flag
from tfeti_dolfinx.constraints.gluing import Gluing
from tfeti_dolfinx.contact.partner import ContactPartner
from tfeti_dolfinx.contact.records import mean_of_copies, relative_displacement
from tfeti_dolfinx.contact.tools import Tools
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.feti.dual import Dual, contact_set
from tfeti_dolfinx.forms.assembly import Forms
from tfeti_dolfinx.forms.checks import checked_function
from tfeti_dolfinx.forms.elasticity import Modulus
from tfeti_dolfinx.forms.newmark import InertialForms, check_copies, mass_form
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.nonlinear.forms import InertialNewtonForms
from tfeti_dolfinx.nonlinear.problem import NonlinearContactProblem
from tfeti_dolfinx.problem import ContactProblem
from tfeti_dolfinx.qp.sets import Face
from tfeti_dolfinx.saved_state import SavedState
from tfeti_dolfinx.settings import Settings
from tfeti_dolfinx.solution import Solution
from tfeti_dolfinx.solve.solver import conclude, solve_dual
from tfeti_dolfinx.subdomains.sparse_block import EqualSubdomains
from tfeti_dolfinx.subdomains.subdomains import Subdomains, subdomain_data
from tfeti_dolfinx.system import System

NAMES = ("load", "contact", "friction", "supports", "predictor")


def _kinetics(
    M: Any, tau: float, v: Array, start: Array, end: Array, du: Array, dw: Array, load: Array
) -> Array:
    """Kinetic energy at the end and at the begin of a step, work of the load and the predictor.

    Velocities are that at the begin, that which the step starts with, and that at the end; ``du``
    is the increment of the displacement, ``dw`` the predicted one, which it is without forces.
    """
    moving, started = v @ (M @ v), start @ (M @ start)
    predicted = -2.0 / tau**2 * (dw - tau * start) @ (M @ (du - dw))
    predicted += 0.5 * (started - moving)
    return np.array([0.5 * end @ (M @ end), 0.5 * moving, load @ du, predicted])


def balance(
    forms: InertialForms | InertialNewtonForms, dual: Dual, solution: Solution, tools: Tools
) -> dict[str, float]:
    """Energies at the end of a step, and the work that has changed them. Collective.

    Returns:
        ``size`` of the step; at its end ``kinetic``, ``elastic`` and ``energy``; work of the
        ``load``, of normal forces of ``contact``, of ``friction``, of ``supports`` (Dirichlet
        conditions, and what jumps at tears to the tolerance), what the ``predictor`` has added,
        at most 0; and ``defect``, what all these leave of the change of the energy: rounding.
    """
    inertia, motion = forms.inertia, forms.inertia.motion
    u, v = solution.dofs.to_dolfinx(solution.u), solution.v
    assert v is not None
    du, dw, du_tools = u - motion.u, motion.predicted - motion.u, tools.increment()
    sets, primal = dual.constraints.sets, solution.dofs.to_primal(du)
    all_du = np.append(primal, du_tools[: tools.num_local])
    done = -solution.lam * dual.constraints.jumps(all_du[dual.subdomains.trace])  # −λᵀB Δu
    of_rows = [done[r].sum() for r in (sets.normals, sets.tangents.ravel(), sets.equalities)]
    # rows know nothing of prescribed components: supports that draw nodes bear their friction
    rubs = 0.0
    if solution.friction is not None:
        records = solution.gluing.records
        along = relative_displacement(records, solution.dofs, primal) + records.motion
        rigid = tools.entries(records)
        np.add.at(along, rigid.condition, rigid.direction * du_tools[rigid.unknown, None])
        rubs = np.sum(solution.tangential_force * along) - of_rows[1]
    of_nodes = (motion.v, motion.start_velocity, v, du, dw, 0.5 * (motion.load + inertia.ends))
    both = _kinetics(inertia.M, motion.time_step, *of_nodes)
    if tools.num_local:
        load = 0.5 * (tools.loads_at_begin + tools.loads)
        velocities = (tools.velocity, tools.start_velocity, tools.velocity_at_end())
        moved = (*velocities, du_tools, tools.predicted_increment)
        both += _kinetics(tools.mass, motion.time_step, *moved, load)
    own = [forms.elastic(u), forms.elastic(motion.u), *np.add(of_rows, (0.0, rubs, -rubs)), *both]
    elastic, before, *rows, kinetic, moving, load_work, predicted = map(
        float, summed(solution.dofs.comm, np.array(own))
    )
    before, work = before + moving, [load_work, *rows, predicted]
    return {
        "size": motion.time_step,
        "kinetic": kinetic,
        "elastic": elastic,
        "energy": kinetic + elastic,
        **dict(zip(NAMES, work, strict=True)),
        "defect": kinetic + elastic - before - sum(work),
    }


class Predictor:
    """argmin ‖u − w‖_M over the u that rows allow, without friction.

    A quadratic program with the mass M as stiffness and the rows of the problem. Prescribed
    components are held where w has them; contacts meet them where they are at the end of the step:
    where w has them they may overlap, though nothing does at the end. Creation and all methods are
    collective.

    Attributes:
        rows_and_start: Rows, and their multipliers that the next call starts from; None at first.
        image: F of these of a restored state, if it is known.
        multiplications: By F of the mass in the last call.
        last: λ of the last call, M(u − w) = −Bᵀλ, and its face; None at first.
    """

    def __init__(self, dofs: TornDofs, settings: Settings) -> None:
        self._dofs = dofs
        # of a mass there is little to learn, and no motion of it is soft
        without = (*settings.options.without, "soft_springs", "mixed_precision")
        options = replace(settings.options, recycle=0, without=without)
        self._settings = replace(settings, extensions=Extensions(), options=options)
        self._options = options
        self._M: csr_array | None = None
        self._subdomains: Subdomains | None = None
        self._dual: Dual | None = None
        self.rows_and_start: tuple[Gluing, Array] | None = None
        self.image: Array = np.zeros(0)
        self.multiplications = 0
        self.last: tuple[Array, Face] | None = None

    def start(self, gluing: Gluing) -> tuple[Array, Array]:
        """Return multipliers of rows that the next call starts from, and their image. Collective.

        Empty before the first, or where the image is not known, as of rows that are new.
        """
        if self.rows_and_start is None or self._dual is None:
            return np.zeros(0), np.zeros(0)
        before, lam = self.rows_and_start
        if before.constraints.B is not gluing.constraints.B:
            return gluing.multipliers(before, lam), np.zeros(0)
        return lam, self._dual.last.multiple(self._dofs.comm, lam)

    def nearest(self, w: Array, M: csr_array, gluing: Gluing, tools: Tools) -> Array:
        """Return the nearest displacement to w; free rigid bodies drift to where theirs is.

        w is in DOLFINx's order, as is this rank's mass M, whose factors are kept while it is the
        same object.
        """
        bodies = tools.of_mass_alone() if tools.num_unknowns else tools
        dofs, settings, sets, f = self._dofs, self._settings, gluing.constraints.sets, M @ w
        c = np.array(gluing.constraints.c)
        values = mean_of_copies(dofs, dofs.to_primal(w)).ravel()
        c[sets.equalities] = gluing.to_equalities @ values
        rows = replace(gluing.constraints, c=c, limits=np.zeros(sets.tangents.shape))
        # 1. what is out of date
        if M is not self._M:
            self.destroy()
            data = subdomain_data(dofs, M, f, rows.trace)
            equals = EqualSubdomains(settings.inverse_factory())
            self._subdomains = settings.make_subdomains(data, dofs, equals, bodies)
            self._M = M
        assert self._subdomains is not None
        own = bodies.load[: bodies.num_local]
        self._subdomains.update(f=np.append(dofs.to_primal(f), own))
        if self._dual is not None and self._dual.constraints.B is rows.B:
            self._dual.update_load(rows)
        else:
            if self._dual is not None:
                self._dual.destroy()
            self._subdomains.retrace(rows.trace)
            made = settings.make_dual(rows, self._subdomains, dofs, contact_set)
            self._dual, self._options = made
        # 2. the program, from the last multipliers on
        dual, options, start = self._dual, self._options, None
        dual.begin_solve()
        if self.rows_and_start is not None:  # nothing has a kernel in M
            start = (gluing.multipliers(*self.rows_and_start), np.zeros(0))
            if self.rows_and_start[0].constraints.B is rows.B:
                dual.know(self.rows_and_start[1], self.image)
        self.image = np.zeros(0)  # it is of the F and the start of a restored state alone
        result, accuracy = solve_dual(dual, options, start)
        self.rows_and_start = (gluing, result.lam.copy()) if result.reason > 0 else None
        self.last = result.lam.copy(), result.face
        self.multiplications = dual.F.count
        conclude(result, accuracy, options, dofs.comm)
        nodal = self._subdomains.num_nodal
        if tools.num_unknowns:
            bodies.take(accuracy.u[nodal:])
            tools.predicted_increment = bodies.increment()
        return dofs.to_dolfinx(accuracy.u[:nodal])

    def destroy(self) -> None:
        """Destroy the PETSc objects; the next call makes them anew."""
        for item in (self._dual, self._subdomains):
            if item is not None:
                item.destroy()
        self._M = self._dual = self._subdomains = None


# --- Newmark's method with contact ------------------------------------------------------------


class ContactDynamics(ContactProblem):
    """Linear elasticity with contact of bodies with mass, step by step.

    A step of the size τ solves one contact problem with K/2 + 2M/τ², and ends at u⁺ and v⁺. Contact
    is implicit: no node overlaps at the end of a step, and its forces, λ, are means over the step.
    ``LoadSteps`` goes through many, or by hand: ``take_step(size)``, ``solve()``, ``accept()``.
    All is collective. F is that of the steps before: their directions are kept, as the option
    ``recycle`` says.

    With fixed obstacles and supports and no friction the energy E = vᵀMv/2 + uᵀKu/2 changes by the
    work of the load less λᵀ(g − Bu): contact adds none, and takes some where it closes. Forces of
    the plain step oscillate where bodies touch. The stabilised one (Deuflhard, Krause, Ertel) moves
    from where inertia alone would bring the bodies to the nearest place that contact allows, in
    M, and from there on; it takes a little energy at each impact.

    Args:
        a: Bilinear form of the stiffness.
        L: Linear form of the load. Its values when the problem is made are those at the start of
            the first step, at each solve those at the end of the step; between them it is linear.
        bcs: Dirichlet conditions, at the end of the step.
        contacts: Obstacles and pairs. Friction acts on what slips in a step.
        decomposition: The torn mesh.
        mass: Mass per volume, a number, a scalar in UFL or numbers for all volumes by names, for
            M = ∫ρ u·v. Or a bilinear form.
        velocity: Velocity at the start, a function; default 0.
        stabilised: Whether steps are contact-stabilised.
        lumped: Whether a density is integrated at the vertices, which makes M diagonal; of elements
            of degree 1 only: vertices alone are too few for others.
        others: As for ``ContactProblem``. What ``u`` has is the displacement at the start.

    Attributes:
        u: The displacement at the end of the step.

    ``report.motion`` has energies and work of the last step, see ``balance``, and
    ``report.contact_forces`` the resultants on the contacts.

    Raises:
        InputError: What is given does not fit; the message names it.
    """

    _system: System[InertialForms | InertialNewtonForms]

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
        super().__init__(a, L, bcs, contacts, decomposition, **others)
        self._system.factory.mixed = False  # many solves come
        if self.options.rtol == "auto":
            raise InputError("rtol auto: errors of steps in time are not estimated; expected one")
        v = np.zeros_like(self.u.x.array)
        if velocity is not None:
            v = checked_function(velocity, self.dofs.V, "velocity").x.array
        check_copies(self.u.x.array, self.dofs, "u, the displacement at the start,")
        check_copies(v, self.dofs, "velocity")
        self._system.forms.inertia.move(np.array(self.u.x.array), np.array(v))
        # slips of the first step count from where bodies and tools are now
        self._system.begin_at(self.dofs.to_primal(self.u.x.array))
        self._system.tools.read(self.time)
        self._system.tools.begin_here()
        self._predictor = Predictor(self.dofs, self._settings) if stabilised else None

    def _given_besides(self) -> dict[str, Any]:
        flags = {"stabilised": self._stabilised, "lumped": self._lumped}
        for name, flag in flags.items():
            checked_flag(flag, name)
        return {**flags, "mass": self._mass, "velocity": self._velocity}

    def _forms(self, a: ufl.Form, L: ufl.Form, V: fem.FunctionSpace, *options: Any) -> Forms:
        return InertialForms(self._mass_form(V), a, L, V, self.decomposition, *options)

    def _mass_form(self, V: fem.FunctionSpace) -> ufl.Form:
        mass = self._mass
        if isinstance(mass, ufl.Form) and self._lumped:
            raise InputError("lumped=True with a form of the mass; expected a density")
        if not isinstance(mass, ufl.Form):
            mass = mass_form(mass, V, self.decomposition, self._thickness, self._lumped)
        return mass

    def take_step(self, size: float) -> None:
        """Say how long the next steps are. Another size than before makes and factors all anew.

        Raises:
            InputError: It is not a positive number, or another one on another rank.
        """
        self._system.forms.inertia.take_step(size)

    def _predict(self) -> None:
        inertia, system = self._system.forms.inertia, self._system
        motion = inertia.motion
        motion.predicted = free = motion.free
        system.tools.begin_time_step(motion.time_step)
        if self._predictor is not None:  # what contact allows the bodies without elasticity
            system.make(self._seconds, "right side")
            with system.tools.at_prediction():
                overlap = system.search.take_in_overlapping(self.dofs.to_primal(free), 0.0)
            if overlap:
                system.change("constraints")
                system.make(self._seconds, "right side")
            motion.predicted = self._predictor.nearest(free, inertia.M, system.gluing, system.tools)
        system.change("load")

    def _begin_next(self) -> None:
        super()._begin_next()
        assert self.solution.v is not None
        self._system.forms.inertia.move(np.array(self.u.x.array), self.solution.v)

    def state(self) -> SavedState:
        """Return the last accepted solution as arrays of this rank, for ``restore``."""
        motion, state = self._system.forms.inertia.motion, super().state()
        v, load = self.dofs.to_primal(motion.v), self.dofs.to_primal(motion.load)
        tools = self._system.tools
        state = replace(state, velocity=v, load=load, size=np.array(motion.time_step))
        state = replace(state, tool_speed=tools.velocity, tool_loads=tools.loads_at_begin)
        if self._predictor is None or self._accepted is None:
            return state
        predicted, image = self._predictor.start(self._accepted[0].gluing)
        return replace(state, predicted=predicted, predicted_image=image)

    def restore(self, state: SavedState) -> None:
        """Go on where another run of the same program has been.

        Raises:
            InputError: As ``ContactProblem.restore``, or the state has no velocities.
        """
        super().restore(state)
        self.solution.v = self._system.forms.inertia.motion.v
        if self._predictor is None:
            return
        state = state.on_nodes(self.dofs).on_rows(self._system.gluing)
        if any_rank(self.decomposition.comm, state.predicted.size > 0):
            self._predictor.rows_and_start = self._system.gluing, state.predicted
            self._predictor.image = state.predicted_image

    def _check_state(self, state: SavedState) -> None:
        super()._check_state(state)
        size = len(self.u.x.array)
        tools = self._system.tools.velocity.shape
        if state.velocity.shape != (size,) or state.load.shape != (size,):
            raise InputError("the state is of a problem without mass; expected velocities")
        if state.tool_speed.shape != tools or state.tool_loads.shape != tools:
            raise InputError("the state is of other rigid bodies; expected those of the problem")

    def _take_motion(self, state: SavedState) -> None:
        inertia = self._system.forms.inertia
        inertia.move(*map(self.dofs.to_dolfinx, (state.u, state.velocity, state.load)))
        inertia.motion.predicted = inertia.motion.free
        if state.size > 0.0:  # equal steps of a series differ by rounding, factors are of the first
            inertia.motion.time_step = float(state.size)
        tools = self._system.tools
        tools.velocity, tools.loads_at_begin = state.tool_speed, state.tool_loads
        tools.begin_time_step(inertia.motion.time_step)
        tools.predicted_increment = 0.0 * tools.velocity  # so fast it is at the end of a step
        super()._take_motion(state)

    def destroy(self) -> None:
        """Destroy the PETSc objects; solution and report stay."""
        super().destroy()
        if self._predictor is not None:
            self._predictor.destroy()

    def _make_solution(self, u: Array, lam: Array, face: Face, gluing: Gluing) -> Solution:
        solution = super()._make_solution(u, lam, face, gluing)
        motion = self._system.forms.inertia.motion
        way = self.dofs.to_dolfinx(u) - motion.predicted
        solution.v = motion.start_velocity + 2.0 / motion.time_step * way
        return solution

    def _report_motion(self) -> None:
        system = self._system
        motion = balance(system.forms, system.dual, self.solution, system.tools)
        if self._predictor is not None:
            motion["predictor_multiplications"] = float(self._predictor.multiplications)
        contact, forces = self.solution.gluing.records.contact, self.solution.condition_forces
        total = summed(self.dofs.comm, sum_rows(contact, forces, len(self.contacts)))
        means = [[float(component) for component in force] for force in total]
        self.report.motion, self.report.contact_forces = motion, means


class NonlinearContactDynamics(ContactDynamics, NonlinearContactProblem):
    """Nonlinear bodies with mass in contact, step by step, in small or in finite strain.

    Steps are those of ``ContactDynamics``, with the residual F instead of K: M(v⁺ − v)/τ =
    −(F(u) + F(u⁺))/2 − Bᵀλ, u⁺ = u + τ(v + v⁺)/2. Each is solved by Newton's method with the
    contact inside, as a load step of ``NonlinearContactProblem``. Momentum is kept to the
    tolerance; the energy of a hyperelastic body in free flight is off by terms of τ², which do not
    add up. In finite strain contact acts where the bodies are, and a stabilised step starts with
    the velocity (w − u)/τ that goes to the predictor w, by the constraints where bodies begin it:
    contact takes from the nodes that hit their velocity along the normal. All is collective.

    Args:
        F: Residual F(u; v) without inertia. Internal variables are those at the start of the step.
        u: The displacement in F, as it is at the start.
        bcs: Dirichlet conditions, at the end of the step.
        contacts: Obstacles and pairs. Friction acts on what slips in a step.
        decomposition: The torn mesh.
        mass: Mass per volume of the mesh as it was, or its bilinear form; see ``ContactDynamics``.
        finite: Whether strains and displacements are finite.
        velocity: Velocity at the start, a function; default 0.
        stabilised: Whether steps are contact-stabilised.
        lumped: Whether a density is integrated at the vertices.
        others: As for ``NonlinearContactProblem``.

    ``report.motion`` is that of ``ContactDynamics``, but that ``load`` is the work of all of F,
    inner forces included, ``elastic`` is 0, ``energy`` the kinetic one, and ``defect`` what the
    tolerance has left.

    Raises:
        InputError: What is given does not fit; the message names it.
    """

    _system: System[InertialNewtonForms]

    def __init__(
        self,
        F: ufl.Form,
        u: fem.Function,
        bcs: Sequence[fem.DirichletBC],
        contacts: Sequence[ContactPartner],
        decomposition: Decomposition,
        *,
        mass: Modulus | ufl.Form,
        finite: bool = False,
        velocity: fem.Function | None = None,
        stabilised: bool = False,
        lumped: bool = False,
        **others: Any,
    ) -> None:
        flags = {"stabilised": stabilised, "lumped": lumped, "finite": finite}
        given = {"mass": mass, "velocity": velocity, **flags, **others}
        super().__init__(F, u, bcs, contacts, decomposition, **given)
        tools = self._system.tools
        if finite and decomposition.mesh.geometry.dim == 3 and np.any(tools.mode >= 3):
            raise InputError(
                f"{tools.free_names[0]}: turns of a rigid body with mass in finite strain in 3D; "
                "expected free translations alone"
            )
        self._system.forms.inertia.motion.load = self._system.forms.forces()
        self._blows: list[Array] = []

    def _forms(
        self, a: ufl.Form, L: ufl.Form, V: fem.FunctionSpace, *options: Any
    ) -> InertialNewtonForms:
        given = (self._mass_form(V), a, L, V, self.decomposition, *options)
        return InertialNewtonForms(*given, u=self.u, places=self._places)

    def _find(self) -> None:
        last = np.array(self.u.x.array)
        if self._places is not None:  # the prediction is that of the begin of the step
            self._set(self._begin)
            self._go_to_places()
            self._system.change("places")  # else a law that moves a tool may leave its place
        try:
            self._system.look_for_changes()
            self._predict()
            if self._places is not None and self._system.forms.inertia.motion.time_step:
                self._project_velocity()
        finally:
            if self._places is not None:
                self._places.back()
            self.u.x.array[:] = last
        super()._find()

    def _project_velocity(self) -> None:
        """Start with the velocity that goes to the prediction; what contact takes is a blow.

        What a node keeps of the velocity with which it hits would work where normals turn.
        """
        motion, predictor = self._system.forms.inertia.motion, self._predictor
        motion.start_velocity, self._blows = motion.v, []
        if predictor is None or predictor.last is None:
            return
        motion.start_velocity = (motion.predicted - motion.u) / motion.time_step
        tools = self._system.tools
        tools.start_velocity = tools.predicted_increment / motion.time_step
        (lam, face), w = predictor.last, self.dofs.to_primal(motion.predicted)
        forces, gluing = lam / motion.time_step**2, self._system.gluing
        struck = ContactProblem._make_solution(self, w, forces, face, gluing)
        self._blows = [struck.contact(i).resultant.force for i in range(len(self.contacts))]

    def _report_motion(self) -> None:
        self._system.forms.inertia.ends = self._system.forms.forces()
        super()._report_motion()
        forces = self.report.contact_forces
        for i, blow in enumerate(self._blows):
            forces[i] = [a + float(b) for a, b in zip(forces[i], blow, strict=True)]
