"""Ready laws: where they hold and who updates them, J2 plasticity in small strain."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeAlias

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms import extract_coefficients

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import interpolation_points
from tfeti_dolfinx.common.validation import (
    FROM_0,
    POSITIVE,
    checked_flag,
    checked_number,
    checked_type,
)
from tfeti_dolfinx.errors import ConvergenceError, InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.elasticity import Elasticity, Modulus, in_ufl
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.nonlinear.state import NewValue

# volumes by their names or tags; None: all
Volumes: TypeAlias = "str | int | Sequence[str | int] | None"


@dataclass(frozen=True)
class ReturnTolerances:
    """Tolerances of the return to the yield surface."""

    # beyond the yield stress by less than this share a point is elastic: where a load step begins
    # the stress lies on the yield surface, up to rounding
    yielding: float = 1e-10
    rtol: float = 1e-14  # of the yield stress, to which the return is solved
    # most Newton steps of the return, which is exact in one where hardening is linear
    max_it: int = 50
    # share of the elastic moduli that a tangent without hardening gets, so that its only kernel are
    # rigid motions; the residual has none of it
    perfect: float = 1e-4
    # share of the shear modulus that a tangent of finite strain keeps on all that stretches:
    # stresses near the moduli, as a trial displacement may have, take from it
    definite: float = 1e-3
    # plastic strain over that of yielding, σ_y/3μ, from which on flow is most of the strain: of ν =
    # 0.3 it leaves as little stiffness against shear, beside that against a change of volume, as
    # ν = 0.474 has
    flows: float = 8.0


# what hardening is given by, and its ranges
HARDENING = {"yield_stress": POSITIVE, "hardening": FROM_0, "saturation": FROM_0, "rate": FROM_0}


@dataclass(frozen=True)
class IsotropicHardening:
    """Yield stress σ_y(p), as ``J2Plasticity`` has it, and the return to it.

    Creation raises an InputError where a number does not fit; the message names it.
    """

    # yield stress at the start, a force per area, a number or numbers at points
    yield_stress: Array
    hardening: Array  # linear hardening modulus, a force per area, likewise
    saturation: Array  # what the yield stress gains by Voce's hardening in the end, likewise
    rate: Array  # rate of Voce's hardening, likewise
    tolerances: ReturnTolerances  # those of the return

    def __post_init__(self) -> None:
        for name, expected in HARDENING.items():
            values = getattr(self, name)
            for number in (values.min(), values.max()) if values.size else ():
                checked_number(number, name, expected)

    @property
    def regularisation(self) -> Array:
        """Share of the elastic moduli in the tangent; 0 where there is hardening."""
        hardens = self.hardening + self.saturation * self.rate > 0.0
        return np.where(hardens, 0.0, self.tolerances.perfect)

    def at(self, p: Array) -> tuple[Array, Array]:
        """Return the yield stress at accumulated plastic strains, and its slope."""
        rest = self.saturation * np.exp(-self.rate * p)
        stress = self.yield_stress + self.hardening * p + self.saturation - rest
        return stress, self.hardening + self.rate * rest

    def returned(self, q: Array, G: Array, p: Array) -> tuple[Array, Array]:
        """Solve q − 3G Δp = σ_y(p + Δp) where q is beyond the yield stress.

        q is von Mises' trial stress, p the accumulated plastic strain where the load step began.
        Return Δp, 0 where a point is elastic, and the slope of σ_y at p + Δp; raise a
        ConvergenceError where steps do not suffice.
        """
        tol, dp = self.tolerances, np.zeros_like(q)
        plastic = q > (1.0 + tol.yielding) * self.at(p)[0]
        for _ in range(tol.max_it):  # concave in dp: Newton's method goes up monotonically
            y, slope = self.at(p + dp)
            f = np.where(plastic, q - 3.0 * G * dp - y, 0.0)
            dp += f / (3.0 * G + slope)
            if not np.any(np.abs(f) > tol.rtol * (q + y)):
                return dp, self.at(p + dp)[1]
        raise ConvergenceError(
            f"J2 plasticity: the return takes more than {tol.max_it} steps somewhere"
        )


class Material(ABC):
    """A ready law, of all volumes or of some. Creation is collective.

    A problem calls ``update`` where its forms have functions that this sets, and commits ``state``.

    Attributes:
        elasticity: The elastic law.
        u: The displacement.
        volumes: Tags of the volumes; None: all.
        selective: Whether what resists a change of volume is integrated at centres of cells.
        dx: The measure of their cells.
        state: Internal variables with their values at the end of a load step.
    """

    # how far from the centre, of a reference cell of length 1, the two points of the rule there
    # are: FFCx 0.9 takes values at a single point for those of other rules, too, and values that
    # differ by 1e-6 for the same; forces of a homogeneous strain are off by the square
    _beside = 1e-5

    def __init__(
        self,
        elasticity: Elasticity,
        u: fem.Function,
        degree: int | None,
        selective: bool,
        volumes: Volumes,
    ) -> None:
        name = type(self).__name__
        checked_type(elasticity, Elasticity, "elasticity", "a tfeti_dolfinx.Elasticity")
        checked_type(u, fem.Function, "u", "a dolfinx.fem.Function")
        if elasticity.model == "plane_stress":
            raise InputError(
                f"{name}: plane stress is not there; expected plane strain, axisymmetric or 3d"
            )
        mesh, on = elasticity.mesh, elasticity.on
        if u.function_space.mesh is not mesh:
            raise InputError(f"{name}: u is on another mesh than the elasticity")
        self.elasticity, self.u = elasticity, u
        self.volumes: list[int] | None = None
        self.state: Mapping[fem.Function, NewValue] = {}
        self._inside: fem.Function | None = None
        inside: dict[str, Any] = {}
        if volumes is not None:
            checked_type(on, Decomposition, f"{name}: volumes=: elasticity.on", "a Decomposition")
            with agreeing(on.comm, name) as given:
                names = volumes if isinstance(volumes, (list, tuple)) else [volumes]
                given["volumes"] = self.volumes = sorted({on.volume(one) for one in names})
                if not names:
                    raise InputError(f"{name}: volumes are none; expected names or tags")
            inside = {"subdomain_data": on.cell_tags, "subdomain_id": tuple(self.volumes)}
            self._inside = fem.Function(fem.functionspace(on.mesh, ("DG", 0)))
            self._inside.x.array[self._rows_of(self._inside)] = 1.0
        own, cell = u.function_space.element.basix_element.degree, mesh.basix_cell()
        simplex = cell in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self.selective = checked_flag(selective, "selective")
        if selective and (simplex or own != 1):
            raise InputError(
                f"selective=True on {cell.name}s with displacements of degree {own}; expected "
                "quadrilaterals or hexahedra of degree 1 (degree 2 does not lock)"
            )
        exact = max(2 * own - (2 if simplex else 0), 1)  # on affine cells
        self._degree = exact if degree is None else degree
        rule: dict[str, Any] = {"quadrature_degree": self._degree, "quadrature_scheme": "default"}
        self.dx = ufl.Measure("dx", domain=mesh, metadata=rule, **inside)
        if selective:
            shifts = (-self._beside, self._beside)
            points = tuple((0.5 + shift,) * mesh.topology.dim for shift in shifts)
            rule = {"quadrature_rule": "custom", "quadrature_points": points}
            rule |= {"quadrature_weights": (0.5, 0.5)}
        # of what resists a change of volume; where it is selective, at the centre of each cell
        self._dx_volume = ufl.Measure("dx", domain=mesh, metadata=rule, **inside)
        self._centred: tuple[fem.Function, fem.Expression] | None = None

    def update(self) -> None:
        """Take ``u`` as it is now. Collective."""
        if not self.selective:
            return
        if self._centred is None:
            W = fem.functionspace(self.elasticity.mesh, ("DG", 0, (3, 3)))
            of_u = fem.Expression(self._stresses(self.u)[0], interpolation_points(W))
            self._centred = fem.Function(W), of_u
        function, of_u = self._centred
        function.interpolate(of_u)

    def stress(self, u: Any) -> Any:
        """Return Cauchy's stress, 3×3, of the displacement that ``update`` was called for."""
        of_volume, of_shape = self._stresses(u)
        if self._centred is not None:
            of_volume = self._centred[0]
        whole = of_volume + of_shape
        return whole if self._inside is None else self._inside * whole  # 0 outside of the volumes

    @abstractmethod
    def _stresses(self, u: Any) -> tuple[Any, Any]:
        """Return the stress by which changes of volume are resisted, and the rest."""

    def _updated(self, V: fem.FunctionSpace, name: str | None = None) -> fem.Function:
        """Return a function that ``update`` sets, by which forms tell that they have the law."""
        function = fem.Function(V, name=name)
        function.law = self
        return function

    def _space(self, shape: tuple[int, ...] = ()) -> fem.FunctionSpace:
        """Return the space of values at the quadrature points."""
        mesh = self.elasticity.mesh
        cell = mesh.basix_cell()
        element = basix.ufl.quadrature_element(cell, value_shape=shape, degree=self._degree)
        return fem.functionspace(mesh, element)

    def _rows_of(self, function: fem.Function) -> Any:
        """Return which values of a scalar function belong to cells of the law, cell by cell."""
        if self.volumes is None:
            return slice(None)
        tags = self.elasticity.on.cell_tags
        cells = tags.indices[np.isin(tags.values, self.volumes)]
        return np.asarray(function.function_space.dofmap.list)[cells].ravel()


