"""The tangent of finite strain that has rigid motions about the current places in its kernel."""

from __future__ import annotations

from typing import Any

import ufl
from dolfinx import fem
from ufl.algorithms import expand_derivatives
from ufl.constantvalue import Zero
from ufl.corealg.traversal import unique_pre_traversal


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
