"""Cholesky factors in single precision by CHOLMOD, whose solves are refined to double precision."""

import ctypes
from collections.abc import Callable
from contextlib import suppress
from ctypes import POINTER, byref, c_double, c_float, c_int, c_size_t, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any
from weakref import finalize

import numpy as np

from tfeti_dolfinx.common.arrays import Array, LocalMatrix
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.factor import CholeskyFactor

# --- CHOLMOD, that of PETSc, by ctypes ----------------------------------------------------------
# PETSc's own interface knows double precision alone. Structures are those of cholmod.h.

LIBRARIES = "libcholmod.so.5", "libcholmod.5.dylib"
REAL, SINGLE, SUPERNODAL, SOLVE_A = 1, 4, 2, 0


class _Common(ctypes.Structure):
    """Head of cholmod_common; the rest is CHOLMOD's own."""

    _fields_ = (
        *((name, c_double) for name in ("dbound", "grow0", "grow1")),
        *((name, c_size_t) for name in ("grow2", "maxrank")),
        ("supernodal_switch", c_double),
        *((name, c_int) for name in ("supernodal", "final_asis", "final_super", "final_ll")),
        *((name, c_int) for name in ("final_pack", "final_monotonic", "final_resymbol")),
        ("zrelax", 3 * c_double),
        ("nrelax", 3 * c_size_t),
        *((name, c_int) for name in ("prefer_zomplex", "prefer_upper")),
        *((name, c_int) for name in ("quick_return_if_not_posdef", "prefer_binary", "print")),
        ("rest", 16384 * ctypes.c_char),
    )


class _Sparse(ctypes.Structure):
    """cholmod_sparse."""

    _fields_ = (
        *((name, c_size_t) for name in ("nrow", "ncol", "nzmax")),
        *((name, c_void_p) for name in ("p", "i", "nz", "x", "z")),
        *((name, c_int) for name in ("stype", "itype", "xtype", "dtype", "sorted", "packed")),
    )


class _Dense(ctypes.Structure):
    """cholmod_dense."""

    _fields_ = (
        *((name, c_size_t) for name in ("nrow", "ncol", "nzmax", "d")),
        *((name, c_void_p) for name in ("x", "z")),
        *((name, c_int) for name in ("xtype", "dtype")),
    )


class _Factor(ctypes.Structure):
    """Head of cholmod_factor."""

    _fields_ = (("n", c_size_t), ("minor", c_size_t), ("perm", c_void_p), ("counts", c_void_p))


@dataclass(frozen=True)
class Cholmod:
    """CHOLMOD, with the workspace that its calls share."""

    library: Any
    common: _Common


@cache
def cholmod() -> Cholmod | None:
    """Load CHOLMOD where it factors in single precision, from 5.1 on; else return None."""
    for name in LIBRARIES:
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        version, common = (3 * c_int)(), _Common()
        library.cholmod_version(version)
        library.cholmod_analyze.restype = POINTER(_Factor)
        known = (5, 1) <= tuple(version[:2]) < (6, 0) and library.cholmod_start(byref(common))
        if known and (common.supernodal_switch, common.supernodal, common.print) == (40.0, 1, 3):
            # LLᵀ, which tells a matrix that is not definite; that is said by an error of ours
            common.supernodal, common.print = SUPERNODAL, 0
            return Cholmod(library, common)
    return None


class SingleFactor:
    """A = L Lᵀ in single precision, of a symmetric matrix with both triangles, scipy or Entries.

    ``entries`` are those of L. Creation raises an ArithmeticError where A has no such factor.
    """

    def __init__(self, A: Any, own: Cholmod) -> None:
        self._own, n = own, A.shape[0]
        # far from the ends of the range, whatever the units are
        self._size = float(np.abs(A.data).max(initial=0.0)) or 1.0
        arrays = [A.indptr.astype(np.int32), A.indices.astype(np.int32)]
        arrays.append((A.data / self._size).astype(np.float32))
        table, index, data = (array.ctypes.data for array in arrays)
        matrix = _Sparse(
            n, n, len(A.data), table, index, None, data, None, 1, 0, REAL, SINGLE, 0, 1
        )
        common = byref(own.common)
        self._factor = own.library.cholmod_analyze(byref(matrix), common)
        self._work = [POINTER(_Dense)() for _ in range(3)]  # X, and two of CHOLMOD's own
        finalize(self, _free, own, self._factor, self._work)
        made = self._factor and own.library.cholmod_factorize(byref(matrix), self._factor, common)
        if not made or self._factor.contents.minor < n:
            raise ArithmeticError("no factor in single precision")
        counts = ctypes.cast(self._factor.contents.counts, POINTER(c_int))
        self.entries = float(np.ctypeslib.as_array(counts, (n,)).sum(dtype=np.int64))

    def solve(self, b: Array) -> Array:
        """A⁻¹ b to single precision, shapes ``(n,)`` or ``(n, q)``."""
        n, columns = b.shape if b.ndim == 2 else (len(b), 1)
        size = float(np.abs(b).max(initial=0.0))
        if size == 0.0:
            return np.zeros(b.shape)
        given = np.divide(b, size, order="F").astype(np.float32, order="F")  # may be below 1e-38
        right = _Dense(n, columns, n * columns, n, given.ctypes.data, None, REAL, SINGLE)
        x, *others = (byref(work) for work in self._work)
        common = byref(self._own.common)
        if not self._own.library.cholmod_solve2(
            SOLVE_A, self._factor, byref(right), None, x, None, *others, common
        ):
            raise MemoryError(f"CHOLMOD has no memory to solve for {n} unknowns")
        found = ctypes.cast(self._work[0].contents.x, POINTER(c_float))
        whole = np.ctypeslib.as_array(found, (columns, n)).T.reshape(b.shape, order="F")
        return np.multiply(whole, size / self._size, dtype=np.float64, order="F")


