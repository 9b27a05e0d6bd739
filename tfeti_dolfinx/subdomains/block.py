"""Block: what the dual knows of a subdomain, its data, kernel and checks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, Literal

import numpy as np
from scipy.linalg import expm

from tfeti_dolfinx.common.arrays import Array, Entries, LocalMatrix
from tfeti_dolfinx.errors import InputError


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
    """

    name: str
    K: Any
    f: Array
    x: Array
    trace_dofs: Array
    body_frame: tuple[Array, float]
    node_shares: Array

    @property
    def bs(self) -> int:
        """Unknowns per node."""
        return len(self.f) // max(len(self.x), 1)


# --- Kernels of subdomain stiffnesses ---------------------------------------------------------


@dataclass(frozen=True)
class KernelTolerances:
    """Tolerances of kernels, fixing nodes and loads on kernels."""

    # energy of a mode, over what its terms may be without their signs, that counts as none:
    # rounding makes 2e-16 of it, a spring of 1e-10 of the stiffness 1e-14 and more
    null: float = 2e-15
    # singular value of a mode beside the others, over the largest, that counts as none: nodes on a
    # line or in one point make it 0 but for rounding
    dependent: float = 1e-10
    equal: float = 1e-9  # distances that differ by less, relatively, count as equal
    # singular value of the kernel's trace rows, parts of orthonormal columns, below which a motion
    # is as good as 0 on the trace: K_ii resists it by the square of that, which a Cholesky factor
    # loses
    on_trace: float = 1e-6
    # of (K⁺)_bb with a diagonal of ones, the inverse of its condition: below it soft parts of its
    # inverse, S, are rounding of stiff ones; with cells of moduli 1 : 1e6 1e-8 was too little
    invertible: float = 1e-6
    in_kernel: float = 1e-6  # part of a mode of length 1 outside of the kernel that is rounding
    # of ‖f‖: what the load of a subdomain does to rigid motions, which have unit norm. Ten times
    # less was found where it balances itself; more moves the subdomain
    balanced: float = 1e-14


TOLERANCES = KernelTolerances()


