"""Block: what the dual knows of a subdomain, its data, kernel and checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from scipy.sparse import csr_array

from tfeti_dolfinx.common.arrays import Array
from tfeti_dolfinx.common.validation import check_load

# --- Input and counters of Blocks -------------------------------------------------------------


@dataclass
class Counters:
    """Counters of the factorisations and solves of a rank's Blocks.

    Attributes:
        factorizations: Numeric factorisations.
        analyses: Symbolic ones: those of a pattern not seen before in this place.
        load_solves: Solves for K⁺f, one for each Block and load.
    """

    factorizations: int = 0
    analyses: int = 0
    load_solves: int = 0


@dataclass(frozen=True)
class SubdomainData:
    """One subdomain: n unknowns, bs at each node.

    Attributes:
        name: Name for messages.
        K: Stiffness, scipy CSR with sorted indices, shape ``(n, n)``.
        f: Load, shape ``(n,)``.
        x: Points of the nodes, shape ``(n / bs, gdim)``.
        trace_dofs: Trace unknowns, ascending, shape ``(t,)``.
        body_frame: Centre and length of the whole body, for its candidate modes.
        node_shares: 1 / number of torn copies of each node, shape ``(n / bs,)``.
        added: What the diagonal of K is to get where rows hold u at 0, shape ``(n,)``; None:
            nothing.
    """

    name: str
    K: Any
    f: Array
    x: Array
    trace_dofs: Array
    body_frame: tuple[Array, float]
    node_shares: Array
    added: Array | None = None

    @property
    def bs(self) -> int:
        """Unknowns per node."""
        return len(self.f) // max(len(self.x), 1)


# --- Kernels of subdomain stiffnesses ---------------------------------------------------------

# Energy of a mode, as a share of what its terms may be without their signs, that counts as none:
# rounding makes 2e-16 of it, a spring of 1e-10 of the stiffness 1e-14 and more.
NULL = 2e-15
# Of the largest singular value of the modes, whose entries are of the size 1: what a mode has on
# its own beside the others. Nodes on a line or in one point make it 0 but for rounding.
DEPENDENT = 1e-10
# of a distance: what is nearer to it counts as equal
EQUAL = 1e-9


def candidate_modes(x: Array, bs: int, centre: Array, length: float) -> Array:
    """Rigid motions for vectors of the space's dimension, constants otherwise.

    Args:
        x: Points of the nodes, shape ``(n, gdim)``.
        bs: Unknowns per node.
        centre: Point that the rotations turn about, shape ``(gdim,)``.
        length: Length that makes rotations comparable to translations; 0 for a body of one node.

    Returns:
        Modes as columns, shape ``(n * bs, k)``; k = 3 in 2D, 6 in 3D, bs for other fields.
    """
    gdim = x.shape[1]
    modes = [np.tile(np.eye(bs)[i], len(x)) for i in range(bs)]
    if bs == gdim and gdim > 1:
        y = (x - centre) / (length or 1.0)
        for i in range(gdim):
            for j in range(i):
                turn = np.zeros((len(x), bs))
                turn[:, j], turn[:, i] = -y[:, i], y[:, j]
                modes.append(turn.ravel())
    return np.stack(modes, axis=1)


MODE_NAMES = {
    (2, 2): ("translation in x", "translation in y", "rotation in the plane"),
    (3, 3): (
        "translation in x",
        "translation in y",
        "translation in z",
        "rotation about z",
        "rotation about y",
        "rotation about x",
    ),
}


def mode_names(gdim: int, bs: int) -> tuple[str, ...]:
    """Return names of the candidate modes of a field with bs components, in their order."""
    constants = tuple(f"constant in component {i}" for i in range(bs))
    return MODE_NAMES.get((gdim, bs), constants)


def kernel_of(K: Any, modes: Array) -> Array:
    """Return an orthonormal basis of the kernel of K within the span of the candidate modes.

    The null space of R₀ᵀ K R₀, R₀ an orthonormal basis of the modes; it is smaller than the
    span, or empty, where springs or mass terms hold the subdomain.

    Args:
        K: Stiffness, shape ``(n, n)``.
        modes: Candidate modes, shape ``(n, k)``.

    Returns:
        R, shape ``(n, r)``, r ≤ k.
    """
    R0 = orthonormal(modes)
    R = R0 @ np.linalg.eigh(R0.T @ (K @ R0))[1]
    energy = np.sum(R * (K @ R), axis=0)
    return R[:, energy <= NULL * _terms(csr_array(K), R)]


def _terms(K: csr_array, R: Array) -> Array:
    """Bound the absolute values of the terms of RᵀKR, for each mode.

    In flat cells entries are differences of far larger numbers, which are as large as those that
    other unknowns of the cell have: the largest diagonal entry that a row meets bounds them.
    """
    meets = K.diagonal()[K.indices]
    largest = np.maximum.reduceat(meets, K.indptr[:-1])
    pattern = csr_array((np.ones_like(K.data), K.indices, K.indptr), shape=K.shape)
    sizes = np.sqrt(largest)[:, None] * np.abs(R)
    return np.asarray(np.sum(sizes * (pattern @ sizes), axis=0))


def orthonormal(modes: Array) -> Array:
    """Return an orthonormal basis of the span of the columns (few of them, maybe dependent)."""
    U, s, _ = np.linalg.svd(modes, full_matrices=False)
    return U[:, s > DEPENDENT * s.max(initial=0.0)]


def fixing_nodes(x: Array, count: int) -> Array:
    """Well-spread nodes: farthest-point sampling (Gonzalez 1985), from the node farthest out.

    Of equal distances, as of the corners of a cube, the first: rounding must not choose.

    Args:
        x: Points of the nodes, shape ``(n, gdim)``.
        count: How many are wanted.

    Returns:
        Their indices, ascending, at most ``count``.
    """
    distance = np.linalg.norm(x - x.mean(axis=0), axis=1)
    chosen = [_farthest(distance)]
    distance = np.linalg.norm(x - x[chosen[0]], axis=1)
    while len(chosen) < min(count, len(x)):
        chosen.append(_farthest(distance))
        distance = np.minimum(distance, np.linalg.norm(x - x[chosen[-1]], axis=1))
    return np.unique(chosen)


def _farthest(distance: Array) -> int:
    return int(np.argmax(distance >= (1.0 - EQUAL) * distance.max()))


def fixing_dofs(x: Array, node_of_dof: Array) -> Array:
    """Return positions of the unknowns at well-spread nodes, given the node of each unknown."""
    nodes = np.unique(node_of_dof)
    chosen = nodes[fixing_nodes(x[nodes], 2 ** x.shape[1])]
    return np.flatnonzero(np.isin(node_of_dof, chosen))


# --- The Block --------------------------------------------------------------------------------

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
        """Return a trace vector on all unknowns, 0 elsewhere."""
        full = np.zeros(len(self.load))
        full[self.trace_dofs] = w
        return full
