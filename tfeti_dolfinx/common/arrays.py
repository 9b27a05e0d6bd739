"""The type of all numpy arrays here, and sums and parts that numpy's own functions lack.

Shapes and units stand in the docstrings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import csc_array, csr_array

Array = np.ndarray[Any, np.dtype[Any]]
ArrayLike = npt.ArrayLike
# stands for 0 in a denominator: smaller than any quantity, and its inverse is still finite
TINY = 1e-300


def sum_rows(row: Array, values: Array, size: int) -> Array:
    """Sums of values, ``(k, ...)``, with the same row, ``(k,)``: floats, shape ``(size, ...)``."""
    shape = values.shape[1:]
    flat = values.reshape(len(values), math.prod(shape))
    sums = np.empty((size, flat.shape[1]))
    for column, total in zip(flat.T, sums.T, strict=True):
        total[:] = np.bincount(row, column, minlength=size)
    return sums.reshape(size, *shape)


def parts_of(sizes: Sequence[int]) -> list[slice]:
    """Return the slices of arrays of these lengths in their concatenation."""
    ends = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def joined(parts: Sequence[Array]) -> Array:
    """One float array of several, maybe none."""
    return np.concatenate([np.empty(0), *parts])


def entries_of_rows(A: Any, rows: Array) -> tuple[Array, Array]:
    """Return the places of these rows' entries in the arrays of a CSR matrix, and their table.

    Taken there, data and column numbers are with the table the arrays of A[rows], which scipy
    makes several matrices for.
    """
    counts = np.diff(A.indptr)[rows]
    table = np.concatenate(([0], np.cumsum(counts)))
    return np.arange(table[-1]) + np.repeat(A.indptr[rows] - table[:-1], counts), table


def rows_times(A: Any, factors: Array) -> csr_array:
    """Return diag(factors) A of a CSR matrix, on the same table."""
    data = A.data * np.repeat(factors, np.diff(A.indptr))
    return csr_array((data, A.indices, A.indptr), shape=A.shape)


def submatrix(A: Any, rows: Array | slice, columns: Array) -> csr_array:
    """Return A[rows][:, columns] of a CSR matrix, columns ascending."""
    rows = np.arange(A.shape[0])[rows]
    place = np.full(A.shape[1], -1, dtype=A.indices.dtype)
    place[columns] = np.arange(len(columns))
    entries, table = entries_of_rows(A, rows)
    column = place[A.indices[entries]]
    kept = column >= 0
    table = np.concatenate(([0], np.cumsum(kept)))[table]
    shape = len(rows), len(columns)
    return csr_array((A.data[entries[kept]], column[kept], table), shape=shape)


def as_petsc_matrix(A: Any) -> PETSc.Mat:
    """A as a matrix of PETSc, on the same arrays if they are sorted CSR of PETSc's integers."""
    A = A.tocsr()
    A.sort_indices()
    table = (*(array.astype(PETSc.IntType, copy=False) for array in (A.indptr, A.indices)), A.data)
    return PETSc.Mat().createAIJWithArrays(A.shape, table, comm=PETSc.COMM_SELF)


class LocalMatrix:
    """A CSR matrix for many products: PETSc's, without scipy's checks of both factors.

    Attributes:
        A: The matrix, on whose arrays it is.
        few: Most vectors that are taken one after the other: scipy is faster with more.
    """

    few = 8

    def __init__(self, A: csr_array) -> None:
        self.A, self._petsc = A, as_petsc_matrix(A)
        # sums in the order of scipy: rounding does not depend on which of the two multiplies
        self._petsc.setOption(PETSc.Mat.Option.USE_INODES, False)
        self._x, self._y = self._petsc.createVecs()

    @cached_property
    def _At(self) -> csc_array:
        return self.A.T

    def __matmul__(self, x: Array) -> Array:
        """A x, shapes ``(n,)`` or ``(n, q)``."""
        if x.ndim == 1:
            self._x.setArray(x)
            self._petsc.mult(self._x, self._y)
            return np.array(self._y.array_r)
        if not 0 < x.shape[1] <= self.few:
            return np.asarray(self.A @ x)
        return np.array([self @ column for column in x.T]).T

    def transposed(self, y: Array) -> Array:
        """Aᵀy, shapes ``(m,)`` or ``(m, q)``."""
        if y.ndim == 1:
            self._y.setArray(y)
            self._petsc.multTranspose(self._y, self._x)
            return np.array(self._x.array_r)
        if not 0 < y.shape[1] <= self.few:
            return np.asarray(self._At @ y)
        return np.array([self.transposed(column) for column in y.T]).T


def node_blocks(K: Any, bs: int) -> Array:
    """Return the ``bs × bs`` block of each node in a symmetric scipy matrix, shape ``(n, bs, bs)``.

    Unknowns of a node follow each other.
    """
    n = K.shape[0]
    blocks = np.zeros((n // bs, bs, bs))
    for k in range(min(bs, n)):
        along = np.append(K.diagonal(k), np.zeros(k)).reshape(-1, bs)
        for i in range(bs - k):
            blocks[:, i, i + k] = blocks[:, i + k, i] = along[:, i]
    return blocks


def node_means(x: Array, bs: int) -> Array:
    """Each entry replaced by the mean of those of its node, shape ``(n,)``.

    Of the diagonal of K these are traces of the nodes' blocks, which do not depend on the axes.
    """
    return np.repeat(x.reshape(-1, bs).mean(axis=1), bs)


def sums(x: Array, parts: Sequence[slice]) -> list[float]:
    """Return the sum over each part of an array."""
    return [float(x[part].sum()) for part in parts]
