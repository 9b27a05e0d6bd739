"""Forms of Newton's method: its matrix and load, on the mesh as it was or as it is."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, ClassVar

import basix
import numpy as np
import ufl
from dolfinx import fem
from scipy.sparse import csr_array
from ufl.algorithms import expand_derivatives
from ufl.constantvalue import Zero
from ufl.corealg.traversal import unique_pre_traversal

from tfeti_dolfinx.common.arrays import EPSILON, Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.parallel import any_rank, least
from tfeti_dolfinx.forms.assembly import Data, Forms, Load
from tfeti_dolfinx.forms.newmark import Inertia
from tfeti_dolfinx.mesh.dofs import TornDofs

# degree of the quadrature whose points det F is looked at
DEGREE = 4
# of |J| |u|: a load less than this is its rounding, and that of F
ROUNDING = 32.0 * EPSILON


def dead_loads(F: ufl.Form, u: fem.Function) -> ufl.Form:
    """Return those terms of F(u; v) that have neither u nor derivatives: loads that stay."""

    def summands(e: Any) -> list[Any]:
        parts = e.ufl_operands if isinstance(e, ufl.classes.Sum) else ()
        return [term for part in parts for term in summands(part)] or [e]

    terms = [(i, e) for i in expand_derivatives(F).integrals() for e in summands(i.integrand())]
    dead = [
        i.reconstruct(integrand=e)
        for i, e in terms
        if not any(isinstance(x, ufl.classes.Derivative) or x == u for x in unique_pre_traversal(e))
    ]
    return ufl.Form(dead)


def rotation_free_tangent(F: ufl.Form, u: fem.Function) -> ufl.Form:
    """Return a tangent of a residual whose kernel are the rigid motions about X + u.

    With F = I + ∇u, the first Piola–Kirchhoff stress P and S = F⁻¹P the tangent along w has a
    material part, ∫E(w) : C : E(v), E(w) = sym(Fᵀ∇w), and a geometric one, ∫∇w S : ∇v = ∫P : Aᵀ∇v,
    A = ∇w F⁻¹. A body under stress resists rotations by the latter, so the whole has a smaller
    kernel, and is often indefinite. Here F⁻ᵀE(w) and F⁻ᵀE(v) take the place of ∇w and ∇v in the
    geometric part: what stretches a body is as stiff as it is, and rotations, E = 0, cost nothing.
    Forces on facets that turn with the body have no part in it.

    Args:
        F: Residual, linear in its test function, for instance ∫P(u):∇v dx less that of loads.
        u: The displacement.
    """
    F = expand_derivatives(F)
    (v,) = F.arguments()
    w = ufl.TrialFunction(u.function_space)
    inside = ufl.Form([i for i in F.integrals() if i.integral_type() == "cell"])
    on_facets = [
        i
        for i in F.integrals()
        if i.integral_type() != "cell"
        and not any(e == ufl.grad(u) for e in unique_pre_traversal(i.integrand()))
    ]
    tangent = ufl.derivative(ufl.Form([*inside.integrals(), *on_facets]), u, w)
    deformation = ufl.Identity(len(u)) + ufl.grad(u)
    inverse = ufl.inv(deformation)

    def stretched(y: Any) -> Any:
        return inverse.T * ufl.sym(deformation.T * ufl.grad(y))

    # F is linear in ∇v: the difference of both geometric parts is that of one gradient; v itself,
    # as body forces have it, has none
    gradient = (stretched(w) * inverse).T * stretched(v) - (ufl.grad(w) * inverse).T * ufl.grad(v)
    change = {ufl.grad(v): expand_derivatives(gradient), v: Zero(v.ufl_shape)}
    return tangent + ufl.replace(inside, change)


class NewtonForms(Forms):
    """Matrix J(u) and load J u − F(u) of the linearised problem at u.

    Its solution is the next displacement, not an increment, which would be rounding of u in the
    end. Creation and all methods are collective. J is the derivative of the residual F; ``finite``
    forms are integrated over the mesh as it was, wherever it is.

    Attributes:
        kept: Whether matrix and factors stay as they are, though u changes.
        known: F(u) where it is known; else None.
        at_model: F(u) of the last load.
    """

    names: ClassVar[tuple[str, str]] = ("J", "F")

    def __init__(
        self,
        J: ufl.Form,
        F: ufl.Form,
        *as_forms: Any,
        u: fem.Function,
        places: "CurrentPlaces | None",
    ) -> None:
        self._u, self._places, self.kept = u, places, False
        self._ready = False  # whether the matrix is that of the present u
        self.known: Array | None = None
        self.at_model: Array = np.zeros(0)
        self._matrix: csr_array | None = None
        mesh, tdim = u.function_space.mesh, u.function_space.mesh.topology.dim
        cells = np.arange(mesh.topology.index_map(tdim).size_local, dtype=np.int32)
        # strains are differences to the identity, and displacements of nodes to those beside them
        self._length = 0.0 if places is None else float(mesh.h(tdim, cells).max(initial=0.0))
        super().__init__(J, F, *as_forms)
        dead = dead_loads(F, u)
        self._dead = None if dead.empty() else self._compiled(dead, self.names[1])

    def changes(self, *kept: str) -> set[str]:
        """Return what is new, of J nothing where it is kept; another u makes a new load."""
        found = super().changes(*kept, *(["stiffness"] if self.kept else []))
        self.repeats = self._ready = False
        if "stiffness" not in found:
            return found
        known, comm = self._matrix, self._decomposition.comm
        if known is not None and self._places is None and "points" not in found:
            before, self._matrix = known.data.copy(), self.tangent()
            self._ready = any_rank(comm, not np.array_equal(self._matrix.data, before))
            self.repeats = not self._ready
        return (found - {"stiffness"} if self.repeats else found) | {"load"}

    def stiffness(self) -> Any:
        """Return this rank's J(u)."""
        if not self._ready:
            self._matrix = self.tangent()
        self._ready = False
        return self._matrix

    def tangent(self) -> Any:
        """Assemble this rank's J(u)."""
        with self._in_place():
            return super().stiffness()

    def load(self) -> Load:
        """Return this rank's J u − F(u), but for what is rounding: that would drive free bodies.

        Loads that know nothing of u are no part of that: a small weight stays.
        """
        assert self._matrix is not None  # stages make it before
        u, dead = self._u.x.array[: self._matrix.shape[1]], self.dead()
        self.at_model = self.residual() if self.known is None else self.known
        found = self._matrix @ u - self.at_model + dead
        rounding = ROUNDING * (abs(self._matrix) @ (abs(u) + self._length))
        found[abs(found) <= rounding] = 0.0
        return Load(found - dead, rounding, dead + np.zeros_like(found))

    def dead(self) -> Any:
        """Return this rank's part of the residual that is of loads which know nothing of u."""
        if self._dead is None:
            return 0.0
        with self._in_place():
            return fem.assemble_vector(self._dead).array

    def residual(self) -> Array:
        """Return this rank's F(u)."""
        with self._in_place():
            return self._linear()

    def _in_place(self) -> AbstractContextManager[None]:
        """Integrate over the mesh as it was, in finite strain."""
        return nullcontext() if self._places is None else self._places.at_rest()


