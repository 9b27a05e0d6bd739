"""Contact of a body's surface with a rigid obstacle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.contact.conditions import conditions, triplets
from tfeti_dolfinx.contact.facets import facet_kind, local_facets
from tfeti_dolfinx.contact.mortar import dual_multipliers, hat_areas, whole_facets
from tfeti_dolfinx.contact.records import ContactRecords
from tfeti_dolfinx.contact.shapes import Shape
from tfeti_dolfinx.contact.surfaces import (
    group_points,
    hat_integrals,
    on_surface,
    surface_facets,
)
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs

QUADRATURE = 4


@dataclass(frozen=True)
class Obstacle:
    """A surface may not enter a rigid shape.

    Args:
        surface: Name or tag of the surface.
        shape: A ``Plane``, ``Sphere``, ``Cylinder``, ``SignedDistance``, or anything with their
            two methods.
        reach: Nodes farther than this from the obstacle get no row at first. After the solve
            all are checked, and those that came to overlap get theirs. A reach that leaves few
            rows without contact makes the solve faster, mostly where contact alone holds a body.
    """

    surface: str | int
    shape: Shape
    reach: float = np.inf

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """The surface."""
        return (self.surface,)

    def first_radius(self, decomposition: Decomposition) -> float:
        """Infinite: all nodes of the surface are looked at."""
        return np.inf

    def displacement_bound(self, dofs: TornDofs, decomposition: Decomposition, u: Array) -> float:
        """Nothing lies beyond the radius, however large the displacement is."""
        return 0.0

    def records(
        self,
        dofs: TornDofs,
        decomposition: Decomposition,
        contact: int,
        radius: float = np.inf,
        depth: float = np.inf,
    ) -> ContactRecords:
        """One condition per vertex of the surface, from its present distance. Collective.

        With φ the signed distance, n = −∇φ/|∇φ| and g = φ/|∇φ|, the condition of a displacement of
        degree 1 is n·u ≤ g at the node. For other degrees it is that of a dual multiplier,
        ∫ψ_i n_i·u ≤ g_i ∫ψ_i, divided by ∫ψ_i, with the gap at the vertex.

        Raises:
            InputError: The surface is unknown or empty or faces away, the shape has no normal at
                a node, or no node is within reach.
        """
        facets = surface_facets(decomposition, self.surface)
        if dofs.V.element.basix_element.degree == 1:
            records = self._at_nodes(dofs, decomposition, contact, facets)
        else:
            records = self._weighted(dofs, decomposition, contact, facets)
        self._check_side(dofs, decomposition, facets)
        near = records.gap <= self.reach
        if decomposition.comm.allreduce(int(np.sum(near))) == 0:
            lowest = float(records.gap.min(initial=np.inf))
            nearest = decomposition.comm.allreduce(lowest, op=MPI.MIN)
            raise InputError(
                f"obstacle of surface {self.surface!r}: no node within reach={self.reach}; "
                f"the nearest is {nearest:.6g} away"
            )
        return replace(records, near=near)

    def _at_nodes(
        self, dofs: TornDofs, decomposition: Decomposition, contact: int, facets: Array
    ) -> ContactRecords:
        groups = on_surface(dofs, decomposition, facets)
        area = hat_integrals(dofs, decomposition, [self.surface])[groups]
        with raised_on_all_ranks(decomposition.comm):
            gap, normal = self._gaps(group_points(dofs)[groups], dofs.bs)
        return ContactRecords(
            contact=np.full(len(groups), contact),
            group=groups,
            normal=normal,
            gap=gap,
            area=area,
            near=np.ones(len(groups), dtype=bool),
            row=np.arange(len(groups)),
            entry_group=dofs.group_offsets[dofs.comm.rank] + groups,
            coefficients=normal,
            candidates=len(groups),
        )

    def _weighted(
        self, dofs: TornDofs, decomposition: Decomposition, contact: int, facets: Array
    ) -> ContactRecords:
        kind, surface = facet_kind(dofs), local_facets(dofs, decomposition, facets)
        degree = QUADRATURE * kind.displacement.degree
        facet, xi, weight = whole_facets(kind, surface, degree)
        dual = dual_multipliers(kind, surface.area, facet, xi, weight)
        vertices = surface.groups[:, : kind.num_vertices]
        with raised_on_all_ranks(decomposition.comm):
            gap, normals = self._gaps(group_points(dofs), dofs.bs)
        (at_vertices,) = dofs.lookup(vertices[dual.facet].ravel(), gap)
        return conditions(
            dofs=dofs,
            contact=contact,
            multipliers=vertices[dual.facet],
            covered=dual.covered,
            gaps=at_vertices.reshape(dual.covered.shape) * dual.covered,
            entries=(
                triplets(
                    vertices[dual.facet],
                    surface.groups[dual.facet],
                    dual.integrals(kind.displacement.values(xi)),
                ),
            ),
            nodes=vertices,
            areas=hat_areas(kind, surface),
            normals=normals,
        )

    def _check_side(self, dofs: TornDofs, decomposition: Decomposition, facets: Array) -> None:
        """Raise if no facet faces the obstacle. Collective."""
        surface = local_facets(dofs, decomposition, facets)
        centres = surface.corners(facet_kind(dofs).num_vertices).mean(axis=1)
        with raised_on_all_ranks(decomposition.comm):
            _, towards = self._gaps(centres, dofs.bs)
        facing = int(np.sum(np.sum(towards * surface.normal, axis=1) > 0.0))
        if dofs.bs > 1 and decomposition.comm.allreduce(facing) == 0:
            raise InputError(
                f"obstacle of surface {self.surface!r}: the surface faces away from it; expected "
                "a shape whose distance falls along the outward normal (is its normal turned?)"
            )

    def _gaps(self, x: Array, gdim: int) -> tuple[Array, Array]:
        """Distances and normals at points of shape ``(n, 2)`` or ``(n, 3)``."""
        points = np.zeros((3, len(x)))
        points[: x.shape[1]] = x.T
        gap, gradient = self.shape.distance(points), self.shape.gradient(points).T[:, :gdim]
        length = np.linalg.norm(gradient, axis=1)
        wrong = ~(np.isfinite(gap) & np.isfinite(length) & (length > 0.0))
        if np.any(wrong):
            raise InputError(
                f"obstacle of surface {self.surface!r} has no distance and normal at the node "
                f"{x[wrong][0].tolist()}: distance {gap[wrong][0]}, gradient {gradient[wrong][0]}"
            )
        return gap / length, -gradient / length[:, None]
