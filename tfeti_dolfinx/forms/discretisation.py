"""The discretisation error, estimated from stresses recovered in each material of each body."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array, sum_rows
from tfeti_dolfinx.common.compat import JIT_OPTIONS, interpolation_points
from tfeti_dolfinx.common.parallel import bcast_from_root
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mesh.untorn import NO_TAG


class StressRecovery:
    """σ* − σ_h and ε* − ε_h, σ* and ε* recovered from the cells around each node.

    A patch is all cells of one material of one body around a node, on both sides of tears. For
    displacements of degree 1 a linear function is fitted to the values at the cells' midpoints,
    and taken at the node (superconvergent patch recovery: Zienkiewicz, Zhu, Int. J. Numer. Methods
    Eng. 33, 1992); for higher degrees the values of the cells at the node are averaged.
    Creation and all methods are collective.

    Args:
        u: Displacement; later values of it are read at each call of ``squares``.
        sigma: Its stress in UFL, 3×3.
        dofs: Dof maps.
        thickness: What areas of the mesh are multiplied with, a number or a scalar in UFL.

    Attributes:
        cells: Space of numbers for cells.
        cell_dof: Unknown of each local cell in it.
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
        points = interpolation_points(W)
        self._pairs = [
            (fem.Expression(tensor, points, jit_options=JIT_OPTIONS), fem.Function(W))
            for tensor in (sigma, e)
        ]
        self.cells = fem.functionspace(mesh, ("DG", 0))
        self.cell_dof = np.asarray(self.cells.dofmap.list)[:, 0]
        stress, strain = (function for _, function in self._pairs)
        dx = ufl.Measure("dx", domain=mesh, metadata={"quadrature_degree": 2 * degree + 1})
        density = thickness * ufl.inner(stress, strain) * ufl.TestFunction(self.cells)
        self._form = fem.form(density * dx, jit_options=JIT_OPTIONS)

    def error(self) -> float:
        """Return the estimate for all bodies, a root of an energy; the same on all ranks."""
        comm = self._dofs.comm
        return float(np.sqrt(bcast_from_root(comm, comm.allreduce(float(self.squares().sum())))))

    def squares(self) -> Array:
        """∫(σ* − σ_h) : (ε* − ε_h) over each local cell, shape ``(cells,)``."""
        for expression, function in self._pairs:
            function.interpolate(expression)
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
            system = dofs.reduce(sums[dofs.dolfinx_node], np.add, 0.0).reshape(-1, size, size + q)
            at_nodes = dofs.spread(_constants(system[:, :, :size], system[:, :, size:]))
            found[own] = at_nodes[dofs.primal_nodes(cells)]
        return found


def _constants(gram: Array, right: Array, ridge: float = 1e-2) -> Array:
    """Return the constants of fits, shape ``(n, q)``, from their normal equations.

    A patch with too few cells for a slope keeps the mean: the ridge, of the mean square distance of
    its cells from the node, is added where a slope is fitted.
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
