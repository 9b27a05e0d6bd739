"""Extreme eigenvalues of B Bᵀ and B D⁻¹ Bᵀ, by SLEPc."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

from tfeti_dolfinx.constraints.rows import Constraints
from tfeti_dolfinx.errors import ConvergenceError, InputError, raised_on_all_ranks

# Of residuals, in units of the largest eigenvalue: far below the digits that are compared, far
# above rounding. The smallest eigenvalue of many rows may take thousands of restarts.
TOLERANCE = 1e-10
MAX_RESTARTS = 10_000
FLOATING_POINT = 72  # PETSC_ERR_FP


def require_slepc(comm: MPI.Intracomm) -> None:
    """Raise unless slepc4py can be imported. Collective.

    Raises:
        InputError: It cannot.
    """
    with raised_on_all_ranks(comm):
        try:
            _slepc()
        except ImportError as error:
            raise InputError(
                f"option spectrum needs slepc4py, which cannot be imported ({error}); expected "
                "Debian's python3-slepc4py-real, conda's slepc4py, or no spectrum"
            ) from None


def extreme_eigenvalues(constraints: Constraints) -> dict[str, float]:
    """Extreme eigenvalues of B Bᵀ and of B D⁻¹ Bᵀ. Collective.

    Their roots are the extreme singular values of B and of B D^-½. The optimality theory of
    TFETI (Dostál, Kozubek, Sadowská, Vondrák, Scalable Algorithms for Contact Problems,
    Springer 2016) asks for bounds on those of B Bᵀ that depend neither on h nor on H. Where the
    rows are scaled with D ≠ I they have unit norm in D⁻¹, and B D⁻¹ Bᵀ takes the place of B Bᵀ,
    whose eigenvalues grow with the entries of D.

    Returns:
        ``BBt_min``, ``BBt_max``, ``BDBt_min``, ``BDBt_max``; nothing if there are no rows. The
        smallest are right to 1e-10 of the largest.

    Raises:
        ConvergenceError: SLEPc stopped before its tolerance.
    """
    if constraints.B.getSize()[0] == 0:
        return {}
    scaled = _scaled(constraints)
    try:
        BBt_min, BBt_max = _extremes(constraints.B)
        BDBt_min, BDBt_max = _extremes(scaled)
    finally:
        scaled.destroy()
    return {"BBt_min": BBt_min, "BBt_max": BBt_max, "BDBt_min": BDBt_min, "BDBt_max": BDBt_max}


def _slepc() -> Any:
    """SLEPc, imported only where it is used: not every installation of DOLFINx has it."""
    return import_module("slepc4py.SLEPc")


def _scaled(constraints: Constraints) -> PETSc.Mat:
    """B D^-½. Collective."""
    scaled, factor = constraints.B.copy(), constraints.B.createVecRight()
    factor.array[:] = constraints.weights**-0.5
    scaled.diagonalScale(R=factor)
    factor.destroy()
    return scaled


def _extremes(B: PETSc.Mat) -> tuple[float, float]:
    """Return the smallest and the largest eigenvalue of B Bᵀ; B has no more rows than columns."""
    SLEPc = _slepc()
    which, test = SLEPc.SVD.Which, SLEPc.SVD.Conv
    svd = SLEPc.SVD().create(B.getComm())
    try:
        svd.setOperators(B)
        svd.setType(SLEPc.SVD.Type.CROSS)  # Krylov-Schur on B Bᵀ, which is never formed
        largest = _first_eigenvalue(svd, which.LARGEST, test.REL, TOLERANCE)
        # relative to the smallest one itself the test would never hold where that is 0
        smallest = _not_negative(svd, which.SMALLEST, test.ABS, TOLERANCE * largest)
    finally:
        svd.destroy()
    return smallest, largest


def _not_negative(svd: Any, which: Any, test: Any, tolerance: float) -> float:
    """An eigenvalue, 0 where SLEPc finds a negative one: B Bᵀ is singular but for rounding."""
    try:
        return _first_eigenvalue(svd, which, test, tolerance)
    except PETSc.Error as error:
        if error.ierr != FLOATING_POINT:
            raise
        return 0.0


def _first_eigenvalue(svd: Any, which: Any, test: Any, tolerance: float) -> float:
    svd.setWhichSingularTriplets(which)
    svd.setConvergenceTest(test)
    svd.setTolerances(tolerance, MAX_RESTARTS)
    svd.solve()
    if svd.getConverged() < 1:
        raise ConvergenceError(
            f"an extreme eigenvalue of B Bᵀ was not found in {svd.getIterationNumber()} restarts"
        )
    return float(svd.getValue(0)) ** 2
