"""J2 plasticity in finite strain: logarithmic strains, a return that is that of small strain."""

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.arrays import EPSILON, Array
from tfeti_dolfinx.common.compat import interpolation_points
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.nonlinear.hyperelasticity import displacement_gradient
from tfeti_dolfinx.nonlinear.materials import IsotropicHardening, Plasticity

# entries of the deformation gradient that a model has, and of a symmetric tensor
ENTRIES = {
    "3d": [(i, j) for i in range(3) for j in range(3)],
    "plane_strain": [(0, 0), (0, 1), (1, 0), (1, 1)],
    "axisymmetric": [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2)],
}
SYMMETRIC = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]


class FiniteJ2Plasticity(Plasticity):
    """Plasticity by von Mises with isotropic hardening in finite strain. Creation is collective.

    F = F_e F_p, the energy is that of Hencky in ln b_e, b_e = F_e F_eᵀ, and Kirchhoff's stress τ
    yields as in ``J2Plasticity``. With the exponential map the return in principal axes is that of
    small strain, and det F_p = 1 exactly (Simo, Comput. Methods Appl. Mech. Engrg. 99, 1992; de
    Souza Neto, Perić, Owen, Computational Methods for Plasticity, 2008, chapter 14):

    1. b = F C_p⁻¹ Fᵀ, its eigenvalues b_a and eigenvectors; ε_a = ½ ln b_a.
    2. s_a = 2μ dev ε_a, q; the return gives Δp, and τ_a = (1 − 3μ Δp/q) s_a.
    3. P = τ F⁻ᵀ, and ∂P/∂F by the derivative of an isotropic function: in principal axes
       δτ_ab = (τ_a − τ_b)/(b_a − b_b) δb_ab, and ∂τ_a/∂ε_b of the return on the diagonal.
    4. At the end of a load step C_p⁻¹ = F⁻¹ b_e F⁻ᵀ, ln b_e = 2(ε − 1.5 Δp s/q).

    P and its derivative are numbers at quadrature points. The residual has P + ∂P : (F − F̂), F̂
    that of the last ``update``, and the volumetric part κ/2 ln²J in UFL.

    A tangent has to be definite on all that stretches, e = sym(δF F⁻¹), and stresses near the
    moduli, as a trial displacement may have, take e τ e from it. Where it keeps less than a share
    of the shear modulus it gets 2s e : e more, with the least s for that: the residual has
    2s sym((F − F̂) F̂⁻¹) added to P, which is 0 at F̂.

    ``NonlinearContactProblem(law.residual(v), u, ..., finite=True, stress=law.stress)`` takes it.

    Arguments are those of ``J2Plasticity``.

    Attributes:
        inverse_plastic: C_p⁻¹ where the load step began, components xx, yy, zz, xy, xz, yz.
        p: Accumulated plastic strain there.
    """

    def _begin(self) -> None:
        elasticity, u = self.elasticity, self.u
        self._entries = ENTRIES[elasticity.model]
        m = len(self._entries)
        scalar, vector = self._space(), self._space((m,))
        self.p = fem.Function(scalar, name="accumulated_plastic_strain")
        self.inverse_plastic = fem.Function(self._space((6,)), name="inverse_plastic_strain")
        self.inverse_plastic.x.array[:] = np.tile(
            [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], len(self.p.x.array)
        )
        self._more, self._G = self._updated(scalar), self._updated(vector)
        self._P, self._dP = self._updated(vector), self._updated(self._space((m, m)))
        points = interpolation_points(scalar)
        self._mu = fem.Expression(elasticity.mu, points)
        self._kappa = fem.Expression(self._bulk * ufl.as_ufl(1.0), points)
        self._points = len(points)
        self._G_of_u = fem.Expression(self._gradient(u), points)
        self._new = (np.array(self.inverse_plastic.x.array), np.array(self.p.x.array))
        self.state = {self.inverse_plastic: lambda: self._new[0], self.p: lambda: self._new[1]}

    def _accumulated(self) -> Array:
        return self._new[1]

    def update(self) -> None:
        """Return stresses to the yield surface where ``u`` is now. Collective.

        Where a body is turned inside out all is not a number, which no step ends with.
        """
        super().update()
        self._G.interpolate(self._G_of_u)
        own, p = self._rows, self.p.x.array[self._rows]
        F = np.zeros((len(p), 3, 3))
        rows, columns = np.array(self._entries).T
        F[:, rows, columns] = self._G.x.array.reshape(-1, len(rows))[own]
        F += np.eye(3)
        out = ~(np.linalg.det(F) > 0.0)
        F[out] = np.eye(3)
        components = self.inverse_plastic.x.array.reshape(-1, 6)[own]
        inverse_plastic = np.empty_like(F)
        for k, (i, j) in enumerate(SYMMETRIC):
            inverse_plastic[:, i, j] = inverse_plastic[:, j, i] = components[:, k]
        hardening, mu = self.hardening(), self._values_of(self._mu)
        with raised_on_all_ranks(self.u.function_space.mesh.comm):
            point = _Return(F, inverse_plastic, p, mu, hardening)
        P, dP = point.P, point.tangent(self._entries)
        P[out] = dP[out] = np.nan
        dilatation = np.log(np.linalg.det(F))
        if self.selective:  # that of the centre of the cell, nearly
            cells = dilatation.reshape(-1, self._points)
            dilatation = np.repeat(cells.mean(axis=1), self._points)
        self._more.x.array[own] = point.missing(self._values_of(self._kappa), dilatation)
        self._P.x.array.reshape(-1, len(rows))[own] = P[:, rows, columns]
        m = len(rows) ** 2
        self._dP.x.array.reshape(-1, m)[own] = dP.reshape(-1, m)
        for new, end, width in zip(self._new, point.end(), (6, 1), strict=True):
            new.reshape(-1, width)[own] = end.reshape(-1, width)

    def _stresses(self, u: Any) -> tuple[Any, Any]:
        F = ufl.Identity(3) + displacement_gradient(self.elasticity, u)
        J, P = ufl.det(F), self._tensor(self._P)
        tau = P * F.T
        if self.elasticity.model == "plane_strain":  # it is a deviator
            across = ufl.as_tensor([[0, 0, 0], [0, 0, 0], [0, 0, 1]])
            tau = tau - (tau[0, 0] + tau[1, 1]) * across
        return self._bulk * ufl.ln(J) / J * ufl.Identity(3), tau / J

    def residual(self, v: Any) -> ufl.Form:
        """Return ∫P:∇v, whose derivative is that of the return."""
        thickness = self.elasticity.thickness
        F = ufl.Identity(3) + displacement_gradient(self.elasticity, self.u)
        energy = thickness * self._bulk / 2 * ufl.ln(ufl.det(F)) ** 2 * self._dx_volume
        way = self._gradient(self.u) - self._G
        P = self._P + ufl.dot(self._dP, way)
        inverse = ufl.inv(ufl.Identity(3) + self._tensor(self._G))
        rates = [ufl.sym(self._tensor(g) * inverse) for g in (way, self._gradient(v))]
        points = ufl.dot(P, self._gradient(v)) + 2 * self._more * ufl.inner(*rates)
        return ufl.derivative(energy, self.u, v) + thickness * points * self.dx

    def _gradient(self, w: Any) -> Any:
        """Entries of ∇w that the model has."""
        g = displacement_gradient(self.elasticity, w)
        return ufl.as_vector([g[i, j] for i, j in self._entries])

    def _tensor(self, entries: Any) -> Any:
        """Return 3×3 tensors from the entries that the model has."""
        place = {ij: k for k, ij in enumerate(self._entries)}
        return ufl.as_tensor(
            [[entries[place[i, j]] if (i, j) in place else 0 for j in range(3)] for i in range(3)]
        )


