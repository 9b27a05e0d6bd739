"""Files for ParaView: VTX where DOLFINx has ADIOS2, XDMF, PVD; they appear whole."""

import ctypes
import errno
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any

import dolfinx
import numpy as np
from dolfinx import fem, io
from mpi4py import MPI

from tfeti_dolfinx.common.agreement import agreeing
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.compat import geometry_dofmap
from tfeti_dolfinx.common.files import checked_path, remove
from tfeti_dolfinx.common.validation import checked_type, named
from tfeti_dolfinx.errors import InputError, TfetiError, raised_on_all_ranks
from tfeti_dolfinx.mesh.untorn import NO_TAG
from tfeti_dolfinx.solution import Solution

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
WRITERS = {".bp": "write_vtx", ".xdmf": "write_xdmf", ".pvd": "write_pvd"}
LITTLE = 2**14  # bytes, more than what a file without fields takes
POINTS = "points of the mesh"


def write_vtx(
    path: str | os.PathLike[str], solution: Solution, interior: bool = False
) -> list[Path]:
    """Write all fields of a solution for ParaView. Collective.

    Nodal fields (displacement, pressure, gap, status, with mass velocity, with contacts traction,
    with friction tangential traction and slip, with a stress stress and von Mises stress averaged
    at the nodes) go to ``path``; cell fields (subdomain, body, material, and the discretisation
    error if it has been estimated) to a second file, ``<stem>_cells.bp``.

    Args:
        path: A name that ends with ``.bp``. Where DOLFINx has no ADIOS2, XDMF files with the
            same stem are written instead.
        solution: The solution.
        interior: Whether to write the fields of ``solution.interior``, too: displacement and, with
            a stress, stress and von Mises stress of the cells.

    Returns:
        The files written.

    Raises:
        InputError: The name does not end with ``.bp``, or the files cannot be written there, as
            where the disk is full; then what was there before stays.
    """
    target = checked_target(path, ".bp", solution, interior)
    if not dolfinx.has_adios2:
        return write_xdmf(target.with_suffix(".xdmf"), solution, interior)
    return _one_step(target, solution, interior)


def write_xdmf(
    path: str | os.PathLike[str], solution: Solution, interior: bool = False
) -> list[Path]:
    """Write all fields of a solution to one XDMF file and its HDF5 companion. Collective.

    Nodal fields are interpolated to the degree of the mesh geometry, which XDMF requires.

    Args:
        path: A name that ends with ``.xdmf``.
        solution: The solution.
        interior: As for ``write_vtx``.

    Returns:
        The files written.

    Raises:
        InputError: The name does not end with ``.xdmf``, else as for ``write_vtx``.
    """
    return _one_step(checked_target(path, ".xdmf", solution, interior), solution, interior)


def write_pvd(
    path: str | os.PathLike[str], solution: Solution, interior: bool = False
) -> list[Path]:
    """Write all fields of a solution for PyVista and ParaView. Collective.

    All fields are in one grid, those of nodes with the displacement's degree. The file names its
    parts, ``<stem>000000.pvtu`` and ``<stem>_p0_000000.vtu`` of each rank.

    Args:
        path: A name that ends with ``.pvd``.
        solution: The solution.
        interior: As for ``write_vtx``.

    Returns:
        The files written.

    Raises:
        InputError: The name does not end with ``.pvd``, else as for ``write_vtx``.
    """
    return _one_step(checked_target(path, ".pvd", solution, interior), solution, interior)


def _one_step(target: Path, solution: Solution, interior: bool) -> list[Path]:
    """Write a series of one step; return the files."""
    series = Series(target, solution, interior)
    try:
        series.write(0.0, fields_of(solution, interior))
        return series.close()
    except TfetiError:  # on all ranks
        series.drop()
        raise


