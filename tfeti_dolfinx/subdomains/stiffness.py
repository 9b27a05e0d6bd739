"""The stiffness of a subdomain, or of all that are equal, and what is made of it once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import TINY, Array
from tfeti_dolfinx.errors import FactorError, InputError
from tfeti_dolfinx.subdomains.dense import Packed, Whole
from tfeti_dolfinx.subdomains.factor import REAL, FactorSize, NotPositiveDefiniteError
from tfeti_dolfinx.subdomains.indefinite import check_rank, why_indefinite
from tfeti_dolfinx.subdomains.input_checks import check_stiffness
from tfeti_dolfinx.subdomains.inverse import FactoredInverse, GeneralisedInverse, solved
from tfeti_dolfinx.subdomains.kernel import candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.kplus import Making, same_pattern, with_entries
from tfeti_dolfinx.subdomains.traced import Traced, seen_along


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

    def __init__(self, name: str, x: Array, K: Any, how: Making) -> None:
        self.name, self.x, self.users, self._how = name, x, 0, how
        self._pinv: GeneralisedInverse | None = None
        self._traced: dict[bytes, Traced] = {}
        self.dense_pinv: tuple[tuple[bool, bytes], Packed | Whole] | None = None
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
        """What the factor stores; of an inverse of one's own, as if it were dense."""
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
        """A Block no longer needs what it has asked for."""
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
