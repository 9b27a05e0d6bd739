"""Checks that any implementation of a protocol passes: Block, K⁺, feasible set."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, diags_array

from tfeti_dolfinx.common.arrays import EPSILON, Array
from tfeti_dolfinx.errors import require
from tfeti_dolfinx.qp.coarse import Coarse
from tfeti_dolfinx.qp.sets import Face, FeasibleSet, Status, face_at
from tfeti_dolfinx.subdomains.block import (
    PROMISED,
    Block,
    SubdomainData,
    candidate_modes,
    fixing_dofs,
    kernel_of,
)
from tfeti_dolfinx.subdomains.factor import CholeskyFactor
from tfeti_dolfinx.subdomains.kplus import MakeInverse


@dataclass(frozen=True)
class CheckTolerances:
    """Steps and tolerances of the checks."""

    # step along a face, relative to the radius of its curvature, so short that what is linear in it
    # stands out from what is quadratic
    short: float = 1e-8
    long: float = 1e-5  # a longer one, so that what is quadratic stands out from rounding
    # steps along a gradient: small sets are curved so much that only the last ones are short
    shorter: tuple[float, ...] = (1e-8, 1e-10, 1e-12, 1e-14)
    # eigenvalues of a stiffness, over the largest, that are 0 but for rounding (which is 1e-16
    # times a few powers of n)
    zero: float = 1e-12
    rank: float = 1e-10  # singular values, their roots, likewise
    # of eps times the condition: what a solve may lose, with room for sums of many terms
    lost: float = 100.0


TOLERANCES = CheckTolerances()

# --- Checks of a feasible set -----------------------------------------------------------------


def check_feasible_set(feasible: FeasibleSet, size: int, seed: int = 0) -> None:
    """Check what solvers rely on, at random points of any feasible set.

    The projection is idempotent and the nearest point; a face has orthonormal directions, along
    which a point may move to both sides, and its curvature, its statuses and its β are right, φ + β
    being how a projected step moves; a maximal step stays in the set; ``onto`` keeps open rows open
    and slipping ones on their boundary.

    Args:
        feasible: The set; an object of any class.
        size: Number n of entries of its vectors.
        seed: Of the random points.

    Raises:
        ConformanceError: Something of that does not hold; the message says what.
        InputError: There is no β for each row.
    """
    promised = [name for name in dir(FeasibleSet) if name[0] != "_"]
    missing = [name for name in promised if not hasattr(feasible, name)]
    require(not missing, f"a FeasibleSet has {', '.join(missing)}")
    rng = np.random.default_rng(seed)
    for scale in (0.1, 1.0, 10.0):
        start, other, g = scale * rng.standard_normal((3, size))
        x, y = feasible.project(start), feasible.project(other)
        # the projection
        obtuse = (start - x) @ (y - x)  # with all points of a convex set
        least = 1e-12 * (1.0 + np.linalg.norm(start - x) * np.linalg.norm(y - x))
        require(obtuse <= least, "P(x) is the nearest point of Ω")
        require(_close(feasible.project(x), x, 1e-14), "P(P(x)) = P(x)")
        # the face
        face = face_at(feasible, x, g)
        _check_face(face, size)
        _check_moves(feasible, x, x - start, rng.standard_normal(face.Z.shape[1]))
        # gradients
        phi, beta = np.where(face.free, g, 0.0), face.beta
        far = x - min(feasible.max_step(x, phi), 1e3) * phi
        require(_close(feasible.project(far), far, 1e-10), "x − αφ ∈ Ω for the largest step α")
        length = 1.0 + np.linalg.norm(phi + beta)
        apart = [feasible.project(x - a * g) - x + a * (phi + beta) for a in TOLERANCES.shorter]
        right = [
            np.linalg.norm(d) <= 1e-4 * a * length
            for d, a in zip(apart, TOLERANCES.shorter, strict=True)
        ]
        require(any(right), "φ + β is the projected gradient")
        # open and slipping rows stay so, wherever others go
        status = face.status
        free = np.full(size, Status.FREE)
        require(_close(feasible.onto(other, free), y, 1e-12), "onto without bounds is P_Ω")
        onto = feasible.onto(other, status)
        require(_close(feasible.project(onto), onto, 1e-12), "onto(x, status) ∈ Ω")
        bound = np.isin(status, (Status.OPEN, Status.SLIP))
        stays = np.array_equal(feasible.face(onto, g).status[bound], status[bound])
        require(stays, "onto keeps open rows open and slipping ones on their boundary")


def _close(a: Array, b: Array, share: float) -> bool:
    return bool(np.linalg.norm(a - b) <= share * (1.0 + np.linalg.norm(b)))


def _check_face(face: Face, size: int) -> None:
    """Shapes, and what each row's status says of the directions."""
    shapes = face.tangents.shape, (len(face.curvature), face.tangents.shape[-1])
    require(face.tangent_rows.shape == shapes[0] == shapes[1], "there is a curvature per tangent")
    require(face.free.shape == face.status.shape == (size,), "there is a status for each row")
    gram = (face.Z.T @ face.Z).toarray()
    require(np.allclose(gram, np.eye(len(gram)), atol=1e-12), "the columns of Z are orthonormal")
    require(np.all(face.curvature >= 0.0), "the curvature is 0 or more")
    free = np.asarray(face.Z.multiply(face.Z).sum(axis=1)).ravel()
    require(np.allclose(free[face.holding], 1.0), "rows that are held are free in Z")
    require(np.all(free[~face.carrying] == 0.0), "open rows are not in Z")
    require(np.isin(face.status, list(Status)).all(), "each status is one of Status")


