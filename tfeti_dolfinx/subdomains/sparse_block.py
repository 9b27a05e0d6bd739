"""A subdomain of sparse finite elements."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.block import BlockDefaults, OperatorKind
from tfeti_dolfinx.subdomains.data import SubdomainData
from tfeti_dolfinx.subdomains.equal import EqualSubdomains
from tfeti_dolfinx.subdomains.firm import holds_firmly
from tfeti_dolfinx.subdomains.input_checks import check_stiffness
from tfeti_dolfinx.subdomains.kernel import kernel_of
from tfeti_dolfinx.subdomains.kplus import Making
from tfeti_dolfinx.subdomains.stiffness import Stiffness
from tfeti_dolfinx.subdomains.traced import Traced

# between projectors: less is rounding
SAME_DIRECTION = 1e-9


class SparseBlock(BlockDefaults):
    """Block of a sparse stiffness: factors of K_ρ and, when asked for, of K_ii.

    They belong to its stiffness, which it may share with Blocks that are equal to it. The
    numbering of the stiffness is that of the first of them.

    Args:
        data: The subdomain.
        how: How inverses are made.
        equals: Finds the stiffness among those of equal subdomains; without it, it shares none.

    Attributes:
        stiffness: K and its factors.
        place: Unknown of the stiffness for each of its own, shape ``(n,)``.

    Raises:
        InputError: K is not symmetric, not finite or not positive semidefinite, or the load is
            not finite.
        FactorError: A factor could not be made.
    """

    place: Array

    def __init__(
        self,
        data: SubdomainData,
        how: Making | None = None,
        equals: EqualSubdomains | None = None,
    ) -> None:
        self._how, self._equals = how or Making(), equals
        self._span: Array | None = None
        self._to_add, self._motions = data.added, np.zeros((len(data.f), 0))
        self._stiffness: Stiffness | None = None
        super().__init__(data)

    @property
    def stiffness(self) -> Stiffness:
        """K and its factors."""
        if self._stiffness is None:
            raise FactorError(f"{self.name}: its factor has been destroyed")
        return self._stiffness

    def set_stiffness(self, K: Any) -> None:
        """Take a stiffness; in the pattern of the one before only the numbers are computed anew."""
        self._forget_traced()
        self._added = self._firm(K)
        if self._added is not None:
            self._motions = kernel_of(K, self.modes)
            K.setdiag(K.diagonal() + self._added)
        old = self._stiffness
        new, self.place = self._found(K, old if old is not None and old.users == 1 else None)
        if new is not old:
            new.users += 1
            self.destroy()
            self._stiffness = new
        self.diagonal, self.kernel = new.diagonal[self.place], new.kernel[self.place]
        if self._added is not None:  # what stiffness holds does not move, nor by rounding
            self.kernel[self._added > 0.0] = 0.0

    def _firm(self, K: Any) -> Array | None:
        """What K is to get on its diagonal, if that holds no motion softly."""
        if self._to_add is None:
            return None
        check_stiffness(self.name, K)
        return self._to_add if holds_firmly(self.modes, self._to_add, K.diagonal()) else None

    def _found(self, K: Any, own: Stiffness | None) -> tuple[Stiffness, Array]:
        """A Stiffness of K, maybe the own one, and the place of each unknown in it."""
        if self._equals is not None:
            return self._equals.find(self.name, self.x, K, own)
        if own is None:
            own = Stiffness(self.name, self.x, K, self._how)
        else:
            own.replace(K)
        return own, np.arange(K.shape[0])

    def multiply(self, u: Array) -> Array:
        """K u on all unknowns, shapes ``(n,)``."""
        return np.asarray((self.stiffness.K @ self._placed(u))[self.place])

    def elastic(self, u: Array) -> Array:
        """K u without its resultant, nor what K has got added, shapes ``(n,)``."""
        if self._added is None:
            return super().elastic(u)
        force = self.multiply(u) - self._added * u
        return np.asarray(force - self._motions @ (self._motions.T @ force))

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)``."""
        return self.stiffness.solve(self._placed(b))[self.place]

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, shapes ``(t,)``."""
        return self._back(self.traced.apply_stiffness(w[self._trace_order]))

    def apply_schur(self, w: Array) -> Array:
        """S w = K_bb w − K_bi K_ii⁻¹ K_ib w, shapes ``(t,)``; K_ii is factored once."""
        return self._back(self.traced.apply_schur(w[self._trace_order]))

    def prepare(self, kind: OperatorKind) -> None:
        """Make K_bb for ``"stiffness"`` and factor K_ii for ``"schur"``."""
        if kind != "pinv":
            self.traced.K_bb  # noqa: B018
        if kind == "schur":
            self.traced.inner, self.traced.K_ib  # noqa: B018

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace; the factor of K_ii goes with it, that of K stays."""
        if not np.array_equal(trace_dofs, self.trace_dofs):
            self._forget_traced()
            self.trace_dofs, self._span = trace_dofs, None

    def act_along(self, span: Array) -> None:
        """Let S be that of the directions that rows act along."""
        if self._span is None or not np.allclose(span, self._span, rtol=0.0, atol=SAME_DIRECTION):
            self._forget_traced()
            self._span = span

    def destroy(self) -> None:
        """Free the factors, if nobody else needs them."""
        self._forget_traced()
        if self._stiffness is not None:
            self._stiffness.users -= 1
            if self._stiffness.users == 0:
                self._stiffness.destroy()
            self._stiffness = None

    @cached_property
    def traced(self) -> Traced:
        """What the stiffness is on the trace, in its own numbering."""
        order = self._trace_order
        span = None if self._span is None else self._span[order]
        return self.stiffness.on_trace(self.trace_place[order], span)

    @property
    def trace_place(self) -> Array:
        """Unknown of the stiffness for each trace unknown, shape ``(t,)``."""
        return self.place[self.trace_dofs]

    @cached_property
    def _trace_order(self) -> Array:
        return np.argsort(self.trace_place)

    def _forget_traced(self) -> None:
        """Drop what depends on the trace."""
        traced = self.__dict__.pop("traced", None)
        if traced is not None:
            self.stiffness.leave(traced)
        self.__dict__.pop("_trace_order", None)

    def _placed(self, u: Array) -> Array:
        """A vector in the numbering of the stiffness."""
        placed = np.empty(len(u))
        placed[self.place] = u
        return placed

    def _back(self, w: Array) -> Array:
        """A trace vector of the stiffness in the Block's order."""
        out = np.empty(len(w))
        out[self._trace_order] = w
        return out
