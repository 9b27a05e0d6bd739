"""Names of the physical groups, merged over the models that ranks have read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mpi4py import MPI

from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.gmsh.model import Part
from tfeti_dolfinx.mesh.untorn import GroupNames

# dimension and tag of a physical group
Group = tuple[int, int]


def group_names(parts: Sequence[Part], top: int, comm: MPI.Intracomm) -> GroupNames:
    """Names of the groups of cells and facets in all parts of all ranks. Collective.

    A part may know only some groups. A group that one part knows only by its number has the
    name that another part gives it.

    Args:
        parts: What this rank has read.
        top: Dimension of the cells.
        comm: Communicator.

    Raises:
        InputError: A name has different tags or dimensions in the parts (unless one part has
            them all: gmsh lets a surface and a volume have the same name), or a tag different
            names.
    """
    # equal sets of names count once, so that what is gathered stays small
    own = {
        frozenset(
            (name, (d, tag)) for d in (top - 1, top) for name, tag in part.names.get(d, {}).items()
        )
        for part in parts
    }
    every = set[frozenset[tuple[str, Group]]]().union(*comm.allgather(own))
    names = _checked_names(every)
    return GroupNames(
        surfaces={name: tag for (dim, tag), name in names.items() if dim == top - 1},
        volumes={name: tag for (dim, tag), name in names.items() if dim == top},
    )


def _checked_names(every: Iterable[frozenset[tuple[str, Group]]]) -> dict[Group, str]:
    """Name of each group, sorted by dimension and tag."""
    pairs = sorted(set[tuple[str, Group]]().union(*every))
    names = {group: name for name, group in pairs if name == str(group[1])}
    given: dict[Group, str] = {}
    groups: dict[str, set[Group]] = {}
    for name, group in pairs:
        if name == str(group[1]):
            continue
        groups.setdefault(name, set()).add(group)
        if given.setdefault(group, name) != name:
            raise InputError(
                f"the physical group of {_said(group)} is named {given[group]!r} in one file "
                f"and {name!r} in another; expected one name"
            )
    for name, its_groups in groups.items():
        if not any(all((name, group) in part for group in its_groups) for part in every):
            said = " and ".join(_said(group) for group in sorted(its_groups))
            raise InputError(
                f"the name {name!r} stands for the physical groups of {said} in different "
                "files; expected one dimension and tag"
            )
    return dict(sorted({**names, **given}.items()))


def _said(group: Group) -> str:
    return f"dimension {group[0]} and tag {group[1]}"
