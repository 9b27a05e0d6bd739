"""The tangent of finite strain that has rigid motions about the current places in its kernel."""

from __future__ import annotations

from typing import Any

import ufl
from dolfinx import fem
from ufl.algorithms import expand_derivatives
from ufl.algorithms.map_integrands import map_integrand_dags
from ufl.constantvalue import Zero
from ufl.corealg.multifunction import MultiFunction
from ufl.corealg.traversal import unique_pre_traversal

from tfeti_dolfinx.errors import InputError


class GeometricPart(MultiFunction):
    """Replace ∇v in a residual, so that it becomes the geometric part of the tangent.

    With F = I + ∇u and A = ∇w F⁻¹ the geometric part ∫∇w S : ∇v of the tangent along w, S = F⁻¹P
    and P the first Piola–Kirchhoff stress, is ∫AP : ∇v = ∫P : Aᵀ∇v. So ∇v becomes Aᵀ∇v, and what
    has v itself, as body forces have, is dropped.

    Args:
        u: The displacement.
        v: The test function of the residual.
        w: The trial function.
    """

    def __init__(self, u: fem.Function, v: Any, w: Any) -> None:
        super().__init__()
        F = ufl.Identity(len(u)) + ufl.grad(u)
        self._v = v
        self._gradient = expand_derivatives(ufl.dot((ufl.grad(w) * ufl.inv(F)).T, ufl.grad(v)))

    expr = MultiFunction.reuse_if_untouched

    def grad(self, o: Any) -> Any:
        """Map ∇v to Aᵀ∇v; other gradients stay."""
        if o.ufl_operands[0] == self._v:
            return self._gradient
        if self._v in set(unique_pre_traversal(o)):
            raise InputError("F: second derivatives of the test function; expected first ones")
        return o

    def argument(self, o: Any) -> Any:
        """Map v to 0."""
        return Zero(o.ufl_shape) if o == self._v else o


def material_tangent(F: ufl.Form, u: fem.Function) -> tuple[ufl.Form, ufl.Form]:
    """Return the material part of the tangent of a residual on the mesh as it was.

    The full tangent of a body under stress does not know rotations, and may be indefinite. The
    material part, ∫(Fᵀ∇w)_sym : C : (Fᵀ∇v)_sym, has the rigid motions about X + u in its kernel at
    any strain. Forces on facets that turn with the body have no part in it.

    Args:
        F: Residual, linear in its test function, for instance ∫P(u):∇v dx less that of loads.
        u: The displacement.

    Returns:
        The material part, and ∫(Fᵀ∇w)_sym : (Fᵀ∇v)_sym, whose kernel is the same.
    """
    F = expand_derivatives(F)
    (v,) = F.arguments()
    w = ufl.TrialFunction(u.function_space)
    inside = ufl.Form([i for i in F.integrals() if i.integral_type() == "cell"])
    on_facets = [
        i
        for i in F.integrals()
        if i.integral_type() != "cell" and not _has_gradient_of(i.integrand(), u)
    ]
    geometric = map_integrand_dags(GeometricPart(u, v, w), inside)
    tangent = ufl.derivative(ufl.Form([*inside.integrals(), *on_facets]), u, w)
    deformation = ufl.Identity(len(u)) + ufl.grad(u)

    def strain(y: Any) -> Any:
        return ufl.sym(deformation.T * ufl.grad(y))

    measure = ufl.dx(domain=u.function_space.mesh)
    return tangent - geometric, ufl.inner(strain(w), strain(v)) * measure


def _has_gradient_of(expression: Any, u: fem.Function) -> bool:
    """Return whether ∇u is in an expression."""
    gradients = (e for e in unique_pre_traversal(expression) if isinstance(e, ufl.classes.Grad))
    return any(e.ufl_operands[0] == u for e in gradients)
