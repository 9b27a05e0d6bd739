"""gmsh's split files: one for each partition, each read on one rank."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.entities import equal_pairs, set_key
from tfeti_dolfinx.mesh.gmsh.model import Elements, ModelContent, open_model, read_content
from tfeti_dolfinx.mesh.untorn import UntornMesh
from tfeti_dolfinx.parallel import Exchange

ONE_MODEL = "expected files that gmsh has written from one model with Mesh.PartitionSplitMeshFiles"
# distance, relative to the size of the mesh, up to which a node's places are the same: files in
# text keep fewer digits than gmsh has
SAME_PLACE = 1e-9


@dataclass(frozen=True)
class SplitFiles:
    """The files ``name_1.msh`` to ``name_{count}.msh`` of a mesh ``name.msh``."""

    path: Path
    count: int

    def file(self, number: int) -> Path:
        """File of a partition, numbered from 1."""
        return self.path.with_name(f"{self.path.stem}_{number}{self.path.suffix}")

    def of_rank(self, comm: MPI.Intracomm) -> list[int]:
        """Numbers of the files that this rank reads: contiguous, and even over the ranks."""
        numbers = range(1, self.count + 1)
        return [p for p in numbers if (p - 1) * comm.size // self.count == comm.rank]


def find_split_files(source: str | PathLike[str] | Any, comm: MPI.Intracomm) -> SplitFiles | None:
    """The split files of a mesh, None if it is a model or one file. Collective.

    Only rank 0 looks, at the source that it was given.

    Raises:
        InputError: A file is missing in the numbering.
    """
    files = None
    with raised_on_all_ranks(comm):
        if comm.rank == 0 and isinstance(source, (str, PathLike)):
            files = _found(Path(source))
    return comm.bcast(files, root=0)


def _found(path: Path) -> SplitFiles | None:
    if path.is_file() or not path.parent.is_dir():
        return None
    pattern = re.compile(re.escape(path.stem) + r"_([1-9]\d*)" + re.escape(path.suffix))
    matches = (pattern.fullmatch(entry.name) for entry in path.parent.iterdir())
    numbers = {int(match[1]) for match in matches if match}
    files = SplitFiles(path, max(numbers, default=0))
    missing = sorted(set(range(1, files.count + 1)) - numbers)
    if missing:
        raise InputError(
            f"{files.file(missing[0])}: no such file, but {files.file(files.count).name} is "
            f"there; expected either {path.name}, or one file for each partition from 1 on"
        )
    return files if numbers else None


def read_split_files(files: SplitFiles, comm: MPI.Intracomm) -> list[ModelContent]:
    """What this rank's files hold, the number of its file as the partition of a cell. Collective.

    Raises:
        InputError: A file cannot be read, or partitions are missing.
    """
    contents = []
    with raised_on_all_ranks(comm):
        for number in files.of_rank(comm):
            # a partition may hold no element in a physical group: gmsh then writes no nodes
            with open_model(files.file(number), may_be_empty=True) as model:
                content = read_content(model, files.file(number).name)
            of_file = {d: _in_partition(e, number) for d, e in content.elements.items()}
            contents.append(replace(content, elements=of_file))
    known = comm.allreduce(
        max((content.num_partitions for content in contents), default=0), op=MPI.MAX
    )
    if known > files.count:
        raise InputError(
            f"{files.file(files.count + 1)}: no such file; expected one file for each of the "
            f"{known} partitions"
        )
    return contents


def _in_partition(elements: Elements, number: int) -> Elements:
    return replace(elements, partitions=np.full(len(elements.ids), number, dtype=np.int64))


def check_shared(
    mesh: UntornMesh, node_ids: Array, x: Array, extent: float, comm: MPI.Intracomm
) -> None:
    """Check that the files are of one mesh. Collective.

    Nodes of one id, and cells of the same nodes, meet on the rank that the id or key names.

    Args:
        mesh: The mesh joined.
        node_ids: Ids of the nodes of each file, one file after the other, shape ``(p,)``.
        x: Their coordinates in these files, shape ``(p, d)``.
        extent: Length of the mesh.
        comm: Communicator.

    Raises:
        InputError: A node lies at different places, or a cell lies in two files.
    """
    exchange = Exchange(comm, node_ids % comm.size)
    node_ids, x = exchange.send(node_ids), exchange.send(x)
    keys = set_key(mesh.cells[:, : mesh.num_vertices])
    exchange = Exchange(comm, (keys % np.uint64(comm.size)).astype(np.int64))
    keys, cell_ids = exchange.send(keys), exchange.send(mesh.cell_ids)
    with raised_on_all_ranks(comm):
        first, second = equal_pairs(node_ids)
        apart = np.abs(x[first] - x[second]).max(axis=1, initial=0.0) > SAME_PLACE * extent
        if np.any(apart):
            i, j = first[apart][0], second[apart][0]
            raise InputError(
                f"node {node_ids[i]} lies at {x[i].tolist()} in one file and at {x[j].tolist()} "
                f"in another; {ONE_MODEL}"
            )
        first, second = equal_pairs(keys)
        if len(first):
            raise InputError(
                f"cells {cell_ids[first[0]]} and {cell_ids[second[0]]} have the same nodes; "
                f"{ONE_MODEL}"
            )
