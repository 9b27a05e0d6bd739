"""Dense symmetric matrices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg.blas import dspmv, dsymm

from tfeti_dolfinx.arrays import Array


class Packed:
    """Half of a symmetric matrix, for one vector at a time: what is read is what it costs.

    Args:
        A: The matrix, shape ``(t, t)``.
    """

    def __init__(self, A: Array) -> None:
        # the upper half by columns, the way BLAS has it, is the lower one by rows
        self._half, self._size = A[np.tri(len(A), dtype=bool)], len(A)

    def apply(self, W: Array) -> Array:
        """A W, shapes ``(t, q)``."""
        if self._size == 0:  # BLAS takes no empty matrix
            return W
        products = [dspmv(self._size, 1.0, self._half, w) for w in W.T]
        return np.stack(products, axis=1)


class Whole:
    """A symmetric matrix, for many vectors at a time.

    Args:
        A: The matrix, shape ``(t, t)``; becomes its own.
    """

    def __init__(self, A: Array) -> None:
        self._A = A

    def apply(self, W: Array) -> Array:
        """A W, shapes ``(t, q)``."""
        if len(self._A) == 0:
            return W
        return np.asarray(dsymm(1.0, self._A, W))


def made_dense(apply: Callable[[Array], Array], size: int, together: int) -> Array:
    """The matrix of a symmetric operator, symmetric to the last bit.

    Args:
        apply: A W, shapes ``(t, q)``.
        size: t.
        together: Columns that are made at once.
    """
    A: Any = np.empty((size, size), order="F")
    for first in range(0, size, together):
        last = min(first + together, size)
        unit = np.zeros((size, last - first), order="F")
        unit[np.arange(first, last), np.arange(last - first)] = 1.0
        A[:, first:last] = apply(unit)
    A += A.T
    A *= 0.5
    return np.asarray(A)
