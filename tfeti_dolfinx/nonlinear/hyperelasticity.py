"""Hyperelastic materials in finite strain."""

from abc import abstractmethod
from math import pi
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.validation import POSITIVE, checked_number
from tfeti_dolfinx.forms.elasticity import Elasticity
from tfeti_dolfinx.nonlinear.materials import Material, Volumes


class Hyperelasticity(Material):
    """A body with an energy in finite strain, on the mesh as it was. Creation is collective.

    ``NonlinearContactProblem(law.residual(v), u, ..., finite=True)`` takes it.

    A tangent has to be definite on all that stretches. Where a law loses that, its tangent gets
    2s e : e more, e = sym(∇w F⁻¹), with the least s that a bound asks for, so that it keeps a share
    ``definite`` of the shear modulus. The residual has 2s e(u − û) : e(v), û the displacement that
    ``update`` was called for, F that of û: its derivative is there, its value is 0.

    Args:
        elasticity: Moduli, and the model: in space, plane strain, or axisymmetric.
        u: The displacement.
        degree: Degree of the quadrature; default twice that of ``u``, and 2 less on simplices, at
            least 1.
        selective: Whether what resists a change of volume is integrated at the centre of each cell,
            on quadrilaterals and hexahedra of degree 1: rubber hardly changes its volume, and cells
            that are fully integrated, or simplices of degree 1, are too stiff for it (locking).
        volumes: Those of this law, as of ``J2Plasticity``.
        definite: Share of the shear modulus that the tangent keeps.

    Raises:
        InputError: Something given does not fit; the message names it.
    """

    def __init__(
        self,
        elasticity: Elasticity,
        u: fem.Function,
        *,
        degree: int | None = None,
        selective: bool = False,
        volumes: Volumes = None,
        definite: float = 0.05,
    ) -> None:
        super().__init__(elasticity, u, degree, selective, volumes)
        E, nu = elasticity.E, elasticity.nu
        self._lmbda = E * nu / (1 + nu) / (1 - 2 * nu)
        self.definite = checked_number(definite, "definite", POSITIVE)
        self._here = self._updated(u.function_space)
        self.update()

    @abstractmethod
    def energies(self, F: Any) -> tuple[Any, Any]:
        """Return the energy per volume by which changes of volume are resisted, and the rest."""

    @abstractmethod
    def missing(self, F: Any) -> Any:
        """Return a bound of s, by which the moduli miss a share of the shear modulus, or 0."""

    def update(self) -> None:
        """Make the tangent of the residual that of where ``u`` is now."""
        super().update()
        self._here.x.array[:] = self.u.x.array

    def deformation(self, u: Any) -> Any:
        """Return the deformation gradient F = I + ∇u, 3×3."""
        return ufl.Identity(3) + displacement_gradient(self.elasticity, u)

    def _stresses(self, u: Any) -> tuple[Any, Any]:
        F = ufl.variable(self.deformation(u))
        of_volume, of_shape = (ufl.diff(psi, F) * F.T / ufl.det(F) for psi in self.energies(F))
        return of_volume, of_shape

    def residual(self, v: Any) -> ufl.Form:
        """Return ∫P(u):∇v, P = ∂ψ/∂F, with a tangent that is definite on stretches."""
        thickness, F = self.elasticity.thickness, self.deformation(self.u)
        of_volume, of_shape = self.energies(F)
        energy = thickness * of_shape * self.dx + thickness * of_volume * self._dx_volume
        here = self.deformation(self._here)
        inverse = ufl.inv(here)
        rate = ufl.sym((F - here) * inverse)
        rate_of_v = ufl.sym(displacement_gradient(self.elasticity, v) * inverse)
        more = 2 * self.missing(here) * ufl.inner(rate, rate_of_v)
        return ufl.derivative(energy, self.u, v) + thickness * more * self.dx


class NeoHooke(Hyperelasticity):
    """Compressible neo-Hooke: ψ = μ/2 (tr FᵀF − 3 − 2 ln J) + λ/2 ln²J, J = det F.

    Its moduli are 2(μ − λ ln J), compared with λ tr², so indefinite where a body is dilated far.
    Arguments are those of ``Hyperelasticity``.
    """

    def energies(self, F: Any) -> tuple[Any, Any]:
        """Return λ/2 ln²J and μ/2 (tr FᵀF − 3 − 2 ln J)."""
        J = ufl.det(F)
        of_shape = self.elasticity.mu * (0.5 * (ufl.inner(F, F) - 3) - ufl.ln(J))
        return self._lmbda / 2 * ufl.ln(J) ** 2, of_shape

    def missing(self, F: Any) -> Any:
        """Bound e : c : e + e τ : e ≥ (μ − λ ln J + μ b) e : e, b the least eigenvalue of FFᵀ."""
        mu, lmbda = self.elasticity.mu, self._lmbda
        least = mu * (1 + principal_squares(F)[0]) - lmbda * ufl.ln(ufl.det(F))
        return ufl.max_value(self.definite * mu - least, 0.0) / 2


class SaintVenantKirchhoff(Hyperelasticity):
    """St. Venant and Kirchhoff: ψ = λ/2 tr²E + μ E : E, E = (FᵀF − I)/2.

    It is for large rotations and small strains: pressed to 0.58 of its length a bar of it becomes
    softer, and unstable. Arguments are those of ``Hyperelasticity``.
    """

    def energies(self, F: Any) -> tuple[Any, Any]:
        """Return λ/2 tr²E and μ E : E."""
        E = 0.5 * (F.T * F - ufl.Identity(3))
        of_volume = self._lmbda / 8 * (ufl.inner(F, F) - 3) ** 2
        return of_volume, self.elasticity.mu * ufl.inner(E, E)

    def missing(self, F: Any) -> Any:
        """Bound e : c : e ≥ 2μ b² e : e, b the least eigenvalue of FFᵀ, and e τ : e by τ's."""
        mu, lmbda, values = self.elasticity.mu, self._lmbda, principal_squares(F)
        pressure = lmbda / 2 * (ufl.inner(F, F) - 3)
        taus = [b * (pressure + mu * (b - 1)) for b in values]
        tau = ufl.min_value(taus[0], ufl.min_value(taus[1], taus[2]))
        return ufl.max_value(self.definite * mu - 2 * mu * values[0] ** 2 - tau, 0.0) / 2


def displacement_gradient(elasticity: Elasticity, u: Any) -> Any:
    """Return ∇u, 3×3, in the order r, z, θ if axisymmetric."""
    g = ufl.grad(u)
    if len(u) == 3:
        return g
    across = elasticity.strain(u)[2, 2]
    return ufl.as_tensor([[g[0, 0], g[0, 1], 0], [g[1, 0], g[1, 1], 0], [0, 0, across]])


def principal_squares(F: Any) -> tuple[Any, Any, Any]:
    """Return the eigenvalues of FFᵀ, ascending, in closed form, not to be differentiated."""
    b = F * F.T
    mean = ufl.tr(b) / 3
    deviator = b - mean * ufl.Identity(3)
    size = ufl.sqrt(ufl.inner(deviator, deviator) / 6 + np.finfo(float).tiny)
    cosine = ufl.det(deviator / size) / 2
    angle = ufl.acos(ufl.max_value(ufl.min_value(cosine, 1.0), -1.0)) / 3
    least, greatest = (mean + 2 * size * ufl.cos(angle + k * 2 * pi / 3) for k in (1, 0))
    return least, 3 * mean - least - greatest, greatest
