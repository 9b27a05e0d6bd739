"""Tags and names that users give: do they belong to the mesh?"""

from __future__ import annotations

from typing import Any

from dolfinx import mesh as dmesh

from tfeti_dolfinx.checks import checked_type, is_whole, shown
from tfeti_dolfinx.errors import InputError


def check_tags(tags: Any, mesh: dmesh.Mesh, of_cells: bool, what: str, expected: str) -> None:
    """Raise unless tags are those of a mesh's cells, or of its facets.

    Args:
        tags: What was given.
        mesh: The mesh.
        of_cells: Whether cells are tagged, else facets.
        what: The tags' name in messages.
        expected: What to give instead, for messages.

    Raises:
        InputError: They are no tags, of another mesh, or of entities of another dimension.
    """
    checked_type(tags, dmesh.MeshTags, what, "dolfinx.mesh.MeshTags")
    if tags.topology is not mesh.topology._cpp_object:
        raise InputError(f"{what} are tags of another mesh; {expected}")
    dim = mesh.topology.dim - (0 if of_cells else 1)
    if tags.dim != dim:
        raise InputError(
            f"{what} are tags of entities of dimension {tags.dim}, not {dim}; {expected}"
        )


def checked_names(names: Any, what: str, tags: Any, tags_name: str) -> dict[str, int]:
    """Names of tags as a dictionary.

    Raises:
        InputError: They are no dictionary from texts to integers, or there are no tags to name.
    """
    if names is None:
        return {}
    checked_type(names, dict, what, "a dictionary of names and tags, such as {'top': 1}")
    for name, tag in names.items():
        if not isinstance(name, str) or not is_whole(tag):
            raise InputError(
                f"{what} has {shown(name)}: {shown(tag)}; expected a name and its tag, 'top': 1"
            )
    if names and tags is None:
        raise InputError(f"{what}={shown(names)} without {tags_name}; expected the tags they name")
    return {name: int(tag) for name, tag in names.items()}
