"""Nonlinear bodies in contact by Newton's method, each step a contact problem of its own."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import EPSILON, TINY, Array, sum_rows, sums
from tfeti_dolfinx.common.parallel import bcast_from_root, dot_over, largest, steering, summed
from tfeti_dolfinx.common.validation import (
    FROM_1,
    checked_callable,
    checked_flag,
    checked_number,
    checked_type,
    named,
)
from tfeti_dolfinx.contact.partner import ContactPartner, Gap, checked_contacts
from tfeti_dolfinx.contact.records import mean_of_copies
from tfeti_dolfinx.errors import (
    ConvergenceError,
    InputError,
    NoSolutionError,
    TfetiError,
    raised_on_all_ranks,
)
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mortar.facets import diameter
from tfeti_dolfinx.nonlinear.forms import CurrentPlaces, NewtonForms, rotation_free_tangent
from tfeti_dolfinx.nonlinear.materials import J2Plasticity, Plasticity, derivative_of, laws_of
from tfeti_dolfinx.nonlinear.newton import (
    Anderson,
    ModelKeeping,
    NewtonTolerances,
    Regularisation,
)
from tfeti_dolfinx.nonlinear.state import InternalVariables, NewValue
from tfeti_dolfinx.problem import ContactProblem
from tfeti_dolfinx.saved_state import SavedState, labels_of_cells
from tfeti_dolfinx.subdomains.subdomains import Subdomains
from tfeti_dolfinx.system import System


class NonlinearContactProblem(ContactProblem):
    """Nonlinear bodies in contact, by Newton's method with the contact inside.

    Mirrors ``dolfinx.fem.petsc.NonlinearProblem``. One load step is the minimum of an incremental
    potential over the displacements that conditions and contacts allow. A Newton step minimises
    its quadratic model over the same set: a ``ContactProblem`` with the stiffness J(u) and the
    load J(u) u − F(u). Its multipliers start the next one. All is collective.

    Newton's method, u the iterate, û the solution of the linearised problem, d = û − u:

    1. *Model.* Assemble J(u); in small strain keep it, with its factors, where the last step was
       short, and from one load step to the next; in finite strain, with the constraints of the
       same places, until the increments are small compared with the first, unless places matter
       more. Solve the contact problem for û, to the forcing term of
       Eisenstat and Walker.
    2. *Line search.* r(t) = F(u + t d; d) + λᵀB d is the slope along d of the potential with the
       contact forces of û, and r(0) = −dᵀJ d < 0. Where r(1) is much larger than 0, the step has
       gone beyond the minimum, and t is a root of r. The modulus of r(1)/r(0), of the part of d
       that a body has, is its remainder.
    3. *End* where ‖d‖ is at most rtol ‖u‖ in the maximum norm of each body, in finite strain with a
       new model of where the bodies are, or the last digit of that; in small strain where the
       remainder times ‖d‖ is, which the next one is expected to be, and a tenth of ‖d‖.
    4. *Step.* u ← u + t d; whole steps in finite strain, where J is not the derivative of F, and
       where J is kept, are accelerated by Anderson's method. It begins anew at a shortened step.

    Args:
        F: Residual F(u; v), a linear form in a test function on a Lagrange space of the torn mesh.
        u: The displacement in F. It is the start of the first load step, and has the solution.
        bcs: Dirichlet conditions on the displacement.
        contacts: Obstacles and pairs of surfaces.
        decomposition: The torn mesh.
        J: Derivative of F, a symmetric bilinear form; default ``ufl.derivative(F, u)``, with what
            ready laws add as their stresses follow u.
        state: Internal variables: for each function what gives its value at the end of a load
            step, see ``InternalVariables``. They are committed by ``accept``. Those of ready laws
            in F need not be given.
        update: Called without arguments when ``u`` has changed, before a form is assembled: for
            functions in F and J that depend on u. Those of ready laws are set after it.
        finite: Whether strains and displacements are finite: F is integrated on the mesh as it
            was, contact and friction act where the bodies are, at X + u. J may not be given: the
            tangent knows no rotations, see ``rotation_free_tangent``. After each solve
            ``decomposition.mesh`` is where it was.
        tolerances: Those of Newton's method.
        others: As for ``ContactProblem``; ``rtol`` is that of the displacement.

    ``solve`` goes on from the last displacement. Where Newton's method or a linearised problem does
    not converge, or that of an iterate has no solution, it raises a ConvergenceError, and ``u`` is
    where the load step began.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    form_name: ClassVar[str] = "J"
    _system: System[NewtonForms]
    _unknown_before: ClassVar[tuple[str, ...]] = NewtonForms.names

    def __init__(
        self,
        F: ufl.Form,
        u: fem.Function,
        bcs: Sequence[fem.DirichletBC],
        contacts: Sequence[ContactPartner],
        decomposition: Decomposition,
        *,
        J: ufl.Form | None = None,
        state: Mapping[fem.Function, NewValue] | None = None,
        update: Callable[[], None] | None = None,
        finite: bool = False,
        tolerances: NewtonTolerances | None = None,
        **others: Any,
    ) -> None:
        checked_type(
            decomposition, Decomposition, "decomposition", "what decompose or read_gmsh return"
        )
        with agreeing(decomposition.comm, type(self).__name__) as given:
            given["finite"] = self._finite = checked_flag(finite, "finite")
            given["update"] = "not given" if update is None else "given"
            checked_type(u, fem.Function, "u", "the dolfinx.fem.Function that F is a residual of")
            checked_type(F, ufl.Form, "F", "a linear form")
            if not F.arguments():
                expected = "a linear form, such as the derivative of an energy"
                raise InputError(f"F has no test function; expected {expected}")
            if update is not None:
                checked_callable(update, "update", "a function without arguments")
            elif u not in F.coefficients():
                raise InputError("F does not depend on u; expected a residual of it, or update=")
            if finite and J is not None:
                raise InputError("finite=True: expected no J, since the tangent is made from F")
            for contact in checked_contacts(contacts) if finite else ():
                if not isinstance(contact.gap, str):
                    raise InputError(
                        f"{contact.name}: a given gap with finite=True; "
                        'expected gap="geometry" or "curved"'
                    )
            laws = laws_of(F, update, u, finite, decomposition)
            self._has_own_tangent = J is not None
            if finite:
                J = rotation_free_tangent(F, u)
            elif J is None:
                J = derivative_of(F, u, laws)
            checked_type(J, ufl.Form, "J", "a bilinear form")
            state = {} if state is None else state
            checked_type(state, Mapping, "state", "a dictionary from functions to their new values")
            of_laws = [item for law in laws for item in law.state.items() if item[0] not in state]
            state = {**state, **dict(of_laws)}
            given["state"] = list(state)
            tolerances = NewtonTolerances() if tolerances is None else tolerances
            checked_type(tolerances, NewtonTolerances, "tolerances", "NewtonTolerances")
            checked_number(tolerances.max_it, "tolerances: max_it", FROM_1)
            given["tolerances"] = asdict(tolerances)
        self._tolerances = tolerances
        forcing, loosest, curvature = (0.3, 0.01, 0.5) if finite else (1.5, 0.1, 0.3)
        self._forcing = forcing if tolerances.forcing is None else tolerances.forcing
        self._loosest = loosest if tolerances.loosest is None else tolerances.loosest
        self._curvature = curvature if tolerances.curvature is None else tolerances.curvature
        self._updates = [law.update for law in laws]
        if update is not None and update not in self._updates:
            self._updates.insert(0, update)
        self._state = InternalVariables(state, decomposition.mesh)
        super().__init__(J, F, bcs, contacts, decomposition, u=u, **others)
        if self.options.rtol == "auto":
            raise InputError("rtol auto: it is for linear problems; expected a number")
        self._exact = self.options.number
        locking = [law for law in laws if not law.selective]
        self._diagnostics.may_lock &= not laws or bool(locking)
        plastic = [law for law in locking if isinstance(law, Plasticity)]
        self._diagnostics.flowing_cells = [law.flowing_cells for law in plastic]
        self._system.is_tangent = True
        self._begin = self._first
        self._system.begin_at(self.dofs.to_primal(self._begin))
        length = bcast_from_root(decomposition.comm, diameter(decomposition))
        self._least = self._tolerances.nowhere * length if finite else 0.0
        # of where bodies are
        self._last_digit = EPSILON * length if finite else 0.0
        self._keeping = ModelKeeping(self._tolerances, finite)
        shares = [law.share for law in laws if isinstance(law, J2Plasticity)]
        self._regularisation = Regularisation(self._tolerances, shares)
        self._first_increment = self._loosest  # of the last load step
        if finite:
            self._check_rotations()

    @cached_property
    def _places(self) -> CurrentPlaces | None:
        return CurrentPlaces(self.u, self.dofs) if self._finite else None

    def _forms(self, a: ufl.Form, L: ufl.Form, V: fem.FunctionSpace, *options: Any) -> NewtonForms:
        given = (a, L, V, self.decomposition, *options)
        return NewtonForms(*given, u=self.u, places=self._places)

    def _find(self) -> None:
        begin = np.array(self.u.x.array)
        try:
            self._newton()
            # loads that go on find the tangent of the last step nearer than an elastic one
            self._system.forms.kept = not self._finite
        except TfetiError:  # on all ranks
            self._system.forms.kept = False
            self._system.change("stiffness")
            self._set(begin)
            self._system.tools.go_back()
            raise
        finally:
            self.options = self._settings.options

    def _newton(self) -> None:
        tol, exact, comm = self._tolerances, self._exact, self.decomposition.comm
        forms, expected = self._system.forms, self._first_increment
        anderson, at_begin = Anderson(tol, comm), largest(comm, self.u.x.array)
        keeping = self._keeping
        keeping.begin()
        last = np.inf  # increment
        self._set(self.u.x.array)  # a law's numbers, or what they depend on, may have changed
        for step in range(tol.max_it):
            u = np.array(self.u.x.array)
            # 1. model
            rtol = float(np.clip(self._forcing * expected, exact, self._loosest))
            if not self._finite and rtol < tol.near * exact:
                rtol = min(rtol, tol.last * exact)
            try:
                rtol = self._solve_linearised(rtol, step)
            except (InputError, NoSolutionError) as error:  # of an iterate, not of what was given
                if step == 0:
                    raise
                raise ConvergenceError(
                    f"Newton's method: in step {step + 1} {error}; or smaller load steps"
                ) from error
            self._counts.newton_steps += 1
            end = self._conforming(u, np.array(self.u.x.array))
            d, most = end - u, largest(comm, end)
            increments = self._increments(d, end, max(at_begin, most))
            increment = float(increments.max(initial=0.0))
            # 2. line search
            t, at_end, remainders = self._line_search(u, d)
            self._regularisation.follow(at_end, forms.kept)
            # the next increment
            expected = float(np.max(np.minimum(remainders, 1.0) * increments, initial=0.0))
            # 3. end
            short = increment <= exact and not (self._finite and forms.kept)
            if not self._finite:  # whose slopes do not see rotations
                shares = np.clip(remainders, tol.steepest, tol.flattest)
                expected = float(np.max(shares * increments, initial=0.0))
                left = np.maximum(tol.safety * remainders, tol.steepest) * increments
                short |= t == 1.0 and bool(np.all(left <= exact))
                if increment > tol.slow * last:
                    expected = min(expected, tol.finer * rtol / self._forcing)
            last = increment
            nothing = most <= max(tol.nothing * at_begin, self._least)
            if nothing or (short and rtol <= exact):
                self._set(end)
                return
            # 4. step
            if step == 0:  # what conditions prescribe is met from then on
                self._first_increment = min(increment, self._loosest)
            # a model that does not hold along d tells nothing of the next, nor does a place that is
            # one of many
            plain = t < 1.0 or bool(np.any(self._let_go))
            if plain:
                anderson.past.clear()
            plain |= step == 0 or not (self._finite or forms.kept)
            if not plain:  # else u is where the line search has ended
                self._set(anderson.next(u, d))
                if self._places is not None and self._places.smallest_volume_ratio() <= 0.0:
                    anderson.past.clear()
                    self._set(u + d)
            kept = keeping.keeps(forms.kept, increment * most, t, tol.near * exact * most)
            # old places leave a body that is let go a moment, which drives it
            forms.kept = kept and not np.any(self._let_go)
        self._regularisation.leave()
        raise ConvergenceError(
            f"Newton's method: the increment is still {increment:.1e} of the displacement after "
            f"{tol.max_it} steps; expected {exact:.0e}: {self._advice(d)}"
        )

    def _increments(self, d: Array, end: Array, most: float) -> Array:
        """Return the increment of each body over its displacement. Collective.

        Less than rounding of the largest displacement, or of places, is none.
        """
        subdomains = self._system.subdomains
        moved, size = subdomains.body_sizes(
            [subdomains.with_rigid(self.dofs.to_primal(x)) for x in (d, end)]
        )
        rounding = max(self._tolerances.nothing * most, self._last_digit)
        moved -= np.maximum(self._negligible(subdomains), rounding)
        return np.where(size > self._least, np.maximum(moved, 0.0) / np.maximum(size, TINY), 0.0)

    def _conforming(self, u: Array, end: Array) -> Array:
        """Join the copies of nodes in finite strain, and let what is let go turn by finite angles.

        Rigid motions of copies that are apart stretch what glues them, and small turns stretch
        bodies, which would end the step early. Collective.
        """
        if not self._finite:
            return end
        dofs, subdomains = self.dofs, self._system.subdomains
        end = dofs.to_dolfinx(dofs.spread(mean_of_copies(dofs, dofs.to_primal(end))))
        if not np.any(self._let_go):
            return end
        bodies = self._system.dual.coarse.bodies
        motion = bodies.part_of(subdomains.with_rigid(dofs.to_primal(end - u)))
        amounts = bodies.amounts(motion) * self._let_go[:, None]
        return end + dofs.to_dolfinx(subdomains.turned_beyond(amounts))

    def _advice(self, d: Array) -> str:
        """Say what may help, from the derivative of F along the last step. Collective."""
        tol, forms, u = self._tolerances, self._system.forms, np.array(self.u.x.array)
        h = (
            tol.difference
            * largest(self.decomposition.comm, u)
            / largest(self.decomposition.comm, d)
        )
        before = forms.residual()
        along = forms.tangent() @ d
        self._set(u + h * d)
        apart = (forms.residual() - before) / h - along
        off, size = np.sqrt(dot_over(self.decomposition.comm, (apart, apart), (along, along)))
        if self._has_own_tangent and off > tol.another * size:
            return (
                "a tangent J that is the derivative of F, as J2Plasticity.tangent(w, v) is that of "
                f"its residual; along the last step they differ by {off / size:.1e} of J"
            )
        moved = self._system.subdomains.with_rigid(self.dofs.to_primal(d))
        if words := self._system.dual.coarse.bodies.moved_rigidly(moved, tol.bends):
            return (
                f"{words}, or contact hardly resists that; add a Dirichlet condition, a spring or "
                "friction, or take smaller load steps"
            )
        return "smaller load steps"

    def _check_rotations(self) -> None:
        """Raise if F takes a rotation for a stretch, as strains of small strain do. Collective."""
        u, forms = np.array(self.u.x.array), self._system.forms
        c, s = np.cos(self._tolerances.turned) - 1.0, np.sin(self._tolerances.turned)
        moved, gdim, found = fem.Function(self.u.function_space), len(self.u), list[Array]()
        for a, b in ((0.0, 0.0), (c, 0.0), (c, s), (2 * c, 0.0)):
            way = np.array([[a, -b, 0.0], [b, a, 0.0], [0.0, 0.0, 0.0]])[:gdim]
            moved.interpolate(lambda x, A=way: A @ x)
            self._set(moved.x.array)
            found.append(forms.residual())
        self._set(u)
        size, *apart = self._by_volumes(
            found[1] - found[0],
            found[2] - found[1],
            found[3] - 2 * found[1] + found[0],  # of bodies that are linear: rings do not turn
        )
        seen = size > self._tolerances.rounding * size.max()
        if np.any(small := seen & (np.min(apart, axis=0) <= self._tolerances.alike * size)):
            names = [f"volume {name!r}" for name in self.decomposition.names.volumes]
            where = dict.fromkeys(names[k - 1] for k in np.nonzero(small)[1] if k)
            raise InputError(
                "finite=True: the residual F takes a rotation for a stretch, as small strain does"
                f"{', in ' * bool(where)}{', '.join(where)}; expected one of finite strain, for "
                "instance the derivative of an energy of I + grad(u)"
            )

    def _by_volumes(self, *forces: Array) -> Array:
        """Return norms of forces at the nodes of each body and volume, (bodies, 1 + volumes).

        Nodes of no volume, or of several, are those of column 0. Collective.
        """
        d, dofs = self.decomposition, np.asarray(self.u.function_space.dofmap.list)
        columns = 1 + len(d.names.volumes)
        of = columns * d.body_of_subdomain[d.cell_subdomain]
        for k, tag in enumerate(d.names.volumes.values()):
            of[d.cells(tag)] += k + 1
        at = np.zeros(len(self.u.x.array) // len(self.u), int)
        at[dofs] = of[:, None]
        shared = dofs[at[dofs] != of[:, None]]
        at[shared] -= at[shared] % columns
        squares = np.stack([np.sum(f.reshape(-1, len(self.u)) ** 2, axis=1) for f in forces], 1)
        found = summed(d.comm, sum_rows(at, squares, d.num_bodies * columns))
        return np.sqrt(found.T).reshape(-1, d.num_bodies, columns)

    def _solve_linearised(self, rtol: float, step: int) -> float:
        """Solve the contact problem of the model at u, and return to what rtol. Collective.

        That is the answer's where the tangent has the entries of the last one. The first problem
        warns, and the last. A kept model without an answer, as its places may hold no body that
        turns, is made anew.
        """
        u, given, forms = np.array(self.u.x.array), self._settings.options, self._system.forms
        self._go_to_places()
        try:
            self._system.look_for_changes()
            rtol = self._exact if forms.repeats else rtol
            warns = given.warnings and (step == 0 or rtol <= self._exact)
            atol = max(given.atol, self._last_digit)
            self.options = replace(given, rtol=rtol, atol=atol, warnings=warns)
            self._solve_in_rounds()
            return rtol
        except TfetiError:  # on all ranks
            if not forms.kept:
                raise
        finally:
            forms.known = None
            if self._places is not None:
                self._places.back()
        forms.kept = False
        self._set(u)
        return self._solve_linearised(rtol, step)

    def _go_to_places(self) -> None:
        """Let contact and rigid motions be those of X + u, in finite strain. Collective."""
        if self._places is None:
            return
        self._places.move(anew=not self._system.forms.kept)
        if not self._system.forms.kept:
            moved = (self.u.x.array, self._places.moved)
            self._system.origin = np.stack([self.dofs.to_primal(u) for u in moved])
        self._system.begin_at(self.dofs.to_primal(self._begin))

    def _set(self, u: Array) -> None:
        """Take a displacement, and what depends on it. Collective."""
        self.u.x.array[:], self._system.forms.known = u, None
        if self._updates:
            with raised_on_all_ranks(self.decomposition.comm), named("update"):
                for update in self._updates:
                    update()

    def _line_search(self, u: Array, d: Array) -> tuple[float, float, Array]:
        """Go to u + t d, and return t in (0, 1], r(1)/r(0), and |r(1)/r(0)| of bodies. Collective.

        The last are of each body's part of d. Where r(1)/r(0) is below 0, d goes too far.
        """
        tol, subdomains = self._tolerances, self._system.subdomains
        primal = subdomains.with_rigid(self.dofs.to_primal(d))
        parts = subdomains.block_parts
        diagonals = [float(block.diagonal @ primal[part] ** 2) for block, part in parts]
        found = subdomains.of_bodies([subdomains.energies(primal), diagonals])
        energies, rounding = (steering(subdomains.comm, *of_bodies) for of_bodies in found)
        rounding *= tol.rounding
        # λᵀB d, since J d + F(u) + Bᵀλ = 0
        forces = -energies - self._works(self._system.forms.at_model, d)
        b, slopes = self._longest(u, d, forces)
        # of a step that is rigid, or nearly, slopes are rounding and say nothing
        remainders = np.ones(len(energies))
        np.divide(np.abs(slopes), energies, remainders, where=energies > rounding)
        a, low, high = 0.0, float(-sum(energies)), float(sum(slopes))
        enough, left = self._curvature * abs(low), high / low if -low > sum(rounding) else 0.0
        if high <= max(enough, sum(rounding)):
            return b, left, remainders
        for _ in range(tol.max_line_search):  # regula falsi in Illinois' form
            t = b - high * (b - a) / (high - low)
            slope = float(sum(self._slopes(u, d, t) + forces))
            if abs(slope) <= enough:
                break
            if slope > 0.0:
                b, high, low = t, slope, 0.5 * low
            else:
                a, low, high = t, slope, 0.5 * high
        return t, left, remainders

    def _longest(self, u: Array, d: Array, forces: Array) -> tuple[float, Array]:
        """Return the longest step that leaves no cell inside out, and r at its end. Collective."""
        t = 1.0
        while t >= self._tolerances.shortest:
            self._set(u + t * d)
            if self._places is None or self._places.smallest_volume_ratio() > 0.0:
                slopes = self._slopes(u, d, t) + forces
                if np.all(np.isfinite(slopes)):
                    return t, slopes
            t *= 0.5
        raise ConvergenceError(
            f"Newton's method: a step shortened to {t:.1e} still turns a cell inside out (det F "
            "≤ 0), or gives a residual that is not finite; expected smaller load steps, tools that "
            "are outside (is a normal turned?), and surfaces with the sides that roll onto a tool"
        )

    def _slopes(self, u: Array, d: Array, t: float) -> Array:
        """F(u + t d; d) of each body. Collective."""
        self._set(u + t * d)
        self._system.forms.known = F = self._system.forms.residual()
        return self._works(F, d)

    def _works(self, F: Array, d: Array) -> Array:
        """Fᵀd of each body, the same on all ranks. Collective."""
        subdomains = self._system.subdomains
        own = subdomains.with_rigid(self.dofs.to_primal(F * d))
        (found,) = subdomains.of_bodies([sums(own, subdomains.dof_parts)])
        return steering(subdomains.comm, *found)

    def update(
        self,
        *,
        load: ufl.Form | None = None,
        values: Sequence[fem.DirichletBC] | None = None,
        stiffness: ufl.Form | None = None,
        gap: Mapping[int | str, Gap] | None = None,
    ) -> None:
        """Take other Dirichlet conditions or gaps; see ``ContactProblem.update``.

        Raises:
            InputError: As there, or a load or a stiffness is given, or a gap in finite strain.
        """
        with agreeing(self.decomposition.comm, "update") as given:
            given |= {"load": load, "stiffness": stiffness, "gap": gap}
            if load is not None or stiffness is not None:
                raise InputError(
                    "update: load and stiffness are those of linear problems; expected constants "
                    "and functions in F that change"
                )
            if gap is not None and self._finite:
                raise InputError(
                    "update: gaps in finite strain are those of the places; expected none"
                )
        super().update(values=values, gap=gap)

    def _begin_next(self) -> None:
        super()._begin_next()
        self._state.commit()
        self._begin = np.array(self.u.x.array)
        self._set(self._begin)

    def state(self) -> SavedState:
        """Return the last accepted solution, with internal variables, for ``restore``.

        Products with F are of the last tangent, which the run that goes on does not have.
        """
        weights = self._system.weights
        state = replace(super().state(), image=np.zeros(0), directions=np.zeros((0, 2, 0)))
        assert weights is not None
        state = replace(state, weights=weights, freezes=np.array(float(self._keeping.freezes)))
        if not self._state.functions:
            return state
        cells = labels_of_cells(self.decomposition)
        return replace(state, cells=cells, internal=self._state.in_cells())

    def restore(self, state: SavedState) -> None:
        """Go on where another run of the same program has been.

        Raises:
            InputError: As ``ContactProblem.restore``, or of other internal variables.
        """
        try:
            super().restore(state)
        finally:
            if self._places is not None:
                self._places.back()
        self._begin = np.array(self.u.x.array)

    def _check_state(self, state: SavedState) -> None:
        super()._check_state(state)
        expected = sum(len(function.x.array) for function in self._state.functions)
        if state.internal.size != expected or len(state.internal) != len(state.cells):
            raise InputError(
                f"the state has {state.internal.size} values of internal variables on this rank; "
                f"expected {expected}, those of state="
            )
        if state.weights.shape != state.u.shape:
            raise InputError("the state has no weights; expected that of a nonlinear problem")

    def _take_motion(self, state: SavedState) -> None:
        if self._state.functions:
            self._state.set_in_cells(state.internal)
        self._begin, self._system.weights = self.dofs.to_dolfinx(state.u), state.weights
        self._system.forms.kept, self._keeping.freezes = False, bool(state.freezes)
        self._set(self._begin)
        self._go_to_places()

    def _negligible(self, subdomains: Subdomains) -> Array:
        begin = subdomains.with_rigid(self.dofs.to_primal(self._begin))
        share = self._tolerances.negligible * self._exact
        return np.asarray(share * subdomains.body_sizes([begin])[0])

    def go_back(self) -> None:
        """Return to the last accepted solution; see ``ContactProblem.go_back``."""
        super().go_back()
        self._set(self.u.x.array)
