"""Names of the physical groups, merged over the models that ranks have read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mpi4py import MPI

from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.gmsh.model import ModelContent
from tfeti_dolfinx.mesh.untorn import PhysicalNames

# dimension and tag of a physical group
PhysicalGroup = tuple[int, int]


def physical_names(
    contents: Sequence[ModelContent], top: int, comm: MPI.Intracomm
) -> PhysicalNames:
    """Names of the physical groups of cells and facets in all models of all ranks. Collective.

    A model may know only some of them. One that a model knows only by its number has the name
    that another gives it.

    Args:
        contents: What this rank has read.
        top: Dimension of the cells.
        comm: Communicator.

    Raises:
        InputError: A name has different tags or dimensions in the models (unless one model has
            them all: gmsh lets a surface and a volume have the same name), or a tag different
            names.
    """
    # equal sets of names count once, so that what is gathered stays small
    own = {
        frozenset(
            (name, (d, tag))
            for d in (top - 1, top)
            for name, tag in content.names.get(d, {}).items()
        )
        for content in contents
    }
    every = set[frozenset[tuple[str, PhysicalGroup]]]().union(*comm.allgather(own))
    names = _checked_names(every)
    return PhysicalNames(
        surfaces={name: tag for (dim, tag), name in names.items() if dim == top - 1},
        volumes={name: tag for (dim, tag), name in names.items() if dim == top},
    )


def _checked_names(
    every: Iterable[frozenset[tuple[str, PhysicalGroup]]],
) -> dict[PhysicalGroup, str]:
    """Name of each physical group, sorted by dimension and tag."""
    pairs = sorted(set[tuple[str, PhysicalGroup]]().union(*every))
    names = {group: name for name, group in pairs if name == str(group[1])}
    given: dict[PhysicalGroup, str] = {}
    groups: dict[str, set[PhysicalGroup]] = {}
    for name, group in pairs:
        if name == str(group[1]):
            continue
        groups.setdefault(name, set()).add(group)
        if given.setdefault(group, name) != name:
            raise InputError(
                f"the physical group of {_described(group)} is named {given[group]!r} in one file "
                f"and {name!r} in another; expected one name"
            )
    for name, its_groups in groups.items():
        if not any(all((name, group) in content for group in its_groups) for content in every):
            said = " and ".join(_described(group) for group in sorted(its_groups))
            raise InputError(
                f"the name {name!r} stands for the physical groups of {said} in different "
                "files; expected one dimension and tag"
            )
    return dict(sorted({**names, **given}.items()))


def _described(group: PhysicalGroup) -> str:
    return f"dimension {group[0]} and tag {group[1]}"
