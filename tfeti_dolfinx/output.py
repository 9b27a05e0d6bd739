"""Files for ParaView: VTX where DOLFINx has ADIOS2, else XDMF; they appear whole."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

import dolfinx
import numpy as np
from dolfinx import fem, io

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import checked_path, checked_type, named
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.entities import NO_TAG
from tfeti_dolfinx.solution import Solution


def write_vtx(
    path: str | os.PathLike[str], solution: Solution, interior: bool = False
) -> list[Path]:
    """Write all fields of a solution for ParaView. Collective.

    Nodal fields (displacement, pressure, gap, status, with mass velocity, with contacts traction,
    with friction tangential traction and slip, with a stress
    stress and von Mises stress averaged at the nodes) go to ``path``; cell fields (subdomain, body,
    material, and the discretisation error if it has been estimated) to a second file beside it,
    ``<stem>_cells.bp``.

    Args:
        path: A name that ends with ``.bp``. Where DOLFINx has no ADIOS2, XDMF files with the
            same stem are written instead.
        solution: The solution.
        interior: Whether to write the fields of ``solution.interior``, too: displacement and, with
            a stress, stress and von Mises stress of the cells.

    Returns:
        The files written.

    Raises:
        InputError: The name does not end with ``.bp``, or nothing can be written there.
    """
    target = checked_target(path, ".bp", solution)
    if not dolfinx.has_adios2:
        return write_xdmf(target.with_suffix(".xdmf"), solution, interior)
    cells = target.with_name(f"{target.stem}_cells.bp")
    for name, functions in zip((target, cells), _fields(solution, interior), strict=True):
        partial = begin_file(name, solution)
        with io.VTXWriter(solution.decomposition.comm, partial, functions, engine="BP4") as vtx:
            vtx.write(0.0)
        end_file(partial, name, solution)
    return [target, cells]


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
        InputError: The name does not end with ``.xdmf``, or nothing can be written there.
    """
    target = checked_target(path, ".xdmf", solution)
    decomposition = solution.decomposition
    folder = begin_file(target.with_name(f"{target.stem}.folder"), solution)
    with raised_on_all_ranks(decomposition.comm), named(f"cannot write {target}", OSError):
        if decomposition.comm.rank == 0:
            folder.mkdir(parents=True)
    with io.XDMFFile(decomposition.comm, folder / target.name, "w") as xdmf:
        xdmf.write_mesh(decomposition.mesh)
        for function in itertools.chain(*_fields(solution, interior)):
            xdmf.write_function(_as_geometry(function, decomposition))
    companion = target.with_suffix(".h5")
    for name in (companion, target):
        end_file(folder / name.name, name, solution)
    with raised_on_all_ranks(decomposition.comm):
        if decomposition.comm.rank == 0:
            folder.rmdir()
    return [target, companion]


def nodal_fields(solution: Solution) -> list[fem.Function]:
    """All nodal fields, on the displacement's element. Collective."""
    fields = [solution.displacement, solution.pressure, solution.gap, solution.status]
    if solution.has_velocity:
        fields.append(solution.velocity)
    if solution.has_contact:
        fields.append(solution.traction)
    if solution.has_friction:
        fields += [solution.tangential_traction, solution.slip]
    if solution.has_stress:
        fields += [solution.nodal_stress, solution.nodal_von_mises]
    return fields


def cell_fields(solution: Solution) -> list[fem.Function]:
    """Subdomain, body, material (-1 where a cell has no tag), and maybe the estimated error.

    Collective.
    """
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


def _fields(solution: Solution, interior: bool) -> tuple[list[fem.Function], list[fem.Function]]:
    """Nodal fields and cell fields. Collective."""
    of_nodes, of_cells = solution.interior.fields if interior else ([], [])
    return nodal_fields(solution) + of_nodes, cell_fields(solution) + of_cells


def _cell_function(W: fem.FunctionSpace, name: str, values: Array) -> fem.Function:
    function = fem.Function(W, name=name)
    function.x.array[np.asarray(W.dofmap.list)[:, 0]] = values
    return function


def _as_geometry(function: fem.Function, decomposition: Decomposition) -> fem.Function:
    """The function on the element of the mesh geometry; cell functions as they are."""
    V = function.function_space
    degree = decomposition.mesh.ufl_domain().ufl_coordinate_element().degree
    if V.element.basix_element.degree in (0, degree):
        return function
    shape = function.ufl_shape
    W = fem.functionspace(V.mesh, ("Lagrange", degree, shape) if shape else ("Lagrange", degree))
    copy = fem.Function(W, name=function.name)
    copy.interpolate(function)
    return copy


def checked_target(path: str | os.PathLike[str], suffix: str, solution: Solution) -> Path:
    """The name to write to; what stands there and beside it is replaced. Collective."""
    target = checked_path(path, suffix)
    checked_type(solution, Solution, "solution", "the solution of a ContactProblem")
    stem = target.stem
    beside = target.with_name(f"{stem}.h5" if suffix == ".xdmf" else f"{stem}_cells{suffix}")
    with raised_on_all_ranks(solution.decomposition.comm):
        for name in (target, beside):
            if name.is_dir() and any(name.iterdir()) and not (name / "md.idx").exists():
                raise InputError(f"{name} is a directory that VTX has not written; expected a file")
    return target


def begin_file(name: Path, solution: Solution) -> Path:
    """Name to write to until the file is whole; what an earlier run left there is removed."""
    partial = name.with_name(f".{name.name}.partial")
    comm = solution.decomposition.comm
    with raised_on_all_ranks(comm), named(f"cannot write {name}", OSError):
        if comm.rank == 0:
            name.parent.mkdir(parents=True, exist_ok=True)
            _remove(partial)
    return partial


def end_file(partial: Path, name: Path, solution: Solution) -> None:
    """Give a whole file its name. Collective."""
    comm = solution.decomposition.comm
    comm.barrier()
    with raised_on_all_ranks(comm), named(f"cannot write {name}", OSError):
        if comm.rank == 0:
            _remove(name)
            os.replace(partial, name)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
