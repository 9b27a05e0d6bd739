"""All load steps in one file that ParaView animates; it appears whole."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem, io

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.output import begin_file, cell_fields, checked_target, end_file, nodal_fields
from tfeti_dolfinx.solution import Solution

POINTS = "points of the mesh"


class Series:
    """Nodal fields of steps, and cell fields beside them. Creation and all methods are collective.

    Files are written under names with ``.partial`` at the end; ``close`` gives them theirs.

    Args:
        path: A name that ends with ``.bp``; cell fields go to ``<stem>_cells.bp``.
        solution: A solution of the problem: its mesh and which fields there are.
        interior: Whether the fields of ``solution.interior`` are written, too: those of cells at
            each step, other cell fields are always the same.

    Raises:
        InputError: The name does not fit, or nothing can be written there.
    """

    def __init__(
        self, path: str | os.PathLike[str], solution: Solution, interior: bool = False
    ) -> None:
        self._target = checked_target(path, ".bp", solution)
        self._cells = self._target.with_name(f"{self._target.stem}_cells.bp")
        self._mesh = solution.decomposition.mesh
        of_nodes, of_cells = solution.interior.fields if interior else ([], [])
        self._fields = [_copy(f) for f in nodal_fields(solution) + of_nodes]
        self._in_cells = [_copy(f) for f in of_cells]
        self._solution = solution
        self._partial, self._vtx = self._opened(self._target, self._fields)
        if self._in_cells:
            self._partial_cells, self._vtx_cells = self._opened(
                self._cells, cell_fields(solution) + self._in_cells
            )

    def write(self, time: float, values: dict[str, Array]) -> None:
        """Add a step from what ``fields_of`` returned for it, in this run or an earlier one.

        Raises:
            InputError: A field is not there, as where an earlier run wrote fewer.
        """
        points = self._mesh.geometry.x.copy()
        for function in self._fields + self._in_cells:
            if function.name not in values:
                raise InputError(
                    f"the step at {time:.6g} of the checkpoint has no field {function.name}; "
                    "expected interior= as in the run that has written it"
                )
            function.x.array[:] = values[function.name]
        self._mesh.geometry.x[:] = values[POINTS]
        self._vtx.write(time)
        if self._in_cells:
            self._vtx_cells.write(time)
        self._mesh.geometry.x[:] = points

    def close(self) -> list[Path]:
        """Give the files their names; which they are."""
        self._vtx.close()
        end_file(self._partial, self._target, self._solution)
        if not self._in_cells:
            self._partial_cells, self._vtx_cells = self._opened(
                self._cells, cell_fields(self._solution)
            )
            self._vtx_cells.write(0.0)
        self._vtx_cells.close()
        end_file(self._partial_cells, self._cells, self._solution)
        return [self._target, self._cells]

    def _opened(self, name: Path, functions: list[fem.Function]) -> tuple[Path, Any]:
        """The file as it is called until it is whole, and what writes it."""
        partial = begin_file(name, self._solution)
        return partial, io.VTXWriter(self._mesh.comm, partial, functions, engine="BP4")


def fields_of(solution: Solution, interior: bool = False) -> dict[str, Array]:
    """Fields of a step by name, and where the mesh is. Collective."""
    of_nodes, of_cells = solution.interior.fields if interior else ([], [])
    fields = nodal_fields(solution) + of_nodes + of_cells
    values = {f.name: np.array(f.x.array) for f in fields}
    return {**values, POINTS: np.array(solution.decomposition.mesh.geometry.x)}


def _copy(function: fem.Function) -> fem.Function:
    return fem.Function(function.function_space, name=function.name)
