"""The torn mesh and what is known of its subdomains, bodies, tags and tears."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.checks import is_whole, shown
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.untorn import PhysicalNames


@dataclass(frozen=True)
class Decomposition:
    """A mesh torn along its subdomain interfaces.

    A subdomain's cells are all on one rank, and no vertex belongs to two subdomains.

    Attributes:
        mesh: The torn DOLFINx mesh, on the communicator it was read on, without ghosts.
        cell_tags: Material tags.
        facet_tags: Surface tags.
        names: Names of the physical groups.
        cell_subdomain: Subdomain of each local cell, shape ``(num_cells,)``.
        original_cells: Original id of each local cell, shape ``(num_cells,)``.
        original_nodes: Original id of each local geometry node, shape ``(num_nodes,)``.
        body_of_subdomain: Body of every subdomain, the same on all ranks, shape ``(N,)``.
        tears: Local facets on the tears, ascending.
        boundary: Local facets on the true boundary, ascending.
        split: New ids of each subdomain that was not connected and was split.
        seconds: Wall seconds that reading and tearing took.
    """

    mesh: dmesh.Mesh
    cell_tags: dmesh.MeshTags
    facet_tags: dmesh.MeshTags
    names: PhysicalNames
    cell_subdomain: Array
    original_cells: Array
    original_nodes: Array
    body_of_subdomain: Array
    tears: Array
    boundary: Array
    split: dict[int, list[int]]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator of the mesh."""
        return self.mesh.comm

    @property
    def num_subdomains(self) -> int:
        """Number of subdomains on all ranks."""
        return len(self.body_of_subdomain)

    @property
    def num_bodies(self) -> int:
        """Number of bodies: parts of the untorn mesh connected through facets."""
        return int(self.body_of_subdomain.max()) + 1

    @property
    def subdomains(self) -> Array:
        """Subdomains of this rank, ascending."""
        return np.unique(self.cell_subdomain)

    @property
    def is_torn(self) -> bool:
        """Whether any body consists of more than one subdomain."""
        return self.num_subdomains > self.num_bodies

    @cached_property
    def body_names(self) -> list[str]:
        """A name for each body, with the volumes that it consists of. Collective at first use."""
        body = self.body_of_subdomain[self.cell_subdomain[self.cell_tags.indices]]
        pairs = np.unique(np.stack((body, self.cell_tags.values), axis=1), axis=0)
        pairs = np.unique(np.concatenate(self.comm.allgather(pairs)), axis=0)
        volume = {tag: name for name, tag in self.names.volumes.items()}
        names = []
        for b in range(self.num_bodies):
            own = ", ".join(repr(volume[tag]) for tag in pairs[pairs[:, 0] == b, 1].tolist())
            names.append(f"body {b} (volume {own})" if own else f"body {b}")
        return names

    def surface(self, name: str | int) -> int:
        """Tag of a surface, given its name or its tag.

        Raises:
            InputError: There is no such surface.
        """
        return _tag(name, self.names.surfaces, "surface")

    def volume(self, name: str | int) -> int:
        """Tag of a volume (in 2D: of a plane region), given its name or its tag.

        Raises:
            InputError: There is no such volume.
        """
        return _tag(name, self.names.volumes, "volume")

    def facets(self, name: str | int) -> Array:
        """Local facets of a surface, ascending."""
        return self.facet_tags.find(self.surface(name))


def _tag(name: str | int, names: dict[str, int], kind: str) -> int:
    if is_whole(name) and int(name) in names.values():
        return int(name)
    if isinstance(name, str) and name in names:
        return names[name]
    if not is_whole(name) and not isinstance(name, str):
        raise InputError(f"{kind} {shown(name)}: expected the name or the tag of one {kind}")
    raise InputError(f"no {kind} {name!r} in the mesh; its {kind}s are: {known_tags(names)}")


def known_tags(names: dict[str, int]) -> str:
    """Names and tags for messages."""
    return ", ".join(f"{n!r} ({t})" for n, t in names.items()) or "none"
