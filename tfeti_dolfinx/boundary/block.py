"""The Block of a subdomain with boundary elements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.boundary.shape import Shape
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.subdomains.data import SubdomainData
from tfeti_dolfinx.subdomains.kplus import Making
from tfeti_dolfinx.subdomains.sparse_block import SparseBlock
from tfeti_dolfinx.subdomains.stiffness import Stiffness


@dataclass(frozen=True)
class Part:
    """A subdomain with boundary elements.

    Attributes:
        name: Name for messages.
        shape: Its shape, maybe that of others, too.
        place: Unknown of the shape for each of its own, shape ``(n,)``.
    """

    name: str
    shape: Shape
    place: Array

    @property
    def on_surface(self) -> Array:
        """Flags of its unknowns on the surface, shape ``(n,)``."""
        return self.place < self.shape.outer * self.shape.x.shape[1]

    def body_force_load(self, hats: Array, b: Array) -> Array:
        """Load on its unknowns of a force b per volume, shape ``(n,)``.

        Args:
            hats: Integrals of the hats over the volume, shape ``(n / d,)``.
            b: Shape ``(d,)``.
        """
        d = len(b)
        placed = np.empty_like(hats)
        placed[self.place[::d] // d] = hats
        return self.shape.body_force_load(placed, b)[self.place]


class BoundaryBlock(SparseBlock):
    """Block of K_S; its Schur complement on the surface is S.

    Args:
        data: The subdomain, of which the stiffness is not looked at.
        part: What takes its place.
        how: How inverses are made.

    Raises:
        InputError: The load is not finite, or a row touches nodes inside.
        FactorError: A factor could not be made.
    """

    def __init__(self, data: SubdomainData, part: Part, how: Making) -> None:
        self._part = part
        if not part.on_surface[data.trace_dofs].all():
            raise InputError(
                f"{part.name}: a value is prescribed inside boundary elements; expected it on "
                "their surface"
            )
        super().__init__(data, how)

    def _found(self, K: Any, own: Stiffness | None) -> tuple[Stiffness, Array]:
        """That of the shape."""
        return self._part.shape.stiffness, self._part.place