def laws_of(
    F: ufl.Form, update: Any, u: fem.Function, finite: bool, decomposition: Decomposition
) -> list[Material]:
    """Return the laws of u in a residual, and the one whose method ``update`` is.

    Raise an InputError where that is of another displacement, a law is of small strain though the
    problem is ``finite``, or laws are in the same volumes, as where ``volumes`` was forgotten. Laws
    that have the same ``volumes`` given, or are in one integral, are taken to act in parallel.
    """
    found: list[tuple[Material, int, set[Any]]] = []  # a law, its integral, tags there
    names = {tag: repr(name) for name, tag in decomposition.names.volumes.items()}
    for k, part in enumerate(F.integrals()):
        tags: set[Any] = set(np.atleast_1d(part.subdomain_id()).tolist())
        if "everywhere" in tags or part.subdomain_data() is not decomposition.cell_tags:
            tags = set(names) if "everywhere" in tags else set()
        for law in (getattr(f, "law", None) for f in extract_coefficients(part.integrand())):
            if isinstance(law, Material) and law.u is u:
                found.append((law, k, tags.intersection(law.volumes or names)))
    laws = dict.fromkeys(law for law, _, _ in found)
    if isinstance(law := getattr(update, "__self__", None), Material):
        if law.u is not u:
            raise InputError(
                f"update is a method of a {type(law).__name__} of another displacement; expected "
                "one that was made with u"
            )
        laws[law] = None
    if finite and any(isinstance(law, J2Plasticity) for law in laws):
        raise InputError(
            "finite=True: J2Plasticity is of small strain; expected FiniteJ2Plasticity"
        )
    for (one, j, here), (other, k, there) in combinations(found, 2):
        meant = one is other or j == k or one.volumes == other.volumes is not None
        if here & there and not meant and (len(names) > 1 or one.volumes or other.volumes):
            where = ", ".join(names[tag] for tag in sorted(here & there))
            raise InputError(
                f"F has a {type(one).__name__} and a {type(other).__name__}, both in {where}; "
                "expected volumes= of both with none in common, or the same where laws act in "
                "parallel"
            )
    return list(laws)


