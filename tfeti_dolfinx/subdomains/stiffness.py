"""The stiffness of a subdomain: K⁺, its trace and the Schur complement S."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.linalg.blas import dspmv, dsymm
from scipy.sparse import block_array, csr_array, vstack

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.validation import check_stiffness
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains.block import candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.factor import (
    REAL,
    CholeskyFactor,
    FactoredInverse,
    FactorSize,
    GeneralisedInverse,
    NotPositiveDefiniteError,
    solved,
)
from tfeti_dolfinx.subdomains.kplus import (
    InverseFactory,
    check_rank,
    regularised,
    same_pattern,
    why_indefinite,
    with_entries,
)

# --- Dense symmetric matrices -----------------------------------------------------------------


class Packed:
    """Packed half of a symmetric matrix, for one vector at a time: reading it is the cost.

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


class SymmetricMatrix:
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
    """Return the matrix of a symmetric operator, symmetric to the last bit.

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


# --- K_bb and the Schur complement S on a trace -----------------------------------------------

# Of the largest singular value of the kernel's trace rows, orthonormal columns of which these are
# a part: below it a motion is as good as 0 on the trace. K_ii resists it by the square of that,
# which a Cholesky factor loses.
NOT_ON_TRACE = 1e-6
# of projectors onto directions: more are rounding
DIGITS = 9


@dataclass(frozen=True)
class ConstrainedTrace:
    """Unknowns, and directions of nodes, that rows act on.

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