class SeriesFile:
    """A VTX, PVD or XDMF file, in a folder but for VTX, of another name until it is whole.

    Creation and methods are collective. ADIOS2 throws where a disk is full, throws again in its
    destructor, which ends the process, and lets other ranks wait for the one that has failed. So
    what is to be written is reserved before. Creation raises an InputError where it cannot be
    written, as all methods say, too.

    Args:
        name: Its name once it is whole.
        functions: What it has, all of one mesh; but for VTX on the nodes of one element, and one
            value a cell.

    Attributes:
        partial: Its name until then, or the folder.
    """

    def __init__(self, name: Path, functions: Sequence[fem.Function]) -> None:
        self._name, self._comm = name, functions[0].function_space.mesh.comm
        self._functions, self._count, self._kind = list(functions), 0, name.suffix
        self._bytes = _bytes_of(functions) * (3 if self._kind == ".pvd" else 1)  # texts
        self.partial = name.with_name(f".{name.name}.partial")
        with raised_on_all_ranks(self._comm), named(f"cannot write {name}", OSError):
            if self._comm.rank == 0:
                name.parent.mkdir(parents=True, exist_ok=True)
                remove(self.partial)  # of an earlier run
                if self._kind != ".bp":
                    self.partial.mkdir()
        self._writer: Any = None
        try:
            if self._kind != ".pvd":  # which is begun without a byte
                _reserve(name, self._comm, LITTLE)
            with raised_on_all_ranks(self._comm), named(f"cannot write {name}"):
                if self._kind == ".bp":
                    functions = self._functions
                    self._writer = io.VTXWriter(self._comm, self.partial, functions, engine="BP4")
                else:
                    kind = io.VTKFile if self._kind == ".pvd" else io.XDMFFile
                    self._writer = kind(self._comm, self.partial / name.name, "w")
        except TfetiError:  # on all ranks
            _drop(self.partial, self._comm)
            raise

    def write(self, time: float) -> None:
        """Add what the functions and the mesh have; times before this one are whole."""
        before = self._count * self._bytes if self._kind == ".bp" else 0
        _reserve(self._name, self._comm, self._bytes, before)
        writer, self._writer = self._writer, None  # where it fails it is never used again
        with _written_by(writer, self._name, self._comm):
            if self._kind == ".bp":
                writer.write(time)
            elif self._kind == ".pvd":
                writer.write_function(self._functions, time)
            else:
                writer.write_mesh(self._functions[0].function_space.mesh)
                for function in self._functions:
                    writer.write_function(_as_geometry(function), time)
        self._writer, self._count = writer, self._count + 1

    def close(self) -> None:
        """Write what is left; of VTK the destructor does it, and makes folders that are missing."""
        writer, self._writer = self._writer, None
        if writer is not None and self._kind != ".pvd":
            with _written_by(writer, self._name, self._comm):
                writer.close()

    def appear(self) -> list[Path]:
        """Give the files their names, in the place of those of an earlier run."""
        self._comm.barrier()
        names, parent = [self._name.name], self._name.parent
        with raised_on_all_ranks(self._comm), named(f"cannot write {self._name}", OSError):
            if self._comm.rank == 0:
                remove(self._name)  # first: it names parts
                if self._kind == ".bp":
                    os.replace(self.partial, self._name)
                if self._kind == ".pvd":
                    own = re.compile(re.escape(self._name.stem) + r"(_p\d+_)?\d{6}\.p?vtu")
                    for file in [file for file in parent.iterdir() if own.fullmatch(file.name)]:
                        file.unlink()
                if self._kind != ".bp":
                    names += sorted({file.name for file in self.partial.iterdir()} - {*names})
                    for part in reversed(names):
                        os.replace(self.partial / part, parent / part)
        _drop(self.partial, self._comm)
        return [parent / part for part in self._comm.bcast(names, root=0)]