class InertialNewtonForms(NewtonForms):
    """Matrix and load of the linearised problem in a time step of bodies with mass.

    The trapezoidal rule, with the residual F at the start and at the end of the step τ and w = u +
    τv, or what takes its place: R(u⁺) = (F(u) + F(u⁺))/2 + 2M(u⁺ − w)/τ², and its derivative J/2 +
    2M/τ². M is that of the bodies where they were. Creation and all methods are collective.
    ``inertia`` has M, and where the step begins; its loads are −F.
    """

    has_mass: ClassVar[bool] = True

    def __init__(self, mass: ufl.Form, *as_forms: Any, **given: Any) -> None:
        super().__init__(*as_forms, **given)
        self.inertia = Inertia(mass, self._V, self._decomposition, self._compiled)
        mesh, places = self._V.mesh, self._places
        at_rest = (lambda: [mesh.geometry.x]) if places is None else lambda: [places.rest]
        self._rest = Data(at_rest, self._decomposition.comm)
        self.given = {**self.given, "mass": mass}

    def changes(self, *kept: str) -> set[str]:
        """Return what is new, by inertia, too."""
        found = self.inertia.changes(self._rest.has_changed())
        return found | super().changes(*kept)

    def tangent(self) -> Any:
        """Assemble this rank's J/2 + 2M/τ²."""
        J = super().tangent()
        with self._in_place():
            return 0.5 * J + self.inertia.share * self.inertia.M

    def residual(self) -> Array:
        """Return this rank's R(u); F(u) before the step has a size."""
        F, inertia, motion = super().residual(), self.inertia, self.inertia.motion
        if not motion.time_step:
            return F
        with self._in_place():
            pull = inertia.M @ (self._u.x.array - motion.predicted)
        return 0.5 * (F - motion.load) + inertia.share * pull

    def dead(self) -> Any:
        """Return this rank's part of R(u) that is of loads at the end."""
        return 0.5 * super().dead()

    def forces(self) -> Array:
        """Return this rank's −F(u): loads less stresses."""
        return -super().residual()

    def elastic(self, u: Array) -> float:
        """Return 0: F need have no energy, and its work is that of the load."""
        return 0.0