def _check_moves(feasible: FeasibleSet, x: Array, g: Array, t: Array) -> None:
    """Moves along the face stay in the set, but for what its curvature bends; g only pushes."""
    face, short, long = feasible.face(x, g), TOLERANCES.short, TOLERANCES.long
    kappa = face.bends
    flat, pushing = kappa == 0.0, np.sqrt(abs(face.Z.sign()).T @ g**2)
    radii = np.where(flat, np.inf, pushing / np.where(flat, 1.0, kappa))
    t = t * np.minimum(1.0, radii)
    step = face.Z @ t
    for sign in (short, -short):
        out = np.linalg.norm(feasible.project(x + sign * step) - x - sign * step)
        stays = out <= 1e-4 * short * (1.0 + np.linalg.norm(step)) + 1e-15 * np.linalg.norm(x)
        require(stays, "x + Zt stays in Ω to both sides, to first order in t")
    moved = feasible.project(x + long * step)
    if np.array_equal(feasible.face(moved, g).status, face.status):  # else it met a bound
        bent = g @ (moved - x - long * step)
        expected = 0.5 * long**2 * float(kappa @ t**2)
        rounding = 1e-14 * np.linalg.norm(g) * np.linalg.norm(x)
        right = abs(bent - expected) <= 0.01 * abs(expected) + rounding
        require(right, "gᵀx along Ω bends by ½ tᵀ diag(κ) t")


# --- Checks of a Block ------------------------------------------------------------------------


def check_kind_of_block(make_block: Callable[[SubdomainData], Block], tol: float = 1e-9) -> None:
    """Check a class of Blocks on small trusses: loose, held by springs, and with another trace.

    Args:
        make_block: The class, or what else makes a Block.
        tol: Relative tolerance, see ``check_block``.

    Raises:
        ConformanceError: A promise is broken; the message says which.
    """
    for data in _trusses():
        K, trace = data.K.copy(), data.trace_dofs
        block = make_block(data)
        check_block(block, K, tol)
        block.retrace(trace[::2])
        require(np.array_equal(block.trace_dofs, trace[::2]), "retrace replaces the trace")
        check_block(block, K, tol)
        block.destroy()


