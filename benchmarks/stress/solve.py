"""Bodies under conditions N u ≤ gap: an LP's verdict, a dense dual problem, a last primal step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.linalg import qr
from scipy.optimize import linprog
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

DEPENDENT = 1e-10
ESCAPES, SURELY_HELD = 1e-6, 1e-9  # work of a motion, of that of all loads
FARTHER = 10.0
PENALTY = 1e4  # of a row's stiffness
ROUNDING = 1e-9
WRONG = 1e-7  # relative residual of the reference
EPSILON = 2.2e-16
STEPS = 20  # of conjugate gradients on the forces
HELD = 1e-14  # of a row's terms: what it is missed by
UNFELT = 1e-11


class UnsettledError(Exception):
    """The reference itself found no solution to its accuracy."""


def null_space(A: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the null space, columns of A being of one size."""
    if A.shape[0] == 0 or A.shape[1] == 0:
        return np.eye(A.shape[1])
    _, sigma, Vt = np.linalg.svd(A, full_matrices=True)
    return Vt[int(np.sum(sigma > DEPENDENT * max(sigma.max(initial=0.0), 1e-300))) :].T


def verdict(
    N: csr_array, gap: np.ndarray, R: np.ndarray, f: np.ndarray, weight: np.ndarray, length: float
) -> str:
    """Whether a displacement keeps all conditions, and no motion escapes to infinity."""
    size = max(np.abs(gap).max(initial=0.0), length)
    if np.any(gap[weight <= DEPENDENT] < -1e-9 * size):
        return "contradiction"
    if np.any(gap < -1e-12 * size):  # else u = 0 does
        m = len(gap)
        A = np.hstack((N.toarray(), -np.ones((m, 1))))
        cost = np.r_[np.zeros(A.shape[1] - 1), 1.0]
        bounds = [(None, None)] * (A.shape[1] - 1) + [(0, None)]
        best = linprog(cost, A, gap / size, bounds=bounds, method="highs")
        if best.fun > 1e-7:
            return "contradiction"
    load = R.T @ f  # prescribed values do no work on what they leave
    total = np.abs(f).sum()
    if R.shape[1] == 0 or np.abs(load).max() <= 1e-12 * total:
        return "solvable"
    A = N @ R
    options = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    best = linprog(
        -load / total, A, np.zeros(len(gap)), bounds=(-1, 1), method="highs", options=options
    )
    if -best.fun > ESCAPES:
        return "no_solution"
    return "solvable" if -best.fun < SURELY_HELD else "borderline"


