"""Factors of the coarse problem's matrices, on each rank."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, diags_array, eye_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.dual.null_basis import NullBasis
from tfeti_dolfinx.errors import FactorError, raised_on_all_ranks
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError

# Added to a unit diagonal, where pivots are lost to rounding; so small a shift is made good by
# refinement in all directions that stand out from rounding.
SHIFTS = (0.0, 1e-14, 1e-13, 1e-12)
# each divides the error in a direction of eigenvalue σ by σ / shift: three do for σ from 1e-8 on
REFINEMENTS = 3


class SemidefiniteFactor:
    """A⁺ of a sparse positive semidefinite A with a known null space, on each rank.

    S A S + E Eᵀ with a unit diagonal of S A S, E unit vectors of entries that determine the null
    modes: an exact generalised inverse for right sides orthogonal to them.

    Args:
        A: scipy CSR, shape ``(r, r)``, the same on all ranks.
        null: Its null space.
        comm: Communicator. The constructor is collective.
        what: Name of A for messages.
        prefix: Prefix of the factor's PETSc options.

    Attributes:
        comm: Communicator.

    Raises:
        FactorError: The factor could not be made.
    """

    def __init__(
        self,
        A: csr_array,
        null: NullBasis,
        comm: MPI.Intracomm,
        what: str,
        prefix: str = "tfeti_coarse_",
    ) -> None:
        self.comm, self._null, diagonal = comm, null, A.diagonal()
        pinned = np.where(diagonal > 0.0, 0.0, 1.0)  # what nothing holds at all stands for itself
        self._scale = np.where(diagonal > 0.0, diagonal, 1.0) ** -0.5
        pinned[null.pins(self._scale)] = 1.0
        scaled = csr_array(A, copy=True)  # quicker than products of sparse matrices
        scaled.data *= np.repeat(self._scale, np.diff(A.indptr))
        scaled.data *= self._scale[A.indices]
        self._A = csr_array(scaled + diags_array(pinned)) if np.any(pinned) else scaled
        self._factor: CholeskyFactor | None = None
        for self._shift in SHIFTS if A.shape[0] else ():
            if self._factored(comm, what, prefix):
                return

    def _factored(self, comm: MPI.Intracomm, what: str, prefix: str) -> bool:
        """Whether all ranks have a factor with the present shift. Collective."""
        lost: NotPositiveDefiniteError | None = None
        with raised_on_all_ranks(comm):
            try:
                shift = self._shift * eye_array(self._A.shape[0])
                self._factor = CholeskyFactor(self._A + shift if self._shift else self._A, prefix)
            except NotPositiveDefiniteError as error:
                lost = error
                if self._shift == SHIFTS[-1]:
                    raise type(error)(f"{what}: {error}") from error
            except FactorError as error:
                raise FactorError(f"{what}: {error}") from error
        if not comm.allreduce(lost is not None, op=MPI.LOR):
            return True
        self.destroy()
        return False

    def solve(self, y: Array) -> Array:
        """A⁺ y up to null modes that are removed, y orthogonal to them."""
        if self._factor is None:
            return y
        b = self._scale * self._null.removed(y)
        x = self._factor.solve(b)
        for _ in range(REFINEMENTS if self._shift else 0):
            x += self._factor.solve(b - self._A @ x)
        return self._null.removed(self._scale * x)

    def destroy(self) -> None:
        """Free the factor."""
        if self._factor is not None:
            self._factor.destroy()
            self._factor = None