def candidate_modes(x: Array, bs: int, centre: Array, length: float) -> Array:
    """Return rigid motions for vectors of the space's dimension, constants otherwise, as columns.

    Shape ``(n * bs, k)`` at nodes x, ``(n, gdim)``: k = 3 in 2D, 6 in 3D, bs for other fields.
    Rotations turn about the centre; the length makes them comparable to translations, 0 for a body
    of one node.
    """
    gdim = x.shape[1]
    turns = bs == gdim and gdim > 1
    modes = np.zeros((len(x), bs, bs + (bs * (bs - 1) // 2 if turns else 0)))
    modes[:, :, :bs] = np.eye(bs)
    if turns:
        y = (x - centre) / (length or 1.0)
        for k, (j, i) in enumerate(combinations(range(gdim), 2)):
            modes[:, j, bs + k], modes[:, i, bs + k] = -y[:, i], y[:, j]
    return modes.reshape(len(x) * bs, -1)


def outside_motions(modes: Array, R: Array) -> Array:
    """Return an orthonormal basis of candidate modes orthogonal to a kernel, shape ``(n, k)``."""
    count = modes.shape[1] - R.shape[1]
    if count <= 0:
        return np.zeros((len(modes), 0))
    sizes = np.linalg.norm(modes, axis=0)
    rest = modes / np.where(sizes > 0.0, sizes, 1.0)
    for _ in range(2):  # once leaves rounding of the kernel
        rest = rest - R @ (R.T @ rest)
    U, sizes, _ = np.linalg.svd(rest, full_matrices=False)
    return np.asarray(U[:, :count][:, sizes[:count] > TOLERANCES.in_kernel])


def mode_names(gdim: int, bs: int) -> tuple[str, ...]:
    """Return names of the candidate modes of a field with bs components, in their order."""
    if bs != gdim or gdim == 1:
        return tuple(f"constant in component {i}" for i in range(bs))
    turns = ["in the plane"] if gdim == 2 else ["about z", "about y", "about x"]
    moves = [f"translation in {axis}" for axis in "xyz"[:gdim]]
    return (*moves, *(f"rotation {turn}" for turn in turns))


def kernel_of(K: Any, modes: Array) -> Array:
    """Return an orthonormal basis of the kernel of K within the span of the candidate modes.

    R, shape ``(n, r)``: the null space of R₀ᵀ K R₀, R₀ an orthonormal basis of the modes, shape
    ``(n, k)``; r < k where springs or mass terms hold the subdomain.
    """
    U, s, _ = np.linalg.svd(modes, full_matrices=False)
    R0 = U[:, s > TOLERANCES.dependent * s.max(initial=0.0)]
    KR0 = K @ R0
    turn = np.linalg.eigh(R0.T @ KR0)[1]
    R = R0 @ turn
    energy = np.sum(R * (KR0 @ turn), axis=0)
    diagonal = K.diagonal()
    terms = diagonal @ R**2  # those of the diagonal, which are often enough
    if np.any(energy > TOLERANCES.null * terms):
        # In flat cells entries are differences of far larger numbers, which are as large as those
        # that other unknowns of the cell have: the largest diagonal entry that a row meets bounds
        # them.
        largest = np.maximum.reduceat(diagonal[K.indices], K.indptr[:-1])
        sizes = np.sqrt(largest)[:, None] * np.abs(R)
        pattern = LocalMatrix(Entries(np.ones(len(K.data)), K.indices, K.indptr, K.shape))
        terms = np.sum(sizes * (pattern @ sizes), axis=0)
    return np.asarray(R[:, energy <= TOLERANCES.null * terms])


def fixing_dofs(x: Array, node_of_dof: Array) -> Array:
    """Return positions of the unknowns at well-spread nodes, given the node of each unknown.

    By farthest-point sampling, from the node farthest out; of equal distances, as of the corners
    of a cube, the first: rounding must not choose (Gonzalez, Theor. Comput. Sci. 38, 1985).
    """
    asked, fixed = np.zeros((2, len(x)), dtype=bool)
    asked[node_of_dof] = True
    nodes, chosen = np.flatnonzero(asked), list[int]()
    x = x[nodes]
    square = np.einsum("ni,ni->n", y := x - x.mean(axis=0), y)
    while len(chosen) < min(2 ** x.shape[1], len(x)):
        chosen.append(int(np.argmax(square >= (1.0 - 2.0 * TOLERANCES.equal) * square.max())))
        own = np.einsum("ni,ni->n", y := x - x[chosen[-1]], y)
        square = own if len(chosen) == 1 else np.minimum(square, own)
    fixed[nodes[chosen]] = True
    return np.flatnonzero(fixed[node_of_dof])


# --- Soft springs -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Springs:
    """Springs from rigid motions of a subdomain to the ground: K = K₁ + P diag(D) Pᵀ.

    As a Dirichlet condition is one of rows, so is the far end of a spring: without its springs a
    subdomain floats, however soft they are. W are orthonormal rigid motions outside of the kernel
    of K, D = WᵀKW is diagonal, and P = KWD⁻¹. K₁W = 0, and (I − WPᵀ)K⁺(I − PWᵀ) is an inverse K₁⁺
    with PᵀK₁⁺ = 0: forces of rows do not stretch springs.
    """

    directions: Array  # W, shape (n, k)
    stretches: Array  # P, shape (n, k)
    stiffness: Array  # D, shape (k,)

    @classmethod
    def of(cls, U: Array, multiply: Callable[[Array], Array], soft: float) -> Springs | None:
        """Return them, from a basis U of motions outside and K B; None unless they are soft.

        ``soft`` is what the geometric mean of D is below then.
        """
        if not U.shape[1]:
            return None
        D, V = np.linalg.eigh(U.T @ multiply(U))
        if not (D[0] > 0.0 and np.exp(np.log(D).mean()) < soft):
            return None
        W = U @ V
        KW = multiply(W)
        return cls(W, KW @ np.linalg.inv(W.T @ KW), D)  # PᵀW = I, however small D is beside K

    def stretched(self, x: Array) -> Array:
        """√D Pᵀx, shapes ``(n,)`` or ``(n, q)``."""
        return np.asarray((np.sqrt(self.stiffness) * (self.stretches.T @ x).T).T)

    def without(self, solve: Callable[[Array], Array], b: Array) -> Array:
        """Return K₁⁺ b, from K⁺, shapes ``(n,)`` or ``(n, q)``."""
        x = solve(b - self.stretches @ (self.directions.T @ b))
        return np.asarray(x - self.directions @ (self.stretches.T @ x))


# --- The Block --------------------------------------------------------------------------------

OperatorKind = Literal["pinv", "stiffness", "schur"]
# what the dual knows of a Block
PROMISED: tuple[str, ...] = (
    *("load", "kernel", "springs", "diagonal", "trace_dofs", "modes", "shares", "bs"),
    *("multiply", "solve", "apply_pinv", "apply_stiffness", "apply_schur", "prepare"),
    *("update", "retrace", "destroy"),
)


class Block:
    """One subdomain, seen through the unknowns that rows of B touch (the *trace*).

    n is the number of its unknowns, t of its trace unknowns, r the dimension of its kernel.
    Nothing here is collective. A kind of subdomain gives four methods, and overrides what it can do
    at less cost: ``set_stiffness(K)`` takes a scipy CSR matrix, sets ``kernel`` and ``diagonal``,
    and raises an InputError where K does not fit; ``multiply(u)`` is K u and ``solve(b)`` K⁺ b on
    all unknowns, shapes ``(n,)``, ``apply_schur(w)`` S w, S the Schur complement of K on the trace,
    shapes ``(t,)``. Any class that has all of it will do; ``check_block`` tests it.

    Args:
        data: The subdomain. Its K is handed to ``set_stiffness`` and not kept.

    Attributes:
        name: Name for messages.
        x: Points of the nodes.
        bs: Unknowns of each node, which follow each other.
        trace_dofs: Trace unknowns among the block's own 0, …, n − 1, ascending, shape ``(t,)``.
        load: f, shape ``(n,)``.
        kernel: R, an orthonormal basis of the kernel of K, shape ``(n, r)``.
        diagonal: Diagonal of K, shape ``(n,)``.
        shares: 1 / number of torn copies of each unknown, shape ``(n,)``.
        springs: What ``kernel`` and ``solve`` do without, as ``Springs`` says; None: nothing.
    """

    kernel: Array
    diagonal: Array
    springs: Springs | None = None
    # what a kind of subdomain gives
    set_stiffness: Callable[[Any], None]
    multiply: Callable[[Array], Array]
    solve: Callable[[Array], Array]
    apply_schur: Callable[[Array], Array]

    def __init__(self, data: SubdomainData) -> None:
        self.name, self.x, self.bs = data.name, data.x, data.bs
        self._body_frame, self.shares = data.body_frame, np.repeat(data.node_shares, data.bs)
        self.trace_dofs = data.trace_dofs
        self.update(data.f)
        self.set_stiffness(data.K)

    @cached_property
    def modes(self) -> Array:
        """C, the candidate modes of the whole body, shape ``(n, k)``."""
        return candidate_modes(self.x, self.bs, *self._body_frame)

    def turned_beyond(self, amounts: Array) -> Array:
        """Return what finite turns move the nodes by beyond modes of these amounts, shape (n,)."""
        (centre, length), gdim = self._body_frame, self.x.shape[1]
        turns = candidate_modes(centre + np.eye(gdim), gdim, centre, length)[:, gdim:]
        small = (turns @ amounts[gdim:]).reshape(gdim, gdim)
        return np.asarray((self.x - centre) @ (expm(small) - np.eye(gdim) - small)).ravel()

    def apply_pinv(self, w: Array) -> Array:
        """K⁺ w on the trace for a force w on the trace, shapes ``(t,)``."""
        return self.solve(self._extended(w))[self.trace_dofs]

    def apply_stiffness(self, w: Array) -> Array:
        """K_bb w, K restricted to the trace, shapes ``(t,)`` (lumped preconditioner)."""
        return self.multiply(self._extended(w))[self.trace_dofs]

    def prepare(self, kind: OperatorKind) -> None:
        """Make what an operator needs, so that no error can come up in a collective call.

        Raises:
            FactorError: A factor that it needs could not be made.
        """

    def update(self, f: Array) -> None:
        """Replace the load.

        Raises:
            InputError: It does not fit.
        """
        if not np.all(np.isfinite(f)):
            wrong = np.sum(~np.isfinite(f))
            raise InputError(f"{self.name}: the load has {wrong} entries not finite")
        self.load = f

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace: other rows act on the subdomain. Factors of K stay."""
        self.trace_dofs = trace_dofs

    def destroy(self) -> None:
        """Free the factors."""

    def _extended(self, w: Array) -> Array:
        """Return a trace vector on all unknowns, 0 elsewhere."""
        full = np.zeros(len(self.load))
        full[self.trace_dofs] = w
        return full


class RigidBlock(Block):
    """A rigid body. K = 0 and R = I: it adds nothing to F, and its motions to G.

    With a mass, in a step in time, K is definite, and there is no kernel. Load and mode are those
    of each unknown, shape ``(n,)``, K of shape ``(n, n)``.
    """

    def __init__(self, name: str, load: Array, mode: Array, num_modes: int, K: Array) -> None:
        self.name, self.bs, n = name, 1, len(load)
        self.x = np.zeros((n, 1))
        self.trace_dofs = np.arange(n)
        self.modes = np.eye(num_modes)[mode]
        self.shares = np.ones(n)
        self.update(load)
        self.kernel, self.diagonal = np.eye(n), np.diag(K)
        self.multiply = self.solve = self.apply_schur = np.zeros_like
        if np.any(K):
            inverse, self.kernel = np.linalg.inv(K), np.zeros((n, 0))
            self.multiply, self.solve = K.__matmul__, inverse.__matmul__
            self.apply_schur = lambda w: np.linalg.solve(
                inverse[np.ix_(self.trace_dofs, self.trace_dofs)], w
            )
