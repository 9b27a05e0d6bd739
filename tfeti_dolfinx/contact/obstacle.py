"""Contact of a body's surface with a rigid obstacle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from tfeti_dolfinx.arrays import Array
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

    def records(self, dofs: TornDofs, decomposition: Decomposition, contact: int) -> ContactRecords:
        """One condition per node of the surface, from its present distance. Collective.

        The condition is  n·u ≤ g  with n = −∇φ/|∇φ| and g = φ/|∇φ|, φ the signed distance.

        Raises:
            InputError: The surface is unknown or empty, the displacement is not of degree 1,
                the shape has no normal at a node, or no node is within reach.
        """
        facets = surface_facets(decomposition, self.surface)
        if dofs.V.element.basix_element.degree != 1:
            raise InputError(
                f"contact on surface {self.surface!r}: expected displacement of degree 1"
            )
        groups = on_surface(dofs, decomposition, facets)
        area = hat_integrals(dofs, decomposition, self.surface)[groups]
        with raised_on_all_ranks(decomposition.comm):
            gap, normal = self._gaps(group_points(dofs)[groups], dofs.bs)
        if decomposition.comm.allreduce(int(np.sum(gap <= self.reach))) == 0:
            nearest = decomposition.comm.allreduce(float(gap.min(initial=np.inf)), op=MPI.MIN)
            raise InputError(
                f"obstacle of surface {self.surface!r}: no node within reach={self.reach}; "
                f"the nearest is {nearest:.6g} away"
            )
        return ContactRecords(
            contact=np.full(len(groups), contact),
            group=groups,
            normal=normal,
            gap=gap,
            area=area,
            near=gap <= self.reach,
            row=np.arange(len(groups)),
            entry_group=dofs.group_offsets[dofs.comm.rank] + groups,
            coefficients=normal,
        )

    def _gaps(self, x: Array, gdim: int) -> tuple[Array, Array]:
        gap, gradient = self.shape.distance(x.T), self.shape.gradient(x.T).T[:, :gdim]
        length = np.linalg.norm(gradient, axis=1)
        wrong = ~(np.isfinite(gap) & np.isfinite(length) & (length > 0.0))
        if np.any(wrong):
            raise InputError(
                f"obstacle of surface {self.surface!r} has no distance and normal at the node "
                f"{x[wrong][0].tolist()}: distance {gap[wrong][0]}, gradient {gradient[wrong][0]}"
            )
        return gap / length, -gradient / length[:, None]
