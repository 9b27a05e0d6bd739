"""Dense linear algebra in decimal digits, as many as one asks for: arrays of ``Decimal``."""

from __future__ import annotations

from decimal import Decimal, getcontext
from typing import Any

import numpy as np

ZERO, ONE = Decimal(0), Decimal(1)
ROUNDING = 40  # digits that cancellation may leave wrong


class SingularError(Exception):
    """A pivot is zero, or of the wrong sign."""


def exact(values: Any) -> np.ndarray:
    """Numbers in double precision as they are."""
    found: np.ndarray = np.frompyfunc(lambda x: Decimal(float(x)), 1, 1)(np.asarray(values))
    return found


def rounded(values: Any) -> np.ndarray:
    """In double precision."""
    return np.asarray(values, dtype=float)


def zeros(*shape: int) -> np.ndarray:
    return np.full(shape, ZERO, dtype=object)


def largest(values: Any) -> Decimal:
    """max |x|, 0 of nothing."""
    return max((abs(x) for x in np.ravel(values)), default=ZERO)


def orthonormal(R: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what independent columns span (Gram and Schmidt, twice)."""
    basis: list[np.ndarray] = []
    for column in R.T:
        v = column.copy()
        for q in basis * 2:
            v = v - q * q.dot(v)
        basis.append(v / v.dot(v).sqrt())
    return np.array(basis, dtype=object).T


class Cholesky:
    """K = LDLᵀ of a positive definite K, without what is zero.

    Args:
        K: Symmetric, shape ``(n, n)``.

    Raises:
        SingularError: K is not positive definite.
    """

    def __init__(self, K: np.ndarray) -> None:
        U, self._rows = K.copy(), []
        for k in range(len(U)):
            if U[k, k] <= 0:
                raise SingularError(f"pivot {k}")
            after = np.array([j for j in range(k + 1, len(U)) if U[k, j]], dtype=int)
            part = U[k, after] / U[k, k]
            U[np.ix_(after, after)] -= part[:, None] * U[k, after]
            self._rows.append((after, part))
        self._diagonal = np.diag(U)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """K⁻¹ of the columns of an array."""
        x = right.copy()
        for k, (after, part) in enumerate(self._rows):
            x[after] -= part[:, None] * x[k]
        x = x / self._diagonal[:, None]
        for k in range(len(x) - 1, -1, -1):
            after, part = self._rows[k]
            x[k] = x[k] - part.dot(x[after])
        return x


def eliminated(A: np.ndarray, right: np.ndarray) -> np.ndarray:
    """A⁻¹ of a vector, by elimination with pivots of columns.

    Raises:
        SingularError: A has a column without a pivot.
    """
    A = np.concatenate((A, right[:, None]), axis=1)
    for k in range(len(A)):
        pivot = max(range(k, len(A)), key=lambda i: abs(A[i, k]))
        if A[pivot, k] == 0:
            raise SingularError(f"column {k}")
        A[[k, pivot]] = A[[pivot, k]]
        rows = np.array([i for i in range(len(A)) if i != k and A[i, k]], dtype=int)
        A[rows, k:] -= (A[rows, k] / A[k, k])[:, None] * A[k, k:]
    return A[:, -1] / np.diag(A)


def lemke(M: np.ndarray, q: np.ndarray, most: int) -> np.ndarray:
    """z ≥ 0 with q + Mz ≥ 0 and zᵀ(q + Mz) = 0 (Lemke, Management Science 11, 1965).

    What cancels is zero in exact numbers, and must be no pivot: each entry is compared with the
    largest that it has been made of.

    Args:
        M: Copositive, shape ``(m, m)``.
        q: Not degenerate, shape ``(m,)``.
        most: Pivots.

    Raises:
        SingularError: It ended in a ray, or had not ended.
    """
    m, tiny = len(q), 10.0 ** (ROUNDING - getcontext().prec)
    cover = exact(1.0 + np.random.default_rng(0).random(m))
    T = np.concatenate((M, cover[:, None], q[:, None]), axis=1)
    seen = np.abs(rounded(T))
    # w_i is i, z_i is m + i, the artificial one 2m
    basic, other, enter = list(range(m)), [*range(m, 2 * m), 2 * m], m
    leave = min(range(m), key=lambda i: q[i] / cover[i])
    if q[leave] >= 0:
        return zeros(m)
    for _ in range(most):
        pivot, column = T[leave, enter], T[:, enter].copy()
        row = -T[leave] / pivot
        row[enter] = ONE / pivot
        size = abs(float(pivot))
        own, above = seen[leave] / size, seen[:, enter] / size
        own[enter] = 1.0 / size
        added = column[:, None] * row
        seen = np.maximum(seen, np.abs(rounded(added)))
        T = T + added
        T[:, enter], seen[:, enter] = column * row[enter], above
        T[leave], seen[leave] = row, own
        T[np.abs(rounded(T)) < tiny * seen] = ZERO
        left, basic[leave] = basic[leave], other[enter]
        other[enter] = left
        if left == 2 * m:
            z = zeros(2 * m)
            z[basic] = T[:, -1]
            return z[m:]
        enter = other.index(left - m if left >= m else left + m)
        falling = [i for i in range(m) if T[i, enter] < 0]
        if not falling:
            break
        leave = min(falling, key=lambda i: -T[i, -1] / T[i, enter])
    raise SingularError("Lemke's method ended in a ray, or has not ended")
