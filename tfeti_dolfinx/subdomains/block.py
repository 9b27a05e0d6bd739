"""The Block: all that the dual knows of a subdomain."""

from __future__ import annotations

from typing import Any, Literal, Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.subdomains.data import SubdomainData
from tfeti_dolfinx.subdomains.input_checks import check_load
from tfeti_dolfinx.subdomains.kernel import candidate_modes

OperatorKind = Literal["pinv", "stiffness", "schur"]


class Block(Protocol):
    """One subdomain, seen through the unknowns that rows of B touch (the *trace*).

    n is the number of its unknowns, t of its trace unknowns, r the dimension of its kernel.
    Nothing here is collective. ``BlockDefaults`` has most of it; ``check_block`` tests it.
    """

    @property
    def trace_dofs(self) -> Array:
        """Trace unknowns among the block's own 0, …, n − 1, ascending, shape ``(t,)``."""
        ...

    @property
    def load(self) -> Array:
        """f, shape ``(n,)``."""
        ...

    @property
    def kernel(self) -> Array:
        """R, an orthonormal basis of the kernel of K, shape ``(n, r)``."""
        ...

    @property
    def diagonal(self) -> Array:
        """Diagonal of K, shape ``(n,)``."""
        ...

    @property
    def modes(self) -> Array:
        """C, the candidate modes of the whole body, shape ``(n, k)``."""
        ...

    @property
    def shares(self) -> Array:
        """1 / number of torn copies of each unknown, shape ``(n,)``."""
        ...

    @property
    def bs(self) -> int:
        """Unknowns of each node, which follow each other."""
        ...

    def multiply(self, u: Array) -> Array:
        """K u on all unknowns, shapes ``(n,)``."""
        ...

    def elastic(self, u: Array) -> Array:
        """K u without its resultant, which is rounding, and without what K has got added.

        Shapes ``(n,)``.
        """
        ...

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)``."""
        ...

    def apply_pinv(self, w: Array) -> Array:
        """K⁺ w on the trace for a force w on the trace, shapes ``(t,)``."""
        ...

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, K restricted to the trace, shapes ``(t,)`` (lumped preconditioner)."""
        ...

    def apply_schur(self, w: Array) -> Array:
        """S w, S the Schur complement of K on the trace, shapes ``(t,)``."""
        ...

    def prepare(self, kind: OperatorKind) -> None:
        """Make what an operator needs, so that no error can come up in a collective call.

        Raises:
            FactorError: A factor that it needs could not be made.
        """
        ...

    def update(self, K: Any = None, f: Array | None = None) -> None:
        """Replace the stiffness or the load; only what depends on it is computed again.

        K becomes the Block's own, as the one that it was made from.

        Raises:
            InputError: They do not fit.
            FactorError: A factor could not be made.
        """
        ...

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace: other rows act on the subdomain. Factors of K stay."""
        ...

    def act_along(self, span: Array) -> None:
        """Say in which directions rows act on the nodes of the trace, until there is a new one.

        S may be that of these directions alone, the others being left free as the inside is.

        Args:
            span: Projector of each node onto its directions, the row of each trace unknown, shape
                ``(t, bs)``.
        """
        ...

    def destroy(self) -> None:
        """Free the factors."""
        ...


class BlockDefaults:
    """A Block but for its stiffness: base of one's own kind.

    A kind gives ``set_stiffness``, which sets ``kernel`` and ``diagonal``, and ``multiply``,
    ``solve`` and ``apply_schur``; it overrides what it can do at less cost.

    Args:
        data: The subdomain. Its K is handed to ``set_stiffness`` and not kept.

    Attributes:
        name: Name for messages.
        x: Points of the nodes.
        bs: Unknowns at each node.
        trace_dofs: Trace unknowns.
        load: f.
        kernel: R.
        diagonal: Diagonal of K.
    """

    kernel: Array
    diagonal: Array

    def __init__(self, data: SubdomainData) -> None:
        self.name, self.x, self.bs = data.name, data.x, data.bs
        self._body_frame, self._node_shares = data.body_frame, data.node_shares
        self.trace_dofs = data.trace_dofs
        self.update(K=data.K, f=data.f)

    def set_stiffness(self, K: Any) -> None:
        """Take a stiffness, scipy CSR, and make what is needed of it.

        Raises:
            InputError: It does not fit.
            FactorError: A factor could not be made.
        """
        raise NotImplementedError("set_stiffness")

    def multiply(self, u: Array) -> Array:
        """K u on all unknowns, shapes ``(n,)``."""
        raise NotImplementedError("multiply")

    def solve(self, b: Array) -> Array:
        """K⁺ b on all unknowns, shapes ``(n,)``."""
        raise NotImplementedError("solve")

    def apply_schur(self, w: Array) -> Array:
        """S w, shapes ``(t,)``."""
        raise NotImplementedError("apply_schur")

    def elastic(self, u: Array) -> Array:
        """K u without its resultant, shapes ``(n,)``."""
        force = self.multiply(u)
        return np.asarray(force - self.kernel @ (self.kernel.T @ force))

    @property
    def modes(self) -> Array:
        """C, the candidate modes of the whole body, shape ``(n, k)``."""
        return candidate_modes(self.x, self.bs, *self._body_frame)

    @property
    def shares(self) -> Array:
        """1 / number of torn copies of each unknown, shape ``(n,)``."""
        return np.repeat(self._node_shares, self.bs)

    def apply_pinv(self, w: Array) -> Array:
        """K⁺ w on the trace, shapes ``(t,)``."""
        return self.solve(self._extended(w))[self.trace_dofs]

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, shapes ``(t,)``."""
        return self.multiply(self._extended(w))[self.trace_dofs]

    def prepare(self, kind: OperatorKind) -> None:
        """All is there."""

    def update(self, K: Any = None, f: Array | None = None) -> None:
        """Replace the stiffness or the load."""
        if f is not None:
            check_load(self.name, f)
            self.load = f
        if K is not None:
            self.set_stiffness(K)

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace."""
        self.trace_dofs = trace_dofs

    def act_along(self, span: Array) -> None:
        """S stays that of the whole trace."""

    def destroy(self) -> None:
        """Nothing is to be freed."""

    def _extended(self, w: Array) -> Array:
        """A trace vector on all unknowns, 0 elsewhere."""
        full = np.zeros(len(self.load))
        full[self.trace_dofs] = w
        return full
