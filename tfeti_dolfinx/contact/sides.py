"""Surfaces in contact: their facets, and which of a pair had better be the secondary one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.curvature import with_curvature
from tfeti_dolfinx.mortar.facet_maps import hat_areas
from tfeti_dolfinx.mortar.facets import Facets, facet_kind, local_facets, with_averaged_normals
from tfeti_dolfinx.mortar.surfaces import surface_facets
from tfeti_dolfinx.parallel import agreed

# of the square (in 2D: of the length) of a facet's radius: an area below it is rounding, and the
# facet has no normal
DEGENERATE = 1e-12
# Facets that make more than about 40 degrees with the averaged normal: on meshes that are fine
# enough for contact a smooth surface stays well below, at a right-angled edge they make 45.
CREASE = 0.75
# Ratios up to which meshes are of one size: an irrational number, so that rounding decides nowhere
# between counts of equal facets; and materials of one stiffness per area.
SAME_SIZE, SAME_STIFFNESS = 2 ** (1 / 6), 1.01


@dataclass(frozen=True)
class Side:
    """A surface of a pair, or one that faces an obstacle.

    Attributes:
        facets: Its facets on this rank, those of a pair with averaged normals and curvature.
        vertices: Global groups of their vertices, shape ``(n, v)``.
        areas: ∫φ_i over each facet, shape ``(n, v)``.
        normals: Direction in which each owned group may not go further: the averaged normal, at
            an obstacle that towards the shape; 0 off the surface, shape ``(g, gdim)``.
    """

    facets: Facets
    vertices: Array
    areas: Array
    normals: Array

    def has_edges(self, comm: MPI.Intracomm) -> bool:
        """Whether a facet stands far off the averaged normal at a vertex of its. Collective."""
        cosine = np.einsum("nvg,ng->nv", self.facets.vertex_normals, self.facets.normal)
        return comm.allreduce(int(np.sum(cosine < CREASE))) > 0


def side_of(contact: str, surface: str | int, dofs: TornDofs, decomposition: Decomposition) -> Side:
    """A surface of a pair. Collective.

    Args:
        contact: Name of the contact, for messages.
        surface: Name or tag of the surface.
        dofs: Dof maps.
        decomposition: The torn mesh.

    Raises:
        InputError: The surface is unknown or empty, or has facets without area.
    """
    kind = facet_kind(dofs)
    facets = local_facets(dofs, decomposition, surface_facets(decomposition, surface))
    whole = facets.radius ** (facets.x.shape[2] - 1)
    flat = int(np.sum(facets.area <= DEGENERATE * whole))
    if count := dofs.comm.allreduce(flat):
        raise InputError(f"{contact}: {count} facets of {surface!r} have no area")
    facets, normals = with_averaged_normals(facets, dofs, kind.num_vertices)
    facets = with_curvature(facets, dofs, kind)
    vertices = facets.groups[:, : kind.num_vertices]
    return Side(facets, vertices, hat_areas(kind, facets), normals)


@dataclass(frozen=True)
class Ratios:
    """The first side of a pair over the second one, where they meet; the same on all ranks.

    Attributes:
        size: Of facets (roots of areas, in 2D lengths), h over h.
        stiffness: Stiffness per area of the elements, E/h over E/h.
    """

    size: float
    stiffness: float

    @property
    def finer(self) -> bool:
        """Whether the first side has the finer mesh, by more than meshes of one size differ."""
        return self.size < 1.0 / SAME_SIZE

    @property
    def exchanged(self) -> Ratios:
        """The second side over the first one."""
        return Ratios(1.0 / self.size, 1.0 / self.stiffness)

    def second_is_better(self) -> bool:
        """Whether the second side had better be the secondary one; of two equal ones it is not.

        The coarser one is; where meshes are of one size, the softer one.
        """
        if max(self.size, 1.0 / self.size) > SAME_SIZE:
            return self.finer
        return self.stiffness > SAME_STIFFNESS


def ratios(
    records: ContactRecords, sides: tuple[Side, Side], dofs: TornDofs, stiffness: Array
) -> Ratios:
    """Compare the meshes and the stiffness of two sides. Collective.

    Stiffness per area is E/h of the elements at a surface: Σ n_i·K_ii n_i / Σ ∫φ_i over its
    vertices, K_ii the block of K before anything is glued, n_i the normal. Sizes are harmonic
    means, which a few large facets beside many small ones do not decide. The vertices that rows
    name are taken, so that a mesh that is fine only where the bodies touch is judged there; where
    there is no such row, all of them.

    Args:
        records: Conditions between the sides.
        sides: Both sides.
        dofs: Dof maps.
        stiffness: Block of K of each primal node, shape ``(num_nodes, bs, bs)``.
    """
    whole = dofs.reduce(stiffness.reshape(-1, dofs.bs**2), np.add, 0.0)
    blocks = whole.reshape(-1, dofs.bs, dofs.bs)
    named = records.entry_group[records.within_reach[records.condition]]
    meets = dofs.add_on_owners(named, np.ones(len(named))) > 0.0
    if dofs.comm.allreduce(int(np.sum(meets))) == 0:
        meets[:] = True
    sums = []
    for side in sides:
        vertices = side.vertices.ravel()
        area = dofs.add_on_owners(vertices, side.areas.ravel())
        facets = dofs.add_on_owners(vertices, np.full(len(vertices), 1.0 / side.vertices.shape[1]))
        at = meets & (area > 0.0)
        n = side.normals[at]
        along = np.einsum("gi,gij,gj", n, blocks[at], n)
        sums.append((along, area[at].sum(), np.sum(facets[at] / area[at]), np.sum(at)))
    along, area, density, count = dofs.comm.allreduce(np.array(sums, dtype=float)).T
    size, per_area = (count / density) ** (1.0 / (dofs.bs - 1)), along / area
    return Ratios(*agreed(dofs.comm, (float(size[0] / size[1]), float(per_area[0] / per_area[1]))))