class Plasticity(Material):
    """Plasticity by von Mises with isotropic hardening, in small or in finite strain.

    Creation is collective; arguments are those of ``J2Plasticity``.

    Attributes:
        given: Yield stress, hardening modulus, saturation and rate in UFL, by their names.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        u: fem.Function,
        *,
        yield_stress: Modulus,
        hardening: Modulus = 0.0,
        saturation: Modulus = 0.0,
        rate: Modulus = 0.0,
        degree: int | None = None,
        selective: bool = False,
        volumes: Volumes = None,
        tolerances: ReturnTolerances | None = None,
    ) -> None:
        super().__init__(elasticity, u, degree, selective, volumes)
        self._bulk = elasticity.E / 3 / (1 - 2 * elasticity.nu)
        values = zip(HARDENING.items(), (yield_stress, hardening, saturation, rate), strict=True)
        self.given = {
            name: in_ufl(value, elasticity.on, name, expected) for (name, expected), value in values
        }
        self._tolerances = tolerances or ReturnTolerances()
        scalar = self._space()
        self._value, points = fem.Function(scalar), interpolation_points(scalar)
        self._rows = self._rows_of(self._value)
        self._at_points = {
            name: value if isinstance(value, fem.Constant) else fem.Expression(value, points)
            for name, value in self.given.items()
        }
        of_yielding = self.given["yield_stress"] / (3 * elasticity.mu)
        self._strain_of_yielding = fem.Expression(of_yielding, points)
        self._begin()
        self.update()

    @abstractmethod
    def _begin(self) -> None:
        """Make functions and expressions at the quadrature points."""

    @abstractmethod
    def _accumulated(self) -> Array:
        """Return p at the end of the load step, at all quadrature points."""

    def flowing_cells(self) -> Array:
        """Return this rank's cells in which plastic flow is most of the strain. Collective."""
        far = self._tolerances.flows * self._values_of(self._strain_of_yielding)
        flows = np.zeros(len(self._value.x.array), dtype=bool)
        flows[self._rows] = self._accumulated()[self._rows] > far
        cells = np.asarray(self._value.function_space.dofmap.list)
        return np.flatnonzero(np.any(flows[cells], axis=1))

    def hardening(self) -> IsotropicHardening:
        """Return yield stress and hardening with their values at its quadrature points. Collective.

        Raise an InputError where a value does not fit; the message names it.
        """
        values = {}
        for name, value in self._at_points.items():
            is_number = isinstance(value, fem.Constant)
            values[name] = np.asarray(value.value) if is_number else self._values_of(value)
        with raised_on_all_ranks(self.u.function_space.mesh.comm):
            return IsotropicHardening(**values, tolerances=self._tolerances)

    def _values_of(self, scalar: fem.Expression) -> Array:
        """Return the values of an expression at its quadrature points. Collective."""
        self._value.interpolate(scalar)
        return np.array(self._value.x.array[self._rows])

    @property
    def regularisation(self) -> Any:
        """Share of the elastic moduli in the tangent, in UFL; 0 where there is hardening."""
        given = self.given
        hardens = given["hardening"] + given["saturation"] * given["rate"]
        return ufl.conditional(ufl.gt(hardens, 0.0), 0.0, self._tolerances.perfect)


