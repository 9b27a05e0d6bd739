"""Displacement and stress inside boundary elements on the mesh, for files and pictures."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.bem.inside import BoundarySolution
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap, interpolation_points
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.dofs import TornDofs


class Interior:
    """Fields on the mesh: Somigliana's identity in boundary elements, finite elements elsewhere.

    Each rank evaluates its own subdomains. Fields are made when they are first asked for, which is
    collective.

    Args:
        boundary: What boundary elements know, or None where there are none.
        u: Displacement on the torn mesh.
        sigma: Its stress in UFL, 3×3, linear in u, or None.
        dofs: Dof maps.
    """

    def __init__(
        self, boundary: BoundarySolution | None, u: fem.Function, sigma: Any, dofs: TornDofs
    ) -> None:
        self._boundary, self._u, self._sigma = boundary, u, sigma
        self._dofs = dofs

    @cached_property
    def displacement(self) -> fem.Function:
        """Displacement; on the surface of boundary elements that of their nodes."""
        dofs, d = self._dofs, self._dofs.bs
        values = dofs.to_primal(self._u.x.array).reshape(-1, d)
        points = dofs.V.tabulate_dof_coordinates()[dofs.dolfinx_node, :d]
        if self._boundary is not None:
            for body in self._boundary.bodies():
                values[body.nodes] = body.inside.displacement(points[body.nodes])
        function = fem.Function(dofs.V, name="interior_displacement")
        function.x.array[:] = dofs.to_dolfinx(values.ravel())
        return function

    @cached_property
    def stress(self) -> fem.Function:
        """Stress at the midpoints of the cells, 3×3, constant in each of them.

        Raises:
            InputError: The problem was given no stress.
        """
        return self._of_cells("interior_stress", self._stress(), (3, 3))

    @cached_property
    def von_mises(self) -> fem.Function:
        """Von Mises stress of ``stress``."""
        layout = np.asarray(self.stress.function_space.dofmap.list)[:, 0]
        stress = self.stress.x.array.reshape(-1, 3, 3)[layout]
        mean = np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3.0
        square = np.sum((stress - mean * np.eye(3)) ** 2, axis=(1, 2))
        return self._of_cells("interior_von_mises", np.sqrt(1.5 * square), ())

    @property
    def fields(self) -> tuple[list[fem.Function], list[fem.Function]]:
        """The fields to write to files: those of nodes, and those of cells."""
        return [self.displacement], [] if self._sigma is None else [self.stress, self.von_mises]

    def _of_cells(self, name: str, values: Array, shape: tuple[int, ...]) -> fem.Function:
        W = fem.functionspace(self._dofs.V.mesh, ("DG", 0, shape) if shape else ("DG", 0))
        function = fem.Function(W, name=name)
        layout = np.asarray(W.dofmap.list)[:, 0]
        size = int(np.prod(shape, dtype=int))  # a rank may have no cells
        function.x.array.reshape(-1, size)[layout] = values.reshape(-1, size)
        return function

    def _stress(self) -> Array:
        """Shape ``(cells, 3, 3)``: in boundary elements σ(0) + Σ ∂_j u_i (σ(x_j e_i) − σ(0)).

        So all that ``sigma`` says of the third direction and of a thickness is in it.
        """
        if self._sigma is None:
            raise InputError("no stress: give ContactProblem(..., stress=sigma)")
        dofs, d, mesh = self._dofs, self._dofs.bs, self._dofs.V.mesh
        at_midpoints = _Midpoints(self._sigma, self._u)
        values = at_midpoints.of(self._u.x.array)
        if self._boundary is None:
            return values
        gradient = np.zeros((len(values), d, d))
        middle = mesh.geometry.x[geometry_dofmap(mesh)].mean(axis=1)[:, :d]
        cells = np.ones(len(values), dtype=bool)
        cells[self._boundary.finite] = False
        for body in self._boundary.bodies():
            own = np.flatnonzero(self._boundary.cell_subdomain == body.subdomain)
            gradient[own] = body.inside.gradient(middle[own])
        zero = at_midpoints.of(np.zeros_like(self._u.x.array))
        values[cells] = zero[cells]
        y = dofs.V.tabulate_dof_coordinates()[:, :d]
        y = y - (y.mean(axis=0) if len(y) else 0.0)
        for i, j in np.ndindex(d, d):
            linear = np.zeros_like(y)
            linear[:, i] = y[:, j]
            unit = at_midpoints.of(linear.ravel()) - zero
            values[cells] += gradient[cells, i, j, None, None] * unit[cells]
        return values


class _Midpoints:
    """A UFL tensor of u, 3×3, at the midpoints of cells for other displacements."""

    def __init__(self, sigma: Any, u: fem.Function) -> None:
        self._u = fem.Function(u.function_space)
        W = fem.functionspace(u.function_space.mesh, ("DG", 0, (3, 3)))
        self._values = fem.Function(W)
        self._expression = fem.Expression(ufl.replace(sigma, {u: self._u}), interpolation_points(W))

    def of(self, values: Array) -> Array:
        """Return an array of shape ``(cells, 3, 3)``, for values of u in DOLFINx's order."""
        self._u.x.array[:] = values
        self._values.interpolate(self._expression)
        layout = np.asarray(self._values.function_space.dofmap.list)[:, 0]
        return np.asarray(self._values.x.array.reshape(-1, 3, 3)[layout])
