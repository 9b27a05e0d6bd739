"""Meshes that gmsh made: physical groups, partitions, and the nodes' own numbers."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.checks import checked_type
from tfeti_dolfinx.errors import raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.gmsh.join import untorn_mesh
from tfeti_dolfinx.mesh.gmsh.model import ModelContent, open_model, read_content
from tfeti_dolfinx.mesh.gmsh.split import find_split_files, read_split_files
from tfeti_dolfinx.mesh.metis import metis
from tfeti_dolfinx.mesh.partition import (
    Subdomains,
    assign_subdomains,
    coordinate_bisection,
    default_count,
)
from tfeti_dolfinx.mesh.tearing import tear
from tfeti_dolfinx.timing import stage


def read_gmsh(
    source: str | PathLike[str] | Any,
    comm: MPI.Intracomm,
    subdomains: Subdomains | None = None,
) -> Decomposition:
    """Read a gmsh mesh and tear it into subdomains. Collective.

    Rank 0 reads; no other rank ever holds more than its own subdomains. If there is no file
    ``name.msh`` but there are the files ``name_1.msh``, ``name_2.msh``, ... that gmsh writes
    with ``Mesh.PartitionSplitMeshFiles``, one for each partition, then these are shared out
    evenly: of ``count`` files, rank ``floor((p - 1) * comm.size / count)`` reads the p-th, and
    no rank ever holds the whole mesh.

    Args:
        source: A ``.msh`` file, or a gmsh model (``gmsh.model``) that is meshed on rank 0.
        comm: Communicator of the torn mesh.
        subdomains: Their number (METIS, made round; split files: coordinate bisection); or
            one id per cell on rank 0, in gmsh's order, and empty arrays elsewhere (for split
            files one id per cell of the files that this rank reads, in the order of the files
            and within a file in gmsh's order, without ghost cells); or a callable of cell
            midpoints, shape ``(3, n)``. Default: gmsh's own partitions if the mesh has them
            (split files: one subdomain per file), else about 4000 unknowns each.

    Returns:
        The torn mesh, its tags and names those of the physical groups. Split files give the
        same as the partitioned mesh in one file.

    Raises:
        InputError: The file is missing or not a mesh, there are no physical groups of cells,
            the cells are of several types, or the subdomains do not fit. Of split files: one
            is missing, a name or a tag means different groups, a node has different
            coordinates, or a cell lies in two files.

    Example:
        gmsh meshes on rank 0; the other ranks give None.

        >>> import gmsh
        >>> comm, model = MPI.COMM_WORLD, None
        >>> if comm.rank == 0:
        ...     gmsh.initialize(interruptible=False)
        ...     gmsh.option.setNumber("General.Terminal", 0)
        ...     model = gmsh.model
        ...     plate = model.occ.addRectangle(0, 0, 0, 2, 1)
        ...     model.occ.synchronize()
        ...     steel = model.addPhysicalGroup(2, [plate], name="steel")
        ...     edges = model.addPhysicalGroup(1, [1, 2, 3, 4], name="edges")
        ...     model.mesh.generate(2)
        >>> decomposition = tfeti.read_gmsh(model, comm, subdomains=3)
        >>> decomposition.num_subdomains, decomposition.body_names
        (3, ["body 0 (volume 'steel')"])
    """
    checked_type(comm, MPI.Intracomm, "comm", "a communicator such as MPI.COMM_WORLD")
    seconds: dict[str, float] = {}
    with stage("mesh", seconds):
        decomposition = _read_and_tear(source, comm, subdomains)
    return replace(decomposition, seconds=seconds)


def _read_and_tear(
    source: Any, comm: MPI.Intracomm, subdomains: Subdomains | None
) -> Decomposition:
    files = find_split_files(source, comm)
    contents = read_split_files(files, comm) if files else _read_on_rank_0(source, comm)
    untorn, partitions = untorn_mesh(contents, comm, shared=files is not None)
    if subdomains is None:
        subdomains = default_count(untorn, comm) if partitions is None else partitions
    # METIS needs the mesh on one rank
    partitioner = coordinate_bisection if files else metis
    subdomain = assign_subdomains(untorn, subdomains, comm, partitioner)
    bisected = files is not None and isinstance(subdomains, (int, np.integer))
    return tear(untorn, subdomain, comm, absorb=bisected)


def _read_on_rank_0(source: Any, comm: MPI.Intracomm) -> list[ModelContent]:
    contents = []
    with raised_on_all_ranks(comm):
        if comm.rank == 0:
            with open_model(source) as model:
                contents.append(read_content(model, "the mesh"))
    return contents
