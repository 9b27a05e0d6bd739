"""The Block: all that the dual knows of a subdomain, and the identities that any Block fulfils."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from tfeti_dolfinx.arrays import Array


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


def check_block(block: Block, K: Any, tol: float = 1e-9) -> None:
    """Assert the identities that the dual relies on, for a Block of stiffness ``K``.

    The kernel is orthonormal, annihilated by K and complete; K⁺ is a symmetric generalised
    inverse: K K⁺ w = w for every trace force w that is orthogonal to the kernel; K_bb and S are
    what they say.

    Args:
        block: The Block.
        K: Its stiffness, a scipy sparse matrix of shape ``(n, n)``.
        tol: Relative tolerance.
    """
    K = K.toarray()
    trace, r = block.trace_dofs, block.kernel.shape[1]
    w, v = np.random.default_rng(0).standard_normal((2, len(trace)))
    base = block.recover(np.zeros(len(trace)))
    R = np.zeros((block.size, r))
    for j in range(r):
        R[:, j] = block.kernel_motion(np.eye(r)[j])
    assert np.allclose(R.T @ R, np.eye(r), atol=tol)
    assert np.allclose(R[trace], block.kernel, atol=tol)
    assert np.abs(K @ R).max(initial=0.0) <= tol * np.abs(K).max()
    assert np.linalg.matrix_rank(K, tol=1e-8 * np.abs(K).max()) == block.size - r

    assert np.allclose(block.diagonal, K.diagonal()[trace], rtol=tol)
    whole = np.random.default_rng(1).standard_normal(block.size)
    assert np.isclose(block.energy(whole), whole @ K @ whole, rtol=tol)
    assert np.allclose(R.T @ block.modes, block.body_modes[0], atol=tol)

    pinv_w, pinv_v = block.apply_pinv(w), block.apply_pinv(v)
    assert np.isclose(v @ pinv_w, w @ pinv_v, rtol=tol, atol=tol * np.abs(pinv_w).max())
    balanced = w - R[trace] @ np.linalg.lstsq(R[trace], w, rcond=None)[0]
    u = base - block.recover(balanced)
    force = np.zeros(block.size)
    force[trace] = balanced
    assert np.abs(K @ u - force).max() <= tol * np.abs(force).max()
    assert np.allclose(u[trace], block.apply_pinv(balanced), atol=tol * np.abs(u).max())

    inner = np.setdiff1d(np.arange(block.size), trace)
    K_bb, K_bi, K_ii = K[np.ix_(trace, trace)], K[np.ix_(trace, inner)], K[np.ix_(inner, inner)]
    S = K_bb - K_bi @ np.linalg.lstsq(K_ii, K_bi.T, rcond=1e-10)[0]
    assert np.allclose(block.apply_stiffness(w), K_bb @ w, atol=tol * np.abs(K_bb @ w).max())
    assert np.allclose(block.apply_schur(w), S @ w, atol=tol * np.abs(K_bb @ w).max())
