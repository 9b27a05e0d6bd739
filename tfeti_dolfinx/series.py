"""All load steps in one file that ParaView animates; it appears whole."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem, io

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.output import begin_file, cell_fields, checked_target, end_file, nodal_fields
from tfeti_dolfinx.solution import Solution

POINTS = "points of the mesh"


class Series:
    """Nodal fields of steps, and cell fields beside them. Creation and all methods are collective.

    Files are written under names with ``.partial`` at the end; ``close`` gives them theirs.

    Args:
        path: A name that ends with ``.bp``; cell fields go to ``<stem>_cells.bp``.
        solution: A solution of the problem: its mesh and which fields there are.

    Raises:
        InputError: The name does not fit, or nothing can be written there.
    """

    def __init__(self, path: str | os.PathLike[str], solution: Solution) -> None:
        self._target = checked_target(path, ".bp", solution)
        self._mesh = solution.decomposition.mesh
        self._fields = [_copy(f) for f in nodal_fields(solution)]
        self._solution = solution
        self._partial = begin_file(self._target, solution)
        self._vtx: Any = io.VTXWriter(self._mesh.comm, self._partial, self._fields, engine="BP4")

    def write(self, time: float, values: dict[str, Array]) -> None:
        """Add a step from what ``fields_of`` returned for it, in this run or an earlier one."""
        points = self._mesh.geometry.x.copy()
        self._mesh.geometry.x[:] = values[POINTS]
        for function in self._fields:
            function.x.array[:] = values[function.name]
        self._vtx.write(time)
        self._mesh.geometry.x[:] = points

    def close(self) -> list[Path]:
        """Give the files their names; which they are."""
        self._vtx.close()
        end_file(self._partial, self._target, self._solution)
        cells = self._target.with_name(f"{self._target.stem}_cells.bp")
        partial = begin_file(cells, self._solution)
        functions = cell_fields(self._solution)
        with io.VTXWriter(self._mesh.comm, partial, functions, engine="BP4") as vtx:
            vtx.write(0.0)
        end_file(partial, cells, self._solution)
        return [self._target, cells]


def fields_of(solution: Solution) -> dict[str, Array]:
    """Nodal fields of a step by name, and where the mesh is. Collective."""
    values = {f.name: np.array(f.x.array) for f in nodal_fields(solution)}
    return {**values, POINTS: np.array(solution.decomposition.mesh.geometry.x)}


def _copy(function: fem.Function) -> fem.Function:
    return fem.Function(function.function_space, name=function.name)
