"""Linear isotropic elasticity in UFL: in space, in plane strain and stress, axisymmetric."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from ufl.algorithms import estimate_total_polynomial_degree

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.compat import geometry_degree
from tfeti_dolfinx.common.parallel import count_over, largest, least
from tfeti_dolfinx.common.validation import POSITIVE, Range, checked_number, checked_type, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.checks import check_mesh, check_not_negative
from tfeti_dolfinx.mesh.decomposition import Decomposition, known_tags

MODELS = {2: ("plane_strain", "plane_stress", "axisymmetric"), 3: ("3d",)}
POISSON = Range("more than -1 and less than 0.5", lambda value: -1.0 < value < 0.5)
# in plane stress what does not change its volume is as good as anything else
POISSON_OF_SHEETS = Range("more than -1 and at most 0.5", lambda value: -1.0 < value <= 0.5)

Number: TypeAlias = "float | fem.Constant | fem.Function | ufl.core.expr.Expr"
Modulus: TypeAlias = "Number | Mapping[str | int, float]"


class Elasticity:
    """Strain, stress and bilinear form of linear isotropic elasticity. Creation is collective.

    Tensors are 3×3 in all models, so that von Mises' stress has all it needs: in plane strain
    with σ_zz, in plane stress with ε_zz, axisymmetric in the order r, z, θ.

    Moduli are numbers, constants, functions or UFL expressions on the torn mesh, or numbers for
    all volumes by their names, ``{"ball": 210e3, "block": 70e3}``. Numbers become constants: to
    change one (``elasticity.E.value = ...``) compiles nothing.

    Args:
        on: The torn mesh. A DOLFINx mesh will do where nothing is named.
        E: Young's modulus, a force per area, more than 0.
        nu: Poisson's ratio, between -1 and 0.5.
        model: "3d", "plane_strain", "plane_stress" or "axisymmetric". In 3D it may be left out.
            Axisymmetric, x[0] is the radius r, x[1] the height z, and u = (u_r, u_z).
        thickness: In plane strain and stress the thickness of the body, a length, nowhere negative,
            by default 1; the bilinear form is multiplied with it.

    Attributes:
        on: What was given as that.
        mesh: The mesh.
        model: The model.
        E: Young's modulus in UFL.
        nu: Poisson's ratio in UFL.
        mu: Shear modulus E/2(1 + ν).
        thickness: What an area of the mesh is multiplied with to be a volume: 1 in 3D, 2πr if
            axisymmetric. Loads take it, ``ufl.dot(t, v) * elasticity.thickness * ds(tag)``, and so
            do pressures, ``ContactProblem(..., thickness=elasticity.thickness)``.

    Raises:
        InputError: A modulus, a name, the model, the mesh or the thickness does not fit.

    Example:
        >>> bar = dmesh.create_unit_square(MPI.COMM_WORLD, 2, 2)
        >>> elastic = tfeti.Elasticity(bar, E=10.0, nu=0.25, model="plane_stress")
        >>> u = fem.Function(fem.functionspace(bar, ("Lagrange", 1, (2,))))
        >>> u.interpolate(lambda x: (x[0], -0.25 * x[1]))
        >>> local = fem.assemble_scalar(fem.form(elastic.stress(u)[0, 0] * ufl.dx))
        >>> print(f"{bar.comm.allreduce(local):.6f}")
        10.000000
    """

    # points that are this near to the axis, over the largest radius, are on it: coordinates from
    # files are rounded, and u_r/r is 0/0 there
    _near_axis = 1e-10

    def __init__(
        self,
        on: Decomposition | dmesh.Mesh,
        *,
        E: Modulus,
        nu: Modulus,
        model: str | None = None,
        thickness: Number | None = None,
    ) -> None:
        checked_type(on, (Decomposition, dmesh.Mesh), "on", "what decompose or read_gmsh return")
        self.on, self.mesh = on, on.mesh if isinstance(on, Decomposition) else on
        with agreeing(self.mesh.comm, "Elasticity") as given:
            given |= {"E": E, "nu": nu, "model": model, "thickness": thickness}
            gdim = self.mesh.geometry.dim
            name = "3d" if model is None and gdim == 3 else model
            if not isinstance(name, str) or name not in MODELS.get(gdim, ()):
                known = ", ".join(map(repr, MODELS.get(gdim, ()))) or "a mesh in 2D or 3D"
                raise InputError(f"model={shown(model)}: expected in {gdim}D one of {known}")
            self.model: str = name
            if thickness is not None and not self.model.startswith("plane"):
                raise InputError(
                    f"thickness={shown(thickness)}: expected none with model={self.model!r}; it "
                    "belongs to plane strain and plane stress"
                )
        self.E = in_ufl(E, on, "E", POSITIVE)
        self.nu = in_ufl(
            nu, on, "nu", POISSON_OF_SHEETS if self.model == "plane_stress" else POISSON
        )
        self.mu = self.E / 2 / (1 + self.nu)
        self._stress: tuple[Any, Any] = (None, None)  # that of the last displacement is kept
        times: Any = 1.0
        if self.model == "axisymmetric":
            r, comm = self.mesh.geometry.x[:, 0], self.mesh.comm
            self._on_axis = self._near_axis * largest(comm, r)
            lowest = least(comm, float(r.min(initial=np.inf)))
            if lowest < -self._on_axis:
                raise InputError(
                    f"model='axisymmetric': the mesh has points with the radius x[0] = {lowest:.6g}"
                    "; expected 0 or more"
                )
            times = 2 * math.pi * ufl.SpatialCoordinate(self.mesh)[0]
        elif thickness is not None:
            times = in_ufl(thickness, on, "thickness", POSITIVE)
            if not isinstance(times, fem.Constant):
                check_not_negative(times, "thickness", self.mesh)
        self.thickness = times

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse another modulus: forms hold the one that is there."""
        if name in ("E", "nu", "mu", "thickness") and name in vars(self):
            raise InputError(
                f"{name} = {shown(value)} of an Elasticity: forms hold what it is; expected a new "
                f"value of that, as in elasticity.{name}.value = ... for a constant"
            )
        super().__setattr__(name, value)

    def strain(self, u: Any) -> Any:
        """Linear strain of a displacement, a UFL tensor of shape ``(3, 3)``.

        Raises:
            InputError: ``u`` has not as many components as the mesh has dimensions.
        """
        gdim = self.mesh.geometry.dim
        shape = getattr(u, "ufl_shape", None)
        if shape != (gdim,):
            of_shape = "" if shape is None else f" of shape {shape}"
            raise InputError(
                f"u is {shown(u)}{of_shape}; expected a displacement of {gdim} components"
            )
        e, across = ufl.sym(ufl.grad(u)), 0  # the third normal strain
        if gdim == 3:
            return e
        if self.model == "plane_stress":
            across = -self.nu / (1 - self.nu) * (e[0, 0] + e[1, 1])
        elif self.model == "axisymmetric":
            # on the axis the limit ∂u_r/∂r; the form compiler has no conditionals of test functions
            r, near = ufl.SpatialCoordinate(self.mesh)[0], self._on_axis
            beside = ufl.conditional(ufl.gt(r, near), 1.0, 0.0)
            across = beside * u[0] / ufl.max_value(r, near) + (1 - beside) * e[0, 0]
        return ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, across]])

    def stress(self, u: Any) -> Any:
        """Return the stress of a displacement by Hooke's law, a UFL tensor of shape ``(3, 3)``.

        This is what ``ContactProblem(..., stress=elasticity.stress)`` takes.

        Raises:
            InputError: As ``strain``.
        """
        if u is not self._stress[0]:
            e, E, nu, mu = self.strain(u), self.E, self.nu, self.mu
            lmbda = E * nu / (1 + nu) / (1 - 2 * nu)
            sigma = 2 * mu * e + lmbda * ufl.tr(e) * ufl.Identity(3)
            if self.model == "plane_stress":
                # λ such that σ_zz = 0 is an exact zero, which UFL drops
                lmbda = E * nu / (1 - nu**2)
                pressure = lmbda * (e[0, 0] + e[1, 1])
                sigma = ufl.as_tensor(
                    [
                        [2 * mu * e[0, 0] + pressure, 2 * mu * e[0, 1], 0],
                        [2 * mu * e[1, 0], 2 * mu * e[1, 1] + pressure, 0],
                        [0, 0, 0],
                    ]
                )
            self._stress = u, sigma
        return self._stress[1]

    def a(self, u: Any, v: Any, dx: ufl.Measure | None = None) -> ufl.Form:
        """The bilinear form ∫σ(u):ε(v) over the volume: times ``thickness``, 2πr if axisymmetric.

        Args:
            u: Trial function.
            v: Test function.
            dx: Measure of cells. By default all cells, with quadrature that is exact on affine
                cells (but for 1/r), and cheap: UFL's own estimate is more expensive on hexahedra.

        Raises:
            InputError: As ``strain``.
        """
        work = ufl.inner(self.stress(u), self.strain(v))
        if dx is None:
            element = v.ufl_function_space().ufl_element()
            simplex = self.mesh.topology.cell_type.name in ("triangle", "tetrahedron")
            slope = element.degree - 1 if simplex else element.degree
            moduli = sum(estimate_total_polynomial_degree(c) for c in (self.E, self.nu))
            curved = 2 * (geometry_degree(self.mesh) - 1)
            # r times products of u_r/r, whose numerator has the displacement's degree
            ring = 3 if self.model == "axisymmetric" else 0
            degree = {"quadrature_degree": int(2 * slope + moduli + curved + ring)}
            dx = ufl.Measure("dx", domain=self.mesh, metadata=degree)
        checked_type(dx, ufl.Measure, "dx", "a measure of UFL, or None")
        return work * dx if isinstance(self.thickness, float) else self.thickness * work * dx


