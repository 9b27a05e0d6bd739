"""K_bb and the Schur complement S of a stiffness on a trace."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import null_space

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kernel import fixing_dofs
from tfeti_dolfinx.subdomains.kplus import Making, regularised

# Of the largest singular value of the kernel's trace rows, orthonormal columns of which these are
# a part: below it a motion is 0 on the trace but for rounding, and K_ii does not resist it.
NOT_ON_TRACE = 1e-10


class Traced:
    """A stiffness seen from a trace; each matrix is made when it is first asked for.

    Args:
        name: Name for messages.
        K: Stiffness, scipy CSR, shape ``(n, n)``.
        kernel: R, shape ``(n, r)``.
        x: Points of the nodes.
        trace: Trace unknowns, ascending, shape ``(t,)``.
        how: How inverses are made.

    Attributes:
        trace: Trace unknowns.
        users: How many Blocks use it.
    """

    def __init__(
        self, name: str, K: Any, kernel: Array, x: Array, trace: Array, how: Making
    ) -> None:
        self.trace, self.users = trace, 0
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
        return self._K[:, self.trace][self._inner_dofs]

    @cached_property
    def _K_bi(self) -> Any:
        """Its transpose, on the same arrays; scipy would make it anew for each product."""
        return self.K_ib.T

    @cached_property
    def inner(self) -> CholeskyFactor | None:
        """K_ii⁺; K_ii is singular where the trace leaves a motion free, say normal rows only.

        None where there is no inside, or no trace that would ask for it.
        """
        inner = self._inner_dofs
        if len(inner) == 0 or len(self.trace) == 0:
            return None
        R_inner = self._kernel[inner] @ self._motions_not_on_trace()
        self._how.counters.factorizations += 1
        self._how.counters.analyses += 1
        K_ii = self._K[inner][:, inner]
        bs = self._K.shape[0] // len(self._x)
        try:
            return regularised(K_ii, R_inner, fixing_dofs(self._x, inner // bs), self._how.prefix)
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
        triangle = np.linalg.qr(self._kernel[self.trace], mode="r")
        return np.asarray(null_space(triangle, rcond=NOT_ON_TRACE))

    @property
    def _inner_dofs(self) -> Array:
        return np.setdiff1d(np.arange(self._K.shape[0]), self.trace, assume_unique=True)
