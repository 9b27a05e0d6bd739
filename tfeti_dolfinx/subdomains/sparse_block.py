"""The Block of a subdomain with a sparse stiffness; equal ones share factors."""

from __future__ import annotations

from collections import defaultdict
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import check_stiffness
from tfeti_dolfinx.errors import FactorError
from tfeti_dolfinx.subdomains.block import (
    BlockDefaults,
    OperatorKind,
    SubdomainData,
    kernel_of,
    orthonormal,
)
from tfeti_dolfinx.subdomains.kplus import InverseFactory, same_pattern
from tfeti_dolfinx.subdomains.stiffness import Stiffness, Traced

# --- Equal subdomains -------------------------------------------------------------------------

# Of the size of a subdomain: nodes nearer than that have the same place. Which nodes are meant
# is all that it decides, so it is far below a cell and far above rounding of coordinates; the
# root keeps places of regular grids, which are rational, off the middle between two roundings.
PLACE = 1e-7 * np.sqrt(2.0)
# Of the largest entry: rounding of a stiffness of cells of size h at x is 1e-16 x / h, and a
# modulus that differs by more is another one.
SAME = 1e-12


class EqualSubdomains:
    """The stiffnesses of a rank, each held once.

    Args:
        how: How inverses are made.
    """

    def __init__(self, how: InverseFactory) -> None:
        self._how = how
        self._of_shape: dict[bytes, list[tuple[Stiffness, Array]]] = defaultdict(list)

    def find(self, name: str, x: Array, K: Any, own: Stiffness | None) -> tuple[Stiffness, Array]:
        """The stiffness that is equal to K, or a new one; and the unknown in it of each of K's.

        Args:
            name: Name for messages.
            x: Points of the nodes.
            K: scipy CSR with sorted indices; not needed any more after it where one is equal.
            own: What takes K if none is equal, since nobody else uses it.

        Raises:
            InputError: K does not fit.
            FactorError: A factor could not be made.
        """
        shape, order = _shape_and_order(x, K.shape[0] // len(x))
        known = self._of_shape[shape] = [
            item for item in self._of_shape[shape] if item[0].users > 0 or item[0] is own
        ]
        for stiffness, its_order in known:
            here = np.empty_like(order)
            here[order] = its_order
            if stiffness is not own and _equal(K, stiffness, here):
                return stiffness, here
        if own is not None:
            own.replace(K)
            return own, np.arange(len(order), dtype=order.dtype)
        made = Stiffness(name, x, K, self._how)
        known.append((made, order))
        return made, np.arange(len(order), dtype=order.dtype)


def places_in_order(x: Array) -> tuple[bytes, Array]:
    """Return the places of the nodes beside the lowest corner in their order, and this order."""
    corner = x.min(axis=0)
    size = float((x.max(axis=0) - corner).max()) or 1.0
    places = np.rint((x - corner) / (PLACE * size)).astype(np.int64)
    nodes = np.lexsort(places.T)
    return places[nodes].tobytes(), nodes


def _shape_and_order(x: Array, bs: int) -> tuple[bytes, Array]:
    """Return the places of the nodes, and the unknowns in their order."""
    places, nodes = places_in_order(x)
    # sizes that differ show in K; as a part of the key they would have to be rounded
    order = (nodes[:, None] * bs + np.arange(bs)).ravel().astype(np.int32)
    return bytes([bs]) + places, order


def _equal(K: Any, other: Stiffness, here: Array) -> bool:
    """Return whether K equals the other stiffness, unknown i being the other's ``here[i]``."""
    allowed = SAME * np.abs(other.K.data).max(initial=0.0)
    in_order = np.array_equal(here, np.arange(len(here)))
    if in_order and same_pattern(K, other.K):
        return bool(np.abs(K.data - other.K.data).max(initial=0.0) <= allowed)
    # the diagonals tell most of those apart that are not
    if not np.abs(K.diagonal() - other.diagonal[here]).max(initial=0.0) <= allowed:
        return False
    there = np.argsort(here).astype(here.dtype)
    moved = K[there]
    moved = csr_array((moved.data, here[moved.indices], moved.indptr), shape=K.shape)
    return bool(np.abs((moved - other.K).data).max(initial=0.0) <= allowed)


# --- Firmness of additions to the diagonal ----------------------------------------------------

# of the largest diagonal entry of K: an energy of a motion of length 1 that is rounding, and one
# from which on the motion is held as firmly as others bend
NOTHING, FIRM = 1e-26, 0.02


def holds_firmly(modes: Array, added: Array, diagonal: Array) -> bool:
    """Return whether rigid motions are free, or held about as firmly as the subdomain deforms.

    What holds them softly, as a short end or a soft part do, makes a nearly singular matrix of one
    whose kernel is known.

    Args:
        modes: Rigid motions as columns, shape ``(n, k)``.
        added: What the diagonal of K is to get, shape ``(n,)``.
        diagonal: That of K, shape ``(n,)``.
    """
    R, most = orthonormal(modes), diagonal.max(initial=0.0)
    # singular values: an eigenvalue of Rᵀ diag(added) R would have an error of 1e-16 of the largest
    energies = np.linalg.svd(np.sqrt(added)[:, None] * R, compute_uv=False) ** 2
    return not np.any((energies > NOTHING * most) & (energies < FIRM * most))


# --- Block of sparse finite elements ----------------------------------------------------------

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
        how: InverseFactory | None = None,
        equals: EqualSubdomains | None = None,
    ) -> None:
        self._how, self._equals = how or InverseFactory(), equals
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
        """Return the addition to the diagonal of K, or None if it would hold motions softly."""
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
        """The stiffness on the trace, in its own numbering."""
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
        """Return a vector in the numbering of the stiffness."""
        placed = np.empty(len(u))
        placed[self.place] = u
        return placed

    def _back(self, w: Array) -> Array:
        """Return a trace vector of the stiffness in the Block's order."""
        out = np.empty(len(w))
        out[self._trace_order] = w
        return out
