"""Contact of a body's surface with a rigid obstacle."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.contact.conditions import Side, conditions
from tfeti_dolfinx.contact.partner import ContactPartner
from tfeti_dolfinx.contact.records import ContactRecords, relative_motion
from tfeti_dolfinx.contact.rigid_body import Law, RigidBody
from tfeti_dolfinx.contact.shapes import Shape, check_placement, check_shape, distance_and_gradient
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.mortar.facets import facet_kind, hat_areas, local_facets
from tfeti_dolfinx.mortar.integrals import integrate_distance
from tfeti_dolfinx.mortar.surfaces import diameter, group_points, surface_facets


@dataclass(frozen=True)
class Obstacle(ContactPartner):
    """A surface may not enter a rigid shape.

    Args:
        surface: Name or tag of the surface.
        shape: A ``Plane``, ``Sphere``, ``Cylinder``, ``SignedDistance``, ``SurfaceMesh``, or
            anything with their two methods; or a ``RigidBody``, which moves.
        displacement: Of the shape: short for a ``RigidBody`` with this law.
        gap: "geometry" for the shape's distance from the vertices, where straight facets do not
            show ("curved" is the same); or what replaces it, however far the shape is (negative:
            interference): a number, or a function of the vertices, shape ``(3, n)``.
        friction: ``Tresca``, ``Coulomb``, or None.
        reach: Nodes farther than this from the obstacle get no row at first. After the solve
            all are checked, and those that came to overlap get theirs. Default: 5 % of the
            surface's extent.
        name: For messages and ``solution.contact(name)``. Default: "obstacle of surface 'a'".

    Example:
        >>> table = tfeti.Plane((0, 0, -0.01), normal=(0, 0, 1))
        >>> tfeti.Obstacle("bottom", table, gap=0.0, name="table").name
        'table'
    """

    surface: str | int
    shape: Shape
    displacement: Law | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        self._check_data(f"obstacle of surface {self.surface!r}")
        check_shape(self.shape, self.name)
        if self.displacement is not None:
            if isinstance(self.shape, RigidBody):
                raise InputError(
                    f"{self.name}: displacement= and a RigidBody; expected one of them"
                )
            tool = RigidBody(self.shape, displacement=self.displacement, name=self.name)
            object.__setattr__(self, "shape", tool)  # it is frozen
            object.__setattr__(self, "displacement", None)

    @property
    def surfaces(self) -> tuple[str | int, ...]:
        """The surface."""
        return (self.surface,)

    def records(
        self,
        dofs: TornDofs,
        contact: int,
        reach: float = np.inf,
        depth: float = np.inf,
    ) -> ContactRecords:
        """One condition per vertex of the surface, from its present distance. Collective.

        With φ the signed distance, n = −∇φ/|∇φ| and g = φ/|∇φ| at the vertex (or the gap that is
        given), the condition is that of a dual multiplier, ∫ψ_i n_i·u ≤ g_i ∫ψ_i, divided by ∫ψ_i.
        Of a displacement of degree 1 it is n·u ≤ g at the node, since ψ_i is biorthogonal to its
        hats.
        """
        facets = local_facets(dofs, surface_facets(dofs.decomposition, self.surface))
        kind = facet_kind(dofs)
        centres, corners = facets.corners.mean(axis=1), facets.corners
        if dofs.bs > 1:  # of a scalar space the gradient's first component counts
            size = diameter(dofs.decomposition)
            check_placement(self.shape, centres, dofs.bs, self.name, size, dofs.comm)
        with raised_on_all_ranks(dofs.comm):
            _, towards = self._distances(centres, dofs.bs)
        facing = dofs.comm.allreduce(int(np.sum(np.sum(towards * facets.normal, axis=1) > 0.0)))
        if dofs.bs > 1 and facing == 0:
            raise InputError(
                f"{self.name}: the surface faces away from it; expected "
                "a shape whose distance falls along the outward normal (is its normal turned?)"
            )
        with raised_on_all_ranks(dofs.comm):
            distance, towards = self._distances(corners.reshape(-1, corners.shape[2]), dofs.bs)
        vertices = facets.vertices.ravel()
        normals = dofs.reduce_on_owners(vertices, towards, np.maximum, -np.inf)
        normals[~np.isfinite(normals)] = 0.0  # off the surface
        side = Side(facets, hat_areas(kind, facets), normals)
        integrals = integrate_distance(kind, facets, distance.reshape(facets.vertices.shape))
        found = conditions(dofs, contact, side, integrals)
        if isinstance(self.shape, RigidBody):
            x = group_points(dofs)[:, : dofs.bs]
            found = replace(found, place=relative_motion(found, dofs, x))
        return self._with_gaps_and_friction(dofs, found, reach, np.inf)

    def _distances(self, x: Array, gdim: int) -> tuple[Array, Array]:
        """Return distances and normals at points of shape ``(n, 2)`` or ``(n, 3)``."""
        gap, gradient = distance_and_gradient(self.shape, x, self.name)
        gradient = gradient[:, :gdim]
        length = np.linalg.norm(gradient, axis=1)
        wrong = ~(np.isfinite(gap) & np.isfinite(length) & (length > 0.0))
        if np.any(wrong):
            raise InputError(
                f"{self.name} has no distance and normal at the node "
                f"{x[wrong][0].tolist()}: distance {gap[wrong][0]}, gradient {gradient[wrong][0]}"
            )
        return gap / length, -gradient / length[:, None]
