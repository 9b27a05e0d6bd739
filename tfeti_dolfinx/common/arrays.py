"""The type of all numpy arrays here, and sums and parts that numpy's own functions lack.

Shapes and units stand in the docstrings.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import csr_array

Array = np.ndarray[Any, np.dtype[Any]]
ArrayLike = npt.ArrayLike
# stands for 0 in a denominator: smaller than any quantity, and its inverse is still finite
TINY = 1e-300
EPSILON = float(np.finfo(float).eps)  # relative rounding of a number


def quotient(a: Array, b: Array) -> Array:
    """a/b entry by entry, 0 where b is not positive."""
    return np.divide(a, b, out=np.zeros(np.broadcast(a, b).shape), where=b > 0.0)


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
    return [slice(int(a), int(b)) for a, b in pairwise(np.cumsum([0, *sizes]))]


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


class Entries(NamedTuple):
    """The arrays of a CSR matrix and its shape, as scipy's have them, by the same names."""

    data: Array
    indices: Array
    indptr: Array
    shape: tuple[int, int]

    def csr(self) -> csr_array:
        """Return them as a matrix of scipy."""
        return csr_array((self.data, self.indices, self.indptr), shape=self.shape)


def entries_at(row: Array, column: Array, value: Array, shape: tuple[int, int]) -> Entries:
    """Return the entries at these places, none of them twice."""
    order = np.lexsort((column, row))
    table = np.searchsorted(row[order], np.arange(shape[0] + 1))
    return Entries(value[order], column[order], table, shape)


def rows_of(A: Any, rows: Array, factors: Array | float = 1.0) -> Entries:
    """Return diag(factors) A[rows] of a CSR matrix."""
    entries, table = entries_of_rows(A, rows)
    data = A.data[entries] * np.repeat(np.broadcast_to(factors, len(rows)), np.diff(table))
    return Entries(data, A.indices[entries], table, (len(rows), A.shape[1]))


def transposed(A: Any) -> Entries:
    """Return Aᵀ of a CSR matrix."""
    row = np.repeat(np.arange(A.shape[0]), np.diff(A.indptr))
    return entries_at(A.indices, row, A.data, A.shape[::-1])


def columns_of(A: Any, columns: Array) -> Entries:
    """Return A[:, columns] of a CSR matrix, columns ascending."""
    place = np.full(A.shape[1], -1, dtype=A.indices.dtype)
    place[columns] = np.arange(len(columns))
    column = place[A.indices]
    kept = column >= 0
    table = np.concatenate(([0], np.cumsum(kept)))[A.indptr]
    return Entries(A.data[kept], column[kept], table, (A.shape[0], len(columns)))


def plus(A: Any, row: Array, column: Array, value: Array) -> Entries:
    """Return A plus these entries, in the order of rows and of columns, as those of a CSR A are."""
    if not len(row):
        return Entries(A.data, A.indices, A.indptr, A.shape)
    first = np.append(True, row[1:] != row[:-1])
    rows, which = row[first], np.cumsum(first) - 1
    entries, begins = entries_of_rows(A, rows)
    own = np.repeat(np.arange(len(rows)), np.diff(begins)) * A.shape[1] + A.indices[entries]
    place = np.searchsorted(own, wanted := which * A.shape[1] + column)
    new = np.searchsorted(own, wanted, side="right") == place
    place += A.indptr[row] - begins[which]
    if not new.any():
        data = np.array(A.data)
        data[place] += value
        return Entries(data, A.indices, A.indptr, A.shape)
    place += np.cumsum(new) - new  # among all
    old = np.ones(len(A.data) + np.sum(new), dtype=bool)
    old[place[new]] = False
    data, indices = np.empty(len(old)), np.empty(len(old), dtype=A.indices.dtype)
    data[old], indices[old] = A.data, A.indices
    data[place[new]], indices[place[new]] = value[new], column[new]
    data[place[~new]] += value[~new]
    table = A.indptr + np.searchsorted(row[new], np.arange(A.shape[0] + 1))
    return Entries(data, indices, table, A.shape)


