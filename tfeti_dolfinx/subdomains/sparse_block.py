"""A subdomain of sparse finite elements."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import null_space

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains.block import BlockDefaults, OperatorKind
from tfeti_dolfinx.subdomains.data import Counters, SubdomainData
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.indefinite import why_indefinite
from tfeti_dolfinx.subdomains.input_checks import check_stiffness
from tfeti_dolfinx.subdomains.kernel import candidate_modes, fixing_nodes, kernel_of
from tfeti_dolfinx.subdomains.kplus import (
    GeneralisedInverse,
    MakeInverse,
    Regularised,
    regularised,
    same_pattern,
    with_entries,
)

# Of the largest singular value of the kernel's trace rows, orthonormal columns of which these are
# a part: below it a motion is 0 on the trace but for rounding, and K_ii does not resist it.
NOT_ON_TRACE = 1e-10


class SparseBlock(BlockDefaults):
    """Block of a sparse stiffness: factors of K_ρ and, when asked for, of K_ii.

    K is stored once; the factor of K_ρ reads it in its place. K_ii is made to be factored and
    let go.

    Args:
        data: The subdomain.
        counters: Counts factorisations.
        kplus: Makes the generalised inverse.
        prefix: Prefix of the factors' PETSc options.

    Raises:
        InputError: K is not symmetric, not finite or not positive semidefinite, or the load is
            not finite.
        FactorError: A factor could not be made.
    """

    def __init__(
        self,
        data: SubdomainData,
        counters: Counters | None = None,
        kplus: MakeInverse = Regularised,
        prefix: str = "tfeti_sub_",
    ) -> None:
        self._counters = Counters() if counters is None else counters
        self._kplus, self._prefix = kplus, prefix
        self._K: Any = None
        self._pinv: GeneralisedInverse | None = None
        super().__init__(data)

    def set_stiffness(self, K: Any) -> None:
        """Take a stiffness; in the pattern of the one before only the numbers are computed anew."""
        check_stiffness(self.name, K)
        K = with_entries(K, self._fixing_dofs)
        self._forget_traced()
        if self._pinv is not None and same_pattern(K, self._K):
            self._K.data[:] = K.data
        else:
            self.destroy()
            self._K = K
        self.diagonal, self.kernel = K.diagonal(), self._kernel()
        self._factor()

    def multiply(self, u: Array) -> Array:
        """K u on all unknowns, shapes ``(n,)``."""
        return np.asarray(self._K @ u)

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)``."""
        if self._pinv is None:
            raise FactorError(f"{self.name}: its factor has been destroyed")
        return self._pinv.solve(b)

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, shapes ``(t,)``."""
        return np.asarray(self._K_bb @ w)

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)``; K_ii is factored once."""
        if self._inner is None:
            return self.apply_stiffness(w)
        return self.apply_stiffness(w) - self._K_ib.T @ self._inner.solve(self._K_ib @ w)

    def prepare(self, kind: OperatorKind) -> None:
        """Make K_bb for ``"stiffness"`` and factor K_ii for ``"schur"``."""
        if kind != "pinv":
            self._K_bb  # noqa: B018
        if kind == "schur":
            self._inner, self._K_ib  # noqa: B018

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace; the factor of K_ii goes with it, that of K stays."""
        if not np.array_equal(trace_dofs, self.trace_dofs):
            self.trace_dofs = trace_dofs
            self._forget_traced()

    def destroy(self) -> None:
        """Free the factors."""
        self._forget_traced()
        if self._pinv is not None:
            self._pinv.destroy()
            self._pinv = None

    def _forget_traced(self) -> None:
        """Drop what depends on the trace."""
        inner = self.__dict__.pop("_inner", None)
        if inner is not None:
            inner.destroy()
        for name in ("_K_bb", "_K_ib"):
            self.__dict__.pop(name, None)

    def _kernel(self) -> Array:
        centre = self.x.mean(axis=0)
        length = np.linalg.norm(self.x - centre, axis=1).max()
        return kernel_of(self._K, candidate_modes(self.x, self.bs, centre, length))

    def _factor(self) -> None:
        """Make K⁺, or follow K's new values in the same pattern."""
        self._counters.factorizations += 1
        try:
            if self._pinv is not None:
                self._pinv.refactor(self.kernel)
                return
            self._counters.analyses += 1
            self._pinv = self._kplus(self._K, self.kernel, self._fixing_dofs, self._prefix)
        except NotPositiveDefiniteError as error:
            self._pinv = None
            why = why_indefinite(self._K, self.kernel, self._fixing_dofs, self.x, self._prefix)
            raise InputError(f"{self.name}: {why}") from error
        except FactorError as error:
            self._pinv = None
            raise FactorError(f"{self.name}: {error}") from error

    @cached_property
    def _K_bb(self) -> Any:
        return self._K[self.trace_dofs][:, self.trace_dofs]

    @cached_property
    def _K_ib(self) -> Any:
        return self._K[:, self.trace_dofs][self._inner_dofs]

    @cached_property
    def _inner(self) -> CholeskyFactor | None:
        """K_ii⁺; K_ii is singular where the trace leaves a motion free, say normal rows only."""
        inner = self._inner_dofs
        if len(inner) == 0:
            return None
        R_inner = self.kernel[inner] @ null_space(self.kernel[self.trace_dofs], rcond=NOT_ON_TRACE)
        self._counters.factorizations += 1
        self._counters.analyses += 1
        K_ii, fixing = self._K[inner][:, inner], self._fixing(inner // self.bs)
        try:
            return regularised(K_ii, R_inner, fixing, self._prefix)
        except FactorError as error:
            raise FactorError(
                f"{self.name}: the stiffness of the unknowns that no row touches, for the "
                f"dirichlet preconditioner: {error}"
            ) from error

    @property
    def _inner_dofs(self) -> Array:
        return np.setdiff1d(np.arange(len(self.load)), self.trace_dofs, assume_unique=True)

    @cached_property
    def _fixing_dofs(self) -> Array:
        """Unknowns of the fixing nodes of K."""
        return self._fixing(np.arange(len(self.load)) // self.bs)

    def _fixing(self, node_of_dof: Array) -> Array:
        """Positions of the unknowns at well-spread nodes, given the node of each unknown."""
        nodes = np.unique(node_of_dof)
        chosen = nodes[fixing_nodes(self.x[nodes], 2 ** self.x.shape[1])]
        return np.flatnonzero(np.isin(node_of_dof, chosen))