class Series:
    """Nodal fields of steps, and cell fields beside them. Creation and all methods are collective.

    Files are written under names with ``.partial`` at the end; ``close`` gives them theirs. An
    InputError is raised where nothing can be written there.

    Args:
        target: A name that ends with ``.bp``, cell fields go to ``<stem>_cells.bp``; or with
            ``.pvd`` or ``.xdmf``, which have all fields.
        solution: A solution of the problem: its mesh and which fields there are.
        interior: Whether the fields of ``solution.interior`` are written, too: those of cells at
            each step, other cell fields are always the same.
    """

    def __init__(self, target: Path, solution: Solution, interior: bool = False) -> None:
        self._name, self._mesh = target, solution.decomposition.mesh
        nodal, cellwise = (
            [fem.Function(f.function_space, name=f.name) for f in fields]
            for fields in changing_fields(solution, interior)
        )
        self._functions = nodal + cellwise
        self._count, self._ended = 0, False
        self._files: list[SeriesFile] = []
        of_cells = cell_fields(solution) + cellwise
        parts = {target: nodal + of_cells}
        if target.suffix == ".bp":
            parts = {target: nodal, target.with_name(f"{target.stem}_cells.bp"): of_cells}
        try:
            for name, fields in parts.items():
                self._files.append(SeriesFile(name, fields))
            self._growing = self._files if cellwise else self._files[:1]
            for file in self._files[len(self._growing) :]:
                file.write(0.0)
                file.close()
        except TfetiError:  # on all ranks
            self.drop()
            raise

    def write(self, time: float, values: Mapping[str, Array]) -> None:
        """Add a step from what ``fields_of`` returned for it, in this run or an earlier one.

        Raise an InputError where a field is not there, as of an earlier run that wrote fewer, or
        the files cannot be written: then they end, whole, with the step before, under the names
        that they have until ``close``.
        """
        points = self._mesh.geometry.x.copy()
        for function in self._functions:
            if function.name not in values:
                raise InputError(
                    f"the step at {time:.6g} of the checkpoint has no field {function.name}; "
                    "expected interior= as in the run that has written it"
                )
            function.x.array[:] = values[function.name].ravel()
        self._mesh.geometry.x[:] = values[POINTS]
        try:
            for file in self._growing:
                file.write(time)
        except TfetiError as error:  # on all ranks
            self._ended = True
            if not self._count:
                self.drop()
                raise
            for file in self._files:
                with suppress(TfetiError):
                    file.close()
            error.add_note(
                f"the {self._count} steps before are in {self._files[0].partial}; "
                f"{self._name} is as it was"
            )
            raise
        finally:
            self._mesh.geometry.x[:] = points
        self._count += 1

    def close(self) -> list[Path]:
        """Give the files their names, but not where they could not be written; return them."""
        if self._ended:
            return []
        for file in self._files:
            file.close()
        return [name for file in self._files for name in file.appear()]

    def drop(self) -> None:
        """Remove the files under the names that they have until ``close``."""
        for file in self._files:
            with suppress(TfetiError):
                file.close()
            _drop(file.partial, self._mesh.comm)


def nodal_fields(solution: Solution) -> list[fem.Function]:
    """All nodal fields, on the displacement's element. Collective."""
    fields = [solution.displacement, solution.pressure, solution.gap, solution.status]
    if solution.v is not None:
        fields.append(solution.velocity)
    if solution.has_contact:
        fields.append(solution.traction)
    if solution.has_friction:
        fields += [solution.tangential_traction, solution.slip]
    if solution.has_stress:
        fields += [solution.nodal_stress, solution.nodal_von_mises]
    return fields


def cell_fields(solution: Solution) -> list[fem.Function]:
    """Subdomain, body, material (-1 without a tag), and maybe the estimated error. Collective."""
    decomposition = solution.decomposition
    subdomain = decomposition.cell_subdomain
    material = np.full(len(subdomain), NO_TAG)
    material[decomposition.cell_tags.indices] = decomposition.cell_tags.values
    W = fem.functionspace(decomposition.mesh, ("DG", 0))
    fields = [
        _cell_function(W, "subdomain", subdomain),
        _cell_function(W, "body", decomposition.body_of_subdomain[subdomain]),
        _cell_function(W, "material", np.where(material == NO_TAG, -1, material)),
    ]
    if solution.has_discretisation_error:
        cells = solution.discretisation_error.function_space.dofmap.list
        error = solution.discretisation_error.x.array[np.asarray(cells)[:, 0]]
        fields.append(_cell_function(W, "discretisation_error", error))
    return fields


def changing_fields(
    solution: Solution, interior: bool
) -> tuple[list[fem.Function], list[fem.Function]]:
    """Nodal fields, and those of cells that change from step to step. Collective."""
    of_nodes, of_cells = solution.interior.fields if interior else ([], [])
    return nodal_fields(solution) + of_nodes, of_cells


