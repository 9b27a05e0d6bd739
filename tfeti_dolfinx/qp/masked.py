"""Preconditioning in face: an approximate inverse on the free rows, 0 on the others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import InputError
from tfeti_dolfinx.parallel import any_rank
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.faces import Face, face_of
from tfeti_dolfinx.qp.problem import QP, FaceOperator


class MaskedPreconditioner:
    """z = I_f(P M_f P + ρ⁻¹Q)φ, I_f the rows that hold: nearly (I_f(PFP + ρQ)I_f)⁻¹φ.

    Conjugate gradients stay on the face, and bounds are kept, because z is 0 where φ is. M_f is
    made anew when the face has changed (Dostál, Optimal Quadratic Programming Algorithms,
    Springer 2009, section 5.10: preconditioning in face).

    Args:
        make: Makes M_f, an approximate inverse of F on a face.
        coarse: P and Q of all rows.
        rho: Penalty ρ.
        like: A vector of the right layout.
    """

    def __init__(
        self,
        make: Callable[[Face], FaceOperator],
        coarse: Coarse,
        rho: float,
        like: PETSc.Vec,
    ) -> None:
        self._make, self._coarse, self._rho = make, coarse, rho
        self._comm = like.getComm().tompi4py()
        self._open: Array | None = None
        self._on_face: FaceOperator | None = None
        self._Qphi, self._work = like.duplicate(), like.duplicate()

    def apply(self, face: Face, phi: PETSc.Vec, z: PETSc.Vec) -> None:
        """z for the free gradient φ on a face. Collective.

        Raises:
            InputError: φ is not 0 where the face does not hold.
            FactorError: M_f could not be made.
        """
        M_f = self._of(face, phi)
        self._coarse.apply_Q(phi, self._Qphi)
        phi.copy(self._work)
        self._work.axpy(-1.0, self._Qphi)
        M_f.mult(self._work, z)
        self._coarse.apply_Q(z, self._work)
        z.axpy(-1.0, self._work)
        z.axpy(1.0 / self._rho, self._Qphi)
        z.array[self._open] = 0.0

    def _of(self, face: Face, phi: PETSc.Vec) -> FaceOperator:
        """M_f, the present one if the face is the same on all ranks."""
        changed = self._open is None or not np.array_equal(self._open, ~face.holding)
        if self._on_face is None or any_rank(self._comm, changed):
            self._leave()
            self._open = ~face.holding
            if any_rank(self._comm, bool(np.any(phi.array_r[self._open] != 0.0))):
                raise InputError(
                    "preconditioning in face: the free gradient of the feasible set is not 0 on "
                    "rows that are open or slip at its face; expected a set that splits "
                    "gradients as its face says, or pc_type none"
                )
            self._on_face = self._make(face_of(face.holding, face.status))
        return self._on_face

    def _leave(self) -> None:
        if self._on_face is not None:
            self._on_face.destroy()
            self._on_face = None

    def destroy(self) -> None:
        """Destroy M_f and the work vectors. Collective."""
        self._leave()
        self._Qphi.destroy()
        self._work.destroy()


def masked(qp: QP, rho: float) -> MaskedPreconditioner | None:
    """The preconditioner of PFP + ρQ on faces of a program; None if it has none."""
    if qp.preconditioner_on is None:
        return None
    return MaskedPreconditioner(qp.preconditioner_on, qp.coarse, rho, qp.d)