def _free(own: Cholmod, factor: Any, work: list[Any]) -> None:
    """Free a factor and its workspace."""
    own.library.cholmod_free_factor(byref(factor), byref(own.common))
    for item in work:
        own.library.cholmod_free_dense(byref(item), byref(own.common))


# --- Factors of K_ρ and K_ii ----------------------------------------------------------------------


@dataclass(frozen=True)
class MixedTolerances:
    """Limits of factors in single precision, and of their refinement."""

    size: int = 2500  # unknowns from which on reading a factor is what a solve takes
    most: int = 6000  # unknowns beyond which subdomains are too often too ill conditioned
    # what a refinement may change, over the change before or the answer: where it is more, steps
    # would have to be set right too often
    good: float = 5e-5
    rtol: float = 1e-7  # below it they would, too
    # share of the answer that the last refinement changes: the next would change what rounding of
    # double precision does
    enough: float = 1e-10
    refinements: int = 5  # at most
    # refined solves after which the factor in double precision is made: they have taken as long
    solves: int = 25


MIXED = MixedTolerances()


class MixedFactor(CholeskyFactor):
    """A = L Lᵀ in single precision; ``solve`` refines until the answer is as double precision's.

    Iterative refinement with residuals in double precision (Higham, Accuracy and Stability of
    Numerical Algorithms, SIAM 2002, chapter 12). After many of them ``exact`` makes a factor in
    double precision of A, which takes its place. Creation raises an ArithmeticError where A is too
    ill conditioned for single precision.
    """

    def __init__(self, A: Any, own: Cholmod, exact: Callable[[Any], CholeskyFactor]) -> None:
        self._single, self._product = SingleFactor(A, own), LocalMatrix(A)
        self._make_exact, self._solves = exact, 0
        self._exact: CholeskyFactor | None = None
        self.entries = self._single.entries
        noise = np.random.default_rng(0).standard_normal(A.shape[0])
        x = self.roughly(noise)
        before = np.linalg.norm(x)
        for _ in range(2):  # errors of the first lie in soft deformations, where the second tells
            x += (change := self.roughly(noise - self._product @ x))
            if not np.linalg.norm(change) <= MIXED.good * before:
                raise ArithmeticError("too ill conditioned for single precision")
            before = np.linalg.norm(change)

    def roughly(self, b: Array) -> Array:
        """A⁻¹ b to single precision, shapes ``(n,)`` or ``(n, q)``."""
        return self._single.solve(b) if self._exact is None else self._exact.solve(b)

    def solve(self, b: Array) -> Array:
        """A⁻¹ b, shapes ``(n,)`` or ``(n, q)``."""
        if self._exact is None and self._solves >= MIXED.solves:
            with suppress(FactorError):  # without memory for it, refined ones go on
                self._exact = self._make_exact(self._product.entries())
                del self._single, self._product
        if self._exact is not None:
            return self._exact.solve(b)
        self._solves += b.shape[1] if b.ndim == 2 else 1
        x = self.roughly(b)
        for _ in range(MIXED.refinements):
            change = self.roughly(b - self._product @ x)
            x += change
            if np.linalg.norm(change) <= MIXED.enough * np.linalg.norm(x):
                break
        return x

    def destroy(self) -> None:
        """Let the factor go."""
        for name in ("_single", "_product", "_exact"):
            self.__dict__.pop(name, None)
