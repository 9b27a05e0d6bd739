"""K_bb and the Schur complement S of a stiffness on a trace."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.sparse import block_array, csr_array, vstack

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kernel import fixing_dofs
from tfeti_dolfinx.subdomains.kplus import Making, regularised

# Of the largest singular value of the kernel's trace rows, orthonormal columns of which these are
# a part: below it a motion is as good as 0 on the trace. K_ii resists it by the square of that,
# which a Cholesky factor loses.
NOT_ON_TRACE = 1e-6
# of projectors onto directions: more are rounding
DIGITS = 9


@dataclass(frozen=True)
class Seen:
    """What rows act on.

    Attributes:
        trace: Trace unknowns, ascending, shape ``(t,)``.
        loose: Orthonormal directions of the trace that no row acts along, shape ``(n, l)``: to S
            they belong to the inside; None where there are none.
        loose_nodes: The node of each, shape ``(l,)``.
        key: What tells it from others.
    """

    trace: Array
    loose: csr_array | None
    loose_nodes: Array
    key: bytes


def seen_along(trace: Array, span: Array | None, n: int) -> Seen:
    """What rows act on that see the nodes of a trace in some directions.

    Args:
        trace: Trace unknowns, ascending, shape ``(t,)``.
        span: As for ``Block.act_along``; None: in all directions.
        n: Number of all unknowns.
    """
    nothing = np.empty(0, dtype=np.int64)
    if span is None:
        return Seen(trace, None, nothing, trace.tobytes())
    bs = span.shape[1]
    nodes, place = np.unique(trace // bs, return_inverse=True)
    left = np.zeros((len(nodes), bs, bs))
    left[place, trace % bs] = -span
    left[place, trace % bs, trace % bs] += 1.0
    at = np.flatnonzero(np.trace(left, axis1=1, axis2=2) > 0.5)
    values, vectors = np.linalg.eigh(left[at])
    which, k = np.nonzero(values > 0.5)
    if len(which) == 0:
        return Seen(trace, None, nothing, trace.tobytes())
    node, axes = nodes[at[which]], vectors[which, :, k]
    rows, columns = node[:, None] * bs + np.arange(bs), np.indices(axes.shape)[0]
    entries = axes.ravel(), (rows.ravel(), columns.ravel())
    # rounded, so that equal subdomains on an oblique plane share it
    key = trace.tobytes() + (np.round(span, DIGITS) + 0.0).tobytes()
    return Seen(trace, csr_array(entries, shape=(n, len(node))), node, key)


class Traced:
    """A stiffness seen from a trace; each matrix is made when it is first asked for.

    Args:
        name: Name for messages.
        K: Stiffness, scipy CSR, shape ``(n, n)``.
        kernel: R, shape ``(n, r)``.
        x: Points of the nodes.
        seen: The trace, and the directions of S.
        how: How inverses are made.

    Attributes:
        seen: The trace, and the directions of S.
        trace: Trace unknowns.
        users: How many Blocks use it.
    """

    def __init__(self, name: str, K: Any, kernel: Array, x: Array, seen: Seen, how: Making) -> None:
        self.seen, self.trace, self.users = seen, seen.trace, 0
        self._name, self._K, self._kernel, self._x, self._how = name, K, kernel, x, how

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, shapes ``(t,)`` or ``(t, q)``."""
        return np.asarray(self.K_bb @ w)

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)`` or ``(t, q)``; K_ii factored once."""
        if self.inner is None:
            return self.apply_stiffness(w)
        return self.apply_stiffness(w) - self._K_bi @ self.inner.solve(self.K_ib @ w)

    @cached_property
    def K_bb(self) -> Any:
        """K on the trace."""
        return self._K[self.trace][:, self.trace]

    @cached_property
    def K_ib(self) -> Any:
        """K between the inside and the trace."""
        K_b, loose = self._K[:, self.trace], self.seen.loose
        if loose is None:
            return K_b[self._inner_dofs]
        return csr_array(vstack((K_b[self._inner_dofs], loose.T @ K_b)))

    @cached_property
    def _K_bi(self) -> Any:
        """Its transpose, on the same arrays; scipy would make it anew for each product."""
        return self.K_ib.T

    @cached_property
    def inner(self) -> CholeskyFactor | None:
        """K_ii⁺; K_ii is singular where the trace leaves a motion free, say normal rows only.

        None where there is no inside, or no trace that would ask for it.
        """
        inner, loose = self._inner_dofs, self.seen.loose
        if (len(inner) == 0 and loose is None) or len(self.trace) == 0:
            return None
        kernel = self._kernel @ self._motions_not_on_trace()
        R_inner, node = kernel[inner], inner // (self._K.shape[0] // len(self._x))
        self._how.counters.factorizations += 1
        self._how.counters.analyses += 1
        K_ii = self._K[inner][:, inner]
        if loose is not None:
            K_l = csr_array(self._K @ loose)
            K_ii = csr_array(block_array([[K_ii, K_l[inner]], [K_l[inner].T, loose.T @ K_l]]))
            R_inner = np.concatenate((R_inner, loose.T @ kernel))
            node = np.concatenate((node, self.seen.loose_nodes))
        try:
            return regularised(K_ii, R_inner, fixing_dofs(self._x, node), self._how.prefix)
        except FactorError as error:
            raise FactorError(
                f"{self._name}: the stiffness of the unknowns that no row touches, for the "
                f"dirichlet preconditioner: {error}"
            ) from error

    def destroy(self) -> None:
        """Free the factor."""
        inner = self.__dict__.pop("inner", None)
        if inner is not None:
            inner.destroy()

    def _motions_not_on_trace(self) -> Array:
        """Coefficients of the motions of the kernel that are 0 on the trace."""
        # the triangle has the null space of the rows, and few rows itself
        rows = self._kernel[self.trace]
        if (loose := self.seen.loose) is not None:
            rows = rows - loose[self.trace] @ (loose.T @ self._kernel)
        triangle = np.linalg.qr(rows, mode="r")
        return np.asarray(null_space(triangle, rcond=NOT_ON_TRACE))

    @property
    def _inner_dofs(self) -> Array:
        return np.setdiff1d(np.arange(self._K.shape[0]), self.trace, assume_unique=True)
