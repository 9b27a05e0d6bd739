"""Cholesky factors of sparse matrices by PETSc, and the options that they read."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
from petsc4py import PETSc

from tfeti_dolfinx.common.arrays import Array, as_petsc_matrix, of_columns
from tfeti_dolfinx.common.compat import is_read
from tfeti_dolfinx.errors import FactorError

log = logging.getLogger(__name__)

# in the order of preference
PACKAGES = ("cholmod", "mumps", "petsc")
# without these an indefinite matrix would pass: CHOLMOD's LDLᵀ takes pivots of any sign, unlike
# LLᵀ, and MUMPS tells their signs only if it also looks for pivots that are zero
DEFINITE = {
    "mat_cholmod_final_asis": "0",
    "mat_cholmod_final_ll": "1",
    "mat_mumps_icntl_13": "1",
    "mat_mumps_icntl_24": "1",
}
# CHOLMOD would print a line of its own beside the error that is raised
QUIET = {"mat_cholmod_print": "0"}
# prefix of the options of a factor that is made to see what it reads
TRIAL = "tfeti_trial_"
CHOLMOD_OUT_OF_MEMORY = "CHOLMOD factorization failed with status -2"


class PetscError(IntEnum):
    """Error codes of PETSc, which petsc4py does not name."""

    OUT_OF_MEMORY = 55
    NO_SUPPORT = 56
    ZERO_PIVOT_LU = 71
    ZERO_PIVOT_CHOLESKY = 81
    MISSING_SOLVER = 92


class NotPositiveDefiniteError(FactorError, ArithmeticError):
    """A matrix that should have a Cholesky factor has none."""


class CholeskyFactor:
    """A = L Lᵀ of a symmetric positive definite matrix on one rank, or of PETSc's on several.

    Creation raises a NotPositiveDefiniteError where A is not positive definite; a FactorError where
    there is no memory for the factor, PETSc has no such solver, or it fails. A is a matrix of scipy
    or ``Entries``, both triangles, and may go after it; one of PETSc is destroyed. PETSc's options
    ``pc_factor_...`` and ``mat_...`` with the prefix are heeded, but for the solver on several
    ranks, which is MUMPS: there all methods are collective, and b and x this rank's parts.
    """

    def __init__(self, A: Any, prefix: str = "tfeti_sub_") -> None:
        matrix = A if isinstance(A, PETSc.Mat) else as_petsc_matrix(A)
        pc = PETSc.PC().create(matrix.getComm())
        # not SPD, which is what the factor is to find out; MUMPS would not look at signs then
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._b, self._x = matrix.createVecs()
        self._factor: Any = None
        try:
            self._factor = _factored(pc, matrix, prefix)
            _check_definite(self._factor)
            if not np.all(np.isfinite(self.solve(np.ones(self._b.getLocalSize())))):
                raise NotPositiveDefiniteError("a pivot is zero")
            # those of L, as far as its package tells
            self.entries = float(max(self._factor.getInfo()["nz_used"], self._b.getLocalSize()))
        except (PETSc.Error, FactorError) as error:
            # PETSc knows no package yet where it could not read an option
            solver = pc.getFactorSolverType() or f"PETSc, with options -{prefix}...,"
            self._factor = None  # the error holds this object
            raise _cause(error, solver, matrix) from error
        finally:
            pc.destroy()
            matrix.destroy()

    def solve(self, b: Array) -> Array:
        """A⁻¹ b, shapes ``(n,)`` or ``(n, q)``."""
        if 0 in (self._b.getSize(), *b.shape[1:]):
            return np.array(b)
        if b.ndim == 2:
            return of_columns(self._solved, b, len(b))
        self._b.setArray(b)
        self._factor.solve(self._b, self._x)
        return np.array(self._x.array_r)

    def roughly(self, b: Array) -> Array:
        """A⁻¹ b to single precision or better, whichever costs less."""
        return self.solve(b)

    def _solved(self, given: PETSc.Mat) -> PETSc.Mat:
        found = given.duplicate()
        self._factor.matSolve(given, found)
        return found

    def destroy(self) -> None:
        """Destroy PETSc's objects."""
        for item in (self._b, self._x, self._factor):
            item.destroy()


@contextmanager
def added_options(prefix: str, given: Mapping[str, Any]) -> Iterator[None]:
    """PETSc's options with some more in the block; those that it has already win."""
    database = PETSc.Options(prefix)
    added = [name for name in given if not database.hasName(name)]
    for name in added:
        database[name] = given[name]
    try:
        yield
    finally:
        for name in added:
            database.delValue(name)


