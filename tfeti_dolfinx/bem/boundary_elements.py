"""Boundary elements on some volumes, beside the finite elements of the forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from tfeti_dolfinx.bem.block import Parts
from tfeti_dolfinx.bem.inside import BoundarySolution
from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.forms.assembly import Forms, Load
from tfeti_dolfinx.forms.checks import is_zero
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.kplus import InverseFactory
from tfeti_dolfinx.subdomains.subdomains import FiniteElements


class BoundaryElements:
    """Volumes whose subdomains get boundary elements: Total BETI.

    The mesh of the surface of each of their subdomains, tears included, is the boundary elements'
    mesh: displacements are linear on its segments or triangles (quadrilaterals are cut in two, both
    ways), tractions constant. The forms stay those of all bodies; the law is read from the bilinear
    one, and has to be homogeneous and isotropic in each of these volumes, in 3D, plane strain or
    plane stress, without springs or masses. Loads on them are tractions and constant forces per
    volume.

    Nothing but the surface counts: cells inside may be as coarse as they like. There the
    displacement of ``solution`` is that of finite elements under the same surface displacement.

    Args:
        volumes: Names or tags of volumes; without any, all bodies.

    Example:
        >>> tfeti.BoundaryElements("ball", "ring")
        BoundaryElements('ball', 'ring')
    """

    def __init__(self, *volumes: str | int) -> None:
        self.volumes = volumes
        cite("boundary elements")

    def __repr__(self) -> str:
        return f"BoundaryElements({', '.join(repr(volume) for volume in self.volumes)})"

    def chosen(self, decomposition: Decomposition) -> Array:
        """Return flags of the subdomains of this rank that get them, shape ``(S,)``. Collective.

        Raises:
            InputError: A volume is not known, or a subdomain lies in others, too.
        """
        count = len(decomposition.subdomains)
        if not self.volumes:
            return np.ones(count, dtype=bool)
        with raised_on_all_ranks(decomposition.comm):
            tags = [decomposition.volume(volume) for volume in self.volumes]
            inside = np.zeros(len(decomposition.cell_subdomain), dtype=bool)
            for tag in tags:
                inside[decomposition.cell_tags.find(tag)] = True
            position = np.searchsorted(decomposition.subdomains, decomposition.cell_subdomain)
            part = np.bincount(position[inside], minlength=count)
            whole = np.bincount(position, minlength=count)
            if (both := (part > 0) & (part < whole)).any():
                raise InputError(
                    f"{self}: subdomain {decomposition.subdomains[np.argmax(both)]} lies in "
                    "another volume, too; expected subdomains within volumes"
                )
            return part > 0

    def assembly(self, dofs: TornDofs, decomposition: Decomposition) -> BoundaryElementAssembly:
        """Return stiffness and load of the subdomains. Collective."""
        return BoundaryElementAssembly(self, dofs, decomposition)


class BoundaryElementAssembly(FiniteElements):
    """Stiffness and load of boundary elements in the place of finite ones.

    Creation and all methods are collective.

    Args:
        elements: The boundary elements.
        dofs: Dof maps.
        decomposition: The torn mesh.
    """

    replaces = True

    def __init__(
        self, elements: BoundaryElements, dofs: TornDofs, decomposition: Decomposition
    ) -> None:
        super().__init__(dofs)
        self._decomposition = decomposition
        self._chosen = elements.chosen(decomposition)
        self._made: Parts | None = None

    def node_blocks(self, K: Any, factory: InverseFactory) -> Array:
        """Make S, and return the stiffness's block of each primal node."""
        self._made = Parts(self._dofs, self._decomposition, self._chosen, factory)
        found = self._made.take_stiffness(K, super().node_blocks(K, factory))
        self.blocks, self.inside = self._made.blocks, self._made.inside()
        return found

    @property
    def _parts(self) -> Parts:
        assert self._made is not None
        return self._made

    def load(self, forms: Forms) -> Load:
        """Return this rank's load."""
        V, of_volume, hats = self._dofs.V, None, None
        L = forms.given[forms.names[1]]
        parts = [] if is_zero(L) else [i for i in L.integrals() if i.integral_type() == "cell"]
        if parts:
            of_volume = self._dofs.to_primal(forms.assembled(ufl.Form(parts), "L"))
            one = fem.Constant(V.mesh, (1.0,) + (0.0,) * (self._dofs.bs - 1))
            volume = ufl.dot(one, ufl.TestFunction(V)) * ufl.dx(domain=V.mesh)
            hats = forms.assembled(volume, "the volume")[:: self._dofs.bs][self._dofs.dolfinx_node]
        replaced = self._parts.load(self._dofs.to_primal(forms.load().values), of_volume, hats)
        return Load(self._dofs.to_dolfinx(replaced))

    def solved(self, u: Array) -> BoundarySolution:
        """Return the solution, in primal order, inside boundary elements."""
        cells = self._decomposition.cell_subdomain
        have = self._chosen[np.searchsorted(self._dofs.subdomains, cells)]
        return BoundarySolution(self._parts.solved(u), np.flatnonzero(~have), cells)