def solve(
    K: csr_array,
    f: np.ndarray,
    N: csr_array,
    gap: np.ndarray,
    R: np.ndarray,
    e: np.ndarray,
    near: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """λ, u, and the rigid part of it, of min ½uᵀKu − fᵀu, N u ≤ gap; R spans ker K, e = Rᵀf.

    Rows that carry force and a rigid part that are nearly right may be given.
    """
    if near is None:
        near = guess(K, f, N, gap, R, e)
    active, rigid = near
    lam, bent = refine(K, f, N, gap - N @ rigid, R, active)
    return lam, bent + rigid, rigid


def guess(
    K: csr_array, f: np.ndarray, N: csr_array, gap: np.ndarray, R: np.ndarray, e: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows that carry force, and the rigid part of u, by the dual problem.

    min ½λᵀFλ − dᵀλ, Gλ = e, λ ≥ 0, with the compliance F = N K⁺ Nᵀ; s = Fλ − d − Gᵀα. Rows whose
    gaps are far come in when they are overlapped: they would spoil its scale.
    """
    Q = np.linalg.qr(R)[0] if R.shape[1] else R
    inverse = pinned_inverse(K, R)

    def compliance(b: np.ndarray) -> np.ndarray:
        b = b - Q @ (Q.T @ b)
        x = inverse(b)
        x += inverse(b - K @ x)
        return x - Q @ (Q.T @ x)

    if N.shape[0] == 0:
        return np.zeros(0, dtype=bool), np.zeros(len(f))
    F = N @ compliance(np.asarray(N.T.todense()))
    F, d, G = 0.5 * (F + F.T), N @ compliance(f) - gap, np.asarray((N @ R).T)
    for share in (0.25, 0.5, 0.75, 1.0):
        reach = np.quantile(np.abs(gap), share)
        near = np.abs(gap) <= (FARTHER * reach if share < 1.0 else np.inf)
        for _ in range(20):
            found = interior_point(F[np.ix_(near, near)], d[near], G[:, near], e)
            if found is None:
                break
            lam, active = np.zeros(len(gap)), np.zeros(len(gap), dtype=bool)
            lam[near], active[near], alpha = found
            entered = ~near & (F @ lam - d - G.T @ alpha < 0.0)
            if not entered.any():
                return active, R @ alpha
            near = near | entered
    raise UnsettledError("Gλ = e has no solution, or far rows came in again and again")


def pinned_inverse(K: csr_array, R: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """K⁻¹ where as many unknowns as R has columns, which span the kernel of K, are held."""
    pinned = qr(R.T, pivoting=True, mode="r")[1][: R.shape[1]]
    rest = np.setdiff1d(np.arange(K.shape[0]), pinned)
    scale = 1.0 / np.sqrt(K.diagonal()[rest])
    scaled = csr_array(K[rest][:, rest].multiply(scale[:, None]).multiply(scale))
    factor = splu(scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def inverse(b: np.ndarray) -> np.ndarray:
        x = np.zeros_like(b)
        x[rest] = (scale * factor.solve((scale * b[rest].T).T).T).T
        return x

    return inverse


def refine(
    K: csr_array, f: np.ndarray, N: csr_array, gap: np.ndarray, R: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """λ and u by a primal active set from one that is nearly right.

    The compliance of what bends easily drowns what contact holds: there the dual loses digits
    that the primal problem has.
    """
    seen = set()
    for _ in range(200):
        u, lam = touching(K, f, N, gap, R, active)
        s = gap - N @ u
        loose = R @ null_space(N[active] @ R)
        away = loose @ (loose.T @ (f - K @ u - N.T @ lam))
        speed = np.where(active, 0.0, N @ away)
        meets = speed > DEPENDENT * np.abs(away).max(initial=0.0)
        if meets.any() and np.abs(away).max() > WRONG * np.abs(f).max():
            # a load moves bodies until they meet something
            first = np.argmin(np.where(meets, s / np.where(meets, speed, 1.0), np.inf))
            active = active | (np.arange(len(gap)) == first)
            continue
        noise = ROUNDING * np.abs(lam).max(initial=0.0)
        depth = ROUNDING * max(np.abs(u).max(), 1e-6 * np.abs(gap).max(initial=0.0))
        wrong = (active & (lam < -noise)) | (~active & (s < -depth))
        if not wrong.any():
            break
        if active.tobytes() in seen:
            size = np.where(active, -lam / (noise or 1.0), -s / (depth or 1.0))
            wrong = np.arange(len(lam)) == np.argmax(np.where(wrong, size, -np.inf))
        seen.add(active.tobytes())
        active = active ^ wrong
    else:
        raise UnsettledError("the primal active set did not settle")
    push = f - N.T @ lam
    rounding = 1e3 * EPSILON * (abs(K) @ np.abs(u)).max()
    off = max(np.abs(K @ u - push).max() - rounding, 0.0)
    size = np.abs(f).max() + np.abs(N.T @ lam).max()
    if off > WRONG * size:
        raise UnsettledError(f"the residual is {off / size:.1e}")
    return np.where(active, lam, 0.0), u


def touching(
    K: csr_array, f: np.ndarray, N: csr_array, gap: np.ndarray, R: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """u and λ where the active rows are equations: multipliers with a large penalty."""
    A, lam = N[active], np.zeros(len(gap))
    row = 1.0 / np.asarray((A.multiply(A) / K.diagonal()).sum(axis=1)).ravel()
    penalty = PENALTY * row
    M = csr_array(K + A.T @ (diags_array(penalty) @ A)) if len(row) else K
    inverse = pinned_inverse(M, R @ null_space(A @ R))
    u, force = np.zeros(len(f)), np.zeros(len(row))
    for k in range(8):
        u += inverse(f - K @ u - A.T @ (force + penalty * (A @ u - gap[active])))
        force = force + penalty * (A @ u - gap[active])
        if k < 4:  # the last steps leave what rounding has made of the forces behind
            force, u = close(A, gap[active], inverse, np.sqrt(penalty), force, u)
    lam[active] = force
    return u, lam


def close(
    A: csr_array,
    gap: np.ndarray,
    inverse: Callable[[np.ndarray], np.ndarray],
    root: np.ndarray,
    force: np.ndarray,
    u: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Conjugate gradients on the forces: rows that are nearly dependent need a larger penalty.

    The operator is W A (K + AᵀW²A)⁻¹AᵀW, W the roots of the penalty: 1 but for such rows.
    """
    r = root * (A @ u - gap)
    p, left = r, r @ r
    rounding = HELD * np.linalg.norm(root * (abs(A) @ np.abs(u)))
    for _ in range(STEPS):
        if left <= rounding**2:
            break
        v = inverse(A.T @ (root * p))
        q = root * (A @ v)
        if p @ q <= DEPENDENT * (p @ p):
            break
        length = left / (p @ q)
        force, u, r = force + length * root * p, u - length * v, r - length * q
        before, left = left, r @ r
        p = r + left / before * p
    return force, u


def interior_point(
    F: np.ndarray, d: np.ndarray, G: np.ndarray, e: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """λ, where λ > s, and α at the end of Mehrotra's predictor and corrector; None without a λ.

    SIAM J. Optim. 2, 1992.
    """
    scale = np.sqrt(np.diag(F))
    F, d, G = F / np.outer(scale, scale), d / scale, G / scale
    # what no row feels is left out
    U, sigma, Vt = np.linalg.svd(G, full_matrices=False)
    felt = sigma > UNFELT * sigma.max(initial=0.0)
    U, sigma, G = U[:, felt], sigma[felt], Vt[felt]
    if np.linalg.norm(e - U @ (U.T @ e)) > 1e-8 * np.linalg.norm(e):
        return None
    e = U.T @ e / sigma
    m, r = len(d), len(e)
    size = max(np.abs(d).max(initial=0.0), np.abs(e).max(initial=0.0), 1e-300)
    d, e = d / size, e / size
    lam, s, alpha = np.ones(m), np.ones(m), np.zeros(r)
    for _ in range(120):
        dual, primal = F @ lam - d - G.T @ alpha - s, G @ lam - e
        mean = lam @ s / m
        if mean < 1e-22:
            break
        H = np.linalg.inv(F + np.diag(s / lam))
        step = partial(_newton_step, H, G, (lam, s, dual, primal))
        dl, _, ds = step(np.zeros(m))
        length = min(_longest(lam, dl), _longest(s, ds))
        ahead = (lam + length * dl) @ (s + length * ds) / m
        dl, da, ds = step(mean * (ahead / mean) ** 3 - dl * ds)
        length = 0.995 * min(_longest(lam, dl), _longest(s, ds))
        if not np.isfinite(length) or length < 1e-12:
            break
        lam, alpha, s = lam + length * dl, alpha + length * da, s + length * ds
    return lam * size / scale, lam > s, U @ (alpha * size / sigma)


def _newton_step(
    H: np.ndarray, G: np.ndarray, now: tuple[np.ndarray, ...], target: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Changes of λ, α and s towards λ_i s_i = target_i, from λ, s and the residuals now."""
    lam, s, dual, primal = now
    right, schur = -dual - s + target / lam, G @ H @ G.T + 1e-14 * np.eye(len(G))
    da = np.linalg.lstsq(schur, -primal - G @ (H @ right), rcond=None)[0]
    dl = H @ (right + G.T @ da)
    return dl, da, target / lam - s - s / lam * dl


def _longest(x: np.ndarray, dx: np.ndarray) -> float:
    falling = dx < 0.0
    return float(min(1.0, (-x[falling] / dx[falling]).min(initial=1.0)))
