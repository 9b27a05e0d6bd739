"""Sparse matrices of few columns in parts that do not meet: dense algebra on each part."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.sparse import csc_array, csr_array, hstack
from scipy.sparse.csgraph import connected_components

from tfeti_dolfinx.arrays import Array


def parts_of_columns(A: csr_array) -> Iterator[tuple[Array, Array, Array]]:
    """Columns that meet in rows, these rows, and the dense matrix there; part by part.

    Args:
        A: Shape ``(n, c)``.
    """
    columns = csc_array(A)
    columns.sort_indices()
    touched = csr_array(
        (np.ones(columns.nnz), columns.indices, columns.indptr), shape=columns.shape[::-1]
    )
    _, label = connected_components(touched @ touched.T, directed=False)
    order = np.argsort(label, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        if len(own):
            part = columns[:, own]
            rows = np.unique(part.indices)
            yield own, rows, csr_array(part)[rows].toarray()


def spread(rows: Array, dense: Array, n: int) -> csr_array:
    """A dense matrix on some of n rows."""
    width = dense.shape[1]
    places = np.repeat(rows, width), np.tile(np.arange(width), len(rows))
    return csr_array((dense.ravel(), places), shape=(n, width))


def side_by_side(parts: list[csr_array], n: int) -> csr_array:
    """Matrices of n rows, maybe none, one after the other."""
    return csr_array(hstack([csr_array((n, 0)), *parts]))


def by_parts(A: csr_array, change: Callable[[Array], Array]) -> csr_array:
    """Columns made of those of each part, as by ``change`` of its dense matrix.

    Args:
        A: Shape ``(n, c)``.
        change: From a dense matrix to one of as many rows.
    """
    n = A.shape[0]
    changed = [spread(rows, change(dense), n) for _, rows, dense in parts_of_columns(A)]
    return side_by_side(changed, n)


def orthonormal_columns(A: csr_array) -> csr_array:
    """An orthonormal basis of the span of independent columns."""
    return by_parts(A, lambda dense: np.linalg.qr(dense)[0])
