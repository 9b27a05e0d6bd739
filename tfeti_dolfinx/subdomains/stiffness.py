"""The stiffness of a subdomain, or of equal ones: K⁺, K_bb and the Schur complement S."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from scipy.linalg import null_space

from tfeti_dolfinx.common.arrays import TINY, Array
from tfeti_dolfinx.common.validation import check_stiffness
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains.block import TOLERANCES, candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.factor import CholeskyFactor, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.kplus import (
    GeneralisedInverse,
    InverseFactory,
    check_rank,
    regularised,
    solved,
    why_indefinite,
)


class Stiffness:
    """K, its kernel, its generalised inverse, and what it is on traces.

    Equal subdomains share one; it lives as long as one of them uses it.

    Args:
        name: Name for messages.
        x: Points of the nodes.
        K: scipy CSR, shape ``(n, n)``; becomes its own.
        how: How inverses are made.

    Attributes:
        K: The stiffness.
        kernel: R, shape ``(n, r)``.
        diagonal: Diagonal of K.

    Raises:
        InputError: K is not symmetric, not finite or not positive semidefinite.
        FactorError: A factor could not be made.
    """

    def __init__(self, name: str, x: Array, K: Any, how: InverseFactory) -> None:
        check_stiffness(name, K)
        self.name, self.x, self.K, self.how = name, x, K, how
        self.size = int(K.shape[0])
        self.bs = self.size // max(len(x), 1)
        self._traced: WeakValueDictionary[bytes, Traced] = WeakValueDictionary()
        centre = x.mean(axis=0)
        length = np.linalg.norm(x - centre, axis=1).max()
        self.diagonal = K.diagonal()
        self.kernel = R = kernel_of(K, candidate_modes(x, self.bs, centre, length))
        how.counters.factorizations += 1
        fixing = fixing_dofs(x, np.arange(self.size) // self.bs)
        try:
            self._pinv: GeneralisedInverse = how.kplus(K, R, fixing, how.prefix)
            if isinstance(self._pinv, CholeskyFactor):
                check_rank(K, R, x, self._pinv)
        except NotPositiveDefiniteError as error:
            raise InputError(f"{name}: {why_indefinite(K, R, fixing, x, how.prefix)}") from error
        except FactorError as error:
            raise FactorError(f"{name}: {error}") from error

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)`` or ``(n, q)``."""
        return solved(self._pinv, b)

    @cached_property
    def stretch_over_shear(self) -> float:
        """About (λ + 2μ)/μ, as ``stretch_over_shear`` finds it."""
        return stretch_over_shear(self.x, self.bs, lambda u: self.K @ u)

    @property
    def entries(self) -> float:
        """Entries of the factor; of an inverse that the user brings, as if it were dense."""
        dense = self.size**2 / 2.0
        return self._pinv.entries if isinstance(self._pinv, CholeskyFactor) else dense

    def on_trace(self, trace: Array) -> Traced:
        """K_bb and S on a trace, ascending, the same for all that use it."""
        key = trace.tobytes()
        if (found := self._traced.get(key)) is None:
            found = self._traced[key] = Traced(self, trace)
        return found


class Traced:
    """A stiffness seen from a trace, ascending; each matrix is made when it is first asked for."""

    def __init__(self, stiffness: Stiffness, trace: Array) -> None:
        self._stiffness, self.trace = stiffness, trace
        self.inside = np.setdiff1d(np.arange(stiffness.size), trace, assume_unique=True)

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)`` or ``(t, q)``; K_ii factored once."""
        Kw = np.asarray(self.K_bb @ w)
        return Kw if self.inner is None else Kw - self._K_bi @ self.inner.solve(self.K_ib @ w)

    @cached_property
    def K_bb(self) -> Any:
        """K on the trace."""
        return self._stiffness.K[self.trace][:, self.trace]

    @cached_property
    def K_ib(self) -> Any:
        """K between the inside and the trace."""
        return self._stiffness.K[self.inside][:, self.trace]

    @cached_property
    def _K_bi(self) -> Any:
        """Its transpose, on the same arrays; scipy would make it anew for each product."""
        return self.K_ib.T

    @cached_property
    def inner(self) -> CholeskyFactor | None:
        """K_ii⁺; K_ii is singular where the trace leaves a motion free, say normal rows only.

        None where there is no inside, or no trace that would ask for it.
        """
        stiffness, inside = self._stiffness, self.inside
        if len(inside) == 0 or len(self.trace) == 0:
            return None
        # the triangle has the null space of the kernel's trace rows, and few rows itself
        triangle = np.linalg.qr(stiffness.kernel[self.trace], mode="r")
        R = stiffness.kernel[inside] @ null_space(triangle, rcond=TOLERANCES.on_trace)
        how, K_ii = stiffness.how, stiffness.K[inside][:, inside]
        how.counters.factorizations += 1
        try:
            fixing = fixing_dofs(stiffness.x, inside // stiffness.bs)
            return regularised(K_ii, R, fixing, how.prefix)
        except FactorError as error:
            raise FactorError(
                f"{stiffness.name}: the stiffness of the unknowns that no row touches, for the "
                f"dirichlet preconditioner: {error}"
            ) from error


def stretch_over_shear(x: Array, bs: int, multiply: Callable[[Array], Array]) -> float:
    """About (λ + 2μ)/μ of a subdomain, whatever its cells are.

    On a subdomain, which is free, uᵀKu of a stretch along an axis is the volume times λ + 2μ, and
    that of a shear along it the volume times μ. The smallest ratio over the axes; 0 where unknowns
    are no displacements.
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