@cache
def default_solver() -> str:
    """Return the first of ``PACKAGES`` that this PETSc has."""
    return next(solver for solver in PACKAGES if has_solver(solver))


def unread_options(given: Mapping[str, Any], solver: str) -> list[str]:
    """Return those options, without a prefix, that a factor by a solver does not ask PETSc for.

    It is tried with a matrix of a single unknown. None where that cannot be made, which has a cause
    that the factors of the problem name.
    """
    chosen = {"pc_factor_mat_solver_type": solver, **given}
    with added_options(TRIAL, chosen):
        if not has_solver(str(chosen["pc_factor_mat_solver_type"]), TRIAL):
            return []
        return [name for name in given if not is_read(TRIAL + name)]


def has_solver(solver: str, prefix: str = "") -> bool:
    """Return whether this PETSc makes Cholesky factors by a solver, and options with a prefix."""
    one = PETSc.Mat().createAIJ((1, 1), nnz=1, comm=PETSc.COMM_SELF)
    one.setValue(0, 0, 1.0)
    one.assemble()
    one.setOption(PETSc.Mat.Option.SPD, True)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    try:
        pc.setOptionsPrefix(prefix)
        pc.setType(PETSc.PC.Type.CHOLESKY)
        pc.setFactorSolverType(solver)
        pc.setOperators(one)
        if prefix:
            pc.setFromOptions()
        pc.setUp()
    except PETSc.Error:
        return False
    finally:
        pc.destroy()
        one.destroy()
    return True


@cache
def say_if_not_cholmod() -> None:
    """Log, once, what factors the matrices where PETSc has no CHOLMOD."""
    if default_solver() != PACKAGES[0]:
        log.warning(
            "this PETSc is built without CHOLMOD (SuiteSparse): matrices are factored by %s, which "
            "may be slower",
            {"mumps": "MUMPS", "petsc": "PETSc's own Cholesky"}[default_solver()],
        )


def _factored(pc: PETSc.PC, matrix: PETSc.Mat, prefix: str) -> PETSc.Mat:
    """Return the factor of a matrix, by PETSc's options with a prefix."""
    pc.setOptionsPrefix(prefix)
    pc.setType(PETSc.PC.Type.CHOLESKY)
    pc.setOperators(matrix)
    given = {"pc_factor_mat_solver_type": default_solver(), **DEFINITE, **QUIET}
    with added_options(prefix, given):
        pc.setFromOptions()
        if matrix.getComm().size > 1:
            pc.setFactorSolverType("mumps")
        pc.setUp()
    reason = pc.getFailedReason()
    if reason == PETSc.PC.FailedReason.FACTOR_OUTMEMORY:
        raise PETSc.Error(PetscError.OUT_OF_MEMORY)
    if reason:
        raise NotPositiveDefiniteError("a pivot is zero")
    return pc.getFactorMatrix()


def _check_definite(factor: PETSc.Mat) -> None:
    """Raise if an eigenvalue is not positive; CHOLMOD does not tell, but has stopped by itself."""
    try:
        negative, zero, _ = factor.getInertia()
    except PETSc.Error as error:
        if error.ierr == PetscError.NO_SUPPORT:
            return
        raise
    if negative or zero:
        raise NotPositiveDefiniteError(f"{negative} eigenvalues are negative, {zero} zero")


def _cause(error: Exception, solver: str, A: PETSc.Mat) -> FactorError:
    """Return the error that says why a matrix could not be factored."""
    if isinstance(error, FactorError):
        return type(error)(f"not positive definite ({solver}: {error})")
    code = getattr(error, "ierr", None)
    if code in (PetscError.ZERO_PIVOT_LU, PetscError.ZERO_PIVOT_CHOLESKY):
        return NotPositiveDefiniteError(f"not positive definite (found by {solver})")
    if code == PetscError.OUT_OF_MEMORY or CHOLMOD_OUT_OF_MEMORY in str(error):
        return FactorError(
            f"out of memory: {solver} had none for the factor of {A.getSize()[0]} unknowns with "
            f"{A.getInfo()['nz_used']:.0f} entries; expected smaller subdomains, or more memory"
        )
    if code == PetscError.MISSING_SOLVER:
        known = ", ".join(name for name in PACKAGES if has_solver(name))
        return FactorError(
            f"this PETSc makes no Cholesky factors by {solver}; expected one of {known}"
        )
    return FactorError(f"{solver} failed: {str(error).strip().splitlines()[-1]}")
