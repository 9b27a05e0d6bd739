"""Materials for nonlinear bodies: J2 plasticity in small strain, hyperelastic laws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import basix.ufl
import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import interpolation_points
from tfeti_dolfinx.common.validation import FROM_0, POSITIVE, checked_number, checked_type
from tfeti_dolfinx.errors import ConvergenceError, InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.elasticity import Elasticity


@dataclass(frozen=True)
class ReturnTolerances:
    """Tolerances of the return to the yield surface.

    Attributes:
        yielding: Beyond the yield stress by less than this share a point is elastic: where a load
            step begins the stress lies on the yield surface, up to rounding.
        rtol: Of the yield stress, to which the return is solved.
        max_it: Most Newton steps of the return, which is exact in one where hardening is linear.
        perfect: Share of the elastic moduli that a tangent without hardening gets, so that its
            only kernel are rigid motions; the residual has none of it.
    """

    yielding: float = 1e-10
    rtol: float = 1e-14
    max_it: int = 50
    perfect: float = 1e-3


class J2Plasticity:
    """Plasticity by von Mises with isotropic hardening in small strain. Creation is collective.

    The yield stress is σ_y(p) = yield_stress + hardening p + saturation (1 − exp(−rate p)), p the
    accumulated plastic strain: no hardening, linear hardening, or Voce's. Stresses return to the
    yield surface along the radius, and the tangent is that of the return (Simo, Hughes,
    Computational Inelasticity, 1998, section 3.3). Strains are those of ``elasticity``: in space,
    plane strain, or axisymmetric.

    Args:
        elasticity: The elastic law; its moduli may differ from point to point.
        u: The displacement.
        yield_stress: Yield stress at the begin, a force per area, more than 0.
        hardening: Linear hardening modulus, a force per area, 0 or more.
        saturation: What the yield stress gains by Voce's hardening in the end, 0 or more.
        rate: Rate of Voce's hardening, 0 or more.
        degree: Degree of the quadrature, of plastic strains too; default twice that of ``u``,
            less 2, and at least 1, and 2 on quadrilaterals and hexahedra.
        tolerances: Those of the return.

    Attributes:
        plastic_strain: Plastic strain where the load step began, components xx, yy, zz, xy and in
            space xz, yz.
        p: Accumulated plastic strain there.
        state: What ``NonlinearContactProblem`` takes as ``state``.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        u: fem.Function,
        *,
        yield_stress: float,
        hardening: float = 0.0,
        saturation: float = 0.0,
        rate: float = 0.0,
        degree: int | None = None,
        tolerances: ReturnTolerances | None = None,
    ) -> None:
        checked_type(elasticity, Elasticity, "elasticity", "a tfeti_dolfinx.Elasticity")
        checked_type(u, fem.Function, "u", "a dolfinx.fem.Function")
        if elasticity.model == "plane_stress":
            raise InputError(
                "J2Plasticity: plane stress is not there; expected plane strain, axisymmetric or 3d"
            )
        self._yield = (
            checked_number(yield_stress, "yield_stress", POSITIVE),
            checked_number(hardening, "hardening", FROM_0),
            checked_number(saturation, "saturation", FROM_0),
            checked_number(rate, "rate", FROM_0),
        )
        self.elasticity, self.u = elasticity, u
        self._tolerances = ReturnTolerances() if tolerances is None else tolerances
        mesh, V = elasticity.mesh, u.function_space
        if V.mesh is not mesh:
            raise InputError("J2Plasticity: u is on another mesh than the elasticity")
        self._gdim = mesh.geometry.dim
        cell = mesh.basix_cell()
        if degree is None:
            simplex = cell in (basix.CellType.triangle, basix.CellType.tetrahedron)
            degree = max(2 * V.element.basix_element.degree - (2 if simplex else 0), 1)
        self.dx = ufl.Measure(
            "dx",
            domain=mesh,
            metadata={"quadrature_degree": degree, "quadrature_scheme": "default"},
        )
        scalar = basix.ufl.quadrature_element(cell, degree=degree)
        tensor = basix.ufl.quadrature_element(
            cell, value_shape=(6 if self._gdim == 3 else 4,), degree=degree
        )
        Q, W = fem.functionspace(mesh, scalar), fem.functionspace(mesh, tensor)
        self.plastic_strain = fem.Function(W, name="plastic_strain")
        self.p = fem.Function(Q, name="accumulated_plastic_strain")
        self._dp = fem.Function(Q, name="plastic_increment")  # of this load step
        self._slope = fem.Function(Q, name="hardening_slope")
        self._q, self._G = fem.Function(Q), fem.Function(Q)
        points = interpolation_points(Q)
        s = self._trial(u)
        self._q_of_u = fem.Expression(ufl.sqrt(1.5 * ufl.inner(s, s)), points)
        self._G_of_x = fem.Expression(elasticity.mu, points)
        self._n = self._normal(u)
        new = self._tensor(self.plastic_strain) + self._dp * self._n
        self.state = {self.plastic_strain: _components(new, self._gdim), self.p: self.p + self._dp}

    @property
    def regularisation(self) -> float:
        """Share of the elastic moduli in the tangent; 0 where there is hardening."""
        _, hardening, saturation, rate = self._yield
        return 0.0 if hardening or saturation * rate else self._tolerances.perfect

    def update(self) -> None:
        """Return stresses to the yield surface where ``u`` is now. Collective."""
        tol = self._tolerances
        self._q.interpolate(self._q_of_u)
        self._G.interpolate(self._G_of_x)
        q, G, p = self._q.x.array, self._G.x.array, self.p.x.array
        dp = np.zeros_like(q)
        with raised_on_all_ranks(self.u.function_space.mesh.comm):
            if not np.all(np.isfinite(q)):
                raise InputError("J2Plasticity: the stress is not finite")
        plastic = q > (1.0 + tol.yielding) * self._yield_stress(p)[0]
        left = bool(np.any(plastic))
        for _ in range(tol.max_it):  # concave in dp: Newton's method goes up monotonically
            if not left:
                break
            y, slope = self._yield_stress(p + dp)
            f = np.where(plastic, q - 3.0 * G * dp - y, 0.0)
            dp += f / (3.0 * G + slope)
            left = bool(np.any(np.abs(f) > tol.rtol * (q + y)))
        with raised_on_all_ranks(self.u.function_space.mesh.comm):
            if left:
                raise ConvergenceError(
                    f"J2Plasticity: the return takes more than {tol.max_it} steps somewhere"
                )
        self._dp.x.array[:] = dp
        self._slope.x.array[:] = self._yield_stress(p + dp)[1]

    def stress(self, u: Any) -> Any:
        """Return the stress, 3×3, of the displacement that ``update`` was called for."""
        e, s, q = self.elasticity.strain(u), self._trial(u), self._norm(u)
        share = 1 - 3 * self.elasticity.mu * self._dp / q
        return self._bulk * ufl.tr(e) * ufl.Identity(3) + share * s

    def residual(self, v: Any) -> ufl.Form:
        """Return ∫σ(u):ε(v)."""
        return self._times(ufl.inner(self.stress(self.u), self.elasticity.strain(v)))

    def tangent(self, w: Any, v: Any) -> ufl.Form:
        """Return the derivative of ``residual`` along w, consistent with the return."""
        e, strain = self.elasticity.strain(w), self.elasticity.strain(v)
        mu, q, n = self.elasticity.mu, self._norm(self.u), self._n
        plastic = ufl.conditional(ufl.gt(self._dp, 0.0), 1.0, 0.0)
        share = 1 - 3 * mu * self._dp / q
        along = 4 * mu**2 * plastic * (1 / (3 * mu + self._slope) - self._dp / q)
        sigma = (
            self._bulk * ufl.tr(e) * ufl.Identity(3)
            + 2 * mu * share * ufl.dev(e)
            - along * ufl.inner(n, e) * n
        )
        if self.regularisation:
            sigma = sigma + self.regularisation * plastic * self.elasticity.stress(w)
        return self._times(ufl.inner(sigma, strain))

    @property
    def _bulk(self) -> Any:
        return self.elasticity.E / 3 / (1 - 2 * self.elasticity.nu)

    def _yield_stress(self, p: Array) -> tuple[Array, Array]:
        """Return the yield stress at accumulated plastic strains, and its slope."""
        start, hardening, saturation, rate = self._yield
        rest = saturation * np.exp(-rate * p)
        return start + hardening * p + saturation - rest, hardening + rate * rest

    def _trial(self, u: Any) -> Any:
        """Deviatoric stress if the load step were elastic."""
        e = self.elasticity.strain(u)
        return 2 * self.elasticity.mu * ufl.dev(e - self._tensor(self.plastic_strain))

    def _norm(self, u: Any) -> Any:
        """Von Mises stress of the trial stress, kept off 0."""
        s = self._trial(u)
        tiny = (self._yield[0] * self._tolerances.yielding) ** 2
        return ufl.sqrt(1.5 * ufl.inner(s, s) + tiny)

    def _normal(self, u: Any) -> Any:
        """Direction of plastic flow, 3 s/2 q."""
        return 1.5 * self._trial(u) / self._norm(u)

    def _tensor(self, c: Any) -> Any:
        """Return 3×3 tensors from their components."""
        if self._gdim == 3:
            return ufl.as_matrix([[c[0], c[3], c[4]], [c[3], c[1], c[5]], [c[4], c[5], c[2]]])
        return ufl.as_matrix([[c[0], c[3], 0], [c[3], c[1], 0], [0, 0, c[2]]])

    def _times(self, density: Any) -> ufl.Form:
        return density * self.elasticity.thickness * self.dx


def _components(t: Any, gdim: int) -> Any:
    """Return the components of symmetric 3×3 tensors."""
    places = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    return ufl.as_vector([t[i, j] for i, j in places[: 6 if gdim == 3 else 4]])
