"""Internal variables of materials: functions that get new values at the end of a load step."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import interpolation_points
from tfeti_dolfinx.common.validation import checked_type, named, shown
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.checks import check_mesh

NewValue = Any  # a UFL expression, or a callable that returns an array of the function's size


class InternalVariables:
    """Internal variables with what gives their values at the end of a step. Collective.

    Creation raises an InputError where a function or its new value does not fit; the message names
    it.

    Args:
        given: For each function on the torn mesh (a quadrature or discontinuous space) a UFL
            expression of its new value, in terms of the displacement and of old values, or a
            callable without arguments that returns the new ``x.array``.
        mesh: The torn mesh.

    Attributes:
        functions: The functions, in the order in which they were given.
    """

    def __init__(self, given: Mapping[fem.Function, NewValue], mesh: Any) -> None:
        self._comm: MPI.Intracomm = mesh.comm
        self._new: dict[fem.Function, Callable[[], Array]] = {}
        for function, value in given.items():
            checked_type(function, fem.Function, "state: a key", "a dolfinx.fem.Function")
            name = f"state: the new value of {function.name}"
            if function.function_space.mesh is not mesh:
                raise InputError(f"state: {function.name} is on another mesh than the torn one")
            if callable(value) and not isinstance(value, ufl.core.expr.Expr):
                self._new[function] = value
                continue
            if getattr(value, "ufl_shape", None) != function.ufl_shape:
                raise InputError(
                    f"{name} is {shown(value)}; expected a UFL expression of shape "
                    f"{function.ufl_shape}, or a callable"
                )
            V = function.function_space
            with raised_on_all_ranks(self._comm), named(f"{name} cannot be compiled"):
                check_mesh(value, name, mesh)
                expression = fem.Expression(value, interpolation_points(V))
            self._new[function] = partial(_interpolated, expression, fem.Function(V))
        self.functions = list(given)

    def in_cells(self) -> Array:
        """Return the present values, cell by cell, shape ``(cells, w)``."""
        return np.hstack([_of_cells(function) for function in self.functions])

    def set_in_cells(self, values: Array) -> None:
        """Set values that ``in_cells`` has returned."""
        widths = [_of_cells(function).shape[1] for function in self.functions]
        parts = np.split(values, np.cumsum(widths)[:-1], axis=1)
        for function, part in zip(self.functions, parts, strict=True):
            dofmap = function.function_space.dofmap
            rows = function.x.array.reshape(-1, dofmap.bs)
            rows[dofmap.list] = part.reshape(*dofmap.list.shape, dofmap.bs)

    def commit(self) -> None:
        """Take the values at the end of a step: all are evaluated before any is set. Collective.

        Raise an InputError where a value is not finite, or a callable fails. Nothing has changed.
        """
        found = []
        with raised_on_all_ranks(self._comm):
            for function, value in self._new.items():
                with named(f"state: the new value of {function.name}"):
                    new = np.asarray(value(), dtype=float)
                if new.shape != function.x.array.shape or not np.all(np.isfinite(new)):
                    raise InputError(
                        f"state: the new value of {function.name} has the shape {new.shape} or is "
                        f"not finite; expected finite numbers of shape {function.x.array.shape}"
                    )
                found.append(new)
        for function, new in zip(self.functions, found, strict=True):
            function.x.array[:] = new


def _of_cells(function: fem.Function) -> Array:
    """Return the values of a function whose unknowns belong to one cell each, ``(cells, w)``."""
    dofmap = function.function_space.dofmap
    cells, width = dofmap.list.shape
    rows = function.x.array.reshape(-1, dofmap.bs)[dofmap.list]
    return np.asarray(rows.reshape(cells, width * dofmap.bs))


def _interpolated(expression: fem.Expression, target: fem.Function) -> Array:
    target.interpolate(expression)
    return np.array(target.x.array)
