"""The two sides of a pair: their facets, and which is the stiffer one where they meet."""

from __future__ import annotations

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.facet_maps import hat_areas
from tfeti_dolfinx.contact.facets import Facets, facet_kind, local_facets, with_averaged_normals
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.contact.surfaces import surface_facets
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.parallel import agreed

DEGENERATE = 1e-12  # of the square (in 2D: of the length) of a facet's radius
CREASE = 0.75  # facets that make more than about 40 degrees with the averaged normal


def side_facets(
    contact: str, surface: str | int, dofs: TornDofs, decomposition: Decomposition
) -> Facets:
    """Facets of a surface on this rank. Collective.

    Args:
        contact: Name of the contact, for messages.
        surface: Name or tag of the surface.
        dofs: Dof maps.
        decomposition: The torn mesh.

    Raises:
        InputError: The surface is unknown or empty, or has facets without area.
    """
    facets = local_facets(dofs, decomposition, surface_facets(decomposition, surface))
    whole = facets.radius ** (facets.x.shape[2] - 1)
    flat = int(np.sum(facets.area <= DEGENERATE * whole))
    if count := decomposition.comm.allreduce(flat):
        raise InputError(f"{contact}: {count} facets of {surface!r} have no area")
    return facets


def has_edges(surface: str | int, dofs: TornDofs, decomposition: Decomposition) -> bool:
    """Whether a facet stands far off the averaged normal at one of its vertices. Collective."""
    facets = local_facets(dofs, decomposition, surface_facets(decomposition, surface))
    facets, _ = with_averaged_normals(facets, dofs, facet_kind(dofs).num_vertices)
    cosine = np.einsum("nvg,ng->nv", facets.vertex_normals, facets.normal)
    return decomposition.comm.allreduce(int(np.sum(cosine < CREASE))) > 0


def stiffness_ratio(
    records: ContactRecords,
    surfaces: tuple[str | int, str | int],
    dofs: TornDofs,
    decomposition: Decomposition,
    stiffness: Array,
) -> float:
    """Stiffness per area of the first surface over that of the second. Collective.

    Stiffness per area is E/h of the elements at a surface: Σ n_i·K_ii n_i / Σ ∫φ_i over its
    vertices, K_ii the diagonal before anything is glued, n_i the normal. The vertices that rows
    name are taken, so that a mesh that is fine only where the bodies touch is judged there; where
    there is no such row, all of them.

    Args:
        records: Conditions between the surfaces.
        surfaces: Their names or tags.
        dofs: Dof maps.
        decomposition: The torn mesh.
        stiffness: Diagonal of K in primal order, shape ``(num_nodes * bs,)``.
    """
    diagonal = dofs.reduce(stiffness.reshape(-1, dofs.bs), np.add, 0.0)
    named = records.entry_group[records.near[records.row]]
    meets = dofs.add_on_owners(named, np.ones(len(named))) > 0.0
    if dofs.comm.allreduce(int(np.sum(meets))) == 0:
        meets[:] = True
    per_area = []
    for name in surfaces:
        area, normal = _vertices(name, dofs, decomposition)
        at = meets & (area > 0.0)
        along = np.sum(normal[at] ** 2 * diagonal[at])
        sums = dofs.comm.allreduce(np.array([along, area[at].sum()]))
        per_area.append(sums[0] / sums[1])
    return agreed(dofs.comm, float(per_area[0] / per_area[1]))


def _vertices(name: str | int, dofs: TornDofs, decomposition: Decomposition) -> tuple[Array, Array]:
    """∫φ_i and the normal for each owned group that is a vertex of a surface, else 0. Collective.

    Returns:
        Shapes ``(g,)`` and ``(g, gdim)``.
    """
    kind = facet_kind(dofs)
    facets = local_facets(dofs, decomposition, surface_facets(decomposition, name))
    vertices = facets.groups[:, : kind.num_vertices]
    area = dofs.add_on_owners(vertices.ravel(), hat_areas(kind, facets).ravel())
    return area, with_averaged_normals(facets, dofs, kind.num_vertices)[1]