def seen_along(trace: Array, span: Array | None, n: int) -> ConstrainedTrace:
    """Return the constrained trace of rows that act on its nodes in some directions only.

    Args:
        trace: Trace unknowns, ascending, shape ``(t,)``.
        span: As for ``Block.act_along``; None: in all directions.
        n: Number of all unknowns.
    """
    nothing = np.empty(0, dtype=np.int64)
    if span is None:
        return ConstrainedTrace(trace, None, nothing, trace.tobytes())
    bs = span.shape[1]
    nodes, place = np.unique(trace // bs, return_inverse=True)
    left = np.zeros((len(nodes), bs, bs))
    left[place, trace % bs] = -span
    left[place, trace % bs, trace % bs] += 1.0
    at = np.flatnonzero(np.trace(left, axis1=1, axis2=2) > 0.5)
    values, vectors = np.linalg.eigh(left[at])
    which, k = np.nonzero(values > 0.5)
    if len(which) == 0:
        return ConstrainedTrace(trace, None, nothing, trace.tobytes())
    node, axes = nodes[at[which]], vectors[which, :, k]
    rows, columns = node[:, None] * bs + np.arange(bs), np.indices(axes.shape)[0]
    entries = axes.ravel(), (rows.ravel(), columns.ravel())
    # rounded, so that equal subdomains on an oblique plane share it
    key = trace.tobytes() + (np.round(span, DIGITS) + 0.0).tobytes()
    return ConstrainedTrace(trace, csr_array(entries, shape=(n, len(node))), node, key)


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

    def __init__(
        self,
        name: str,
        K: Any,
        kernel: Array,
        x: Array,
        seen: ConstrainedTrace,
        how: InverseFactory,
    ) -> None:
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


# --- Stiffness of one subdomain, or of equal ones ---------------------------------------------


class Stiffness:
    """K, stored once, its kernel and its generalised inverse.

    The factor of K_ρ reads K in its place. Several Blocks may use it: it counts them.

    Args:
        name: Name for messages.
        x: Points of the nodes.
        K: scipy CSR, shape ``(n, n)``; becomes its own.
        how: How inverses are made.

    Attributes:
        x: Points of the nodes.
        K: The stiffness.
        kernel: R, shape ``(n, r)``.
        diagonal: Diagonal of K.
        users: How many Blocks use it.
        dense_pinv: Dense K⁺ on a trace, with what tells it from others, if somebody has put it
            here to keep.

    Raises:
        InputError: K is not symmetric, not finite or not positive semidefinite.
        FactorError: A factor could not be made.
    """

    def __init__(self, name: str, x: Array, K: Any, how: InverseFactory) -> None:
        self.name, self.x, self.users, self._how = name, x, 0, how
        self._pinv: GeneralisedInverse | None = None
        self._traced: dict[bytes, Traced] = {}
        self.dense_pinv: tuple[tuple[bool, bytes], Packed | SymmetricMatrix] | None = None
        self.K: Any = None
        self.replace(K)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.K.shape[0])

    @property
    def bs(self) -> int:
        """Unknowns per node."""
        return self.size // max(len(self.x), 1)

    def replace(self, K: Any) -> None:
        """Take a stiffness; in the pattern of the one before only the numbers are computed anew."""
        check_stiffness(self.name, K)
        K = with_entries(K, self._fixing_dofs(K.shape[0]))
        self._forget_traced()
        self.__dict__.pop("stretch_over_shear", None)
        if self._pinv is not None and same_pattern(K, self.K):
            self.K.data[:] = K.data
        else:
            self.destroy()
            self.K = K
        self.diagonal, self.kernel = K.diagonal(), self._kernel()
        self._factor()

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)`` or ``(n, q)``."""
        if self._pinv is None:
            raise FactorError(f"{self.name}: its factor has been destroyed")
        return solved(self._pinv, b)

    @cached_property
    def stretch_over_shear(self) -> float:
        """About (λ + 2μ)/μ, as ``stretch_over_shear`` finds it."""
        return stretch_over_shear(self.x, self.bs, lambda u: self.K @ u)

    @property
    def factor_size(self) -> FactorSize:
        """Storage of the factor; of an inverse that the user brings, as if it were dense."""
        if isinstance(self._pinv, FactoredInverse):
            return self._pinv.size
        n = float(self.size)
        return FactorSize(n * n / 2.0, REAL * n * n / 2.0)

    def on_trace(self, trace: Array, span: Array | None = None) -> Traced:
        """K_bb and S on a trace, ascending, made once for each; ``leave`` it in the end.

        Args:
            trace: The trace.
            span: Projectors onto the directions of S, as for ``Block.act_along``; default all.
        """
        seen = seen_along(trace, span, self.size)
        key = seen.key
        if key not in self._traced:
            self._traced[key] = Traced(self.name, self.K, self.kernel, self.x, seen, self._how)
        self._traced[key].users += 1
        return self._traced[key]

    def leave(self, traced: Traced) -> None:
        """Drop one user of the matrices on a trace; free them with the last."""
        traced.users -= 1
        if traced.users == 0:
            self._traced.pop(traced.seen.key, None)
            traced.destroy()

    def destroy(self) -> None:
        """Free the factors."""
        self._forget_traced()
        if self._pinv is not None:
            self._pinv.destroy()
            self._pinv = None

    def _forget_traced(self) -> None:
        """Drop what K has on traces; who uses it asks anew."""
        for traced in self._traced.values():
            traced.destroy()
        self._traced, self.dense_pinv = {}, None

    def _fixing_dofs(self, n: int) -> Array:
        """Unknowns of the fixing nodes of K."""
        return fixing_dofs(self.x, np.arange(n) // (n // len(self.x)))

    def _kernel(self) -> Array:
        centre = self.x.mean(axis=0)
        length = np.linalg.norm(self.x - centre, axis=1).max()
        return kernel_of(self.K, candidate_modes(self.x, self.bs, centre, length))

    def _factor(self) -> None:
        """Make K⁺, or follow K's new values in the same pattern."""
        self._how.counters.factorizations += 1
        fixing, prefix = self._fixing_dofs(self.size), self._how.prefix
        try:
            if self._pinv is not None:
                self._pinv.refactor(self.kernel)
            else:
                self._how.counters.analyses += 1
                self._pinv = self._how.kplus(self.K, self.kernel, fixing, prefix)
            if isinstance(self._pinv, FactoredInverse):
                check_rank(self.K, self.kernel, self.x, self._pinv.solve)
        except NotPositiveDefiniteError as error:
            self.destroy()
            why = why_indefinite(self.K, self.kernel, fixing, self.x, prefix)
            raise InputError(f"{self.name}: {why}") from error
        except FactorError as error:
            self._pinv = None
            raise FactorError(f"{self.name}: {error}") from error


def stretch_over_shear(x: Array, bs: int, multiply: Callable[[Array], Array]) -> float:
    """About (λ + 2μ)/μ of a subdomain, whatever its cells are.

    On a subdomain, which is free, uᵀKu of a stretch along an axis is the volume times λ + 2μ, and
    that of a shear along it the volume times μ.

    Args:
        x: Points of the nodes, shape ``(n / bs, gdim)``.
        bs: Unknowns at each node.
        multiply: K u, shapes ``(n,)``.

    Returns:
        The smallest over the axes; 0 where unknowns are no displacements.
    """
    if bs != x.shape[1] or bs == 1 or len(x) == 0:
        return 0.0
    x, ratios = x - x.mean(axis=0), []
    for i in range(bs):
        stretch, shear = np.zeros_like(x), np.zeros_like(x)
        stretch[:, i], shear[:, i] = x[:, i], x[:, (i + 1) % bs]
        along, across = (float(u @ multiply(u)) for u in (stretch.ravel(), shear.ravel()))
        ratios.append(along / max(across, TINY))
    return min(ratios)
