"""Which function spaces fit a torn mesh, and which are the same."""

from __future__ import annotations

from typing import Any

import basix
import numpy as np
from dolfinx import fem

from tfeti_dolfinx.checks import checked_type
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition


def check_space(V: fem.FunctionSpace, decomposition: Decomposition) -> None:
    """Raise unless V is a space for displacements on the torn mesh.

    Raises:
        InputError: It is on another mesh, not continuous, not Lagrange, or neither scalar nor
            of one component for each dimension.
    """
    checked_type(V, fem.FunctionSpace, "the space", "a dolfinx.fem.FunctionSpace")
    if V.mesh is not decomposition.mesh:
        raise InputError(
            "the space is on another mesh (the one before decompose?); expected it on "
            "decomposition.mesh, the torn mesh"
        )
    try:
        element = V.element.basix_element
    except RuntimeError as error:
        raise InputError("mixed spaces are not supported, expected a Lagrange space") from error
    if element.family != basix.ElementFamily.P or element.discontinuous or element.degree < 1:
        raise InputError(
            f"space {V.ufl_element()}: expected a continuous Lagrange space of degree 1 or more"
        )
    shape, gdim = tuple(V.ufl_element().reference_value_shape), V.mesh.geometry.dim
    if shape not in ((), (gdim,)):
        raise InputError(
            f"the space has values of shape {shape}; expected displacements of {gdim} components "
            f"in {gdim}D, shape ({gdim},), or a scalar space"
        )


def is_same_space(V: Any, W: Any) -> bool:
    """Whether two C++ spaces are the same on this rank: mesh, element and numbering."""
    if V is W:
        return True
    return bool(
        V.mesh is W.mesh
        and V.element == W.element
        and V.dofmap.bs == W.dofmap.bs
        and np.array_equal(V.dofmap.map(), W.dofmap.map())
    )


def component_of(V: fem.FunctionSpace, component: list[int]) -> Any:
    """C++ space of a component of V; None if it has no such component."""
    space = V._cpp_object
    if len(component) > 1 or any(not 0 <= i < V.num_sub_spaces for i in component):
        return None
    return space.sub(component) if component else space


def described(V: Any) -> str:
    """A C++ space for messages."""
    try:
        degree = V.element.basix_element.degree
    except RuntimeError:
        return "a mixed space"
    kind = "a component of a space" if V.component() else "a space"
    return f"{kind} of degree {degree} with {V.dofmap.index_map_bs} unknowns per node"
