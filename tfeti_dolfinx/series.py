"""All load steps in one file that ParaView animates; it appears whole."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from dolfinx import fem

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError, TfetiError
from tfeti_dolfinx.output import VtxFile, cell_fields, checked_target, nodal_fields
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
        target = checked_target(path, ".bp", solution)
        self._names = [target, target.with_name(f"{target.stem}_cells.bp")]
        self._mesh = solution.decomposition.mesh
        of_nodes, of_cells = solution.interior.fields if interior else ([], [])
        self._fields = [_copy(f) for f in nodal_fields(solution) + of_nodes]
        self._in_cells = [_copy(f) for f in of_cells]
        self._count, self._ended = 0, False
        self._files: list[VtxFile] = []
        contents = (self._fields, cell_fields(solution) + self._in_cells)
        try:
            for name, functions in zip(self._names, contents, strict=True):
                self._files.append(VtxFile(name, functions))
            self._growing = self._files if self._in_cells else self._files[:1]
            if not self._in_cells:
                self._files[1].write(0.0)
                self._files[1].close()
        except TfetiError:  # on all ranks
            self.drop()
            raise

    def write(self, time: float, values: dict[str, Array]) -> None:
        """Add a step from what ``fields_of`` returned for it, in this run or an earlier one.

        Raises:
            InputError: A field is not there, as where an earlier run wrote fewer; or the files
                cannot be written: then they end, whole, with the step before, under the names
                that they have until ``close``.
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
        try:
            for file in self._growing:
                file.write(time)
        except TfetiError as error:  # on all ranks
            self._end(error)
            raise
        finally:
            self._mesh.geometry.x[:] = points
        self._count += 1

    def close(self) -> list[Path]:
        """Give the files their names; which they are. None where they could not be written."""
        if self._ended:
            return []
        for file in self._files:
            file.close()
        for file in self._files:
            file.appear()
        return self._names

    def drop(self) -> None:
        """Remove the files under the names that they have until ``close``."""
        for file in self._files:
            file.drop()

    def _end(self, error: TfetiError) -> None:
        """Keep the steps before one that cannot be written, and say where they are."""
        self._ended = True
        if not self._count:
            self.drop()
            return
        for file in self._files:
            with suppress(TfetiError):
                file.close()
        here = self._files[0].partial
        error.add_note(
            f"the {self._count} steps before are in {here}; {self._names[0]} is as it was"
        )


def fields_of(solution: Solution, interior: bool = False) -> dict[str, Array]:
    """Fields of a step by name, and where the mesh is. Collective."""
    of_nodes, of_cells = solution.interior.fields if interior else ([], [])
    fields = nodal_fields(solution) + of_nodes + of_cells
    values = {f.name: np.array(f.x.array) for f in fields}
    return {**values, POINTS: np.array(solution.decomposition.mesh.geometry.x)}


def _copy(function: fem.Function) -> fem.Function:
    return fem.Function(function.function_space, name=function.name)
