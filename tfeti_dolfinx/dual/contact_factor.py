"""Factors of a distributed matrix of contact rows, of which most ranks may have none."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError, raised_on_all_ranks
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, added_options, has_solver

# rows up to which each rank that has any has a factor of the whole: to tell each other of so few
# costs less than to share their elimination
FEW_ROWS = 1000


class Factor(Protocol):
    """The inverse of a matrix."""

    def solve(self, b: Array) -> Array:
        """A⁻¹b, of this rank's parts. Collective."""
        ...

    def destroy(self) -> None:
        """Free it. Collective."""
        ...


def contact_factor(A: PETSc.Mat, prefix: str) -> Factor:
    """A factor of a symmetric positive definite matrix, which is taken over. Collective.

    Ranks without rows have no part in it: MUMPS 5.7 has been seen to hang in a solve with rows on
    one rank of two.

    Args:
        A: Symmetric positive definite, AIJ.
        prefix: Prefix of the factor's PETSc options.

    Raises:
        FactorError: It could not be made.
    """
    comm, (rows, size) = A.getComm().tompi4py(), A.getSizes()[0]
    indptr, indices, data = A.getValuesCSR()
    A.destroy()
    owners = comm.Split(0 if rows else MPI.UNDEFINED, comm.rank)
    with raised_on_all_ranks(comm):
        if not rows:
            return NoRows()
        if owners.size == 1:
            owners.Free()
            return CholeskyFactor(csr_array((data, indices, indptr), shape=(size, size)), prefix)
        part = PETSc.Mat().createAIJ(((rows, size),) * 2, csr=(indptr, indices, data), comm=owners)
        return DistributedFactor(part, owners, prefix)


class NoRows:
    """Of a rank without rows."""

    def solve(self, b: Array) -> Array:
        """Nothing."""
        return b

    def destroy(self) -> None:
        """There is nothing to free."""


class DistributedFactor:
    """A = L Lᵀ shared by ranks with rows, by MUMPS; of few rows, or without it, whole on each.

    Args:
        A: Symmetric positive definite, MPIAIJ; taken over. The constructor is collective.
        comm: Its communicator; taken over.
        prefix: Prefix of the PETSc options.

    Raises:
        FactorError: It could not be made.
    """

    def __init__(self, A: PETSc.Mat, comm: MPI.Intracomm, prefix: str) -> None:
        A.setOption(PETSc.Mat.Option.SPD, True)
        self._comm = comm
        self._b, self._x = A.createVecs()
        self._pc: Any = PETSc.PC().create(A.getComm())
        self._pc.setOptionsPrefix(prefix)
        self._pc.setOperators(A)
        parallel = A.getSize()[0] > FEW_ROWS and has_solver("mumps")
        self._pc.setType(PETSc.PC.Type.CHOLESKY if parallel else PETSc.PC.Type.REDUNDANT)
        given = {"pc_factor_mat_solver_type": "mumps"} if parallel else {}
        with raised_on_all_ranks(comm), added_options(prefix, given):
            try:
                self._pc.setFromOptions()
                self._pc.setUp()
            except PETSc.Error as error:
                raise FactorError(f"the contact rows of a face: {error}") from error
        A.destroy()

    def solve(self, b: Array) -> Array:
        """A⁻¹b, of this rank's parts."""
        self._b.array[:] = b
        self._pc.apply(self._b, self._x)
        return np.array(self._x.array_r)

    def destroy(self) -> None:
        """Free the factor."""
        for item in (self._pc, self._b, self._x):
            item.destroy()
        self._comm.Free()