class J2Plasticity(Plasticity):
    """Plasticity by von Mises with isotropic hardening in small strain. Creation is collective.

    The yield stress is σ_y(p) = yield_stress + hardening p + saturation (1 − exp(−rate p)), p the
    accumulated plastic strain: no hardening, linear hardening, or Voce's. Stresses return to the
    yield surface along the radius, and the tangent is that of the return (Simo, Hughes,
    Computational Inelasticity, 1998, section 3.3). Strains are those of ``elasticity``: in space,
    plane strain, or axisymmetric.

    Args:
        elasticity: The elastic law; its moduli may differ from point to point.
        u: The displacement.
        yield_stress: Yield stress at the start, a force per area, more than 0. As moduli of
            ``elasticity`` it may be a number, one for each volume by its name, a constant, a
            function or UFL on the torn mesh, and so may be what hardens.
        hardening: Linear hardening modulus, a force per area, 0 or more.
        saturation: What the yield stress gains by Voce's hardening in the end, 0 or more.
        rate: Rate of Voce's hardening, 0 or more.
        degree: Degree of the quadrature, of plastic strains too; default twice that of ``u``,
            less 2, and at least 1, and 2 on quadrilaterals and hexahedra.
        selective: Whether the change of volume is integrated at the centre of each cell, on
            quadrilaterals and hexahedra of degree 1: plastic flow keeps the volume, and cells that
            are fully integrated, or simplices of degree 1, are too stiff for it (locking).
        volumes: Those of this law, a name or tag or several; default all. ``residual`` and
            ``tangent`` are integrals over them, ``stress`` is 0 elsewhere.
        tolerances: Those of the return.

    Attributes:
        plastic_strain: Plastic strain where the load step began, components xx, yy, zz, xy and in
            space xz, yz.
        p: Accumulated plastic strain there.
        share: Share of the elastic moduli that plastic points have in the tangent at least, and
            none of it in the residual; ``NonlinearContactProblem`` sets it.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    def _begin(self) -> None:
        self._gdim, elasticity, u = self.elasticity.mesh.geometry.dim, self.elasticity, self.u
        Q, W = self._space(), self._space((6 if self._gdim == 3 else 4,))
        self.share = fem.Constant(elasticity.mesh, 0.0)
        self.share.law = self  # no part of what the user gives
        self.plastic_strain = fem.Function(W, name="plastic_strain")
        self.p = fem.Function(Q, name="accumulated_plastic_strain")
        self._dp = self._updated(Q, name="plastic_increment")  # of this load step
        self._slope = self._updated(Q, name="hardening_slope")
        self._q_and_G, s = fem.Function(self._space((2,))), self._trial(u)
        q_and_G = ufl.as_vector((ufl.sqrt(1.5 * ufl.inner(s, s)), elasticity.mu))
        self._q_and_G_of_u = fem.Expression(q_and_G, interpolation_points(Q))
        self._n = 1.5 * s / self._norm(u)  # direction of plastic flow
        new = self._tensor(self.plastic_strain) + self._dp * self._n
        places = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
        components = [new[i, j] for i, j in places[: 6 if self._gdim == 3 else 4]]
        self.state = {self.plastic_strain: ufl.as_vector(components), self.p: self.p + self._dp}

    def _accumulated(self) -> Array:
        return np.asarray(self.p.x.array + self._dp.x.array)

    @property
    def regularisation(self) -> Any:
        """Share of the elastic moduli that plastic points have in the tangent besides, in UFL."""
        return ufl.max_value(self.share, super().regularisation)

    def update(self) -> None:
        """Return stresses to the yield surface where ``u`` is now. Collective."""
        super().update()
        self._q_and_G.interpolate(self._q_and_G_of_u)
        q, G = self._q_and_G.x.array.reshape(-1, 2)[self._rows].T.copy()
        hardening = self.hardening()
        with raised_on_all_ranks(self.u.function_space.mesh.comm):
            if not np.all(np.isfinite(q)):
                raise InputError("J2Plasticity: the stress is not finite")
            dp, slope = hardening.returned(q, G, self.p.x.array[self._rows])
        self._dp.x.array[self._rows] = dp
        self._slope.x.array[self._rows] = slope

    def _stresses(self, u: Any) -> tuple[Any, Any]:
        e = self.elasticity.strain(u)
        return self._bulk * ufl.tr(e) * ufl.Identity(3), self._deviator(u)

    def residual(self, v: Any) -> ufl.Form:
        """Return ∫σ(u):ε(v)."""
        thickness, e = self.elasticity.thickness, self.elasticity.strain(v)
        dilatation = ufl.tr(self.elasticity.strain(self.u))
        volume = thickness * self._bulk * dilatation * ufl.tr(e)
        return volume * self._dx_volume + thickness * ufl.inner(self._deviator(self.u), e) * self.dx

    def tangent(self, w: Any, v: Any) -> ufl.Form:
        """Return the derivative of ``residual`` along w, consistent with the return."""
        F = self.residual(v)
        return ufl.derivative(F, self.u, w) + self.of_update(F, w, v)

    def of_update(self, F: ufl.Form, w: Any, v: Any) -> ufl.Form:
        """Return the derivative along w of a residual as ``update`` returns stresses.

        And what is for tangents alone.
        """
        e, mu = self.elasticity.strain(w), self.elasticity.mu
        plastic = ufl.conditional(ufl.gt(self._dp, 0.0), 2 * mu, 0.0)
        increment = plastic * ufl.inner(self._n, e) / (3 * mu + self._slope)
        more = self.regularisation * plastic * ufl.inner(ufl.dev(e), self.elasticity.strain(v))
        return ufl.derivative(F, self._dp, increment) + self.elasticity.thickness * more * self.dx

    def _deviator(self, u: Any) -> Any:
        """Deviatoric stress, returned by what ``update`` has found."""
        return (1 - 3 * self.elasticity.mu * self._dp / self._norm(u)) * self._trial(u)

    def _trial(self, u: Any) -> Any:
        """Deviatoric stress if the load step were elastic."""
        e = self.elasticity.strain(u)
        return 2 * self.elasticity.mu * ufl.dev(e - self._tensor(self.plastic_strain))

    def _norm(self, u: Any) -> Any:
        """Von Mises stress of the trial stress, kept off 0."""
        s = self._trial(u)
        tiny = (self.given["yield_stress"] * self._tolerances.yielding) ** 2
        return ufl.sqrt(1.5 * ufl.inner(s, s) + tiny)

    def _tensor(self, c: Any) -> Any:
        """Return 3×3 tensors from their components."""
        if self._gdim == 3:
            return ufl.as_matrix([[c[0], c[3], c[4]], [c[3], c[1], c[5]], [c[4], c[5], c[2]]])
        return ufl.as_matrix([[c[0], c[3], 0], [c[3], c[1], 0], [0, 0, c[2]]])


def derivative_of(F: ufl.Form, u: fem.Function, laws: Sequence[Material]) -> ufl.Form:
    """Return the derivative of a residual as ``update`` of its laws returns stresses."""
    J = ufl.derivative(F, u)
    v, w = J.arguments()
    of_laws = [law.of_update(F, w, v) for law in laws if isinstance(law, J2Plasticity)]
    return sum(of_laws, J)