class CurrentPlaces:
    """The places X + u of a mesh and of its nodes. Creation and ``move`` are collective.

    Attributes:
        moved: The displacement of the mesh, u as far as its degree has it.
    """

    def __init__(self, u: fem.Function, dofs: TornDofs) -> None:
        V = u.function_space
        self._u, self._dofs, self._mesh = u, dofs, V.mesh
        self._here, self._moving = np.array(u.x.array), fem.Function(V)
        self._rest: Array | None = None  # while the mesh is moved
        element = V.mesh.ufl_domain().ufl_coordinate_element()
        self._at_points = fem.Function(fem.functionspace(V.mesh, element))
        cells = np.asarray(self._at_points.function_space.dofmap.list)
        self._from, self._to = cells.ravel(), geometry_dofmap(V.mesh)[: len(cells)].ravel()
        det = ufl.det(ufl.Identity(len(u)) + ufl.grad(u))
        points, _ = basix.make_quadrature(V.mesh.basix_cell(), DEGREE)
        self._det = fem.Expression(det, points)
        self._cells = np.arange(len(cells), dtype=np.int32)

    @property
    def rest(self) -> Array:
        """X, which may be others between two solves."""
        return self._mesh.geometry.x if self._rest is None else self._rest

    @contextmanager
    def at_rest(self) -> Iterator[None]:
        """Put the mesh to X for a while. Not collective."""
        x = self._mesh.geometry.x
        here = x.copy()
        x[:] = self.rest
        try:
            yield
        finally:
            x[:] = here

    def move(self, anew: bool) -> None:
        """Put mesh and nodes to X + u, u as it is now, else as it was the last time."""
        self.back()
        x, gdim = self._mesh.geometry.x, self._mesh.geometry.dim
        rest, nodes = x.copy(), self._u.function_space.tabulate_dof_coordinates()
        self._rest = rest
        if anew:
            self._here = np.array(self._u.x.array)
        self._moving.x.array[:] = self._here
        self._at_points.interpolate(self._moving)
        self._moving.interpolate(self._at_points)
        self.moved = self._moving.x.array
        moved = self._at_points.x.array.reshape(-1, gdim)
        x[self._to, :gdim] = rest[self._to, :gdim] + moved[self._from]
        here = nodes.copy()
        here[:, :gdim] += self._here.reshape(-1, gdim)
        self._dofs.nodes = np.stack((here, nodes))

    def back(self) -> None:
        """Put them to where they were. Not collective."""
        self._mesh.geometry.x[:] = self.rest
        self._rest = self._dofs.nodes = None

    def smallest_volume_ratio(self) -> float:
        """Return the smallest det F at points of cells, u as it is now. Collective."""
        own = np.min(self._det.eval(self._mesh, self._cells), initial=np.inf)
        return least(self._mesh.comm, float(own))
