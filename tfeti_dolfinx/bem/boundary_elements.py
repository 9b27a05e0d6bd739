"""Boundary elements on some volumes, beside the finite elements of the forms."""

from __future__ import annotations

from typing import Any

import numpy as np

from tfeti_dolfinx.bem.block import Parts
from tfeti_dolfinx.bem.inside import BoundarySolution
from tfeti_dolfinx.common.arrays import Array, node_blocks
from tfeti_dolfinx.common.logging import cite
from tfeti_dolfinx.common.validation import checked_type
from tfeti_dolfinx.errors import InputError, raised_on_all_ranks
from tfeti_dolfinx.extensions import Extensions
from tfeti_dolfinx.forms.assembly import Forms
from tfeti_dolfinx.mesh.decomposition import Decomposition
from tfeti_dolfinx.mesh.dofs import TornDofs
from tfeti_dolfinx.subdomains.build import MakeBlock
from tfeti_dolfinx.subdomains.kplus import InverseFactory


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


def check_boundary_elements(elements: Any, own: Extensions) -> None:
    """Raise if boundary elements do not fit what the program brings.

    Raises:
        InputError: They are something else, or there is a Block of the program's own.
    """
    expected = 'tfeti_dolfinx.BoundaryElements, say BoundaryElements("ball")'
    checked_type(elements, BoundaryElements, "boundary_elements", expected)
    if own.block is not None:
        raise InputError("boundary_elements: extensions have a block, too; expected one of them")


class BoundaryElementAssembly:
    """Stiffness and load of boundary elements in the place of finite ones, if there are any.

    Creation and all methods are collective.

    Args:
        elements: The boundary elements, or None.
        dofs: Dof maps.
        decomposition: The torn mesh.
    """

    def __init__(
        self, elements: BoundaryElements | None, dofs: TornDofs, decomposition: Decomposition
    ) -> None:
        self._dofs, self._decomposition = dofs, decomposition
        self._chosen = None if elements is None else elements.chosen(decomposition)
        self._parts: Parts | None = None

    @property
    def exists(self) -> bool:
        """True if there are boundary elements."""
        return self._chosen is not None

    def node_blocks(self, K: Any, how: InverseFactory) -> Array:
        """Make S; the stiffness's block of each primal node, shape ``(num_nodes, bs, bs)``.

        Args:
            K: Stiffness of finite elements in DOLFINx's numbering, scipy CSR.
            how: How inverses are made.

        Raises:
            InputError: The mesh or the stiffness does not fit.
            FactorError: S could not be made.
        """
        blocks = node_blocks(K, self._dofs.bs)[self._dofs.dolfinx_node]
        if self._chosen is None:
            return blocks
        self._parts = Parts(self._dofs, self._decomposition, self._chosen, how)
        return self._parts.take_stiffness(K, blocks)

    def load(self, forms: Forms) -> Array:
        """Return this rank's load in DOLFINx's numbering.

        Raises:
            InputError: There is a load that boundary elements cannot take.
        """
        f = forms.load()
        if self._parts is None:
            return f
        volume = forms.volume_load()
        of_volume = None if volume is None else self._dofs.to_primal(volume)
        hats = None if volume is None else forms.hats()[self._dofs.dolfinx_node]
        replaced = self._parts.load(self._dofs.to_primal(f), of_volume, hats)
        return self._dofs.to_dolfinx(replaced)

    def blocks(self, make_block: MakeBlock) -> MakeBlock:
        """Return the factory of this rank's Blocks, those of finite elements as given."""
        return make_block if self._parts is None else self._parts.blocks(make_block)

    def solved(self, u: Array) -> BoundarySolution | None:
        """Return the solution, in primal order, inside boundary elements."""
        if self._parts is None or self._chosen is None:
            return None
        cells = self._decomposition.cell_subdomain
        have = self._chosen[np.searchsorted(self._dofs.subdomains, cells)]
        return BoundarySolution(self._parts.solved(u), np.flatnonzero(~have), cells)

    def inside(self) -> int:
        """Return the number of unknowns of all ranks that boundary elements do without."""
        return 0 if self._parts is None else self._parts.inside()