def check_kind_of_inverse(make_inverse: MakeInverse, tol: float = 1e-9) -> None:
    """Check a generalised inverse on small trusses: loose, and held by springs.

    K K⁺ K = K; K⁺ is symmetric positive semidefinite; K is as it was.

    Args:
        make_inverse: Its class, or what else makes one, as for ``Extensions(kplus=...)``.
        tol: Relative tolerance.

    Raises:
        ConformanceError: A promise is broken; the message says which.
    """
    for data in _trusses():
        K, fixing = data.K, fixing_dofs(data.x, np.arange(data.K.shape[0]) // data.bs)
        modes, before = candidate_modes(data.x, data.bs, *data.body_frame), K.toarray()
        inverse = make_inverse(K, kernel_of(K, modes), fixing, "tfeti_sub_")
        require(np.array_equal(K.toarray(), before), "K is as it was")
        K, ones = before, np.eye(len(before))
        alone = np.stack([inverse.solve(e) for e in ones], axis=1)
        pinv = inverse.solve(ones) if isinstance(inverse, CholeskyFactor) else alone
        largest = np.abs(pinv).max()
        require(np.allclose(alone, pinv, atol=tol * largest), "one right side is as several")
        require(np.allclose(K @ pinv @ K, K, atol=tol * np.abs(K).max()), "K K⁺ K = K")
        require(np.allclose(pinv, pinv.T, atol=tol * largest), "K⁺ is symmetric")
        require(np.linalg.eigvalsh(pinv)[0] >= -tol * largest, "K⁺ is positive semidefinite")


def _trusses() -> Iterator[SubdomainData]:
    """Random points, each held to each by a bar, loose and on springs."""
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
        for K in (loose, held):
            yield SubdomainData(
                name=f"truss of {len(x)} nodes in {gdim}D",
                K=K.copy(),
                f=rng.standard_normal(n),
                x=x,
                trace_dofs=np.arange(0, n, 2),
                body_frame=(x.mean(axis=0), 1.0),
                node_shares=np.ones(len(x)),
            )


def check_block(block: Block, K: Any, tol: float = 1e-9) -> None:
    """Check the identities that the dual relies on, for a Block of stiffness ``K``.

    The kernel is orthonormal, annihilated by K and complete; K⁺ is a symmetric generalised
    inverse: K K⁺ w = w for every trace force w that is orthogonal to the kernel, both of K without
    the Block's springs; K_bb and S are what they say; a new load replaces the old one.

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
    K, R, trace = K.toarray(), block.kernel, block.trace_dofs
    floating, springs = K, block.springs
    if springs is not None:
        floating = K - (springs.stretches * springs.stiffness) @ springs.stretches.T
    n, r, rng = len(K), R.shape[1], np.random.default_rng(0)
    # the kernel
    shapes = [block.load.shape, block.diagonal.shape, block.shares.shape]
    require(shapes == [(n,)] * 3, "load, diagonal and shares have the shape (n,)")
    require(R.shape == (n, r) and len(block.modes) == n, "kernel and modes have n rows")
    require(np.all(np.diff(trace) > 0), "trace_dofs ascend")
    require(np.allclose(R.T @ R, np.eye(r), atol=tol), "Rᵀ R = I")
    require(np.abs(floating @ R).max(initial=0.0) <= tol * np.abs(K).max(), "K R = 0")
    values = np.linalg.eigvalsh(floating)
    require(np.sum(values > TOLERANCES.zero * values[-1]) == n - r, "the kernel is complete")
    # K and K_bb
    require(np.allclose(block.diagonal, K.diagonal(), rtol=tol), "diagonal is that of K")
    u, (w, v) = rng.standard_normal(n), rng.standard_normal((2, len(trace)))
    require(np.allclose(block.multiply(u), K @ u, atol=tol * np.abs(K @ u).max()), "multiply is K")
    inner, K_bb = np.setdiff1d(np.arange(n), trace), K[np.ix_(trace, trace)]
    block.prepare("stiffness")
    atol = tol * np.abs(K).max() * np.abs(w).max(initial=0.0)
    require(np.allclose(block.apply_stiffness(w), K_bb @ w, atol=atol), "apply_stiffness is K_bb")
    # K⁺ and S
    tol = max(tol, TOLERANCES.lost * EPSILON * values[-1] / values[r])
    _check_inverse(block, floating, w, v, tol)
    K_bi, K_ii = K[np.ix_(trace, inner)], K[np.ix_(inner, inner)]
    Sw = K_bb @ w - K_bi @ (np.linalg.lstsq(K_ii, K_bi.T, rcond=TOLERANCES.rank)[0] @ w)
    block.prepare("schur")
    atol = tol * np.abs(K_bb @ w).max(initial=0.0)
    require(np.allclose(block.apply_schur(w), Sw, atol=atol), "apply_schur is S")
    # the load
    before = np.array(block.load)
    block.update(f=before + 1.0)
    changed = np.array_equal(block.load, before + 1.0)
    block.update(f=before)
    require(changed and np.array_equal(block.load, before), "update(f=...) replaces the load")


def _check_inverse(block: Block, K: Array, w: Array, v: Array, tol: float) -> None:
    """K⁺ is symmetric, and K K⁺ w = w for a balanced w."""
    block.prepare("pinv")
    trace, R = block.trace_dofs, block.kernel
    largest = np.abs(block.apply_pinv(w)).max(initial=0.0)
    product, transposed = v @ block.apply_pinv(w), w @ block.apply_pinv(v)
    atol = tol * largest * np.linalg.norm(v)
    require(np.isclose(product, transposed, rtol=tol, atol=atol), "K⁺ is symmetric")
    # a mode that is 0 on the trace but for rounding must not be scaled up
    balanced = w - R[trace] @ np.linalg.lstsq(R[trace], w, rcond=TOLERANCES.rank)[0]
    force = np.zeros(len(K))
    force[trace] = balanced
    u, largest = block.solve(force), np.abs(force).max()
    require(np.abs(K @ u - force).max() <= tol * largest, "K K⁺ w = w for Rᵀ w = 0")
    on_trace, atol = block.apply_pinv(balanced), tol * np.abs(u).max()
    require(np.allclose(u[trace], on_trace, atol=atol), "solve and apply_pinv agree")


# --- A coarse problem for tests of solvers ----------------------------------------------------


class DenseCoarse(Coarse):
    """A constraint from a dense G, for a program on one rank. Shapes ``(r, m)`` and ``(r,)``."""

    def __init__(self, G: Array, e: Array) -> None:
        inverse = np.linalg.pinv(G @ G.T, hermitian=True)
        super().__init__(MPI.COMM_SELF, csr_array(G.T), e, inverse.__matmul__)

    def damped_solve(self, face: Face, y: Array, damping: float) -> Array:
        """(G_f G_fᵀ + damping·GGᵀ)⁺y."""
        G_f = face.restricted(Gt := self.Gt.toarray())
        return np.linalg.pinv(Gt.T @ G_f + damping * Gt.T @ Gt, hermitian=True) @ y

    def on_face(self, face: Face) -> Coarse:
        """Return the same G on a face."""
        G_f = face.restricted(self.Gt.toarray())
        inverse = np.linalg.pinv(G_f.T @ G_f, hermitian=True)
        return Coarse(self.comm, self.Gt, self.e, inverse.__matmul__, face)
