"""The type of all numpy arrays here, and sums and parts that numpy's own functions lack.

Shapes and units stand in the docstrings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

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
