"""The preconditioner on a face, scaled by the rows of the face alone."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.contact_factor import Factor, contact_factor
from tfeti_dolfinx.dual.operator import DualOperator
from tfeti_dolfinx.dual.smoothing import Smoothing, Springs
from tfeti_dolfinx.gluing.constraints import Constraints
from tfeti_dolfinx.qp.faces import Face
from tfeti_dolfinx.qp.problem import FaceOperator

# an entry of B_N D⁻¹ B_Nᵀ − I, whose diagonal is 1, that is rounding
ORTHONORMAL = 1e-12
# added to the unit diagonal: rows that depend on each other leave no pivot, and B_fᵀ takes away
# what the shift makes of them, down to rounding over it
SHIFT = 1e-8


class FacePreconditioner:
    """M_f = W⁻¹B_f D⁻¹ A D⁻¹B_fᵀ W⁻¹, W = B_f D⁻¹B_fᵀ, f the rows of a face.

    Gluing and Dirichlet rows are orthonormal in D⁻¹ and orthogonal to contact rows, so W is the
    identity but for its block of contact rows, W_C, normals and tangents. That is the identity too
    where no two of them meet, as at an obstacle, and no component is prescribed.

    Where a face is curved M_f stands for (ZᵀFZ + κ)⁻¹. F + κ is the F of a scene in which each
    direction with a curvature moves a spring of stiffness 1/κ besides: for that B_f gains the
    column 1 and A the entry 1/κ. Its weight in D is 1/(κσ), σ the diagonal of B D⁻¹ diag(K) D⁻¹Bᵀ,
    which makes M_f the inverse where F is 1/σ. So it is W_κ⁻¹(B_f D⁻¹ A D⁻¹B_fᵀ + κσ²)W_κ⁻¹ with
    W_κ = W + κσ.

    Where the operator on all rows has a metric, displacements with given jumps are made smooth in
    it (``Smoothing``).

    Args:
        whole: B D⁻¹ A D⁻¹Bᵀ on all rows, A the Schur complements, or the stiffness on the trace.
        constraints: B and D. The constructor is collective.
        diagonal: That of K on the local trace unknowns.
        prefix: Prefix of the factor's PETSc options.
    """

    def __init__(
        self, whole: DualOperator, constraints: Constraints, diagonal: Array, prefix: str
    ) -> None:
        self._whole, self._prefix, sets = whole, prefix, constraints.sets
        self._contact = np.concatenate((sets.normals, sets.tangents.ravel()))
        self._gram = _contact_gram(constraints, self._contact)
        self._size = _diagonal(constraints, diagonal)
        self._smoothing: Smoothing | None = None
        if whole.metric is not None:
            self._smoothing = Smoothing(whole, whole.metric, constraints.weights, diagonal)

    def on_face(self, face: Face) -> FaceOperator:
        """M_f on a face. Collective.

        Raises:
            FactorError: W_C has no factor.
        """
        on_contact = csr_array(face.Z[self._contact])
        kept = np.unique(on_contact.indices)
        Z_C, factor = csr_array(face.Z[:, kept]), None
        size = Z_C.multiply(Z_C).T @ self._size
        bent = face.curvature[kept] * size
        if self._gram is not None:
            part = _restricted(self._gram, csr_array(on_contact[:, kept]))
            added = part.createVecLeft()
            added.array[:] = SHIFT + bent
            part.setDiagonal(added, PETSc.InsertMode.ADD_VALUES)
            added.destroy()
            if part.getSize()[0]:
                factor = contact_factor(part, self._prefix)
            else:
                part.destroy()
        operator = self._whole if self._smoothing is None else self._smoothing
        return _OnFace(operator, face, Z_C, (bent, size), factor)

    def destroy(self) -> None:
        """Destroy W_C, not the operator on all rows. Collective."""
        if self._smoothing is not None:
            self._smoothing.destroy()
        if self._gram is not None:
            self._gram.destroy()


class _OnFace:
    """M_f between vectors of a face, which have the layout of all rows."""

    def __init__(
        self,
        whole: DualOperator | Smoothing,
        face: Face,
        Z_C: csr_array,
        springs: tuple[Array, Array],
        factor: Factor | None,
    ) -> None:
        self._whole, self._face, self._Z_C, self._factor = whole, face, Z_C, factor
        (self._bent, size), bends = springs, springs[0] > 0.0
        self._bends = bool(np.any(bends))
        self._springs = Springs(csr_array(Z_C[:, bends]), self._bent[bends], size[bends])

    def mult(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M_f x. Collective."""
        if isinstance(self._whole, Smoothing):
            y.array[:] = self._scaled(x.array_r)
            self._whole.mult(y, self._scaled, self._springs)
        else:
            scaled, springs = x.duplicate(), self._springs
            scaled.array[:] = self._scaled(x.array_r)
            self._whole.mult(scaled, y)
            moved = springs.bent * springs.size * (springs.directions.T @ scaled.array_r)
            y.array[:] += springs.directions @ moved
            scaled.destroy()
        y.array[:] = self._scaled(y.array_r)

    def dependent(self, x: Array) -> Array | None:
        """The part of x in the null space of W_κ, and so of B_fᵀ. Collective.

        (1 + W/ε)⁻², ε the shift, leaves (ε/σ)² of what has the eigenvalue σ.
        """
        if self._factor is None:
            return None
        values = self._Z_C.T @ x
        for _ in range(2):
            values = SHIFT * self._factor.solve(values)
        return np.asarray(self._Z_C @ values)

    def _scaled(self, x: Array) -> Array:
        """W_κ⁻¹x on the rows of the face."""
        values = self._face.restricted(x)
        if self._factor is None and not self._bends:
            return values
        contact = self._Z_C.T @ values
        solved = contact / (1.0 + self._bent)
        if self._factor is not None:
            solved = self._factor.solve(contact)
        return np.asarray(values + self._Z_C @ (solved - contact))

    def destroy(self) -> None:
        """Free the factor. Collective."""
        if self._factor is not None:
            self._factor.destroy()


def _restricted(gram: PETSc.Mat, Z: csr_array) -> PETSc.Mat:
    """ZᵀWZ, Z with a row for each local row of W. Collective."""
    comm, index = gram.getComm(), PETSc.IntType
    own = Z.shape[1]
    start = comm.tompi4py().exscan(own) or 0
    indices = (start + Z.indices).astype(index)
    table = (Z.indptr.astype(index), indices, Z.data)
    size = ((Z.shape[0], None), (own, None))
    directions = PETSc.Mat().createAIJ(size=size, csr=table, comm=comm)
    part = gram.PtAP(directions)
    directions.destroy()
    return part


def _diagonal(constraints: Constraints, diagonal: Array) -> Array:
    """The diagonal of B D⁻¹ diag(K) D⁻¹Bᵀ on the local rows. Collective."""
    B = constraints.B
    squares, size = B.copy(), B.createVecRight()
    rows, columns, values = squares.getValuesCSR()
    squares.setValuesCSR(rows, columns, values**2)
    squares.assemble()
    size.array[:] = diagonal / constraints.weights**2
    result = B.createVecLeft()
    squares.mult(size, result)
    found = np.array(result.array_r)
    for item in (squares, size, result):
        item.destroy()
    return found


def _contact_gram(constraints: Constraints, contact: Array) -> PETSc.Mat | None:
    """B_C D⁻¹ B_Cᵀ, or None where it is the identity but for rounding. Collective."""
    B = constraints.B
    comm = B.getComm()
    first = B.getOwnershipRange()[0]
    rows = PETSc.IS().createGeneral((first + contact).astype(PETSc.IntType), comm=comm)
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
