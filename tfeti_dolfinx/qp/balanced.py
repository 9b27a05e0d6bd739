"""A preconditioner of a face beside a part of its space that is solved for apart."""

from __future__ import annotations

from typing import Protocol

from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.qp.problem import FaceOperator


class CoarsePart(Protocol):
    """Y and X, C = XYᵀ, and a diagonal D.

    Vectors of rows are this rank's parts; coordinates may be replicated or distributed. All methods
    are collective.

    Attributes:
        energy: D, shape of the coordinates.
    """

    energy: Array

    def solve(self, c: Array) -> Array:
        """X c."""
        ...

    def forces(self, c: Array) -> Array:
        """Y c, in the face."""
        ...

    def moved(self, y: Array) -> Array:
        """Yᵀ y, y in the face."""
        ...

    def destroy(self) -> None:
        """Free what it holds."""
        ...


class Balanced:
    """M = (I − YC)ᵀ M_f (I − YC) + CᵀDC (Mandel, Comm. Numer. Methods Engrg. 9, 1993, 233–241).

    Where D = (CFCᵀ)⁻¹ and Y = FCᵀD it is the inverse of F on the range of Cᵀ; what is only near to
    that remains positive semidefinite, and definite if no x has both (I − YC)x = 0 and DCx = 0. M_f
    and Y, X, D are taken over.
    """

    def __init__(self, on_face: FaceOperator, part: CoarsePart) -> None:
        self._on_face, self._part = on_face, part

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x, x in the face. Collective."""
        part, rest = self._part, x.copy()
        c = part.solve(part.moved(x.array_r))
        rest.array[:] -= part.forces(c)
        self._on_face.mult(rest, y)
        rest.destroy()
        y.array[:] -= part.forces(part.solve(part.moved(y.array_r) - part.energy * c))

    def destroy(self) -> None:
        """Free both. Collective."""
        self._part.destroy()
        self._on_face.destroy()
