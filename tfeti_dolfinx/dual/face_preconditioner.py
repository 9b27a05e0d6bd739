"""The preconditioner on a face, scaled by the rows of the face alone."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.contact_factor import Factor, contact_factor
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.problem import FaceOperator, Operator

# an entry of B_N D⁻¹ B_Nᵀ − I, whose diagonal is 1, that is rounding
ORTHONORMAL = 1e-12
# added to the unit diagonal: rows that depend on each other leave no pivot, and B_fᵀ takes away
# what the shift makes of them, down to rounding over it
SHIFT = 1e-8


class FacePreconditioner:
    """M_f = W⁻¹B_f D⁻¹ A D⁻¹B_fᵀ W⁻¹, W = B_f D⁻¹B_fᵀ, f the rows of a face.

    Gluing and Dirichlet rows are orthonormal in D⁻¹ and orthogonal to contact rows, so W is the
    identity but for its block of contact rows, W_N. That is the identity too where no two of them
    meet, as at an obstacle.

    Args:
        whole: B D⁻¹ A D⁻¹Bᵀ on all rows, A the Schur complements, or the stiffness on the trace.
        constraints: B and D. The constructor is collective.
        prefix: Prefix of the factor's PETSc options.
    """

    def __init__(self, whole: Operator, constraints: Constraints, prefix: str) -> None:
        self._whole, self._prefix = whole, prefix
        self._normals = constraints.sets.normals
        self._gram = _contact_gram(constraints)

    def on_face(self, face: Face) -> FaceOperator:
        """M_f on a face. Collective.

        Raises:
            FactorError: W_N has no factor.
        """
        carrying = face.carrying[self._normals]
        if self._gram is None:
            return _OnFace(self._whole, face, self._normals[carrying], None)
        first = self._gram.getOwnershipRange()[0]
        kept = (first + np.flatnonzero(carrying)).astype(PETSc.IntType)
        rows = PETSc.IS().createGeneral(kept, comm=self._gram.getComm())
        part = self._gram.createSubMatrix(rows, rows)
        rows.destroy()
        part.shift(SHIFT)
        factor = contact_factor(part, self._prefix) if part.getSize()[0] else None
        return _OnFace(self._whole, face, self._normals[carrying], factor)

    def destroy(self) -> None:
        """Destroy W_N, not the operator on all rows. Collective."""
        if self._gram is not None:
            self._gram.destroy()


class _OnFace:
    """M_f between vectors of a face, which have the layout of all rows."""

    def __init__(self, whole: Operator, face: Face, rows: Array, factor: Factor | None) -> None:
        self._whole, self._face, self._rows, self._factor = whole, face, rows, factor

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M_f x. Collective."""
        scaled = x.duplicate()
        scaled.array[:] = self._scaled(x.array_r)
        self._whole.mult(scaled, y)
        scaled.destroy()
        y.array[:] = self._scaled(y.array_r)

    def dependent(self, x: Array) -> Array | None:
        """The part of x in the null space of W, and so of B_fᵀ. Collective.

        (1 + W/ε)⁻², ε the shift, leaves (ε/σ)² of what has the eigenvalue σ.
        """
        if self._factor is None:
            return None
        part, values = np.zeros_like(x), x[self._rows]
        for _ in range(2):
            values = SHIFT * self._factor.solve(values)
        part[self._rows] = values
        return part

    def _scaled(self, x: Array) -> Array:
        """W⁻¹x on the rows of the face."""
        values = self._face.restricted(x)
        if self._factor is not None:
            values[self._rows] = self._factor.solve(values[self._rows])
        return values

    def destroy(self) -> None:
        """Free the factor. Collective."""
        if self._factor is not None:
            self._factor.destroy()


def _contact_gram(constraints: Constraints) -> PETSc.Mat | None:
    """B_N D⁻¹ B_Nᵀ, or None where it is the identity but for rounding. Collective."""
    B, normals = constraints.B, constraints.sets.normals
    comm = B.getComm()
    first = B.getOwnershipRange()[0]
    rows = PETSc.IS().createGeneral((first + normals).astype(PETSc.IntType), comm=comm)
    B_N = B.createSubMatrix(rows)
    transposed = B_N.transpose(PETSc.Mat())
    inverse = B.createVecRight()
    inverse.array[:] = 1.0 / constraints.weights
    B_N.diagonalScale(None, inverse)
    gram = B_N.matMult(transposed)
    for item in (rows, B_N, transposed, inverse):
        item.destroy()
    gram.shift(-1.0)
    apart = gram.norm(PETSc.NormType.INFINITY)
    gram.shift(1.0)
    if comm.tompi4py().bcast(apart <= ORTHONORMAL, root=0):
        gram.destroy()
        return None
    return gram
