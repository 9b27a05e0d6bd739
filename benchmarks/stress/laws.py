"""Laws of nonlinear bodies in UFL alone: what the package's are compared with.

Displacements are in plane strain or in space; numbers may be a ``fem.Constant``.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import basix.ufl
import ufl
from dolfinx import fem

from tfeti_dolfinx.common.compat import interpolation_points


def gradient(u: Any) -> Any:
    """The gradient of a displacement, 3 × 3."""
    g = ufl.grad(u)
    if len(u) == 3:
        return g
    return ufl.as_matrix([[g[0, 0], g[0, 1], 0], [g[1, 0], g[1, 1], 0], [0, 0, 0]])


def neo_hooke(u: Any, E: Any, nu: Any) -> Any:
    """Energy per volume of a compressible neo-Hookean body."""
    F, mu, lmbda = ufl.Identity(3) + gradient(u), E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)
    log = ufl.ln(ufl.det(F))
    return mu / 2 * (ufl.tr(F.T * F) - 3) - mu * log + lmbda / 2 * log**2


def st_venant(u: Any, E: Any, nu: Any) -> Any:
    """Energy per volume of St. Venant and Kirchhoff."""
    F, mu, lmbda = ufl.Identity(3) + gradient(u), E / 2 / (1 + nu), E * nu / (1 + nu) / (1 - 2 * nu)
    strain = (F.T * F - ufl.Identity(3)) / 2
    return mu * ufl.inner(strain, strain) + lmbda / 2 * ufl.tr(strain) ** 2


def deformation(u: Any, E: Any, nu: Any, limit: float = 0.02) -> Any:
    """Energy per volume of Hencky's law: the modulus of shear falls with the strain."""
    mu, bulk, g = E / 2 / (1 + nu), E / 3 / (1 - 2 * nu), gradient(u)
    e = ufl.dev(ufl.sym(g))
    size = ufl.inner(e, e) / limit**2
    shear = 2 * mu * limit**2 * (0.8 * (ufl.sqrt(1 + size) - 1) + 0.1 * size)
    return bulk / 2 * ufl.tr(g) ** 2 + shear


class SimplePlasticity:
    """J2 with linear hardening, the return in one form.

    Attributes:
        state: New values of the internal variables, by their functions.
    """

    def __init__(self, u: fem.Function, E: Any, nu: Any, sy: Any, H: Any, degree: int) -> None:
        mesh = u.function_space.mesh
        self.mu, self.bulk = E / 2 / (1 + nu), E / 3 / (1 - 2 * nu)
        self.dx = ufl.dx(
            domain=mesh, metadata={"quadrature_degree": degree, "quadrature_scheme": "default"}
        )
        cell = mesh.basix_cell()
        plastic, p = (
            fem.Function(fem.functionspace(mesh, element))
            for element in (
                basix.ufl.quadrature_element(cell, value_shape=shape, degree=degree)
                for shape in ((9,), ())
            )
        )
        old = ufl.as_matrix([[plastic[3 * i + j] for j in range(3)] for i in range(3)])
        e = ufl.sym(gradient(u))
        s = 2 * self.mu * ufl.dev(e - old)
        q = ufl.sqrt(1.5 * ufl.inner(s, s) + 1e-24)
        f = q - (sy + H * p)
        dp = ufl.conditional(ufl.gt(f, 1e-12), f / (3 * self.mu + H), 0.0)
        n = 1.5 * s / q
        self.stress = self.bulk * ufl.tr(e) * ufl.Identity(3) + s - 2 * self.mu * dp * n
        new = old + dp * n
        new = ufl.as_vector([new[i, j] for i in range(3) for j in range(3)])
        self.state = {plastic: new, p: p + dp}

    def residual(self, v: Any) -> Any:
        """The residual, linear in v."""
        return ufl.inner(self.stress, ufl.sym(gradient(v))) * self.dx

    def commit(self) -> None:
        """Give the internal variables their new values."""
        for target, new in self._targets:
            target.interpolate(new)
        for function, (target, _) in zip(self.state, self._targets, strict=True):
            function.x.array[:] = target.x.array

    @cached_property
    def _targets(self) -> list[tuple[fem.Function, fem.Expression]]:
        spaces = [(function.function_space, new) for function, new in self.state.items()]
        return [(fem.Function(W), fem.Expression(e, interpolation_points(W))) for W, e in spaces]
