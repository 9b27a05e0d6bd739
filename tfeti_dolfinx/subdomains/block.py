"""The Block: all that the dual knows of a subdomain, and the identities that any Block fulfils."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import require


class Block(Protocol):
    """One subdomain, seen through the unknowns that rows of B touch (the *trace*).

    n is the number of its unknowns, t of its trace unknowns, r the dimension of its kernel.
    Nothing here is collective.
    """

    @property
    def size(self) -> int:
        """n."""
        ...

    @property
    def trace_dofs(self) -> Array:
        """Trace unknowns among the block's own 0, …, n − 1, ascending, shape ``(t,)``."""
        ...

    @property
    def kernel(self) -> Array:
        """R, an orthonormal basis of the kernel, its trace rows, shape ``(t, r)``."""
        ...

    @property
    def kernel_load(self) -> Array:
        """e = Rᵀ f, shape ``(r,)``."""
        ...

    @property
    def load_norm(self) -> float:
        """‖f‖."""
        ...

    @property
    def body_modes(self) -> tuple[Array, Array]:
        """How the modes of the whole body lie in this kernel.

        Returns:
            Rᵀ C, shape ``(r, k)``, C the candidate modes of the body on this block, and the
            Gram matrix of what is left of them, Cᵀ(I − R Rᵀ)C, shape ``(k, k)``.
        """
        ...

    @property
    def modes(self) -> Array:
        """C, the candidate modes of the whole body on all unknowns, shape ``(n, k)``."""
        ...

    @property
    def diagonal(self) -> Array:
        """Diagonal of K on the trace, shape ``(t,)``."""
        ...

    def energy(self, u: Array) -> float:
        """uᵀKu."""
        ...

    @property
    def body_metric(self) -> Array:
        """Cᵀ W C, shape ``(k, k)``, W the share of this block in each of its nodes."""
        ...

    def body_moments(self, u: Array) -> Array:
        """Cᵀ W u of a displacement on all unknowns, shape ``(k,)``."""
        ...

    @property
    def condensed_load(self) -> Array:
        """K⁺ f on the trace, shape ``(t,)``."""
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

    def prepare(self, operator: str) -> None:
        """Make what an operator needs, so that no error can come up in a collective call.

        Args:
            operator: ``"pinv"``, ``"stiffness"`` or ``"schur"``.

        Raises:
            FactorError: A factor that it needs could not be made.
        """
        ...

    def recover(self, w: Array) -> Array:
        """K⁺(f − w) on all unknowns, shape ``(n,)``; w on the trace."""
        ...

    def kernel_motion(self, alpha: Array) -> Array:
        """R α on all unknowns, shape ``(n,)``."""
        ...

    def update(self, K: Any = None, f: Array | None = None) -> None:
        """Replace the stiffness or the load; only what depends on it is computed again."""
        ...

    def retrace(self, trace_dofs: Array) -> None:
        """Replace the trace: other rows act on the subdomain. Factors of K stay."""
        ...

    def destroy(self) -> None:
        """Free the factors."""
        ...


# eigenvalues of a stiffness and singular values, relative to the largest one, that are 0 but for
# rounding
ZERO, RANK = 1e-12, 1e-10


def check_block(block: Block, K: Any, tol: float = 1e-9) -> None:
    """Check the identities that the dual relies on, for a Block of stiffness ``K``.

    The kernel is orthonormal, annihilated by K and complete; K⁺ is a symmetric generalised
    inverse: K K⁺ w = w for every trace force w that is orthogonal to the kernel; K_bb and S are
    what they say.

    Args:
        block: The Block.
        K: Its stiffness, a scipy sparse matrix of shape ``(n, n)``.
        tol: Relative tolerance; what goes through an inverse may be off by what rounding makes
            of the condition of K if that is more.

    Raises:
        ConformanceError: An identity does not hold; the message names it.
    """
    K, trace, r = K.toarray(), block.trace_dofs, block.kernel.shape[1]
    size = np.abs(K).max()
    R = np.zeros((block.size, r))
    for j in range(r):
        R[:, j] = block.kernel_motion(np.eye(r)[j])
    require(np.allclose(R.T @ R, np.eye(r), atol=tol), "Rᵀ R = I")
    require(np.allclose(R[trace], block.kernel, atol=tol), "kernel is R on the trace")
    require(np.abs(K @ R).max(initial=0.0) <= tol * size, "K R = 0")
    values = np.linalg.eigvalsh(K)
    require(np.sum(values > ZERO * values[-1]) == block.size - r, "the kernel is complete")

    require(np.allclose(block.diagonal, K.diagonal()[trace], rtol=tol), "diagonal is that of K")
    whole = np.random.default_rng(1).standard_normal(block.size)
    require(np.isclose(block.energy(whole), whole @ K @ whole, rtol=tol), "energy is uᵀKu")
    require(np.allclose(R.T @ block.modes, block.body_modes[0], atol=tol), "body_modes is Rᵀ C")

    inverse_tol = max(tol, 100 * np.finfo(float).eps * values[-1] / values[r])
    w, v = np.random.default_rng(0).standard_normal((2, len(trace)))
    _check_inverse(block, K, R, w, v, inverse_tol)

    inner = np.setdiff1d(np.arange(block.size), trace)
    K_bb, K_bi, K_ii = K[np.ix_(trace, trace)], K[np.ix_(trace, inner)], K[np.ix_(inner, inner)]
    S = K_bb - K_bi @ np.linalg.lstsq(K_ii, K_bi.T, rcond=RANK)[0]
    largest = np.abs(K_bb @ w).max()
    block.prepare("stiffness")
    applied = block.apply_stiffness(w)
    require(np.allclose(applied, K_bb @ w, atol=tol * largest), "apply_stiffness is K_bb")
    block.prepare("schur")
    applied = block.apply_schur(w)
    require(np.allclose(applied, S @ w, atol=inverse_tol * largest), "apply_schur is S")


def _check_inverse(block: Block, K: Array, R: Array, w: Array, v: Array, tol: float) -> None:
    """K⁺ is symmetric, and K K⁺ w = w for a balanced w."""
    block.prepare("pinv")
    trace, largest = block.trace_dofs, np.abs(block.apply_pinv(w)).max()
    product, transposed = v @ block.apply_pinv(w), w @ block.apply_pinv(v)
    atol = tol * largest * np.linalg.norm(v)
    require(np.isclose(product, transposed, rtol=tol, atol=atol), "K⁺ is symmetric")
    # a mode that is 0 on the trace but for rounding must not be scaled up
    balanced = w - R[trace] @ np.linalg.lstsq(R[trace], w, rcond=RANK)[0]
    base = block.recover(np.zeros(len(trace)))
    u = base - block.recover(balanced)
    force = np.zeros(block.size)
    force[trace] = balanced
    largest = np.abs(force).max()
    require(np.abs(K @ u - force).max() <= tol * largest, "K K⁺ w = w for Rᵀ w = 0")
    atol = tol * max(np.abs(u).max(), np.abs(base).max())
    on_trace = block.apply_pinv(balanced)
    require(np.allclose(u[trace], on_trace, atol=atol), "recover and apply_pinv agree")
