"""The identities that any Block fulfils."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.arrays import Array
from tfeti_dolfinx.errors import require
from tfeti_dolfinx.subdomains.block import Block
from tfeti_dolfinx.subdomains.data import SubdomainData
from tfeti_dolfinx.subdomains.inverse import GeneralisedInverse, solved
from tfeti_dolfinx.subdomains.kernel import candidate_modes, fixing_dofs, kernel_of
from tfeti_dolfinx.subdomains.kplus import MakeInverse, with_entries

# Eigenvalues of a stiffness, as a share of the largest, that are 0 but for rounding (which is
# 1e-16 times a few powers of n); singular values are their roots, and cut off above rounding.
ZERO, RANK = 1e-12, 1e-10
# of eps times the condition: what a solve may lose, with room for sums of many terms
LOST = 100.0
# what the dual asks a Block for
PROMISED = [name for name in vars(Block) if not name.startswith("_")]


def check_kind_of_block(make_block: Callable[[SubdomainData], Block], tol: float = 1e-9) -> None:
    """Check a class of Blocks on small trusses: loose, held by springs, and with changes.

    Args:
        make_block: The class, or what else makes a Block.
        tol: Relative tolerance, see ``check_block``.

    Raises:
        ConformanceError: A promise is broken; the message says which.
    """
    for data, changed in _trusses():
        K, trace = data.K.copy(), data.trace_dofs
        block = make_block(data)
        check_block(block, K, tol)
        block.retrace(trace[::2])
        require(np.array_equal(block.trace_dofs, trace[::2]), "retrace replaces the trace")
        check_block(block, K, tol)
        block.act_along(np.eye(block.bs)[trace[::2] % block.bs])
        check_block(block, K, tol)
        block.update(K=changed.copy())
        check_block(block, changed, tol)
        block.destroy()


def check_kind_of_inverse(make_inverse: MakeInverse, tol: float = 1e-9) -> None:
    """Check a generalised inverse on small trusses: loose, held by springs, and with changes.

    K K⁺ K = K; K⁺ is symmetric positive semidefinite; ``refactor`` follows new values, also where
    the kernel comes or goes; K is as it was.

    Args:
        make_inverse: Its class, or what else makes one, as for ``Extensions(kplus=...)``.
        tol: Relative tolerance.

    Raises:
        ConformanceError: A promise is broken; the message says which.
    """
    for data, changed in _trusses():
        nodes = np.arange(data.K.shape[0]) // data.bs
        fixing = fixing_dofs(data.x, nodes)
        modes = candidate_modes(data.x, data.bs, *data.body_frame)
        K = with_entries(data.K, fixing)
        inverse = make_inverse(K, kernel_of(K, modes), fixing, "tfeti_sub_")
        _check_pinv(inverse, K.toarray(), tol)
        rows = np.repeat(np.arange(K.shape[0]), np.diff(K.indptr))
        K.data[:] = changed.toarray()[rows, K.indices]
        inverse.refactor(kernel_of(K, modes))
        require(np.array_equal(K.toarray(), changed.toarray()), "K is as it was")
        _check_pinv(inverse, changed.toarray(), tol)
        inverse.destroy()


def _check_pinv(inverse: GeneralisedInverse, K: Array, tol: float) -> None:
    """K K⁺ K = K, K⁺ symmetric positive semidefinite."""
    pinv = solved(inverse, np.eye(len(K)))
    alone = np.stack([inverse.solve(e) for e in np.eye(len(K))], axis=1)
    largest = np.abs(pinv).max()
    require(np.allclose(alone, pinv, atol=tol * largest), "one right side is as several")
    require(np.allclose(K @ pinv @ K, K, atol=tol * np.abs(K).max()), "K K⁺ K = K")
    require(np.allclose(pinv, pinv.T, atol=tol * largest), "K⁺ is symmetric")
    require(np.linalg.eigvalsh(pinv)[0] >= -tol * largest, "K⁺ is positive semidefinite")


def _trusses() -> Iterator[tuple[SubdomainData, csr_array]]:
    """Random points, each held to each by a bar, and another stiffness for each truss."""
    rng = np.random.default_rng(0)
    for gdim in (2, 3):
        x = rng.uniform(size=(9, gdim))
        i, j = np.triu_indices(len(x), 1)
        bars, axes = np.zeros((len(i), len(x), gdim)), x[i] - x[j]
        bars[np.arange(len(i)), i], bars[np.arange(len(i)), j] = axes, -axes
        rows = bars.reshape(len(i), -1)
        loose = csr_array(rows.T @ rows)
        n = loose.shape[0]
        held = csr_array(loose + diags_array(np.where(np.arange(n) % gdim, 1.0, 0.0)))
        for K, other in ((loose, held), (held, 2.0 * held)):
            yield (
                SubdomainData(
                    name=f"truss of {len(x)} nodes in {gdim}D",
                    K=K.copy(),
                    f=rng.standard_normal(n),
                    x=x,
                    trace_dofs=np.arange(0, n, 2),
                    body_frame=(x.mean(axis=0), 1.0),
                    node_shares=np.ones(len(x)),
                ),
                csr_array(other),
            )


def check_block(block: Block, K: Any, tol: float = 1e-9) -> None:
    """Check the identities that the dual relies on, for a Block of stiffness ``K``.

    The kernel is orthonormal, annihilated by K and complete; K⁺ is a symmetric generalised
    inverse: K K⁺ w = w for every trace force w that is orthogonal to the kernel; K_bb and S are
    what they say; a new load replaces the old one.

    Args:
        block: The Block, of any class.
        K: Its stiffness, a scipy sparse matrix of shape ``(n, n)``.
        tol: Relative tolerance; what goes through an inverse may be off by what rounding makes
            of the condition of K if that is more.

    Raises:
        ConformanceError: An identity does not hold; the message names it.
    """
    missing = [name for name in PROMISED if not hasattr(block, name)]
    require(not missing, f"a Block has {', '.join(missing)}")
    K = K.toarray()
    values = _check_kernel(block, K, tol)
    _check_stiffness(block, K, tol)
    lowest = values[block.kernel.shape[1]]
    inverse_tol = max(tol, LOST * np.finfo(float).eps * values[-1] / lowest)
    _check_inverse(block, K, inverse_tol)
    _check_schur(block, K, inverse_tol)
    _check_load(block)


def _check_kernel(block: Block, K: Array, tol: float) -> Array:
    """Shapes, and R; returns the eigenvalues of K."""
    n, R, trace = len(K), block.kernel, block.trace_dofs
    r = R.shape[1]
    shapes = [block.load.shape, block.diagonal.shape, block.shares.shape]
    require(shapes == [(n,)] * 3, "load, diagonal and shares have the shape (n,)")
    require(R.shape == (n, r) and len(block.modes) == n, "kernel and modes have n rows")
    require(np.all(np.diff(trace) > 0), "trace_dofs ascend")
    require(np.allclose(R.T @ R, np.eye(r), atol=tol), "Rᵀ R = I")
    require(np.abs(K @ R).max(initial=0.0) <= tol * np.abs(K).max(), "K R = 0")
    values = np.linalg.eigvalsh(K)
    require(np.sum(values > ZERO * values[-1]) == n - r, "the kernel is complete")
    return np.asarray(values)


def _check_stiffness(block: Block, K: Array, tol: float) -> None:
    """K, its diagonal, and K_bb."""
    trace, rng = block.trace_dofs, np.random.default_rng(1)
    require(np.allclose(block.diagonal, K.diagonal(), rtol=tol), "diagonal is that of K")
    u, w = rng.standard_normal(len(K)), rng.standard_normal(len(trace))
    largest = np.abs(K @ u).max()
    require(np.allclose(block.multiply(u), K @ u, atol=tol * largest), "multiply is K")
    free = K @ u - block.kernel @ (block.kernel.T @ (K @ u))
    require(np.allclose(block.elastic(u), free, atol=tol * largest), "elastic is K, balanced")
    block.prepare("stiffness")
    expected = K[np.ix_(trace, trace)] @ w
    atol = tol * np.abs(K).max() * np.abs(w).max(initial=0.0)
    require(np.allclose(block.apply_stiffness(w), expected, atol=atol), "apply_stiffness is K_bb")


def _check_inverse(block: Block, K: Array, tol: float) -> None:
    """K⁺ is symmetric, and K K⁺ w = w for a balanced w."""
    block.prepare("pinv")
    trace, R = block.trace_dofs, block.kernel
    w, v = np.random.default_rng(0).standard_normal((2, len(trace)))
    largest = np.abs(block.apply_pinv(w)).max(initial=0.0)
    product, transposed = v @ block.apply_pinv(w), w @ block.apply_pinv(v)
    atol = tol * largest * np.linalg.norm(v)
    require(np.isclose(product, transposed, rtol=tol, atol=atol), "K⁺ is symmetric")
    # a mode that is 0 on the trace but for rounding must not be scaled up
    balanced = w - R[trace] @ np.linalg.lstsq(R[trace], w, rcond=RANK)[0]
    force = np.zeros(len(K))
    force[trace] = balanced
    u, largest = block.solve(force), np.abs(force).max()
    require(np.abs(K @ u - force).max() <= tol * largest, "K K⁺ w = w for Rᵀ w = 0")
    on_trace, atol = block.apply_pinv(balanced), tol * np.abs(u).max()
    require(np.allclose(u[trace], on_trace, atol=atol), "solve and apply_pinv agree")


def _check_schur(block: Block, K: Array, tol: float) -> None:
    """S is K_bb − K_bi K_ii⁺ K_ib."""
    trace = block.trace_dofs
    inner = np.setdiff1d(np.arange(len(K)), trace)
    K_bb, K_bi, K_ii = K[np.ix_(trace, trace)], K[np.ix_(trace, inner)], K[np.ix_(inner, inner)]
    S = K_bb - K_bi @ np.linalg.lstsq(K_ii, K_bi.T, rcond=RANK)[0]
    w = np.random.default_rng(2).standard_normal(len(trace))
    block.prepare("schur")
    atol = tol * np.abs(K_bb @ w).max(initial=0.0)
    require(np.allclose(block.apply_schur(w), S @ w, atol=atol), "apply_schur is S")


def _check_load(block: Block) -> None:
    """``update`` replaces the load."""
    before = np.array(block.load)
    block.update(f=before + 1.0)
    changed = np.array_equal(block.load, before + 1.0)
    block.update(f=before)
    require(changed and np.array_equal(block.load, before), "update(f=...) replaces the load")
