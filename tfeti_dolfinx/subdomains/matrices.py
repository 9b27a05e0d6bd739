"""K⁺, K_bb and S on a trace as matrices that are applied through factors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.cost import (
    TOGETHER,
    sparse_products,
    sparse_traffic,
    sweeps,
    sweeps_traffic,
)
from tfeti_dolfinx.subdomains.dense import Packed, Whole, made_dense
from tfeti_dolfinx.subdomains.stiffness import Stiffness
from tfeti_dolfinx.subdomains.traced import Traced

# Of the stiffness of a node: what K⁺ makes of forces of size 1 on a sound subdomain stays far below
# it. Above it, where springs or soft parts hardly hold a subdomain, the parts of K⁺ w that cancel
# are so large that a dense product loses two or three times as much to rounding as a factor does.
HARDLY_HELD = 1e5


class TraceMatrix(Protocol):
    """A symmetric matrix on a trace, applied as cheaply as factors allow.

    Attributes:
        size: Number of its rows, t.
        has_dense: Whether there is use in a dense one.
    """

    size: int
    has_dense: bool

    @property
    def is_sound(self) -> bool:
        """Whether a dense one rounds no worse than the factors; may cost a solve."""
        ...

    def apply(self, W: Array) -> Array:
        """A W, shapes ``(t, q)``."""
        ...

    def seconds(self, count: int) -> float:
        """Of ``apply`` to so many vectors, by the model."""
        ...

    def traffic(self, count: int) -> float:
        """Bytes that ``apply`` to so many vectors moves, by the model."""
        ...

    def dense(self, packed: bool) -> Packed | Whole:
        """The same, dense."""
        ...


class PinvMatrix:
    """K⁺ on a trace.

    Args:
        stiffness: The stiffness.
        trace: Trace unknowns of it, ascending.
    """

    has_dense = True

    def __init__(self, stiffness: Stiffness, trace: Array) -> None:
        self._stiffness, self._trace, self.size = stiffness, trace, len(trace)

    @property
    def is_sound(self) -> bool:
        """Whether random forces of size 1 move the trace by no more than a sound subdomain."""
        if self.size == 0:
            return True
        forces = np.random.default_rng(0).standard_normal((self.size, 1))
        largest = self._stiffness.diagonal[self._trace].max()
        return bool(np.abs(self.apply(forces)).max() * largest <= HARDLY_HELD)

    def apply(self, W: Array) -> Array:
        """K⁺ W, through the factor, as many right sides at once as are good for the cache."""
        out = np.empty(W.shape, order="F")
        for first in range(0, W.shape[1], TOGETHER):
            some = slice(first, first + TOGETHER)
            B = np.zeros((self._stiffness.size, W[:, some].shape[1]), order="F")
            B[self._trace] = W[:, some]
            out[:, some] = self._stiffness.solve(B)[self._trace]
        return out

    def seconds(self, count: int) -> float:
        """Of ``apply`` to so many vectors, by the model."""
        return sweeps(self._stiffness.factor_size, self._stiffness.size, count)

    def traffic(self, count: int) -> float:
        """Bytes that ``apply`` to so many vectors moves, by the model."""
        return sweeps_traffic(self._stiffness.factor_size, self._stiffness.size, count)

    def dense(self, packed: bool) -> Packed | Whole:
        """The same, dense; kept for the next operator on this trace."""
        key = packed, self._trace.tobytes()
        kept = self._stiffness.dense_pinv
        if kept is None or kept[0] != key:
            self._stiffness.dense_pinv = None  # two of them might be too large
            kept = self._stiffness.dense_pinv = (key, _made(self, packed))
        return kept[1]


class SchurMatrix:
    """S on a trace.

    Args:
        traced: The stiffness on the trace.
    """

    has_dense = True

    def __init__(self, traced: Traced) -> None:
        self._traced, self.size = traced, len(traced.trace)

    @property
    def is_sound(self) -> bool:
        """Yes: S is of the size of K."""
        return True

    def apply(self, W: Array) -> Array:
        """S W, through the factor of K_ii."""
        return self._traced.apply_schur(W)

    def seconds(self, count: int) -> float:
        """Of ``apply`` to so many vectors, by the model."""
        inner = self._traced.inner
        products = sparse_products(self._traced.K_bb.nnz, count)
        if inner is None:
            return products
        products += 2.0 * sparse_products(self._traced.K_ib.nnz, count)
        return products + sweeps(inner.size, self._traced.K_ib.shape[0], count)

    def traffic(self, count: int) -> float:
        """Bytes that ``apply`` to so many vectors moves, by the model."""
        inner, K_ib = self._traced.inner, self._traced.K_ib
        products = sparse_traffic(self._traced.K_bb.nnz, count)
        if inner is None:
            return products
        products += 2.0 * sparse_traffic(K_ib.nnz, count)
        return products + sweeps_traffic(inner.size, K_ib.shape[0], count)

    def dense(self, packed: bool) -> Packed | Whole:
        """The same, dense."""
        return _made(self, packed)


class StiffnessMatrix:
    """K_bb on a trace: sparse as it is.

    Args:
        K_bb: scipy CSR, shape ``(t, t)``.
    """

    has_dense = False

    def __init__(self, K_bb: Any) -> None:
        self._K_bb, self.size = K_bb, K_bb.shape[0]

    @property
    def is_sound(self) -> bool:
        """There is no dense one."""
        return True

    def apply(self, W: Array) -> Array:
        """K_bb W."""
        return np.asarray(self._K_bb @ W)

    def seconds(self, count: int) -> float:
        """Of ``apply`` to so many vectors, by the model."""
        return sparse_products(self._K_bb.nnz, count)

    def traffic(self, count: int) -> float:
        """Bytes that ``apply`` to so many vectors moves, by the model."""
        return sparse_traffic(self._K_bb.nnz, count)

    def dense(self, packed: bool) -> Packed | Whole:
        """The same, dense."""
        return _made(self, packed)


class OwnMatrix:
    """What a Block of another class applies, one vector after the other.

    Args:
        apply: A w, shapes ``(t,)``.
        size: t.
    """

    has_dense = True

    def __init__(self, apply: Callable[[Array], Array], size: int) -> None:
        self._apply, self.size = apply, size

    @property
    def is_sound(self) -> bool:
        """Nothing is known against it."""
        return True

    def apply(self, W: Array) -> Array:
        """A W."""
        return np.stack([self._apply(np.ascontiguousarray(w)) for w in W.T], axis=1)

    def seconds(self, count: int) -> float:
        """Nothing is known of it: 0, so that it stays as it is."""
        return 0.0

    def traffic(self, count: int) -> float:
        """Bytes that ``apply`` to so many vectors moves, by the model."""
        return 0.0

    def dense(self, packed: bool) -> Packed | Whole:
        """The same, dense."""
        return _made(self, packed)


def _made(matrix: TraceMatrix, packed: bool) -> Packed | Whole:
    A = made_dense(matrix.apply, matrix.size, TOGETHER)
    return Packed(A) if packed else Whole(A)