class _Return:
    """The return of many points at once, in principal axes.

    Args:
        F: Deformation gradients, shape (n, 3, 3), of positive determinants.
        inverse_plastic: C_p⁻¹, shape (n, 3, 3).
        p: Accumulated plastic strains, shape (n,).
        mu: Shear moduli, shape (n,).
        hardening: The yield stress.

    Attributes:
        P: τ F⁻ᵀ, shape (n, 3, 3), without its volumetric part.
    """

    def __init__(
        self, F: Array, inverse_plastic: Array, p: Array, mu: Array, hardening: IsotropicHardening
    ) -> None:
        self.F, self.mu, self.p, self.hardening = F, mu, p, hardening
        self.F_inverse = np.linalg.inv(F)
        self.M = inverse_plastic @ F.mT
        self.b, self.axes = np.linalg.eigh(F @ self.M)
        self.b = np.maximum(self.b, np.finfo(float).tiny)
        self.strain = 0.5 * np.log(self.b)
        s = 2.0 * mu[:, None] * (self.strain - self.strain.mean(axis=1, keepdims=True))
        q = np.sqrt(1.5 * np.sum(s**2, axis=1))
        self.dp, self.slope = hardening.returned(q, mu, p)
        q = np.maximum(q, hardening.tolerances.yielding * hardening.yield_stress)
        self.share = 1.0 - 3.0 * mu * self.dp / q
        self.regular = hardening.regularisation * (self.dp > 0.0)
        self.n, self.q, self.s = 1.5 * s / q[:, None], q, s
        tau = (self.axes * (self.share[:, None] * s)[:, None, :]) @ self.axes.mT
        self.P = tau @ self.F_inverse.mT

    def tangent(self, entries: list[tuple[int, int]]) -> Array:
        """Return ∂P/∂F for some entries of both, shape (n, m, m)."""
        rows, columns = np.array(entries).T
        diagonal, shear = self._moduli()
        P, turned = self.P, self.axes.mT
        found = np.empty((len(self.F), len(entries), len(entries)))
        for k, (i, j) in enumerate(entries):
            # δF = e_i e_jᵀ, so that δb has M's row j in its row i
            half = np.zeros_like(self.F)
            half[:, i, :] = self.M[:, j, :]
            db = turned @ (half + half.mT) @ self.axes
            d_tau = shear * db
            strains = np.einsum("naa->na", db) / (2.0 * self.b)
            d_tau[:, range(3), range(3)] = np.einsum("nab,nb->na", diagonal, strains)
            dP = self.axes @ d_tau @ turned @ self.F_inverse.mT
            # δ(F⁻ᵀ) = −F⁻ᵀ δFᵀ F⁻ᵀ
            dP -= P[:, :, j, None] * self.F_inverse[:, None, :, i]
            found[:, :, k] = dP[:, rows, columns]
        return found

    def missing(self, kappa: Array, dilatation: Array) -> Array:
        """Return the least s with which the tangent on stretches is definite, shape (n,).

        With e in principal axes it is Σ (∂τ_a/∂ε_b + κ) e_aa e_bb − Σ τ_a e_aa² beside, for a ≠ b,
        ((τ_a − τ_b)(b_a + b_b)/(b_a − b_b) − (τ_a + τ_b)/2) e_ab², τ with its mean κ ln J.
        ``kappa`` are bulk moduli, ``dilatation`` is ln J.
        """
        diagonal, shear = self._moduli()
        tau = self.share[:, None] * self.s + (kappa * dilatation)[:, None]
        along = diagonal + kappa[:, None, None] - np.eye(3) * tau[:, None, :]
        across = shear * (self.b[:, :, None] + self.b[:, None, :])
        across -= 0.5 * (tau[:, :, None] + tau[:, None, :])
        a, b = np.triu_indices(3, 1)
        least = np.minimum(np.linalg.eigvalsh(along)[:, 0], across[:, a, b].min(axis=1))
        wanted = self.hardening.tolerances.definite * self.mu
        return np.asarray(np.maximum(wanted - least, 0.0) / 2.0)

    def _moduli(self) -> tuple[Array, Array]:
        """Return ∂τ_a/∂ε_b and (τ_a − τ_b)/(b_a − b_b) off the diagonal, in principal axes."""
        elastic = 2.0 * self.mu * (self.share + self.regular)
        along = 1.0 / (3.0 * self.mu + self.slope) - self.dp / self.q
        along *= 4.0 * self.mu**2 * (self.dp > 0.0)
        deviator = np.eye(3) - 1.0 / 3.0
        diagonal = elastic[:, None, None] * deviator
        diagonal -= along[:, None, None] * self.n[:, :, None] * self.n[:, None, :]
        # (ε_a − ε_b)/(b_a − b_b) = ln(1 + x)/2x b_b, x = b_a/b_b − 1, which rounding leaves alone
        x = self.b[:, :, None] / self.b[:, None, :] - 1.0
        small = np.abs(x) < EPSILON
        ratio = np.where(small, 1.0, np.log1p(x) / np.where(small, 1.0, x))
        return diagonal, elastic[:, None, None] * ratio / (2.0 * self.b[:, None, :])

    def end(self) -> tuple[Array, Array]:
        """Return C_p⁻¹ and p at the end of the load step, as arrays of their functions."""
        elastic = np.exp(2.0 * (self.strain - self.dp[:, None] * self.n))
        b = (self.axes * elastic[:, None, :]) @ self.axes.mT
        new = self.F_inverse @ b @ self.F_inverse.mT
        rows, columns = np.array(SYMMETRIC).T
        return new[:, rows, columns].ravel(), self.p + self.dp