def fields_of(solution: Solution, interior: bool = False) -> dict[str, Array]:
    """Fields of a step by name, and where the mesh is. Collective."""
    fields = chain(*changing_fields(solution, interior))
    values = {f.name: np.array(f.x.array) for f in fields}
    return {**values, POINTS: np.array(solution.decomposition.mesh.geometry.x)}


def _cell_function(W: fem.FunctionSpace, name: str, values: Array) -> fem.Function:
    function = fem.Function(W, name=name)
    function.x.array[np.asarray(W.dofmap.list)[:, 0]] = values
    return function


def _as_geometry(function: fem.Function) -> fem.Function:
    """Return the function on the element of the mesh geometry; cell functions as they are."""
    V = function.function_space
    degree = V.mesh.ufl_domain().ufl_coordinate_element().degree
    if V.element.basix_element.degree in (0, degree):
        return function
    shape = function.ufl_shape
    W = fem.functionspace(V.mesh, ("Lagrange", degree, shape) if shape else ("Lagrange", degree))
    copy = fem.Function(W, name=function.name)
    copy.interpolate(function)
    return copy


def checked_target(
    path: str | os.PathLike[str], suffix: str, solution: Solution, interior: bool = False
) -> Path:
    """Return the name to write to; what stands there and beside it is replaced. Collective."""
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    with agreeing(solution.decomposition.comm, WRITERS[suffix]) as given:
        given |= {"path": path, "interior": bool(interior)}
        target = checked_path(path, suffix)
        beside = {".bp": f"{target.stem}_cells.bp", ".xdmf": f"{target.stem}.h5"}
        for name in (target, target.with_name(beside.get(suffix, target.name))):
            if name.is_dir() and any(name.iterdir()) and not (name / "md.idx").exists():
                whose = " that VTX has not written" if name.suffix == ".bp" else ""
                raise InputError(f"{name} is a directory{whose}; expected a file")
    return target


def _reserve(name: Path, comm: MPI.Intracomm, size: int, before: int = 0) -> None:
    """Raise unless so many bytes fit beside a name, after those that a file has. Collective.

    Rank 0 takes and gives them back: that knows quotas and limits of a file's size, too.
    """
    what = f"cannot write {name}, up to {size / 1e6:.3g} MB more"
    with raised_on_all_ranks(comm), named(what, OSError):
        if comm.rank == 0 and hasattr(os, "posix_fallocate"):  # macOS has none
            with tempfile.TemporaryFile(dir=name.parent) as file:
                try:
                    os.posix_fallocate(file.fileno(), before, size)
                except OSError as error:
                    if error.errno in FULL:
                        raise


def _bytes_of(functions: Sequence[fem.Function]) -> int:
    """Return what a file takes at most for a mesh and functions on it, all ranks. Collective."""
    mesh = functions[0].function_space.mesh
    cells, width = geometry_dofmap(mesh).shape
    nodes, numbers = len(mesh.geometry.x), 0
    for function in functions:
        dofmap = function.function_space.dofmap
        width = max(width, np.shape(dofmap.list)[1])
        here = len(function.x.array) // dofmap.bs
        nodes = max(nodes, here)
        numbers += here * {2: 3, 4: 9}.get(dofmap.bs, dofmap.bs)  # ParaView knows nothing in 2D
    numbers += 5 * nodes + (width + 3) * cells  # points, their numbers and ghosts; cells and kinds
    names = LITTLE + 2048 * len(functions)  # and least and largest values
    return int(mesh.comm.allreduce(8 * numbers + names))


@contextmanager
def _written_by(writer: Any, name: Path, comm: MPI.Intracomm) -> Iterator[None]:
    """Name what a library raises inside, on all ranks.

    Its object is kept for ever then: the destructor writes again, and ends the process.
    """
    try:
        with raised_on_all_ranks(comm), named(f"cannot write {name}"):
            yield
    except TfetiError:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(writer))
        raise


def _drop(path: Path, comm: MPI.Intracomm) -> None:
    """Remove what is no longer needed. Collective."""
    comm.barrier()
    if comm.rank == 0:
        with suppress(OSError):
            remove(path)