def in_ufl(value: Any, on: Decomposition | dmesh.Mesh, what: str, expected: Range) -> Any:
    """Return a modulus as a scalar in UFL. Collective."""
    mesh = on.mesh if isinstance(on, Decomposition) else on
    if isinstance(value, Mapping):
        return _by_volume(value, on, what, expected)
    with raised_on_all_ranks(mesh.comm):
        if not isinstance(value, ufl.core.expr.Expr):
            return fem.Constant(mesh, checked_number(value, what, expected))
        if value.ufl_shape != ():
            raise InputError(f"{what} is of shape {value.ufl_shape}; expected a scalar")
        check_mesh(value, what, mesh)
        values = np.zeros(0)
        if isinstance(value, fem.Constant):
            values = value.value.ravel()
        elif isinstance(value, fem.Function) and value.ufl_element().degree < 2:
            values = np.sort(value.x.array)  # a nan comes last
        for number in np.append(values[:1], values[-1:]).tolist():
            checked_number(number, what, expected)
    return value


def _by_volume(
    values: Mapping[str | int, float], on: Decomposition | dmesh.Mesh, what: str, expected: Range
) -> fem.Function:
    """Return a function that is constant in each volume. Collective."""
    if not isinstance(on, Decomposition):
        raise InputError(f"{what} by volumes: expected a Decomposition, which knows their names")
    with raised_on_all_ranks(on.comm):
        by_tag: dict[int, float] = {}
        for name, value in values.items():
            try:
                tag = on.volume(name)
            except InputError as error:
                raise InputError(f"{what}: {error}") from error
            if tag in by_tag:
                raise InputError(
                    f"{what}: the volume {name!r} is there twice, by its name and its tag"
                )
            by_tag[tag] = checked_number(value, f"{what}[{name!r}]", expected)
    function = fem.Function(fem.functionspace(on.mesh, ("DG", 0)), name=what)
    cell_dof = np.asarray(function.function_space.dofmap.list)[:, 0]
    given = np.zeros(len(cell_dof), dtype=bool)
    for tag, value in by_tag.items():
        cells = on.cell_tags.find(tag)
        function.x.array[cell_dof[cells]] = value
        given[cells] = True
    if missing := count_over(on.comm, ~given):
        others = {name: tag for name, tag in on.names.volumes.items() if tag not in by_tag}
        for_all = f"one for every volume, without one are: {known_tags(others)}"
        wanted = for_all if others else "every cell in a volume, or one number for all"
        raise InputError(f"{what}: {missing} cells have no value; expected {wanted}")
    return function
