"""Stress fields, nodal averages over cells and tears, and the discretisation error."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.algorithms.analysis import extract_arguments, extract_coefficients, extract_constants

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.compat import interpolation_points
from tfeti_dolfinx.common.validation import POSITIVE, checked_callable, checked_number, named, shown
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.forms.checks import check_mesh, check_not_negative
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import NO_TAG

Stress = Callable[[Any], Any]


@dataclass(frozen=True)
class PointValues:
    """Values at points; not a number where a point is in no body.

    Attributes:
        displacement: Shape ``(k, gdim)``.
        stress: Shape ``(k, gdim, gdim)``, in 2D without σ_zz.
    """

    displacement: Array
    stress: Array


def value_row(u: Array, stress: Array) -> Array:
    """Return a row for each point: 1, displacement and stress."""
    return np.column_stack((np.ones(len(u)), u, stress.reshape(len(u), u.shape[1] ** 2)))


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
            f"stress(u) has shape {sigma.ufl_shape}; expected (3, 3): σ_zz, too, 0 in plane stress"
        )
    return sigma


def checked_thickness(thickness: Any, decomposition: Decomposition) -> Any:
    """Return the thickness, a number or a scalar in UFL, once it is checked. Collective."""
    if not isinstance(thickness, ufl.core.expr.Expr):
        return checked_number(thickness, "thickness", POSITIVE)
    if thickness.ufl_shape != ():
        raise InputError(f"thickness is of shape {thickness.ufl_shape}; expected a scalar")
    check_mesh(thickness, "thickness", decomposition.mesh)
    if extract_arguments(thickness):
        raise InputError("thickness has a test or trial function; expected a scalar with values")
    if isinstance(thickness, fem.Constant):
        checked_number(thickness.value, "thickness", POSITIVE)
    else:
        check_not_negative(thickness, "thickness", decomposition.mesh)
    return thickness


class Freezable:
    """A UFL expression whose constants and functions, but for one, can be kept as they are.

    The mesh is no function: where it is moved, the expression moves along. u is the function in it
    that it is a function of, or None.
    """

    def __init__(self, expression: Any, u: fem.Function | None = None) -> None:
        self.expression, self._u = expression, u
        self._constants = extract_constants(expression)
        self._functions = [f for f in extract_coefficients(expression) if f is not u]

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


def interpolating(expression: Any, W: fem.FunctionSpace) -> Callable[[fem.Function], None]:
    """Return what sets a function of the discontinuous space W to what a UFL expression is then.

    What has internal variables is known at their points alone: it is fitted there, by a linear
    function in each cell if they are enough, else by a constant.
    """
    nodes = interpolation_points(W)
    elements = (f.ufl_element() for f in extract_coefficients(expression))
    internal = (e.custom_quadrature()[0] for e in elements if e.has_custom_quadrature)
    if (points := next(internal, None)) is None:
        at_nodes = fem.Expression(expression, nodes)
        return lambda function: function.interpolate(at_nodes)
    layout, bs = np.asarray(W.dofmap.list), W.dofmap.index_map_bs
    cells, there = np.arange(len(layout), dtype=np.int32), fem.Expression(expression, points)
    terms = slice(None) if len(points) > points.shape[1] else slice(1)
    linear = [np.column_stack((np.ones(len(x)), x))[:, terms] for x in (nodes, points)]
    fit = linear[0] @ np.linalg.pinv(linear[1])

    def interpolate(function: fem.Function) -> None:
        values = there.eval(W.mesh, cells).reshape(len(cells), len(points), bs)
        found = np.einsum("np,cpk->cnk", fit, values)
        function.x.array.reshape(-1, bs)[layout] = found

    return interpolate


def cellwise(expression: Any, dofs: TornDofs, name: str) -> fem.Function:
    """A UFL expression at the nodes of each cell, discontinuous between cells. Collective."""
    element = ("DG", dofs.V.element.basix_element.degree, expression.ufl_shape)
    W = fem.functionspace(dofs.V.mesh, element if expression.ufl_shape else element[:2])
    function = fem.Function(W, name=name)
    interpolating(expression, W)(function)
    return function


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
    values = function.x.array.reshape(-1, function.function_space.dofmap.index_map_bs)
    layout = np.asarray(in_cells.function_space.dofmap.list).ravel()
    weight = np.repeat(volume, cells.shape[1])[:, None]
    terms = weight * in_cells.x.array.reshape(-1, values.shape[1])[layout]
    sums = sum_rows(cells.ravel(), np.hstack((terms, weight)), dofs.num_nodes)
    sums = dofs.spread(dofs.reduce(sums[dofs.dolfinx_node], np.add))
    values[dofs.dolfinx_node] = sums[:, :-1] / sums[:, -1:]
    return function


def from_vertices(dofs: TornDofs, values: Array, vertices: Array, name: str) -> fem.Function:
    """Function from values, ``(g,)`` or ``(g, bs)``, of owned groups that are vertices. Collective.

    Nodes between vertices take the value of the linear interpolant where all those vertices have
    one, else 0: a field of a surface stays on the surface.
    """
    (S, dof), (W, node) = dofs.scalar, dofs.hats
    linear, scalar = fem.Function(W), fem.Function(S, name=name)
    linear.x.array[:] = dofs.spread(vertices.astype(float))[node]
    scalar.interpolate(linear)
    outside = scalar.x.array < 1.0 - 1e-8
    vector = fem.Function(dofs.V, name=name)
    for i, component in enumerate(values.T if values.ndim > 1 else [values]):
        linear.x.array[:] = dofs.spread(np.where(vertices, component, 0.0))[node]
        scalar.interpolate(linear)
        scalar.x.array[outside] = 0.0
        vector.x.array.reshape(-1, dofs.bs)[dofs.dolfinx_node, i] = scalar.x.array[dof]
    return scalar if values.ndim == 1 else vector


class StressRecovery:
    """σ* − σ_h and ε* − ε_h, σ* and ε* recovered from the cells around each node.

    A patch is all cells of one material of one body around a node, on both sides of tears. For
    displacements of degree 1 a linear function is fitted to the values at the cells' midpoints, and
    taken at the node (superconvergent patch recovery: Zienkiewicz, Zhu, Int. J. Numer. Methods Eng.
    33, 1992); for higher degrees the values of the cells at the node are averaged. Creation and all
    methods are collective. Later values of u are read at each call of ``squares``; σ_h is its
    stress in UFL, 3×3, and the thickness multiplies areas. ``cells`` is the space of numbers for
    cells, ``cell_dof`` the unknown of each local cell in it.
    """

    def __init__(self, u: fem.Function, sigma: Any, dofs: TornDofs, thickness: Any) -> None:
        self._dofs, mesh, degree = dofs, dofs.V.mesh, dofs.V.element.basix_element.degree
        # the cells around each node, by body and material
        self._layout, self._kinds = np.asarray(dofs.V.dofmap.list), _kinds(dofs.decomposition)
        self._count = dofs.comm.allreduce(int(self._kinds.max(initial=0)) + 1, op=MPI.MAX)
        self._basis = np.ones((*self._layout.shape, 1))
        if degree == 1:
            at = dofs.V.tabulate_dof_coordinates()[self._layout, : mesh.geometry.dim]
            offset = at.mean(axis=1, keepdims=True) - at
            self._basis = np.concatenate((self._basis, offset), axis=2)
        W = fem.functionspace(mesh, ("DG", degree, (3, 3)))
        e = ufl.sym(ufl.grad(u))
        if e.ufl_shape == (2, 2):
            # where another entry of the strain is not 0, the same entry of the stress is (plane
            # stress), or it has no derivative of u, and its error is of higher order (axisymmetry)
            e = ufl.as_tensor([[e[0, 0], e[0, 1], 0], [e[1, 0], e[1, 1], 0], [0, 0, 0]])
        self._pairs = [(interpolating(tensor, W), fem.Function(W)) for tensor in (sigma, e)]
        self.cells = fem.functionspace(mesh, ("DG", 0))
        self.cell_dof = np.asarray(self.cells.dofmap.list)[:, 0]
        stress, strain = (function for _, function in self._pairs)
        dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree + 1})
        density = thickness * ufl.inner(stress, strain) * ufl.TestFunction(self.cells)
        self._form = fem.form(density * dx)

    def squares(self) -> Array:
        """∫(σ* − σ_h) : (ε* − ε_h) over each local cell, shape ``(cells,)``."""
        for interpolate, function in self._pairs:
            interpolate(function)
            layout = np.asarray(function.function_space.dofmap.list)
            values = function.x.array.reshape(-1, 9)[layout]
            function.x.array.reshape(-1, 9)[layout] = self._recovered(values) - values
        return np.maximum(fem.assemble_vector(self._form).array[self.cell_dof], 0.0)

    def _recovered(self, values: Array) -> Array:
        """Values at the nodes of cells from such, shape ``(cells, nodes, q)``. Collective."""
        dofs, size, q = self._dofs, self._basis.shape[2], values.shape[2]
        found = np.empty_like(values)
        if size > 1:
            values = np.repeat(values.mean(axis=1, keepdims=True), values.shape[1], axis=1)
        for kind in range(self._count):
            own = self._kinds == kind
            cells, basis = self._layout[own], self._basis[own]
            terms = np.concatenate((basis, values[own]), axis=2)[..., None, :] * basis[..., None]
            sums = sum_rows(cells.ravel(), terms.reshape(-1, size * (size + q)), dofs.num_nodes)
            system = dofs.reduce(sums[dofs.dolfinx_node], np.add).reshape(-1, size, size + q)
            at_nodes = dofs.spread(_constants(system[:, :, :size], system[:, :, size:]))
            found[own] = at_nodes[dofs.primal_node[cells]]
        return found


def _constants(gram: Array, right: Array, ridge: float = 1e-2) -> Array:
    """Return the constants of fits, shape ``(n, q)``, from their normal equations.

    With the ridge, of slopes' mean square distances, patches of too few cells keep the mean.
    """
    slopes = np.arange(1, gram.shape[1])
    spread = gram[:, slopes, slopes].mean(axis=1, keepdims=True) if slopes.size else 0.0
    gram = gram.copy()
    gram[:, slopes, slopes] += ridge * spread
    gram[gram[:, 0, 0] == 0.0] = np.eye(gram.shape[1])  # no cell of this kind
    return np.asarray(np.linalg.solve(gram, right)[:, 0])


def _kinds(decomposition: Decomposition) -> Array:
    """A number for the material of each local cell, of those of its body, from 0 on. Collective."""
    tags = np.full(len(decomposition.cell_subdomain), NO_TAG)
    tags[decomposition.cell_tags.indices] = decomposition.cell_tags.values
    body = decomposition.body_of_subdomain[decomposition.cell_subdomain]
    # body and tag as one number, in the order of the pairs; tags from 0 on
    pair = (body.astype(np.int64) << 32) + (tags.astype(np.int64) - NO_TAG)
    known = np.unique(np.concatenate(decomposition.comm.allgather(np.unique(pair))))
    first = np.searchsorted(known >> 32, known >> 32)
    return np.searchsorted(known, pair) - first[np.searchsorted(known, pair)]
