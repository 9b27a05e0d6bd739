"""Fields for a user to look at: stress, von Mises, and nodal averages over cells and tears."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms.analysis import extract_arguments, extract_coefficients, extract_constants

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.compat import JIT_OPTIONS, interpolation_points
from tfeti_dolfinx.common.validation import POSITIVE, checked_callable, checked_number, named, shown
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.forms.checks import check_mesh, check_not_negative
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs

Stress = Callable[[Any], Any]


def von_mises(sigma: Any) -> Any:
    """Von Mises stress of a 3×3 tensor, as a UFL expression."""
    deviator = sigma - ufl.tr(sigma) / 3 * ufl.Identity(3)
    return ufl.sqrt(1.5 * ufl.inner(deviator, deviator))


def checked_stress(stress: Stress, u: fem.Function) -> Any:
    """Return the stress of u as a UFL expression; raise an InputError unless it is a 3×3 tensor."""
    expected = "a callable from a displacement to its stress in UFL"
    if isinstance(stress, ufl.core.expr.Expr):  # which can be called, but for something else
        raise InputError(f"stress is an expression; expected {expected}")
    checked_callable(stress, "stress", expected)
    with named("stress(u)"):
        sigma = stress(u)
    if not isinstance(sigma, ufl.core.expr.Expr):
        raise InputError(f"stress(u) is {shown(sigma)}; expected a UFL tensor of shape (3, 3)")
    if sigma.ufl_shape != (3, 3):
        raise InputError(
            f"stress(u) has shape {sigma.ufl_shape}; expected (3, 3), in plane strain with σ_zz"
        )
    return sigma


def checked_thickness(thickness: Any, decomposition: Decomposition) -> Any:
    """Check and return the thickness, a number or a scalar in UFL. Collective.

    Raise an InputError where it is neither, negative somewhere, or on another mesh.
    """
    if not isinstance(thickness, ufl.core.expr.Expr):
        return checked_number(thickness, "thickness", POSITIVE)
    if thickness.ufl_shape != ():
        raise InputError(f"thickness is of shape {thickness.ufl_shape}; expected a scalar")
    check_mesh(thickness, "thickness", decomposition)
    if extract_arguments(thickness):
        raise InputError("thickness has a test or trial function; expected a scalar with values")
    if isinstance(thickness, fem.Constant):
        checked_number(thickness.value, "thickness", POSITIVE)
    else:
        check_not_negative(thickness, "thickness", decomposition.mesh)
    return thickness


class Freezable:
    """A UFL expression whose constants and functions, but for one, can be kept as they are.

    The mesh is no function: where it is moved, the expression moves along.

    Args:
        expression: The expression.
        u: The function in it that it is a function of, or None.

    Attributes:
        expression: The expression.
    """

    def __init__(self, expression: Any, u: fem.Function | None = None) -> None:
        self.expression, self._u = expression, u
        self._constants = extract_constants(expression)
        self._functions = [f for f in extract_coefficients(expression) if f is not u]

    def __call__(self, u: fem.Function) -> Any:
        """Return the expression with another function."""
        return ufl.replace(self.expression, {self._u: u})

    def frozen(self) -> Callable[..., Any]:
        """Return what makes the expression, of any function, with what else is in it as it is now.

        Values are copied here, and the expression made when that is called.
        """
        values = [np.array(c.value) for c in self._constants]
        functions = {f: f.copy() for f in self._functions}

        def made(u: fem.Function | None = None) -> Any:
            pairs = zip(self._constants, values, strict=True)
            copies = {c: fem.Constant(c.ufl_domain(), value) for c, value in pairs}
            own = {} if u is None else {self._u: u}
            return ufl.replace(self.expression, copies | functions | own)

        return made


def frozen(expression: Any) -> Any:
    """Return a UFL expression with its constants and functions as they are now; numbers as is."""
    if not isinstance(expression, ufl.core.expr.Expr):
        return expression
    return Freezable(expression).frozen()()


def cellwise(expression: Any, dofs: TornDofs, name: str) -> fem.Function:
    """A UFL expression at the nodes of each cell, discontinuous between cells. Collective.

    What has internal variables is known at their points alone: it is fitted there, by a linear
    function in each cell if they are enough, else by a constant.
    """
    element = ("DG", dofs.V.element.basix_element.degree, expression.ufl_shape)
    W = fem.functionspace(dofs.V.mesh, element if expression.ufl_shape else element[:2])
    function = fem.Function(W, name=name)
    nodes = interpolation_points(W)
    points = quadrature_points(expression)
    if points is None:
        function.interpolate(fem.Expression(expression, nodes, jit_options=JIT_OPTIONS))
        return function
    layout, bs = np.asarray(W.dofmap.list), W.dofmap.index_map_bs
    cells = np.arange(len(layout), dtype=np.int32)
    there = fem.Expression(expression, points, jit_options=JIT_OPTIONS).eval(W.mesh, cells)
    terms = slice(None) if len(points) > points.shape[1] else slice(1)
    linear = [np.column_stack((np.ones(len(x)), x))[:, terms] for x in (nodes, points)]
    fit = linear[0] @ np.linalg.pinv(linear[1])
    values = np.einsum("np,cpk->cnk", fit, there.reshape(len(cells), len(points), bs))
    function.x.array.reshape(-1, bs)[layout] = values
    return function


def quadrature_points(expression: Any) -> Array | None:
    """Return the points that functions on quadrature spaces in an expression have values at."""
    elements = (f.ufl_element() for f in extract_coefficients(expression))
    return next((e.custom_quadrature()[0] for e in elements if e.has_custom_quadrature), None)


def nodal(expression: Any, dofs: TornDofs, name: str) -> fem.Function:
    """A UFL expression averaged at the nodes, weighted by the cells' volumes. Collective.

    The average goes over the cells of all torn copies, so the field has no jumps at the tears.
    """
    in_cells, mesh = cellwise(expression, dofs, name), dofs.V.mesh
    shape, degree = expression.ufl_shape, dofs.V.element.basix_element.degree
    element = ("Lagrange", degree, shape) if shape else ("Lagrange", degree)
    function = fem.Function(fem.functionspace(mesh, element), name=name)
    DG0 = fem.functionspace(mesh, ("DG", 0))
    form = fem.form(ufl.TestFunction(DG0) * ufl.dx(metadata={"quadrature_degree": 2}))
    volume = fem.assemble_vector(form).array[np.asarray(DG0.dofmap.list)[:, 0]]
    cells = np.asarray(function.function_space.dofmap.list)
    weight = np.repeat(volume, cells.shape[1])[:, None]
    values = function.x.array.reshape(-1, function.function_space.dofmap.index_map_bs)
    layout = np.asarray(in_cells.function_space.dofmap.list).ravel()
    terms = in_cells.x.array.reshape(-1, values.shape[1])[layout] * weight
    sums = sum_rows(cells.ravel(), np.hstack((terms, weight)), dofs.num_nodes)
    sums = dofs.spread(dofs.reduce(sums[dofs.dolfinx_node], np.add, 0.0))
    values[dofs.dolfinx_node] = sums[:, :-1] / sums[:, -1:]
    return function


def from_vertices(dofs: TornDofs, values: Array, vertices: Array) -> fem.Function:
    """Scalar function from values of the owned groups that are vertices, both ``(g,)``. Collective.

    Nodes between vertices take the value of the linear interpolant where all those vertices have
    one, else 0: a field of a surface stays on the surface.
    """
    (S, _), (W, node) = dofs.scalar, dofs.hats
    function, inside = fem.Function(S), fem.Function(S)
    linear, share = fem.Function(W), fem.Function(W)
    linear.x.array[:] = dofs.spread(np.where(vertices, values, 0.0))[node]
    share.x.array[:] = dofs.spread(vertices.astype(float))[node]
    function.interpolate(linear)
    inside.interpolate(share)
    function.x.array[inside.x.array < 1.0 - 1e-8] = 0.0
    return function


def vector_from_vertices(dofs: TornDofs, values: Array, vertices: Array, name: str) -> fem.Function:
    """Vector function from values at vertices, shape ``(g, bs)``, as ``from_vertices``.

    Collective.
    """
    function = fem.Function(dofs.V, name=name)
    components = function.x.array.reshape(-1, dofs.bs)
    for i in range(dofs.bs):
        component = from_vertices(dofs, values[:, i], vertices)
        components[dofs.dolfinx_node, i] = component.x.array[dofs.scalar[1]]
    return function
