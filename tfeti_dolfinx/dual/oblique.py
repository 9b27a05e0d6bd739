"""Projectors of Gλ = e where some multipliers follow others: oblique, not orthogonal."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.grams import Grams, replicated
from tfeti_dolfinx.dual.null_basis import NullBasis
from tfeti_dolfinx.errors import FactorError, raised_on_all_ranks
from tfeti_dolfinx.parallel import summed
from tfeti_dolfinx.qp.faces import Face


class ObliqueProjectors:
    """P = Z(I − G_fᵀH⁺G(I + C)Z)Zᵀ with H = G(I + C)ZG_fᵀ, of a face and C.

    λ = (I + C)u moves with u in the face: G(I + C)u = 0 for u = Pv, and P makes nothing of what
    G_fᵀ gives. With C = 0 it is the orthogonal projector of the face.

    Args:
        Gt: This rank's rows of Gᵀ, scipy CSR, shape ``(m_local, r)``.
        grams: G_f G_fᵀ of faces.
        face: The face.
        C: What follows what, on this rank, scipy CSR, shape ``(m_local, m_local)``.
        null: null(Gᵀ).
        comm: Communicator. The constructor is collective.

    Raises:
        FactorError: H is singular.
    """

    def __init__(
        self,
        Gt: csr_array,
        grams: Grams,
        face: Face,
        C: csr_array,
        null: NullBasis,
        comm: MPI.Intracomm,
    ) -> None:
        self._comm, self._face, self._Gt = comm, face, Gt
        self._following = csr_array(C.T @ Gt)
        part = csr_array((face.Z.T @ self._following).T @ (face.Z.T @ Gt))
        self._factor = GeneralFactor(grams.of_face(face), replicated(part, comm), null, comm)

    def coordinates(self, x: Array) -> Array:
        """H⁺G(I + C)ZZᵀx, replicated, shape ``(r,)`` or ``(r, q)``. Collective."""
        own = self._face.restricted(x)
        return self._factor.solve(summed(self._comm, self._Gt.T @ own + self._following.T @ own))

    def combine(self, mu: Array) -> Array:
        """ZZᵀGᵀμ, this rank's part. Not collective."""
        return self._face.restricted(self._Gt @ mu)

    def project(self, x: Array) -> Array:
        """P x, shapes ``(m_local,)`` or ``(m_local, q)``. Collective."""
        return self._face.restricted(x) - self.combine(self.coordinates(x))

    def restoring(self, y: Array) -> Array:
        """u = ZG_fᵀH⁺y, for which G(I + C)u = y if any u does that. Not collective."""
        return self.combine(self._factor.solve(y))


class GeneralFactor:
    """(A + N)⁺ of a sparse positive semidefinite A, with a null space that N keeps, on each rank.

    Scaled to a unit diagonal of A, with unit vectors added as in ``SemidefiniteFactor``.

    Args:
        A: scipy CSR, shape ``(r, r)``, the same on all ranks.
        N: The same.
        null: The null space of both, and of their transposes.
        comm: Communicator. The constructor is collective.

    Raises:
        FactorError: The sum is singular besides.
    """

    def __init__(self, A: csr_array, N: csr_array, null: NullBasis, comm: MPI.Intracomm) -> None:
        self._null, diagonal = null, A.diagonal()
        pinned = np.where(diagonal > 0.0, 0.0, 1.0)
        self._scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
        pinned[null.pins(self._scale)] = 1.0
        S = diags_array(self._scale)
        with raised_on_all_ranks(comm):
            try:
                self._factor = splu(csc_array(S @ (A + N) @ S + diags_array(pinned)))
            except RuntimeError as error:
                raise FactorError(f"the coarse problem of a face with friction: {error}") from error

    def solve(self, y: Array) -> Array:
        """The solution without null modes, for y orthogonal to them; ``(r,)`` or ``(r, q)``."""
        x = self._factor.solve((self._scale * self._null.removed(y).T).T)
        return self._null.removed((self._scale * x.T).T)