def beside(A: Entries, B: Entries) -> Entries:
    """Return [A, B]."""
    parts = np.diff(A.indptr), np.diff(B.indptr)
    table = A.indptr + B.indptr
    of_A = np.arange(len(A.data)) + np.repeat(B.indptr[:-1], parts[0])
    of_B = np.arange(len(B.data)) + np.repeat(A.indptr[1:], parts[1])
    data, indices = np.empty(table[-1]), np.empty(table[-1], dtype=np.int64)
    data[of_A], data[of_B] = A.data, B.data
    indices[of_A], indices[of_B] = A.indices, A.shape[1] + B.indices
    return Entries(data, indices, table, (A.shape[0], A.shape[1] + B.shape[1]))


def as_petsc_matrix(A: Any) -> PETSc.Mat:
    """A as a matrix of PETSc, on the same arrays if they are CSR of PETSc's integers, and sorted.

    A matrix of scipy is sorted; columns of a row of ``Entries`` ascend.
    """
    if not isinstance(A, Entries):
        A = A.tocsr()
        A.sort_indices()
    table = (*(array.astype(PETSc.IntType, copy=False) for array in (A.indptr, A.indices)), A.data)
    return PETSc.Mat().createAIJWithArrays(A.shape, table, comm=PETSc.COMM_SELF)


class LocalMatrix:
    """A CSR matrix for many products: PETSc's, without scipy's checks of both factors.

    ``count`` is the number of its entries.
    """

    def __init__(self, A: csr_array | Entries | PETSc.Mat) -> None:
        self._petsc = A if isinstance(A, PETSc.Mat) else as_petsc_matrix(A)
        self.shape, self.count = self._petsc.getSize(), int(self._petsc.getInfo()["nz_used"])
        # sums are those of scipy to the last bit, and so the same in any number of columns
        self._petsc.setOption(PETSc.Mat.Option.USE_INODES, False)
        self._x, self._y = self._petsc.createVecs()

    def __matmul__(self, x: Array) -> Array:
        """A x, shapes ``(n,)`` or ``(n, q)``."""
        if x.ndim > 1:
            return of_columns(self._petsc.matMult, x, self.shape[0])
        self._x.setArray(x)
        self._petsc.mult(self._x, self._y)
        return np.array(self._y.array_r)

    def transposed(self, y: Array) -> Array:
        """Aᵀy, shapes ``(m,)`` or ``(m, q)``."""
        if y.ndim > 1:
            return of_columns(self._petsc.transposeMatMult, y, self.shape[1])
        self._y.setArray(y)
        self._petsc.multTranspose(self._y, self._x)
        return np.array(self._x.array_r)

    def part(self, rows: Array, columns: Array) -> PETSc.Mat:
        """Return A[rows][:, columns]."""
        sets = [
            PETSc.IS().createGeneral(places.astype(PETSc.IntType), PETSc.COMM_SELF)
            for places in (rows, columns)
        ]
        return self._petsc.createSubMatrix(*sets)

    def is_symmetric(self, tolerance: float) -> bool:
        """Return whether entries of A − Aᵀ are at most this large."""
        return bool(self._petsc.isSymmetric(tolerance))

    def entries(self) -> Entries:
        """Return copies of its arrays."""
        indptr, indices, data = self._petsc.getValuesCSR()
        return Entries(data, indices, indptr, self.shape)


def of_columns(product: Callable[[PETSc.Mat], PETSc.Mat], x: Array, rows: int) -> Array:
    """Return a product of PETSc with columns, maybe none, shape ``(rows, q)``."""
    if not x.shape[1]:
        return np.zeros((rows, 0))
    given = PETSc.Mat().createDense(x.shape, array=np.asfortranarray(x), comm=PETSc.COMM_SELF)
    made = product(given)
    found = np.array(made.getDenseArray(readonly=True), order="F")
    given.destroy()
    made.destroy()
    return found


def node_blocks(K: Any, bs: int) -> Array:
    """The ``bs × bs`` block of each node of a symmetric scipy matrix, shape ``(n, bs, bs)``."""
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
